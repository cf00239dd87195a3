"""Flows whose viscosity follows from a closed form: waves of shear, bodies that turn, channels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado import Problem, Scene, Simulation
from cortado.forces import Body
from cortado.losses import CentreOfMass
from cortado.particles.state import State

KERNELS = {"cubic_spline": 2.0, "wendland_c2": 2.6, "wendland_c4": 3.0}
"""Their supports in spacings."""
SOLVERS = {
    "pcisph": {"kind": "pcisph", "density_tolerance": 0.001, "maximum_iterations": 10},
    "projection": {"kind": "projection"},
}
NU = 0.1
"""Kinematic viscosity [m2/s]."""
DENSITY = 1000.0
VISCOSITY = DENSITY * NU
"""[Pa s]"""


def simulation(
    upper: Sequence[float],
    spacing: float,
    kernel: str = "cubic_spline",
    form: str = "stress",
    own: Sequence[Body] = (),
    **tables: Any,
) -> Simulation:
    """Of a box of fluid from 0 to ``upper``, periodic and without pressure if nothing else is said, in float64."""
    box = {"shape": "box", "lower": [0.0] * len(upper), "upper": list(upper)}
    forces = {"gravity": [0.0] * len(upper), "viscosity": form, "pressure": False, **tables.pop("forces", {})}
    walls = tables.pop("container", {})
    container = walls if "shape" in walls else {**box, "periodic": [True] * len(upper), **walls}
    given: dict[str, Any] = {
        "dimension": len(upper),
        "discretisation": {"spacing": spacing, "kernel": kernel, "support": KERNELS[kernel]},
        "phase": [{"name": "fluid", "rest_density": DENSITY, "viscosity": VISCOSITY}],
        "fluid": [{**box, "phase": "fluid"}],
        "container": container,
        "forces": forces,
        "solver": {"kind": "pcisph", "time_step": 0.05 * spacing**2 / NU},
    }
    return Simulation(Scene(**given | tables), precision="float64", forces=own)


# ---- waves of shear ----------------------------------------------------------------------------------------------
def disordered(one: Simulation, disorder: float | None) -> np.ndarray:
    """Positions (n, d) [m] of the particles of a periodic box: those of the lattice, each coordinate changed by up to
    ``disorder`` spacings, or, if that is None, those of fluid without viscosity that was stirred for 60 steps."""
    scene, random = one.scene, np.random.default_rng(3)
    spacing, lengths = scene.discretisation.spacing, np.array(scene.container.upper)
    if disorder is not None:
        return (one.positions + disorder * spacing * random.uniform(-1.0, 1.0, one.positions.shape)) % lengths
    forces = {"viscosity": "none", "pressure": True, "gravity": [0.0] * scene.dimension}
    stirred = Simulation(
        Scene(**scene.model_dump() | {"forces": forces, "solver": {"kind": "pcisph", "time_step": 0.05 * spacing}}),
        precision="float64",
    )
    v = random.uniform(-1.0, 1.0, one.positions.shape)
    return stirred.step(stirred.state({"initial_velocities": v}), {}, steps=60)["positions"] % lengths


def viscosity_of_wave(one: Simulation, x: np.ndarray, wave: Sequence[int], along: Sequence[float]) -> float:
    """Over the one asked for, of particles at ``x`` (n, d) [m] in a box of 1 m, in which there are so many periods of a
    wave along its axes, with velocities ``along``."""
    k, direction = 2.0 * np.pi * np.array(wave, float), np.array(along) / np.linalg.norm(along)
    assert abs(k @ direction) < 1e-12  # shear
    v = np.sin(x @ k)[:, None] * direction
    return float(-(acceleration(one, x, v) * v).sum() / (v * v).sum() / (k @ k) / NU)


def acceleration(one: Simulation, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, d) [m/s2] by the viscous force."""
    after = one.step(one.state({"initial_positions": x, "initial_velocities": v}), {}, steps=1)
    return (after["velocities"] - v) / one.scene.solver.time_step


# ---- bodies that turn --------------------------------------------------------------------------------------------
def turning(dimension: int, across: int, form: str = "stress", pressure: bool = False, time: float = 2.0) -> np.ndarray:
    """(11,) the angular momentum over the first, at equal times, of a disc or ball of 1 m that turns with 0.1 rad/s
    in empty space. Without pressure its particles fly straight on, which takes them 1.02 times as far apart."""
    middle = [0.0] * dimension
    ball = {"shape": "sphere", "centre": middle, "radius": 0.5, "phase": "fluid"}
    tables = {"fluid": [ball], "container": {"shape": "none"}, "forces": {"pressure": pressure}}
    one = simulation(middle, 1.0 / across, form=form, **tables)
    steps = int(np.ceil(time / one.scene.solver.time_step / 10))
    x = one.positions
    v = np.zeros_like(x)
    v[:, :2] = 0.1 * np.column_stack([-x[:, 1], x[:, 0]])
    state, found = one.state({"initial_velocities": v}), []
    for k in range(11):
        x, v = state["positions"], state["velocities"]
        found.append((x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum())
        state = one.step(state, {}, steps=steps) if k < 10 else state
    return np.array(found) / found[0]


# ---- channels ----------------------------------------------------------------------------------------------------
def band(x: Any, v: Any, t: Any, push: Any, low: Any, high: Any) -> Any:
    """A force along x in a band of y."""
    return wp.vec3(wp.where(x[1] > low and x[1] < high, push, 0.0), 0.0, 0.0)


@dataclass(frozen=True)
class Channel:
    """Fluid between plates without slip, 1 m apart, that is pushed along x in a band of y: all of it (Poiseuille), or
    the middle tenth, beside which the shear is the same everywhere (Couette). It starts with the flow of the closed
    form and goes on for a time; after 0.3 of the one that momentum needs to cross it 5 % of a disturbance are left."""

    across: int
    reynolds: float
    """Of the mean velocity and the width."""
    low: float = 0.0
    """Where the band begins; it ends as far from the other plate."""
    kernel: str = "cubic_spline"
    form: str = "stress"
    pressure: bool = True
    solver: str = "pcisph"
    time: float = 0.3 / NU
    """[s]"""
    apart: float = 0.0
    """By how much of itself the viscosity is changed to both sides for the slope; without, a tangent gives it."""

    def series(self) -> tuple[np.ndarray, np.ndarray]:
        """Odd numbers n, and the amplitudes of sin(n pi y) [m/s] of the flow at last, for a push of 1 m/s2."""
        n = 2.0 * np.arange(2000) + 1.0
        push = 4.0 * np.cos(n * np.pi * self.low) / (n * np.pi)
        return n, push / (NU * n**2 * np.pi**2)

    @property
    def push(self) -> float:
        """[m/s2]"""
        n, amplitudes = self.series()
        return self.reynolds * NU / float((amplitudes * 2.0 / (n * np.pi)).sum())

    def exact(self, y: np.ndarray) -> np.ndarray:
        """Velocities [m/s]."""
        n, amplitudes = self.series()
        return self.push * (amplitudes[:, None] * np.sin(n[:, None] * np.pi * y)).sum(axis=0)

    def exact_slope(self) -> float:
        """d Q / d mu at the end, of a flow that started with that of the closed form for the viscosity without change:
        minus the flow that starts from rest, over the viscosity."""
        n, amplitudes = self.series()
        grown = 1.0 - np.exp(-(n**2) * np.pi**2 * NU * self.time)
        return -self.push * float((amplitudes * grown * 2.0 / (n * np.pi)).sum()) / NU

    def run(self) -> dict[str, float]:
        """The mean velocity and its derivative by the viscosity over those of the closed forms, the greatest velocity
        across the channel over the mean, how far a particle moved across it, and by how much the two rows beside a wall
        slid past each other, both in spacings."""
        spacing, fastest = 1.0 / self.across, 2.0 * self.reynolds * NU
        step = min(0.09 * spacing**2 / NU, 0.2 * spacing / fastest)
        steps = int(np.ceil(self.time / step))
        tables = {"container": {"periodic": [True, False], "slip": "no"}, "forces": {"pressure": self.pressure}}
        tables["solver"] = {"kind": "pcisph", "time_step": self.time / steps, **SOLVERS[self.solver]}
        pushed = Body(band, push=self.push, low=self.low, high=1.0 - self.low)
        one = simulation([10.0 * spacing, 1.0], spacing, self.kernel, self.form, [pushed], **tables)
        y = one.positions[:, 1]
        v = np.column_stack([self.exact(y), np.zeros(len(y))])
        problem, dot = Problem(one, steps, CentreOfMass(np.zeros(2))), np.zeros(0)

        def observe(_: int, tangent: State) -> None:
            nonlocal dot
            dot = tangent.numpy(2)["velocities"]

        values = {"initial_velocities": v, "viscosity": VISCOSITY}
        end = problem.tangents(values, {"viscosity": DENSITY}, observe, [steps])[steps]
        slope = dot[:, 0].mean()
        if self.apart:
            ends = (problem.end({**values, "viscosity": VISCOSITY * (1.0 + h)}) for h in (self.apart, -self.apart))
            faster, slower = (end.state.numpy(2)["velocities"][:, 0].mean() for end in ends)
            slope = (faster - slower) / (2.0 * self.apart * NU)
        mean = self.reynolds * NU
        between = np.diff(self.exact(np.array([0.5, 1.5]) * spacing))[0]
        return {
            "flow": end.velocities[:, 0].mean() / mean,
            "slope": slope / self.exact_slope(),
            "across": np.abs(end.velocities[:, 1]).max() / mean,
            "moved": np.abs(end.positions[:, 1] - y).max() / spacing,
            "slid": float(between * self.time / spacing),
        }
