"""Scenes that the tests share."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import FinalPositions
from cortado.scene.stability import stability_limits


def simulated(scene: Scene, precision: str = "float64") -> Simulation:
    """The simulation of a scene, which tests of this process share, with its walls, its graphs and its kernels: a run
    changes nothing of it."""
    return _simulated(scene.to_json(), precision)


@cache
def _simulated(text: str, precision: str) -> Simulation:
    return Simulation(Scene.from_json(text), precision=precision)


def box(lower: Sequence[float], upper: Sequence[float], **more: Any) -> dict[str, Any]:
    """The table of a box: of fluid, of a container, or of a solid, by what else it says."""
    return {"shape": "box", "lower": lower, "upper": upper, **more}


def pool(upper: Sequence[float], room: Sequence[float], spacing: float = 0.05, viscosity: float = 0.001, **tables: Any):
    """Water from a corner of a box up to ``upper``, in a box up to ``room`` [m], with tables that replace its own."""
    corner = [0.0] * len(room)
    own = {
        "dimension": len(room),
        "discretisation": {"spacing": spacing},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": viscosity}],
        "fluid": [box(corner, upper, phase="water")],
        "container": box(corner, room),
        "solver": {"kind": "projection", "time_step": 0.001},
    }
    return Scene(**{**own, **tables})


def bodies(
    dimension: int, fluid: Sequence[dict[str, Any]], container: dict[str, Any] | None = None, spacing: float = 0.05,
    viscosity: float = 0.0, **tables: Any,
) -> Scene:  # fmt: skip
    """Bodies of water, if nothing else is said, in a container if there is one, with tables that replace its own."""
    own = {
        "dimension": dimension,
        "discretisation": {"spacing": spacing},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": viscosity}],
        "fluid": [{"phase": "water", **body} for body in fluid],
        "solver": {"kind": "pcisph", "time_step": 1e-4},
    }
    return Scene(**own | ({} if container is None else {"container": container}) | tables)


def pool_text(
    upper: Sequence[float],
    room: Sequence[float],
    solver: str,
    spacing: float = 0.05,
    viscosity: float = 1.0,
    lower: Sequence[float] = (0.0, 0.0),
) -> str:
    """The text of a scene file in the plane: a box of water in a box, which ends with the keys of its [solver]."""
    return f"""
dimension = 2
discretisation = {{ spacing = {spacing} }}
phase = [{{ name = "water", rest_density = 1000.0, viscosity = {viscosity} }}]
fluid = [{{ shape = "box", lower = {list(lower)}, upper = {upper}, phase = "water" }}]
container = {{ shape = "box", lower = [0.0, 0.0], upper = {room} }}
[solver]
{solver}
"""


def splash(**solver: Any) -> Scene:
    """125 particles that fall from rest and splash in a box (the report's gradient analysis)."""
    block = {"shape": "box", "lower": [0.0, 0.3, 0.0], "upper": [0.25, 0.55, 0.25], "phase": "water"}
    fixed = {} if "kind" in solver else {"minimum_iterations": 5, "maximum_iterations": 5}
    return scene(name="splash", fluid=[block], solver={"kind": "pcisph", "time_step": 0.0021, **fixed, **solver})


C2 = {"spacing": 0.05, "support": 2.6, "kernel": "wendland_c2"}
CUBIC = {"spacing": 0.05, "support": 2.0, "kernel": "cubic_spline"}


def scene(**changes: Any) -> Scene:
    """125 particles that collapse from rest on the floor of a box, by PCISPH, with tables replaced. The projection has
    the smoothing kernel that it has where none is given, so that fewer modules are compiled."""
    tables: dict[str, Any] = {
        "name": "collapse",
        "dimension": 3,
        "discretisation": CUBIC,
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
        "fluid": [{"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.25, 0.25, 0.25], "phase": "water"}],
        "container": {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.4, 0.6, 0.25]},
        "forces": {"gravity": [0.0, -9.81, 0.0], "viscosity": "pairwise", "pressure": True},
        "solver": {
            "kind": "pcisph",
            "time_step": 0.0021,
            "minimum_iterations": 5,
            "maximum_iterations": 5,
            "density_tolerance": 0.01,
        },
    }
    tables |= changes
    tables["solver"] = {"kind": "pcisph", **tables["solver"]}
    if tables["solver"]["kind"] == "projection":
        tables["discretisation"] = changes.get("discretisation", C2)
        if "forces" not in changes:
            tables["forces"] = {**tables["forces"], "viscosity": "stress"}  # the only one that it has
    return Scene(**tables)


def plane(**changes: Any) -> Scene:
    """The same in two dimensions: 8 x 8 particles."""
    tables: dict[str, Any] = {
        "dimension": 2,
        "fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water"}],
        "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8]},
        "forces": {"gravity": [0.0, -9.81]},
    }
    return scene(**{**tables, **changes})


OIL = {"name": "oil", "rest_density": 1800.0, "viscosity": 0.4}
HONEY = {"name": "honey", "rest_density": 1300.0, "viscosity": 2.0}
MIXING = {"mobility": 0.1, "mobility_form": "degenerate", "interface_width": 0.04, "strength": 1.0}


def two_layers(**changes: Any) -> Scene:
    """The collapse, with a heavier and stickier fluid in the upper layers, which diffuses into the lower one."""
    blocks = [
        {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.25, 0.15, 0.25], "phase": "water"},
        {"shape": "box", "lower": [0.0, 0.15, 0.0], "upper": [0.25, 0.25, 0.25], "phase": "oil"},
    ]
    phases = [scene().phase[0].model_dump(), OIL]
    return scene(**{"name": "two layers", "phase": phases, "fluid": blocks, "mixture": MIXING, **changes})


def plane_of_three(**changes: Any) -> Scene:
    """Three fluids side by side in two dimensions: 8 x 8 particles, 24 of each but the last."""
    blocks = [
        {"shape": "box", "lower": [x, 0.0], "upper": [min(x + 0.15, 0.4), 0.4], "phase": name}
        for x, name in ((0.0, "water"), (0.15, "oil"), (0.3, "honey"))
    ]
    phases = [scene().phase[0].model_dump(), OIL, HONEY]
    mixture = {**MIXING, "mobility": 0.03, "mobility_form": "constant"}
    return plane(**{"name": "plane of three", "phase": phases, "fluid": blocks, "mixture": mixture, **changes})


def jet(path: Any = None, **changes: Any) -> Scene:
    """In the plane: 3 particles abreast shot into a pool of 48, from a nozzle that may move along a path."""
    slot = {"phase": "water", "outlet": [0.3, 0.26], "radius": 0.075, "length": 0.3, "flow_rate": 0.3, "path": path}
    pool = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.2], "phase": "water"}
    room = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.8]}
    return plane(**{"name": "jet", "fluid": [pool], "container": room, "emitter": [slot], **changes})


def pour(**changes: Any) -> Scene:
    """Oil that is poured aslant on water and mixes with it, 4 particles in a layer."""
    outlet = {"outlet": [0.09, 0.17, 0.12], "direction": [0.3, -1.0, 0.1]}
    nozzle = {"phase": "oil", "radius": 0.06, "length": 0.2, "flow_rate": 0.015, **outlet}
    pool = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.25, 0.1, 0.25], "phase": "water"}
    room = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [0.25, 0.5, 0.25]}
    phases = [scene().phase[0].model_dump(), OIL]
    tables = {"name": "pour", "phase": phases, "fluid": [pool], "container": room, "mixture": MIXING}
    return scene(**{**tables, "emitter": [nozzle], **changes})


def scatter(positions: np.ndarray, spacing: float) -> None:
    """Move particles to where the stress has corners: the lowest four close to the floor or behind it, and the last
    three away from the others."""
    positions[np.argsort(positions[:, 1])[:4], 1] = spacing * np.array([-0.1, 0.05, 0.15, 0.35])
    positions[-3:, 1] += 3 * spacing


def thrown(simulation):
    """Positions and velocities of a state with scatter in both."""
    random, x, v = np.random.default_rng(3), simulation.positions, simulation.velocities
    spacing = simulation.scene.discretisation.spacing
    inwards = 0.02 * spacing + 0.1 * spacing * random.random(x.shape)
    return {"initial_positions": x + inwards, "initial_velocities": v + 0.5 * random.standard_normal(v.shape)}


class Weighed:
    """A linear loss of positions, velocities, fractions, and how solids lie and move, with random weights."""

    def __init__(self, simulation: Simulation, seed: int = 8):
        random, state = np.random.default_rng(seed), simulation.state()
        solids = {solid.name for solid in simulation.scene.solid}
        names = ["positions", "velocities", "mass_fractions"]
        names += [name for name in state.fields if name.split(".")[0] in solids]
        self.weights = {name: random.standard_normal(state[name].shape) for name in names}

    def value(self, end: Any) -> float:
        return sum(float((weights * end[name]).sum()) for name, weights in self.weights.items())

    def adjoint(self, end: Any) -> dict[str, np.ndarray]:
        return self.weights


class Squares:
    """A loss: the sum of weights times the squares of fields and quantities, by their names."""

    def __init__(self, weights: Mapping[str, Any]):
        self.weights = weights

    def value(self, end: Any) -> float:
        return sum(float((weights * end[name] ** 2).sum()) for name, weights in self.weights.items())

    def adjoint(self, end: Any) -> dict[str, np.ndarray]:
        return {name: 2.0 * weights * end[name] for name, weights in self.weights.items()}


def aimed(simulation: Simulation, steps: int) -> Problem:
    """A problem that is solved where each particle has gone by 0.02 sin(7 x)."""
    return Problem(simulation, steps, FinalPositions(simulation.positions + 0.02 * np.sin(7.0 * simulation.positions)))


def stability_limit(scene: Scene) -> float:
    """The smallest of the limits of a scene's time step [s], infinite if nothing moves."""
    return min(stability_limits(scene).values())
