"""Phases that separate and mix on particles at rest, against closed forms; `validation/README.md` says what was found.

Lengths are in spacings, and M = alpha = 1: an interface is 4.39 epsilon wide, what grows fastest from an even mixture
is 4 pi epsilon long, and takes 16 epsilon^2 to grow by e. The equations are those of `cortado.sph.free_energy`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cortado import Scene, Simulation, Trajectory
from cortado.discretise.smoothing import shear_factor
from cortado.scene.parameter_values import reference_density


def resting(
    columns: int,
    rows: int,
    width: float,
    support: float = 2.0,
    densities: tuple[float, ...] = (1000.0, 1000.0),
    device: str = "cpu",
    **mixture: Any,
) -> Simulation:
    """Particles that stay where they are, a spacing of 1 apart in a periodic box; ``width`` is epsilon."""
    upper = [float(columns), float(rows)]
    scene = Scene(
        dimension=2,
        discretisation={"spacing": 1.0, "support": support, "kernel": "cubic_spline"},
        phase=[{"name": f"phase {k}", "rest_density": one, "viscosity": 0.0} for k, one in enumerate(densities)],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": upper, "phase": "phase 0"}],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": upper, "periodic": [True, True]},
        forces={"gravity": [0.0, 0.0], "viscosity": "none", "pressure": False},
        mixture={"mobility": 1.0, "mobility_form": "constant", "interface_width": width, **mixture},
        solver={"kind": "pcisph", "time_step": 1.0},
    )
    return Simulation(scene, device=device, precision="float64")


def run(simulation: Simulation, first: np.ndarray, until: float, steps: int = 1, **controls: Any) -> Trajectory:
    """From mass fractions ``first`` (n, phases), or those of the first of two phases (n,), in so many equal steps."""
    if first.ndim == 1:
        first = np.column_stack([first, 1.0 - first])
    return simulation.run(steps, {"mass_fractions": first, "time_step": until / steps, **controls})


def watched(
    simulation: Simulation, first: np.ndarray, until: float, steps: int, advance: Callable[[], None] | None = None
) -> np.ndarray:
    """The same, (steps + 1, n, phases) fractions only; ``advance`` is called after each step."""
    frames = [first]

    def observe(step: int, state: Any) -> None:
        frames.append(state.numpy(2)["mass_fractions"])
        if advance is not None:
            advance()

    controls = {"mass_fractions": first, "time_step": until / steps}
    simulation.rollout(steps, controls).forward(observe, keep=False)
    return np.array(frames)


def noise(simulation: Simulation, amplitude: float, seed: int) -> np.ndarray:
    """(n, phases) fractions around an even mixture, uniform within the amplitude for two phases; their means even."""
    particles, phases = simulation.mass_fractions.shape
    disturbed = np.random.default_rng(seed).uniform(-amplitude, amplitude, (particles, phases - 1))
    disturbed = np.column_stack([disturbed, -disturbed.sum(axis=1)])
    return 1.0 / phases + disturbed - disturbed.mean(axis=0)


@dataclass(frozen=True)
class Energy:
    """The discrete free energy of `cortado.sph.free_energy`, for particles (n, 2) at rest; in NumPy."""

    simulation: Simulation
    positions: np.ndarray
    masses: np.ndarray
    """(n,) [kg / m3]"""

    def __post_init__(self) -> None:
        lattice, box = self.simulation.solver.lattice, np.array(self.simulation.scene.container.upper)
        tree = cKDTree(np.mod(self.positions, box), boxsize=box)
        i, j = tree.query_pairs(lattice.support, output_type="ndarray").T
        separations = self.positions[i] - self.positions[j]
        separations -= box * np.round(separations / box)
        kernel, particles = self.simulation.smoothing, len(self.positions)
        weights = kernel.weight(np.linalg.norm(separations, axis=1), 2, lattice.support)
        n = np.bincount(i, weights, particles) + np.bincount(j, weights, particles) + lattice.self_weight
        n *= lattice.volume
        factors = lattice.laplacian_correction * shear_factor(kernel, separations, lattice.support)
        pairs = i, j, (self.masses[i] / n[j] + self.masses[j] / n[i]) * factors
        object.__setattr__(self, "_pairs", pairs)

    def __call__(self, fractions: np.ndarray) -> float:
        """Of mass fractions (n, phases), over the mass of all particles."""
        i, j, weights = self._pairs
        width, volume = self.simulation.scene.mixture.interface_width, self.simulation.solver.lattice.volume
        wells = self.masses @ self.simulation.free_energy.value(fractions)
        gradients = weights @ ((fractions[i] - fractions[j]) ** 2).sum(axis=1)
        return float((wells - 0.5 * width**2 * volume * gradients) / self.masses.sum())


# ---- an even mixture falls apart -------------------------------------------------------------------------------------
RATIOS = np.array([0.25, 0.5, 0.75, 1.0])
"""Wave numbers in that of the fastest growing wave, k* = 1 / (2 epsilon)."""


def growth(wavelength: int, substep: float | None = None) -> np.ndarray:
    """The growth rates of waves of `RATIOS`, in those of -k^2 (f'' + epsilon^2 k^2), f'' = -1 / 2.

    ``wavelength``: particles in the fastest growing wave. ``substep``: a time step shorter than the engine's substeps.
    """
    width = wavelength / (4.0 * np.pi)
    simulation = resting(4 * wavelength, 8, width)
    x, k = simulation.positions[:, 0], RATIOS / (2.0 * width)
    first = 0.5 + 2.5e-5 * np.cos(k * x[:, None] + np.arange(4)).sum(axis=1)
    until = 32.0 * width**2
    last = run(simulation, first, until, 4 if substep is None else int(np.ceil(until / substep))).mass_fractions[-1]
    waves = np.exp(-1j * k * x[:, None])
    size, first_size = (np.abs((c - 0.5) @ waves) for c in (last[:, 0], first))
    return np.log(size / first_size) / until / (k**2 * (0.5 - width**2 * k**2))


def test_an_even_mixture_falls_apart_as_fast_as_it_should():
    """Within 5 % for the fastest wave, within 10 % from a quarter of its wave number; better with more particles."""
    errors = np.abs([growth(wavelength) - 1.0 for wavelength in (8, 12, 16)])
    assert (errors[:, -1] < 0.05).all()
    assert (errors < 0.1).all()
    assert (errors[1:] < 0.7 * errors[:-1]).all()


# ---- an interface ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Interface:
    """Two interfaces across a periodic box, after they have settled."""

    distances: np.ndarray
    """(n,) from the nearest one, negative in the first phase [epsilon]"""
    fractions: np.ndarray
    """(n,) of the first phase"""

    @staticmethod
    def exact(distances: np.ndarray) -> np.ndarray:
        """(n,) (1 - tanh(x / (2 epsilon))) / 2"""
        return 0.5 * (1.0 - np.tanh(0.5 * distances))

    @property
    def error(self) -> float:
        """Root mean square within the distance of 4.39 epsilon."""
        near = np.abs(self.distances) < 4.39
        return float(np.sqrt(np.mean((self.fractions - self.exact(self.distances))[near] ** 2)))


def interface(wavelength: int) -> Interface:
    """From a profile half again as wide as it should be, over 200 epsilon^2."""
    width = wavelength / (4.0 * np.pi)
    simulation = resting(3 * wavelength, 8, width)
    middle = 1.5 * wavelength
    distances = (np.abs(simulation.positions[:, 0] - middle) - 0.5 * middle) / width
    last = run(simulation, Interface.exact(distances / 1.5), 200.0 * width**2, steps=50).mass_fractions[-1]
    return Interface(distances, last[:, 0])


def test_an_interface_is_as_wide_as_it_should_be():
    """Within 2 % of the exact profile (RMS), and better with more particles."""
    errors = [interface(wavelength).error for wavelength in (8, 12)]
    assert errors[1] < 0.5 * errors[0] < 0.5 * 0.02


# ---- miscible phases mix ---------------------------------------------------------------------------------------------
def mixing(wavelength: int, steps: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """2 k^2 t, and the variance of a wave of 0.2 in that of the start, which is to be exp(-2 k^2 t)."""
    simulation = resting(2 * wavelength, 8, width=1e-6, free_energy="miscible")
    k = 2.0 * np.pi / wavelength
    first = 0.5 + 0.2 * np.cos(k * simulation.positions[:, 0])
    trajectory = run(simulation, first, 0.5 / k**2, steps)
    variance = trajectory.mass_fractions[:, :, 0].var(axis=1)
    return 2.0 * k**2 * trajectory.times, variance / variance[0]


def test_miscible_phases_mix_as_fast_as_they_should():
    """Within 3 % of Fick's law with 12 particles in a wave, and better with more.

    In the engine's own substeps the error of an explicit step makes up for some of that of the lattice; 400 time steps
    leave little of it.
    """
    found = [mixing(wavelength, steps) for wavelength in (12, 16, 24) for steps in (1, 400)]
    errors = [abs(variance[-1] / np.exp(-times[-1]) - 1.0) for times, variance in found]
    assert max(errors) < 0.03
    lattice = errors[1::2]
    assert lattice[2] < 0.6 * lattice[1] < 0.4 * lattice[0]


# ---- what may not change, and what may not rise ----------------------------------------------------------------------
@pytest.mark.parametrize("form", ["constant", "degenerate"])
def test_the_free_energy_never_rises_and_phases_keep_their_mass(form):
    """On particles off the lattice, one phase 1.8 times as dense as the other, at every one of 1,000 substeps."""
    densities = (1000.0, 1800.0)
    simulation = resting(24, 24, 0.65, 3.0, densities, mobility_form=form)
    positions = simulation.positions + np.random.default_rng(1).uniform(-0.2, 0.2, simulation.positions.shape)
    first, steps = noise(simulation, 0.2, seed=2), 1000
    until = steps * (20.0 / simulation.run(1, {"time_step": 20.0}).substeps)  # about the longest substep
    trajectory = run(simulation, first, until, steps, initial_positions=positions)
    assert trajectory.substeps == 1
    np.testing.assert_array_equal(trajectory.positions[-1], positions)

    mass = reference_density(first, np.array(densities))
    energy = Energy(simulation, positions, mass)
    energies = np.array([energy(c) for c in trajectory.mass_fractions])
    assert (np.diff(energies) < 0.0).all()
    assert energies[-1] < 0.6 * energies[0]  # the phases have parted, as far as they touch

    phase_masses = mass @ trajectory.mass_fractions
    assert np.abs(phase_masses / phase_masses[0] - 1.0).max() < 1e-12
    assert np.abs(trajectory.mass_fractions.sum(axis=2) - 1.0).max() < 1e-12


# ---- coarsening ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Coarsening:
    """An even mixture of two phases that has parted, and goes on to have less and less interface."""

    times: np.ndarray
    """(frames,) [epsilon^2]"""
    energies: np.ndarray
    """(frames,) over the mass"""
    fractions: np.ndarray
    """(frames, n) of the first phase"""

    @property
    def lengths(self) -> np.ndarray:
        """(frames,) the average distance between interfaces, each with the energy epsilon / 3 [epsilon]."""
        return 1.0 / (3.0 * self.energies)

    def exponent(self, begin: float, end: float) -> float:
        """Of the power of the time that the lengths follow between two times [epsilon^2], all of log t alike."""
        moments = np.linspace(np.log(begin), np.log(end), 30)
        lengths = np.interp(moments, np.log(self.times[1:]), np.log(self.lengths[1:]))
        return float(np.polyfit(moments, lengths, 1)[0])


def coarsening(
    across: int,
    form: str,
    until: float,
    seed: int,
    steps: int,
    advance: Callable[[], None] | None = None,
    device: str = "cpu",
) -> Coarsening:
    """From noise of 5 % in a square, until so many epsilon^2."""
    simulation = resting(across, across, 0.65, 3.0, device=device, mobility_form=form)
    energy = Energy(simulation, simulation.positions, np.ones(simulation.particles))
    fractions = watched(simulation, noise(simulation, 0.05, seed), until * 0.65**2, steps, advance)
    times, energies = np.arange(steps + 1) * until / steps, np.array([energy(c) for c in fractions])
    return Coarsening(times, energies, fractions[:, :, 0])


def test_regions_grow_by_a_third_power_of_the_time():
    """With a constant mobility. A small and short run; `validation/mixture.py` has longer ones, and the degenerate
    mobility."""
    result = coarsening(96, "constant", until=1200.0, seed=1, steps=48)
    assert (np.diff(result.energies) < 0.0).all()
    assert 0.28 < result.exponent(200.0, 1200.0) < 0.38


# ---- more phases -----------------------------------------------------------------------------------------------------
def separating(
    phases: int, until: float, across: int = 32, steps: int = 20, advance: Callable[[], None] | None = None
) -> np.ndarray:
    """(steps + 1, n, phases) fractions that separate from noise, until so many epsilon^2."""
    width = 0.8
    simulation = resting(across, across, width, 3.0, (1000.0,) * phases)
    return watched(simulation, noise(simulation, 0.15 / (phases - 1), seed=3), until * width**2, steps, advance)


@pytest.mark.parametrize(("phases", "until"), [(3, 600.0), (4, 1000.0)])
def test_three_and_four_phases_part(phases, until):
    """Into regions of each; nothing is clipped, and no fraction is far outside of 0 to 1."""
    fractions = separating(phases, until)
    assert np.abs(fractions.sum(axis=2) - 1.0).max() < 1e-12
    assert fractions.min() > -0.05
    assert fractions.max() < 1.05
    pure = (fractions[-1] > 0.9).mean(axis=0)
    assert (pure > 0.2 / phases).all()
