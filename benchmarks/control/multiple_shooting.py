"""Multiple shooting: the run is cut into segments, whose first states are searched beside the controls."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado import InputError, Problem, gradients, optimise, optimisers
from cortado.errors import ComputationError, DivergedError
from cortado.losses import Frames, Loss, Snapshot
from cortado.losses.loss import Adjoint, by_field
from cortado.scene.parameter_values import Arrays

from .objective import BudgetSpent, Objective
from .task import GRAVITY

SHORT_RUNS = gradients.AdjointViscosity()


@dataclass(frozen=True)
class MultipleShooting:
    """Rounds of Adam on controls and first states of segments, with an augmented Lagrangian of the gaps between them.

    A gradient goes back through one segment alone, so that it need not survive the whole run (Bock and Plitt 1984). A
    round begins with the states of a run, without gaps, and is kept if a run with the new controls has a lesser loss;
    if not, gaps cost more in the next one.
    """

    segments: int = 2
    updates: int = 6
    """Of a round."""
    penalty: float = 3.0
    """Of a gap, at first: a mean square of one unit costs so many losses of the baseline."""
    growth: float = 3.0
    """Of the penalty, after a round that is not kept."""
    learning_rate: float = 0.05
    """Of states, in their units: spacings, and speeds of a fall by a spacing."""
    estimator: gradients.AdjointEstimator = SHORT_RUNS

    def search(self, objective: Objective, seed: int) -> None:
        """Raises `InputError` for tasks with a nozzle."""
        if objective.task.scene.emitter:
            raise InputError("multiple shooting needs all particles in each segment, but here a nozzle pours them.")
        rates = {"controls": 0.1, "positions": self.learning_rate, "velocities": self.learning_rate}
        try:
            (loss,) = objective.values([objective.start])
            gaps = Gaps(objective, self.segments, self.estimator, self.penalty * abs(loss))
            while True:
                start = {"controls": objective.best, **gaps.closed(objective.best)}
                bounds, before = {"controls": (-1.0, 1.0)}, objective.best_loss
                try:
                    found = optimise(gaps, start, optimisers.Adam(rates), self.updates, bounds)
                    gaps.learn()
                    objective.values([found.last_parameters["controls"]])
                except (DivergedError, ComputationError, InputError):
                    pass  # A segment was lost: the round is not kept.
                if objective.best_loss >= before:
                    gaps.penalty *= self.growth
        except BudgetSpent:
            return


class Gaps:
    """The augmented Lagrangian, as `cortado.optimise` asks for it: L + sum of <y, c> + penalty <c, c> / 2 over the gaps
    c between segments, with means over the particles in the place of sums."""

    def __init__(self, objective: Objective, segments: int, estimator: gradients.AdjointEstimator, penalty: float):
        self._objective, self._estimator, self.penalty = objective, estimator, penalty
        task, problem = objective.task, objective.inner
        ends = np.linspace(0, task.steps, segments + 1).astype(int)
        asked: Any = problem.loss
        by_step: dict[int, Loss] = asked.losses if isinstance(asked, Frames) else {task.steps: asked}
        spacing = task.scene.discretisation.spacing
        self._units = {"positions": spacing, "velocities": np.sqrt(GRAVITY * spacing)}
        self._borders = [Border(self._units) for _ in ends[1:-1]]
        self._parts: list[tuple[slice, Problem]] = []
        for begin, end, border in zip(ends[:-1], ends[1:], [*self._borders, None], strict=True):
            losses = {int(step - begin): loss for step, loss in by_step.items() if begin < step <= end}
            if border is not None:
                border.loss = losses.get(int(end - begin))
                losses[int(end - begin)] = border
            self._parts.append((slice(begin, end), Problem(problem.simulation, int(end - begin), Frames(losses))))

    def closed(self, u: np.ndarray) -> Arrays:
        """The states of a run with these controls, by which there are no gaps: (borders, n, d), in their units."""
        steps = [part.stop for part, _ in self._parts[:-1]]
        self._objective.steps.forward += self._objective.task.steps
        controls = self._objective.task.controls.parameters(u)
        states = self._objective.inner.states({**controls, **self._objective.fixed}, steps)
        return {
            name: np.array([getattr(states[step], name) for step in steps]) / unit for name, unit in self._units.items()
        }

    def learn(self) -> None:
        """Let the multipliers follow the gaps of the last evaluation."""
        for border in self._borders:
            border.learn(self.penalty)

    def value_and_gradient(self, parameters: Mapping[str, np.ndarray], gradient: None = None) -> tuple[float, Arrays]:
        """Of controls and states by name. Raises `BudgetSpent`."""
        controls = self._objective.task.controls
        over_time = controls.parameters(parameters["controls"])
        total, bars = 0.0, []
        found = {name: np.zeros_like(parameters[name]) for name in self._units}
        for k, ((part, problem), first) in enumerate(zip(self._parts, self._firsts(parameters), strict=True)):
            self._objective.require_budget()
            if k < len(self._borders):
                self._borders[k].expect({name: parameters[name][k] for name in self._units}, self.penalty)
            self._objective.steps.forward += problem.steps
            self._objective.steps.backward += problem.steps
            of_part = {name: value[part] for name, value in over_time.items()}
            one = problem.estimate({**of_part, **first}, self._estimator)
            total += one.loss
            bars.append(one.gradient)
            for name, unit in self._units.items():
                if k > 0:
                    found[name][k - 1] += unit * one.gradient[f"initial_{name}"]
                if k < len(self._borders):
                    found[name][k] -= self._borders[k].pull[name]
        all_bars = {name: np.concatenate([one[name] for one in bars]) for name in over_time}
        return total, {"controls": controls.adjoint(parameters["controls"], all_bars), **found}

    def _firsts(self, parameters: Mapping[str, np.ndarray]) -> Iterator[Arrays]:
        """The first states of the segments, as parameters of their problems."""
        yield self._objective.fixed
        for k in range(len(self._borders)):
            yield {f"initial_{name}": unit * parameters[name][k] for name, unit in self._units.items()}


class Border:
    """The end of a segment, which shall be the first state of the next one: a loss of the gap, and what the task asks
    of the state there."""

    def __init__(self, units: Mapping[str, float]):
        self._units = units
        self._multipliers: Arrays = dict.fromkeys(units, np.zeros(()))
        self._gaps: Arrays = {}
        self.loss: Loss | None = None
        self.pull: Arrays = {}
        """The derivatives with respect to the gaps (n, d), by field, once the loss was differentiated."""

    def expect(self, state: Arrays, penalty: float) -> None:
        """The next segment begins with this state, fields (n, d) in their units."""
        self._state, self._penalty = state, penalty

    def learn(self, penalty: float) -> None:
        """A step of the multipliers."""
        for name, gap in self._gaps.items():
            self._multipliers[name] = self._multipliers[name] + penalty * gap

    def value(self, end: Snapshot) -> float:
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        total, bars = (0.0, {}) if self.loss is None else self._of_task(end)
        n = len(end.positions)
        for name, unit in self._units.items():
            gap = getattr(end, name) / unit - self._state[name]
            slope = self._multipliers[name] + self._penalty * gap
            total += float(((self._multipliers[name] + slope) * gap).sum()) / (2.0 * n)
            self._gaps[name], self.pull[name] = gap, slope / n
            bars[name] = bars.get(name, 0.0) + slope / (n * unit)
        return total, (bars["positions"], bars["velocities"])

    def _of_task(self, end: Snapshot) -> tuple[float, Arrays]:
        assert self.loss is not None
        loss, bar = self.loss.value_and_adjoint(end)
        return loss, dict(by_field(bar, end.dimension))
