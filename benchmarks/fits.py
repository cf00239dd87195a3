"""``python -m benchmarks.fits``: how often error bars hold the truth, what a fit costs beside a search, and what it
says of a wrong model.

Each experiment is simulated with known parameters, in the plane with some 125 particles and 20 steps; noise that is
correlated within a frame and over time is added, again and again, and fitted each time. What is done is kept in --out,
a line for each fit, and the next call goes on after it.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from tyro.extras import SubcommandApp

import cortado
from cortado import measured
from cortado.cli.command import Work, command
from cortado.cli.parsing import Program
from cortado.cli.process import main
from cortado.optimisation.fitting.fitted import Fit
from cortado.optimisation.transforms import Logarithm, Transformed

STEPS, TIME_STEP = 20, 0.005
CONTAINER = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.3], "slip": "no"}
app = SubcommandApp()
FITS = Program("python -m benchmarks.fits", app, "Measures how right error bars are.")


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

    def noisy(self, seed: int) -> measured.Experiment:
        """With noise; a different one for each seed."""
        random = np.random.default_rng(seed)
        found = {}
        for name, one in self.experiment.observations.items():
            noise = correlated(random, len(one.times), self.shapes[name], self.kept)
            found[name] = one.measured + self.sizes[name] * noise
        return self.experiment.measured_again(found)


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
        "solver": solver or {"time_step": TIME_STEP, "minimum_iterations": 4, "maximum_iterations": 4},
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
        "solver": {"time_step": 0.0008, "minimum_iterations": 4, "maximum_iterations": 4},
    }
    simulation = cortado.Simulation(cortado.Scene(**tables))
    first, times = simulation.positions[::6], 0.0008 * np.linspace(2, STEPS, 10)
    tracks = measured.Tracks(simulation, first, times, np.zeros((len(times), *first.shape)))
    true, start = {"surface_tension": 0.05, "viscosity": 0.1}, {"surface_tension": 0.04, "viscosity": 0.13}
    experiment = measured.Experiment(simulation, {"tracers": tracks})
    experiment = experiment.measured_again(experiment.predicted(true))
    return Case(experiment, true, start, {}, {"tracers": first.shape}, {"tracers": 2e-6})


CASES = {"video": video, "force": force, "drop": drop}


def record(case: Case, fitted: Fit) -> dict[str, Any]:
    """Of one fit: by the label of each number, its error over its standard error, the same of the naive covariance, and
    whether each of the intervals holds the truth."""
    true = fitted.coordinates.vector(np.concatenate([np.ravel(case.true[name]) for name in fitted.coordinates.names]))
    lower, upper = (np.concatenate([np.ravel(p[k]) for p in fitted.intervals().values()]) for k in range(2))
    free, off = fitted.coordinates.free, fitted.u - true
    holds = (lower[free] <= fitted.coordinates.numbers(true)) & (fitted.coordinates.numbers(true) <= upper[free])
    naive = np.abs(off) <= 1.96 * np.sqrt(np.diag(fitted.naive_covariance))
    return {
        "labels": fitted.labels,
        "off": off.tolist(),
        "error": np.sqrt(np.diag(fitted.coordinate_covariance)).tolist(),
        "holds": holds.tolist(),
        "naive_holds": naive.tolist(),
        "naive_error": np.sqrt(np.diag(fitted.naive_covariance)).tolist(),
        "doubts": len(fitted.doubts),
        "runs": fitted.runs,
        "tangents": fitted.tangents,
    }


def cover(case: str, runs: int, out: Path) -> str:
    """A table of how many intervals held the truth."""
    out.mkdir(parents=True, exist_ok=True)
    path, made = out / f"{case}.jsonl", CASES[case]()
    done = path.read_text().splitlines() if path.exists() else []
    for seed in range(len(done), runs):
        fitted = cortado.fit(made.noisy(seed), made.start, made.bounds)
        line = json.dumps(record(made, fitted))
        with path.open("a") as file:
            file.write(line + "\n")
        done.append(line)
    rows = [json.loads(line) for line in done[:runs]]
    text = [f"{case}: {len(rows)} fits; of them {sum(row['doubts'] > 0 for row in rows)} doubt the model"]
    for k, label in enumerate(rows[0]["labels"]):
        holds, naive = (100 * np.mean([row[key][k] for row in rows]) for key in ("holds", "naive_holds"))
        spread = np.std([row["off"][k] for row in rows])
        error, small = (np.median([row[key][k] for row in rows]) for key in ("error", "naive_error"))
        bias = np.mean([row["off"][k] for row in rows])
        text.append(
            f"  {label}: {holds:.1f} % of the 95 % intervals hold the truth, {naive:.1f} % of the naive ones; scatter "
            f"{spread:.3g}, standard error {error:.3g}, naive {small:.3g}; bias {bias:.2g}"
        )
    return "\n".join(text)


def cost_beside_search(evaluations: int) -> str:
    """The fit of a noisy video beside a search of its plain sum of squares by L-BFGS."""
    case = video()
    experiment, simulation = case.noisy(0), case.experiment.simulation
    names = list(case.true)
    at = {name: np.array(value, dtype=np.float64) for name, value in case.true.items()}
    one, along = experiment.observations["camera"], {"viscosity": np.array([0.0, 1.0])}
    frames = one.measured.reshape(-1, *one.renderer.shape)
    steps = np.rint(one.times / TIME_STEP).astype(int)
    losses = {
        int(k): cortado.losses.Image(one.renderer, np.maximum(f, 0.0)) for k, f in zip(steps, frames, strict=True)
    }
    problem = cortado.Problem(simulation, STEPS, cortado.losses.Frames(losses))
    forward = _seconds(lambda: experiment.predicted(at))
    tangent = _seconds(lambda: experiment.linearised(at, [along])) / forward
    gradient = _seconds(lambda: problem.value_and_gradient(at)) / forward
    fitted = cortado.fit(experiment, case.start, case.bounds)
    search = Transformed(problem, {name: Logarithm() for name in names})
    start = search.coordinate({name: np.array(value, dtype=np.float64) for name, value in case.start.items()})
    bounds = {name: tuple(np.log(end) for end in pair) for name, pair in case.bounds.items()}
    found = cortado.optimise(search, start, "lbfgs", scale=0.3, iterations=evaluations, bounds=bounds)
    needed = next(k for k, r in enumerate(found.history, 1) if r.loss <= found.loss * (1.0 + 1e-6))
    own = fitted.runs - fitted.tangents + fitted.tangents * tangent
    return (
        f"A run with a tangent costs as much as {tangent:.2g} forward runs, one with a gradient {gradient:.2g}.\n"
        f"The fit: {fitted.runs - fitted.tangents} forward runs and {fitted.tangents} with a tangent, as much as "
        f"{own:.0f} forward runs.\n"
        f"L-BFGS: {needed} gradients until the loss was within 1e-6 of the least, {len(found.history)} until it ended: "
        f"as much as {needed * gradient:.0f} and {len(found.history) * gradient:.0f} forward runs.\n"
        f"The fit needed {own / (needed * gradient):.2g} of that."
    )


def _seconds(work: Callable[[], Any]) -> float:
    """Of the processor: median of five, after two that compile and capture."""
    work()
    work()
    times = []
    for _ in range(5):
        begin = process_time()
        work()
        times.append(process_time() - begin)
    return float(np.median(times))


def of_another_model() -> str:
    """A video that the other solver made, and one of a finer spacing, fitted with PCISPH at the spacing 0.02 m."""
    case, text = video(), list[str]()
    makers = {
        "projection": two_fluids(2.0, kind="projection", time_step=TIME_STEP, iterations=16),
        "finer spacing": two_fluids(2.0, 0.0125, time_step=TIME_STEP, minimum_iterations=4, maximum_iterations=4),
    }
    one = case.experiment.observations["camera"]
    for name, made in makers.items():
        lens = made.renderer(resolution=(24, 18))
        seen = measured.Experiment(made, {"camera": measured.Video(lens, one.times, np.zeros((8, 18, 24, 3)))})
        clean = seen.predicted({"viscosity": np.array([2.0, 2.0])})["camera"]
        noise = case.sizes["camera"] * correlated(np.random.default_rng(0), 8, (18, 24, 3), case.kept)
        fitted = cortado.fit(case.experiment.measured_again({"camera": clean + noise}), case.start, case.bounds)
        text += [f"{name}:", *(f"  {line}" for line in str(fitted).splitlines())]
    return "\n".join(text)


@command(app, answers=True)
def effort(evaluations: int = 60) -> Work:
    """Fit a video, and search the same by L-BFGS: what do they cost, in forward runs?

    Args:
        evaluations: Updates of L-BFGS at most.
    """
    return partial(cost_beside_search, evaluations)


@command(app, answers=True)
def wrong() -> Work:
    """Fit videos of another solver and of a finer spacing: are the truths within the bars, or does the fit doubt?"""
    return of_another_model


@command(app, answers=True)
def coverage(case: str = "video", runs: int = 200, out: Path = Path("runs/fits")) -> Work:
    """Fit one experiment with many kinds of noise, and count how many intervals hold the truth.

    Args:
        case: "video", "force" or "drop".
        runs: Number of fits.
        out: Folder of what is done.
    """
    return partial(cover, case, runs, out)


if __name__ == "__main__":
    main(program=FITS)
