"""Experiments with known parameters, in the plane with some 125 particles and 20 steps, and noise that is correlated
within a frame and over time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.ndimage import gaussian_filter

import cortado
from cortado import measured

STEPS, TIME_STEP = 20, 0.005
CONTAINER = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.3], "slip": "no"}


@dataclass(frozen=True)
class Case:
    """An experiment with known parameters, and its noise."""

    experiment: measured.Experiment
    """Measured without noise."""
    true: dict[str, Any]
    start: dict[str, Any]
    bounds: dict[str, Any]
    shapes: dict[str, tuple[int, ...]]
    """Of a frame of each observation, for the noise."""
    sizes: dict[str, float]
    """Standard deviation of the noise of each observation."""
    kept: float = 0.5
    """Of the noise from frame to frame."""

    def noise(self, seed: int) -> dict[str, np.ndarray]:
        """(frames, m) of each observation; a different one for each seed."""
        random, each = np.random.default_rng(seed), self.experiment.observations.items()
        return {n: self.sizes[n] * correlated(random, len(one.times), self.shapes[n], self.kept) for n, one in each}

    def noisy(self, seed: int) -> measured.Experiment:
        """With noise."""
        each = self.experiment.observations
        return self.experiment.measured_again({n: each[n].measured + noise for n, noise in self.noise(seed).items()})


def correlated(random: np.random.Generator, frames: int, shape: tuple[int, ...], kept: float) -> np.ndarray:
    """(frames, m) noise of standard deviation 1: of a picture, blurred over two pixels, with light that flickers as a
    whole; it fades by a factor ``kept`` from frame to frame."""
    fresh = random.standard_normal((frames, *shape))
    if len(shape) == 3:
        fresh = np.stack([gaussian_filter(one, (2, 2, 0), mode="wrap") for one in fresh])
        fresh = 0.9 * fresh / fresh.std() + np.sqrt(0.19) * random.standard_normal((frames, 1, 1, 1))
    for f in range(1, frames):
        fresh[f] = kept * fresh[f - 1] + np.sqrt(1.0 - kept**2) * fresh[f]
    return fresh.reshape(frames, -1)


def two_fluids(viscosity: float, spacing: float = 0.02, **solver: Any) -> cortado.Simulation:
    """Syrup beside a lighter syrup."""
    fluids = [("heavy", 1300.0, [0.45, 0.12, 0.03], 0.0), ("light", 1000.0, [0.1, 0.3, 0.8], 0.1)]
    tables: dict[str, Any] = {
        "dimension": 2,
        "discretisation": {"spacing": spacing},
        "phase": [{"name": n, "rest_density": d, "viscosity": viscosity, "colour": c} for n, d, c, _ in fluids],
        "fluid": [{"shape": "box", "lower": [x, 0.0], "upper": [x + 0.1, 0.26], "phase": n} for n, _, _, x in fluids],
        "container": CONTAINER,
        "forces": {"gravity": [0.0, -9.81], "viscosity": "stress"},
        "solver": solver
        or {"kind": "pcisph", "time_step": TIME_STEP, "minimum_iterations": 4, "maximum_iterations": 4},
    }
    return cortado.Simulation(cortado.Scene(**tables))


def video(frames: int = 8) -> Case:
    """The viscosity of one of two fluids, and how much lighter it is, from a video."""
    simulation = two_fluids(2.0)
    renderer = simulation.renderer(resolution=(24, 18))
    times = TIME_STEP * np.linspace(STEPS / frames, STEPS, frames)
    blank = np.zeros((frames, *renderer.shape))
    true = {"viscosity": [2.0, 2.0], "rest_density": [1300.0, 1000.0]}
    start = {"viscosity": [2.0, 3.0], "rest_density": [1300.0, 1100.0]}
    bounds = {"rest_density": ([1300.0, 500.0], [1300.0, 2000.0]), "viscosity": ([2.0, 0.1], [2.0, 50.0])}
    experiment = measured.Experiment(simulation, {"camera": measured.Video(renderer, times, blank)})
    experiment = experiment.measured_again(experiment.predicted(true))
    return Case(experiment, true, start, bounds, {"camera": renderer.shape}, {"camera": 0.03})


def force() -> Case:
    """A viscosity, from the force on the walls."""
    simulation = two_fluids(2.0)
    times = TIME_STEP * np.arange(1.0, STEPS + 1.0)
    scales = cortado.measured.SensorSeries(cortado.sensors.WallForce(), times, 0.0 * times, 2, columns=["force_y"])
    true, start = {"viscosity": [2.0, 2.0]}, {"viscosity": [1.2, 2.0]}
    experiment = measured.Experiment(simulation, {"scales": scales})
    experiment = experiment.measured_again(experiment.predicted(true))
    bounds = {"viscosity": ([0.1, 2.0], [10.0, 2.0])}
    return Case(experiment, true, start, bounds, {"scales": (1,)}, {"scales": 2.0}, kept=0.3)


def drop() -> Case:
    """The surface tension of a drop that is drawn out, from tracers in it."""
    tables: dict[str, Any] = {
        "dimension": 2,
        "discretisation": {"spacing": 0.002},
        "phase": [{"name": "oil", "rest_density": 900.0, "viscosity": 0.1}],
        "fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.036, 0.014], "phase": "oil"}],
        "container": {"shape": "none"},
        "forces": {"gravity": [0.0, 0.0], "viscosity": "stress", "surface_tension": 0.05},
        "solver": {"kind": "pcisph", "time_step": 0.0008, "minimum_iterations": 4, "maximum_iterations": 4},
    }
    simulation = cortado.Simulation(cortado.Scene(**tables))
    first, times = simulation.positions[::6], 0.0008 * np.linspace(2, STEPS, 10)
    tracks = measured.Tracks(simulation, first, times, np.zeros((len(times), *first.shape)))
    true, start = {"surface_tension": 0.05, "viscosity": 0.1}, {"surface_tension": 0.04, "viscosity": 0.13}
    experiment = measured.Experiment(simulation, {"tracers": tracks})
    experiment = experiment.measured_again(experiment.predicted(true))
    return Case(experiment, true, start, {}, {"tracers": first.shape}, {"tracers": 2e-6})


CaseName = Literal["video", "force", "drop"]
CASES: dict[CaseName, Callable[[], Case]] = {"video": video, "force": force, "drop": drop}
