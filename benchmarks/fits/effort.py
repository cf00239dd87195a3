"""What a fit of a video costs beside a search by L-BFGS-B, in forward runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np
from scipy.optimize import minimize

import cortado
from cortado import measured
from cortado.errors import DivergedError
from cortado.optimisation.fitting.gauss_newton import next_point, search
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, Weighting

from .cases import STEPS, TIME_STEP, video

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
        self.note(u)  # a trial point is known before it is run
        return super().residuals(u)

    def note(self, u: np.ndarray) -> None:
        """That this is where the search is now."""
        self.reached.append((self.runs + self.tangents * self.costs.tangent, u.copy()))


class Searches:
    """The sum of squares of one noisy video, by a search of ours and by L-BFGS-B."""

    def __init__(self, seed: int):
        self.case = video(frames=10)
        noisy = self.case.noisy(seed)
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
        """By our search alone, without the tangents at its end."""
        traced = Traced(self.experiment, coordinates, costs)
        traced.note(search(traced, traced.estimated(coordinates.start), self.weights, 12, 0.0).next)
        return traced.reached

    def by_lbfgs(self, coordinates: Coordinates, costs: Costs) -> list[Reached]:
        """By L-BFGS-B of SciPy, with our reverse gradient and the same coordinates, to its end."""
        reached = list[Reached]()
        free = coordinates.free

        def value_and_gradient(u: np.ndarray) -> tuple[float, np.ndarray]:
            reached.append(((len(reached) + 1) * costs.gradient, u.copy()))
            try:
                loss, gradient = self.problem.value_and_gradient(coordinates.values(u))
            except DivergedError:  # far off: the line search comes back
                return 1e9, np.zeros(len(u))
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
            try:
                return problem.sum_of_squares(problem.residuals(u), self.weights)
            except DivergedError:
                return np.inf

        near = (cost for cost, u in reached if (np.abs(u - best) <= 0.1 * error).all())
        last = (cost for cost, u in reached if squares(u) <= squares(best) * (1.0 + 1e-6))
        return next(near, np.nan), next(last, np.nan)


def cost_beside_search(seed: int) -> str:
    """A table in Markdown."""
    one, text = Searches(seed), list[str]()
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
        u, _ = next_point(problem, problem.linearised(u), weights)
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
