"""Compare derivatives of the loss by reverse mode, forward mode and finite differences, in float64."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cortado.calls import ShortRepr
from cortado.device.precision import FLOAT64
from cortado.errors import DivergedError
from cortado.gradients.estimator import NO_RUN
from cortado.losses import CentreOfMass, CentreOfMassAlong, FinalPositions, Frames, Image, SensorMatch
from cortado.losses.loss import Adjoint, Loss, Snapshot, SnapshotAdjoint, by_field, slope
from cortado.losses.run_losses import as_loss
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.render.renderer import Renderer
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation


def up_to(problem: Problem, steps: int) -> Problem | None:
    """Shorten a problem. Return None if no step, or no frame of a `Frames` loss, remains."""
    loss: Any = problem.loss
    if isinstance(loss, Frames):
        kept = {step: one for step, one in loss.losses.items() if step <= steps}
        loss = Frames(kept) if kept else None
    return Problem(problem.simulation, steps, loss, problem.memory_budget) if loss is not None and steps > 0 else None


def first_rows(problem: Problem, values: Arrays, steps: int) -> Arrays:
    """Cut parameters that vary over time to their values in the first ``steps`` steps."""
    known = problem.simulation.known
    over_time = {name for name, value in values.items() if name in known.over_time and value.ndim > known[name].rank}
    return {name: value[:steps] if name in over_time else value for name, value in values.items()}


ANY_PRECISION = (FinalPositions, CentreOfMass, CentreOfMassAlong, SensorMatch)
"""Loss classes that accept states in float32 and in float64."""


def in_float64(problem: Problem) -> Problem:
    """Return the problem in float64. A user-defined loss may need float32 and is wrapped in `Rounded`."""
    single = problem.simulation
    if single.precision == FLOAT64:
        return problem

    def double(loss: Any) -> Any:
        if isinstance(loss, Frames):
            return Frames({step: double(one) for step, one in loss.losses.items()})
        if type(loss) is Image and isinstance(loss.renderer, Renderer):
            return Image(loss.renderer.in_precision(FLOAT64), loss.target, loss.distance)
        return loss if type(loss) in ANY_PRECISION else Rounded(loss, single)

    return Problem(single.in_precision("float64"), problem.steps, double(problem.loss), 2 * problem.memory_budget)


class Rounded:
    """A wrapper that passes float64 states to a loss as float32."""

    def __init__(self, loss: Any, single: Simulation):
        self._loss, self._single = as_loss(loss), single

    def value(self, end: Snapshot) -> float:
        return self._loss.value(self._rounded(end))

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        value, bar = self._loss.value_and_adjoint(self._rounded(end))
        if not isinstance(bar, (State, SnapshotAdjoint)):
            return value, bar
        state = end.state.like()
        state.set(by_field(bar, end.dimension))
        return value, SnapshotAdjoint(state, bar.colours) if isinstance(bar, SnapshotAdjoint) else state

    def _rounded(self, end: Snapshot) -> Snapshot:
        state = self._single.solver.new_state()
        state.set(end.state.numpy(end.dimension))
        if end.moment is None:
            return Snapshot(state, end.dimension, end.colours)
        single = replace(end.moment, state=state, evaluator=self._single.evaluator, _values={})
        return Snapshot(state, end.dimension, end.colours, single)


SAMPLE_STEPS = 25
ROUGH = (1e-1, 1e-2, 1e-3)
"""Step sizes of the central differences of a float32 loss, as multiples of the direction."""
FLOAT32_ROUND_OFF = 1e-6
ABOVE_ROUND_OFF = 30.0
"""Least usable difference between two float32 losses, relative to their round-off."""


class LossHistory:
    """The loss of a problem after several numbers of steps. A `Frames` loss is computed at the steps of its frames."""

    def __init__(self, problem: Problem):
        loss, steps = problem.loss, problem.steps
        frames = loss.losses if isinstance(loss, Frames) else None
        every = steps < SAMPLE_STEPS
        spread = range(steps + 1) if every else np.linspace(0, steps, SAMPLE_STEPS + 1).round().astype(int)
        self.problem = problem
        self.sample_steps = np.array(sorted(frames) if frames else list(spread)[min(1, steps) :])
        by_step = {int(m): frames[m] if frames else loss for m in self.sample_steps}
        self._losses = {m: one if isinstance(one, Rounded) else as_loss(one) for m, one in by_step.items()}
        self._total = np.cumsum if frames else np.asarray

    def sides(self, parameters: Arrays, along: Arrays, h: float, losses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return central differences of the loss, and distances between one-sided differences, as two arrays
        (sample_steps,). Central differences are NaN after a run diverges. The distances are 0 for a float32 loss."""
        differences, sums = [], []
        for loss, before, after in self._beside(parameters, along, h):
            rounded = isinstance(loss, Rounded)
            old, new = loss.value(before), loss.value(after)
            differences.append(_change(loss, before, after) if rounded and h < 1.0 else new - old)
            sums.append(np.nan if rounded else old + new)
        unknown = [np.nan] * (len(self.sample_steps) - len(sums))
        bends = np.abs(self._total(sums + unknown) - 2.0 * losses) / h
        return self._total(differences + unknown) / (2.0 * h), np.nan_to_num(bends)

    def rough_miss(self, parameters: Arrays, along: Arrays) -> float:
        """Return the median relative difference between adjoints and finite differences of a float32 loss."""
        if not any(isinstance(loss, Rounded) for loss in self._losses.values()):
            return 0.0
        found = np.full((len(ROUGH), len(self.sample_steps)), np.inf)
        for row, h in zip(found, ROUGH, strict=True):
            for k, (loss, before, after) in enumerate(self._beside(parameters, along, h)):
                if isinstance(loss, Rounded):
                    by_adjoint, by_value = _change(loss, before, after), loss.value(after) - loss.value(before)
                    size, noise = max(abs(by_adjoint), abs(by_value)), FLOAT32_ROUND_OFF * abs(loss.value(after))
                    row[k] = abs(by_adjoint - by_value) / size if size > ABOVE_ROUND_OFF * noise else np.inf
        seen = found.min(axis=0)
        return float(np.median(seen[np.isfinite(seen)])) if np.isfinite(seen).any() else 0.0

    def _beside(self, parameters: Arrays, along: Arrays, h: float) -> Iterator[tuple[Loss, Snapshot, Snapshot]]:
        """Yield each loss with its states in two runs, at ``-h`` and ``h`` times ``along``, until a run diverges."""
        moved = ({name: parameters[name] + step * d for name, d in along.items()} for step in (-h, h))
        behind, ahead = (self._reached({**parameters, **one}) for one in moved)
        for step, loss in self._losses.items():
            if step in behind and step in ahead:
                yield loss, behind[step], ahead[step]

    def _reached(self, parameters: Arrays) -> dict[int, Snapshot]:
        """Return the states at the sample steps before a particle is lost, or none if the run cannot begin."""
        try:
            return self.problem.states(parameters, self._losses)
        except NO_RUN as error:
            first_lost = error.step if isinstance(error, DivergedError) else 0
        steps = [step for step in self._losses if step < first_lost]
        if not steps or steps[-1] == 0:
            return {}
        problem, last = self.problem, steps[-1]
        shorter = Problem(problem.simulation, last, self._losses[last], problem.memory_budget)
        return shorter.states(first_rows(problem, parameters, last), steps)

    def tangent(self, parameters: Arrays, along: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return three arrays (sample_steps,): the losses, their derivatives along a direction, and the strain [m]. The
        strain is the root mean square difference between the tangents of nearest neighbours' positions."""
        dots: dict[int, Arrays] = {}
        dimension = self.problem.simulation.dimension

        def observe(step: int, dot: State) -> None:
            if step in self._losses:
                dots[step] = dot.numpy(dimension)

        ends = self.problem.tangents(parameters, along, observe, self._losses)
        slopes, strain = [], []
        for step, loss in self._losses.items():
            _, bar = loss.value_and_adjoint(ends[step])
            wanted = [name for name in by_field(bar, dimension) if name not in dots[step]]
            more = self.problem.along(ends[step], wanted, dots[step], parameters, along)
            slopes.append(float(slope(bar, {**along, **dots[step], **more})))
            x, dot = ends[step].positions, dots[step]["positions"]
            nearest = cKDTree(x).query(x, k=2)[1][:, 1] if len(x) > 1 else [0]
            strain.append(float(np.sqrt(((dot - dot[nearest]) ** 2).sum(axis=1).mean())))
        losses = self._total([loss.value(ends[step]) for step, loss in self._losses.items()])
        return losses, self._total(slopes), np.array(strain)


def _change(loss: Loss, before: Snapshot, after: Snapshot) -> float:
    """Return the change of a loss to second order, from the mean of both adjoints, which avoids round-off."""
    old, new = (end.state.numpy(end.dimension) for end in (before, after))
    distance = {name: new[name] - old[name] for name in new} | {"colours": after.colours - before.colours}
    bars = [loss.value_and_adjoint(end)[1] for end in (before, after)]
    beyond = {name for bar in bars for name in by_field(bar, before.dimension) if name not in distance}
    distance |= {name: after[name] - before[name] for name in beyond}
    return 0.5 * sum(float(slope(bar, distance)) for bar in bars)


STEPS = tuple(10.0**-k for k in range(3, 9))
"""Step sizes of the central differences, as multiples of the direction."""
MODE_TOLERANCE = 1e-8
"""Greatest accepted relative difference between reverse and forward mode in float64."""
PLATEAU = 1e-3
"""Relative difference below which central differences with two successive step sizes count as converged."""
CORNER = 1e-4
"""Least relative difference between the two one-sided slopes at a corner of the loss."""
SLACK = 10.0
"""Greatest accepted distance from forward mode to a central difference, relative to `Consistency.gaps`."""
RESOLUTION = 1e-6
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
FAINT = 1e-4
"""Effect on the loss below which `balanced` ignores a parameter, relative to the strongest parameter's effect."""
ROUND_OFF = 1e-13
"""Greatest directional derivative that counts as 0, relative to the loss."""
DIFFERENCE_ROUND_OFF = 1e-15
"""Round-off of a central difference, relative to the loss divided by the step size."""


@dataclass(frozen=True, repr=False)
class Consistency(ShortRepr):
    """Derivatives of the loss along one direction, by reverse mode, forward mode and central differences."""

    sample_steps: np.ndarray
    """Numbers of steps (sample_steps,) after which the loss is computed."""
    losses: np.ndarray
    """Loss after each sample step (sample_steps,)."""
    adjoint: float
    """Directional derivative of the last loss by reverse mode."""
    size: float
    """Norm of the elementwise product of gradient and direction, which is the scale of round-off in ``adjoint``."""
    tangents: np.ndarray
    """Directional derivatives (sample_steps,) by forward mode."""
    differences: np.ndarray
    """Central differences (tried, sample_steps), which are not computed if reverse and forward mode disagree."""
    sides: np.ndarray
    """Distances (tried, sample_steps) between the forward and the backward difference, for each tried step size."""
    steps: np.ndarray
    """Tried step sizes (tried,) of the central differences, as multiples of the direction."""

    @property
    def disagreement(self) -> float:
        """Relative difference between reverse and forward mode, or 0 if all derivatives are below round-off."""
        last, least = float(self.tangents[-1]), ROUND_OFF * abs(float(self.losses[-1]))
        size = max(abs(self.adjoint), abs(last), self.size)
        distance = abs(self.adjoint - last) / size if size > least else 0.0
        return distance if np.isfinite(self.adjoint + last) else float("inf")

    @property
    def gaps(self) -> np.ndarray:
        """Relative differences (tried - 1, sample_steps) of central differences with successive step sizes."""
        round_off = DIFFERENCE_ROUND_OFF * np.abs(self.losses).max() / self.steps[1:, None]
        return self._worst(np.abs(np.diff(self.differences, axis=0)) + round_off)

    @property
    def misses(self) -> np.ndarray:
        """Relative distances (tried, sample_steps) between central differences and forward mode."""
        return self._worst(np.abs(self.differences - self.tangents))

    @property
    def corner(self) -> np.ndarray:
        """Relative distance (sample_steps,) between the one-sided differences, about 0 without a corner."""
        return np.asarray(self._worst(self.sides).min(axis=0, initial=np.inf))

    @property
    def is_on_a_corner(self) -> bool:
        """True if reverse and forward mode agree, but the two one-sided differences do not."""
        slopes = self.corner[self.converged]
        return self.disagreement < MODE_TOLERANCE and bool(len(slopes)) and float(slopes[-1]) > CORNER

    @property
    def converged(self) -> np.ndarray:
        """Mask (sample_steps,) of the sample steps at which the central differences converge."""
        return np.asarray(self.gaps.min(axis=0, initial=np.inf) < PLATEAU)

    @property
    def last_converged(self) -> int | None:
        """Last sample step at which the central differences converge, or None."""
        return int(self.sample_steps[self.converged][-1]) if self.converged.any() else None

    @property
    def miss(self) -> float | None:
        """Relative distance from forward mode to the nearest central difference at `last_converged`, or None."""
        return float(self.misses[:, self.converged].min(axis=0)[-1]) if self.converged.any() else None

    @property
    def differences_agree(self) -> bool:
        """True if forward mode agrees with the central differences wherever the central differences converge."""
        allowed = np.maximum(SLACK * self.gaps.min(axis=0, initial=np.inf), RESOLUTION)
        near = self.misses.min(axis=0, initial=np.inf) <= np.maximum(allowed, self.corner)
        return bool(near[self.converged].all())

    @property
    def right(self) -> bool:
        """True if reverse mode, forward mode and finite differences agree."""
        return self.disagreement < MODE_TOLERANCE and self.differences_agree

    def _worst(self, distances: np.ndarray) -> np.ndarray:
        """Divide the greatest distance up to each sample step by the greatest central difference up to the step."""
        size = np.maximum.accumulate(np.abs(self.differences[len(self.differences) - len(distances) :]), axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(np.maximum.accumulate(distances, axis=1) / size, nan=np.inf, posinf=np.inf)


def balanced(gradient: Arrays, directions: Arrays) -> Arrays:
    """Scale the directions so that all parameters change the loss by similar amounts. A strong parameter then cannot
    hide an error in the adjoint of a weak parameter, and two errors cannot cancel."""
    changes = {name: abs(float((gradient[name] * along).sum())) for name, along in directions.items()}
    finite = [change for change in changes.values() if np.isfinite(change)]
    strongest = max(finite, default=0.0)
    least = min((change for change in finite if change > FAINT * strongest), default=0.0)
    found = dict(directions)
    for k, (name, change) in enumerate(changes.items()):
        if change > FAINT * strongest:
            found[name] = (1.0 + k * GOLDEN % 1.0) * least / change * directions[name]
    return found


def check_consistency(history: LossHistory, values: Arrays, gradient: Arrays, directions: Arrays) -> Consistency:
    """Compare derivatives along `balanced` directions. ``gradient`` is the gradient by reverse mode."""
    along = balanced(gradient, directions)
    losses, tangents, _ = history.tangent(values, along)
    products = np.concatenate([(gradient[name] * along[name]).ravel() for name in along])
    found: list[tuple[np.ndarray, np.ndarray]] = []

    def so_far() -> Consistency:
        differences, sides = np.array(found).reshape(-1, 2, len(losses)).transpose(1, 0, 2)
        adjoint, size, tried = float(products.sum()), float(np.linalg.norm(products)), np.array(STEPS[: len(found)])
        return Consistency(history.sample_steps, losses, adjoint, size, tangents, differences, sides, tried)

    best = np.inf
    for h in STEPS if so_far().disagreement < MODE_TOLERANCE else ():
        found.append(history.sides(values, along, h, losses))
        gap = so_far().gaps[-1, -1] if len(found) > 1 else np.inf
        if (gap < RESOLUTION / SLACK or (best < PLATEAU and gap > best)) and so_far().differences_agree:
            break
        best = min(best, gap)
    return so_far()
