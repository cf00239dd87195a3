"""A state together with what the step after it depends on; and quantities of the states of a run, recorded."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_names
from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.rollout.rollout import Rollout
from cortado.scene.containers import Container
from cortado.scene.discrete_scene import Lattice
from cortado.scene.parameter_values import Arrays
from cortado.scene.quantity_names import QUANTITIES, check_quantity
from cortado.scene.solids import SolidTable


class Evaluates(Protocol):
    """What computes quantities: see `cortado.runs.quantities.evaluator.QuantityEvaluator`."""

    lattice: Lattice
    solids: tuple[SolidTable, ...]
    container: Container

    def values(self, names: Iterable[str], moment: "Moment") -> Arrays: ...

    def tangents(
        self, names: Iterable[str], moment: "Moment", dot: Mapping[str, NDArray], parameters_dot: Mapping[str, NDArray]
    ) -> Arrays: ...

    def adjoint(self, bars: Mapping[str, NDArray], moment: "Moment") -> tuple[Arrays, Arrays]: ...


@dataclass(frozen=True, eq=False)
class Moment:
    """A state, and the parameters of the step that begins at it. Quantities are computed when they are asked for, and
    kept."""

    state: State
    """On the device."""
    parameters: Mapping[str, NDArray]
    """By name, with one row of those over time, and a first axis for the scenes of a batch or one for all of them."""
    substeps: int
    """Explicit steps of diffusion within the step."""
    row: int
    """Which of the steps of a run the parameters are those of, or how many there are: after the last one."""
    evaluator: Callable[[], Evaluates]
    """Makes what computes quantities."""
    _values: Arrays = field(default_factory=dict)

    @classmethod
    def of(cls, rollout: Rollout, step: int, state: State, evaluator: Callable[[], Evaluates]) -> "Moment":
        """A state of a rollout's present evaluation, after so many steps. After the last one the parameters are as
        `row_of` says."""
        parameters = row_of(rollout, rollout.parameters.written, step)
        size = rollout.step_sizes.of_step(min(step, max(rollout.steps - 1, 0)))
        if size is not None:
            parameters["time_step"] = size
        return cls(state, parameters, rollout.substeps, step, evaluator)

    @property
    def lattice(self) -> Lattice:
        """Constants of the lattice of particles at rest."""
        return self.evaluator().lattice

    @property
    def solids(self) -> tuple[SolidTable, ...]:
        """Those of the scene, as they begin."""
        return self.evaluator().solids

    @property
    def container(self) -> Container:
        """That of the scene."""
        return self.evaluator().container

    def value(self, name: str) -> NDArray:
        """A quantity of the state, float64, read-only, of a batch with a first axis for the scenes."""
        if name not in self._values:
            found = self.evaluator().values([name], self)[name]
            found.flags.writeable = False
            self._values[name] = found
        return self._values[name]

    def adjoint(self, bars: Mapping[str, NDArray]) -> tuple[Arrays, Arrays]:
        """From adjoints of quantities to those of the state's fields and of the step's parameters."""
        return self.evaluator().adjoint(bars, self)

    def tangents(self, names: list[str], dot: Mapping[str, NDArray], parameters_dot: Mapping[str, NDArray]) -> Arrays:
        """Of quantities, along tangents of the state's fields and of the step's parameters."""
        return self.evaluator().tangents(names, self, dot, parameters_dot)


def row_of(rollout: Rollout, values: Mapping[str, NDArray], row: int) -> Arrays:
    """What was written of parameters for all steps of a rollout, of those over time one row, in arrays of its own.
    After the last step they are those of it, but paths of solids go on as far as they went in it: else solids would
    stop."""
    found = {}
    for name, value in values.items():
        shares = _shares_of_rows(rollout, name, row, value) or {}
        rows = [share * value[:, k : k + 1] for k, share in shares.items()]
        found[name] = np.sum(rows, axis=0) if rows else np.asarray(value)
    return found


def add_to_row(rollout: Rollout, name: str, bar: NDArray, row: int, total: NDArray) -> None:
    """The transpose of `row_of`: add the adjoint of a parameter of one row to that of all rows, ``total``."""
    shares = _shares_of_rows(rollout, name, row, total)
    if shares is None:
        total += bar
        return
    for k, share in shares.items():
        total[:, k : k + 1] += share * bar


def _shares_of_rows(rollout: Rollout, name: str, row: int, values: NDArray) -> dict[int, float] | None:
    """Of which rows a row is the sum, with their factors; None of parameters that are not over time."""
    known = rollout.solver.layout.known
    if name not in known.over_time:
        return None
    rows = values.shape[1]
    if row < rows:
        return {row: 1.0}
    return {rows - 1: 2.0, rows - 2: -1.0} if known[name].grows and rows > 1 else {rows - 1: 1.0}


class Recorder:
    """Computes quantities of the states of a rollout in the arrays of another solver of the same scene, as the
    rollout's own are at work."""

    def __init__(self, rollout: Rollout, names: Iterable[str], evaluator: Callable[[], Evaluates], dimension: int):
        """``evaluator`` makes what computes them, and is asked for it where there are ``names``. Raises `InputError`
        for a name that is none."""
        self.names = tuple(dict.fromkeys(check_quantity(name, "record") for name in require_names("record", names)))
        self._rollout, self._evaluator = rollout, evaluator() if self.names else None
        self._dimension = dimension

    def __call__(self, step: int, state: State) -> Arrays:
        """By name those of the state after so many steps, in the precision of the run."""
        made = self._evaluator
        if made is None:
            return {}
        real = self._rollout.solver.discretisation.precision.numpy
        moment = Moment.of(self._rollout, step, state, lambda: made)
        return {name: self._value(name, moment).astype(real) for name in self.names}

    def _value(self, name: str, moment: Moment) -> NDArray:
        """NaN where the step after the state loses a particle: the run says so where it takes it."""
        try:
            return moment.value(name)
        except DivergedError:
            positions = moment.state.positions
            return np.full(QUANTITIES[name].shape(len(positions), self._dimension), np.nan)
