"""``python -m benchmarks.fits``: how often error bars hold the truth, what a fit costs beside a search, and what it
says of a wrong model.

Each experiment is simulated with known parameters, in the plane with some 125 particles and 20 steps; noise that is
correlated within a frame and over time is added, again and again, and fitted each time. What is done is kept in --out,
a line for each fit, and the next call goes on after it.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize
from tyro.extras import SubcommandApp

import cortado
from cortado import measured
from cortado.cli.command import Work, command
from cortado.cli.parsing import Program
from cortado.cli.process import main
from cortado.optimisation.fitting.coordinates import Coordinates
from cortado.optimisation.fitting.fitted import Fit
from cortado.optimisation.fitting.least_squares import LeastSquares, Weighting
from cortado.optimisation.fitting.search import next_step, search

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


NUMBERS = (("viscosity", 1), ("rest_density", 1), ("viscosity", 0))
"""That are fitted, the first one, two or three of them."""
Reached = tuple[float, np.ndarray]
"""What was spent so far, in forward runs, and where the search was."""


@dataclass(frozen=True)
class Costs:
    """Of runs, beside a forward run."""

    tangent: float
    """Of each direction of a run along tangents, beside the run itself."""
    gradient: float
    """Of a run with a reverse gradient."""


class Traced(LeastSquares):
    """Notes what was spent when each point was reached."""

    def __init__(self, experiment: measured.Experiment, coordinates: Coordinates, costs: Costs):
        super().__init__([experiment], coordinates)
        self.costs, self.reached = costs, list[Reached]()

    def residuals(self, u: np.ndarray) -> list[np.ndarray]:
        found = super().residuals(u)
        self.note(u)
        return found

    def note(self, u: np.ndarray) -> None:
        """That this is where the search is now."""
        self.reached.append((self.runs + self.tangents * self.costs.tangent, u.copy()))


class Searches:
    """The sum of squares of one noisy video, by a search of ours and by L-BFGS-B."""

    def __init__(self) -> None:
        self.case = video(frames=10)
        noisy = self.case.noisy(0)
        camera = noisy.observations["camera"]
        light = np.maximum(camera.measured, 0.0)  # as losses of images refuse light below 0
        self.experiment = noisy.measured_again({"camera": light})
        frames, steps = light.reshape(-1, *camera.renderer.shape), np.rint(camera.times / TIME_STEP).astype(int)
        image = cortado.losses.Image
        losses = {int(k): image(camera.renderer, frame) for k, frame in zip(steps, frames, strict=True)}
        self.problem = cortado.Problem(self.case.experiment.simulation, STEPS, cortado.losses.Frames(losses))
        self.true = {name: np.array(value, dtype=np.float64) for name, value in self.case.true.items()}
        self.weights = [Weighting(self.case.sizes["camera"])]
        self.factor = frames[0].size / self.case.sizes["camera"] ** 2
        """From the loss, a sum of means over pixels, to the weighted sum of squares."""

    def costs(self) -> Costs:
        """Least times of the processor, taken in turn."""
        along = {"viscosity": np.array([0.0, 1.0])}, {"rest_density": np.array([0.0, 1.0])}
        works = [
            lambda: self.experiment.predicted(self.true),
            lambda: self.experiment.linearised(self.true, along),
            lambda: self.problem.value_and_gradient(self.true),
        ]
        forward, tangents, gradient = _seconds(works)
        return Costs((tangents / forward - 1.0) / len(along), gradient / forward)

    def coordinates(self, numbers: int, off: float) -> Coordinates:
        """With a start that is off by a factor, up and down in turn."""
        start, lower, upper = ({name: value.copy() for name, value in self.true.items()} for _ in range(3))
        for number, (name, phase) in enumerate(NUMBERS[:numbers]):
            start[name][phase] *= off if number % 2 == 0 else 1.0 / off
            lower[name][phase] /= 8.0
            upper[name][phase] *= 8.0
        return Coordinates.of(start, self.true, {name: (lower[name], upper[name]) for name in self.true})

    def ours(self, coordinates: Coordinates, costs: Costs) -> list[Reached]:
        """By our search alone, without the tangents at its end, and one trial point at a time."""
        traced = Traced(self.experiment, coordinates, costs)
        at = traced.estimated(coordinates.start)
        for _ in range(10):
            found = search(traced, at, self.weights, 1, 0.0)
            traced.note(np.clip(found.at.u + found.step.shift, *coordinates.bounds))  # known without a run
            at = found.at
        return traced.reached

    def by_lbfgs(self, coordinates: Coordinates, costs: Costs) -> list[Reached]:
        """By L-BFGS-B of SciPy, with our reverse gradient and the same coordinates, to its end."""
        reached = list[Reached]()
        free = coordinates.free

        def value_and_gradient(u: np.ndarray) -> tuple[float, np.ndarray]:
            reached.append(((len(reached) + 1) * costs.gradient, u.copy()))
            loss, gradient = self.problem.value_and_gradient(coordinates.values(u))
            slope = np.concatenate([gradient[name] for name in coordinates.names])[free] * coordinates.slopes(u)
            return self.factor * loss, self.factor * slope

        bounds = list(zip(*coordinates.bounds, strict=True))
        options = {"ftol": 1e-12, "gtol": 1e-3}
        minimize(value_and_gradient, coordinates.start, method="L-BFGS-B", jac=True, bounds=bounds, options=options)
        return reached

    def spent(
        self, reached: Sequence[Reached], problem: LeastSquares, best: np.ndarray, error: np.ndarray
    ) -> tuple[float, float]:
        """Until the estimate was within 0.1 standard errors, and the sum of squares within 1e-6 of the least."""

        def squares(u: np.ndarray) -> float:
            return problem.sum_of_squares(problem.residuals(u), self.weights)

        near = (cost for cost, u in reached if (np.abs(u - best) <= 0.1 * error).all())
        last = (cost for cost, u in reached if squares(u) <= squares(best) * (1.0 + 1e-6))
        return next(near, np.nan), next(last, np.nan)


def cost_beside_search() -> str:
    """A table in Markdown."""
    one, text = Searches(), list[str]()
    costs = one.costs()
    text += [
        f"In forward runs, each with its pictures: a direction of a tangent {costs.tangent:.2f} besides, a gradient "
        f"{costs.gradient:.2f}.",
        "",
        "| fitted | start off by | to 0.1 bars | to 1e-6 | L-BFGS-B to 0.1 bars | to 1e-6 | its evaluations | share of "
        "that to 0.1 bars | to 1e-6 | whole fit, with bars | share |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for numbers in (1, 2, 3):
        for off in (1.3, 2.0):
            coordinates = one.coordinates(numbers, off)
            start = coordinates.values(coordinates.start)
            bounds = {n: (p[0], p[1]) for n, p in zip(start, _pairs(coordinates), strict=True)}
            fitted = cortado.fit(one.experiment, start, bounds)
            whole = fitted.runs + fitted.tangents * costs.tangent
            problem = LeastSquares([one.experiment], coordinates)
            best = minimise(problem, fitted.u, one.weights)
            error = np.sqrt(np.diag(fitted.coordinate_covariance))
            ours, theirs = (
                one.spent(reached, problem, best, error)
                for reached in (one.ours(coordinates, costs), one.by_lbfgs(coordinates, costs))
            )
            cells = [*ours, *theirs, theirs[0] / costs.gradient, ours[0] / theirs[0], ours[1] / theirs[1]]
            cells += [whole, whole / theirs[0]]
            text.append(f"| {numbers} | {off:g} | {' | '.join(f'{cell:.3g}' for cell in cells)} |")
    return "\n".join(text)


def _pairs(coordinates: Coordinates) -> list[tuple[np.ndarray, np.ndarray]]:
    """Bounds of each parameter."""
    ends = [coordinates.named(end).values() for end in (coordinates.lower, coordinates.upper)]
    return list(zip(*ends, strict=True))


def minimise(problem: LeastSquares, u: np.ndarray, weights: Sequence[Weighting]) -> np.ndarray:
    """The least sum of squares, by Gauss and Newton with tangents at every point."""
    for _ in range(6):
        u = u + next_step(problem, problem.linearised(u), weights).shift
    return u


def _seconds(works: Sequence[Callable[[], Any]]) -> list[float]:
    """Of the processor: the least of ten, taken in turn, after two that compile and capture."""
    times = []
    for _ in range(12):
        row = []
        for work in works:
            begin = process_time()
            work()
            row.append(process_time() - begin)
        times.append(row)
    return list(np.min(times[2:], axis=0))


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
def effort() -> Work:
    """Fit a video, and search the same by L-BFGS-B: what do they cost, in forward runs?"""
    return cost_beside_search


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
