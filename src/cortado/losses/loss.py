"""Losses: what they are given and return, of one scene and of a batch, and the sum of several at several steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, overload, runtime_checkable

import numpy as np

from cortado.arrays import is_whole
from cortado.calls import FixedDict, fixed
from cortado.code_words import code_words
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.device.reduction import add
from cortado.errors import InputError, shown
from cortado.particles.state import State
from cortado.runs.quantity_values import Moment
from cortado.scene.discrete_scene import Lattice
from cortado.scene.quantity_names import check_readable
from cortado.scene.shape_tables import Container
from cortado.scene.solids import SolidTable
from cortado.words import counted


def precision_of(state: State) -> Precision:
    """Of the arrays of a state."""
    return FLOAT64 if state.positions.dtype == FLOAT64.vector else FLOAT32


@dataclass(frozen=True)
class Snapshot:
    """A state of a rollout, the last one as a rule, as NumPy arrays or as Warp arrays, in the scene's order."""

    state: State
    """Warp arrays (n,): positions [m], velocities [m / s], mass fractions [-], and what else the solver carries from
    step to step."""
    dimension: int
    colours: np.ndarray
    """(phases, 3) of the phases: red, green and blue, linear, from 0 to 1."""
    moment: Moment | None = None
    """The state with the parameters of the step after it, which its quantities follow from; None where they are not
    known."""

    def __repr__(self) -> str:
        return f"Snapshot({counted(len(self.state.positions), 'particle')}, {self.precision.name})"

    @property
    def precision(self) -> Precision:
        """The precision of the Warp arrays."""
        return precision_of(self.state)

    @cached_property
    def positions(self) -> np.ndarray:
        """(n, d) [m], float64, read-only"""
        return self._field("positions")

    @cached_property
    def velocities(self) -> np.ndarray:
        """(n, d) [m / s], float64, read-only"""
        return self._field("velocities")

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """(n, phases) [-], float64, read-only"""
        return self._field("mass_fractions")

    def __getitem__(self, name: str) -> np.ndarray:
        """A field of the state by its name, such as "velocities", or a quantity of its particles, such as "density" or
        "pressure", or the load on a solid, such as "rotor.load" (see `docs/sensors.md`); float64, read-only. Raises
        `InputError` for any other name."""
        if name in ADJOINT_FIELDS:
            return getattr(self, name)
        if isinstance(name, str) and name in self.state.names:
            return self._field(name)
        check_readable(name, "a field of a state", self.state.names)
        return self._quantity(name)

    @property
    def lattice(self) -> Lattice:
        """Constants of the particles at rest, such as their volume."""
        return moment_of(self).lattice

    @property
    def solids(self) -> tuple[SolidTable, ...]:
        """Those of the scene, as they begin; where one that moves is now, fields of the state say."""
        return moment_of(self).solids

    @property
    def container(self) -> Container:
        """The container of the scene."""
        return moment_of(self).container

    def _field(self, name: str) -> np.ndarray:
        return _read_only(self.state.numpy(self.dimension, only=[name])[name])

    def _quantity(self, name: str) -> np.ndarray:
        return moment_of(self).value(name)


def _read_only(values: np.ndarray) -> np.ndarray:
    """A copy in float64 that a loss cannot change by mistake for what is computed from it next."""
    found = values.astype(np.float64)
    found.flags.writeable = False
    return found


def moment_of(end: "Snapshot | SnapshotBatch") -> Moment:
    """What quantities of a state follow from; raises `InputError` where it is not known."""
    if end.moment is None:
        raise InputError("a quantity is asked for of a state whose simulation is not known, but must be of a run's.")
    return end.moment


@dataclass(frozen=True, repr=False)
class StepBar:
    """Derivatives of a loss with respect to the parameters of one step."""

    row: int
    """Which of a run's steps it is, or how many there are: one after the last (`row_of` of
    `cortado.runs.quantity_values`)."""
    parameters: Mapping[str, np.ndarray]
    """By name, with a first axis for the scenes of a batch, and one row of those over time."""


@dataclass(frozen=True, repr=False)
class SnapshotAdjoint:
    """Derivatives of a loss that also looks at the colours."""

    state: State
    """With respect to positions, velocities and mass fractions, as Warp arrays."""
    colours: np.ndarray
    """(phases, 3)"""
    quantities: Mapping[str, np.ndarray] = field(default_factory=dict)
    """With respect to quantities of the particles, by name."""
    step: StepBar | None = None
    """With respect to the parameters of the step after the state, once that of quantities is in it."""

    def through_quantities(self, end: "Snapshot | SnapshotBatch") -> "SnapshotAdjoint":
        """With respect to the state and the parameters alone: quantities follow from these."""
        if not self.quantities:
            return self
        moment = moment_of(end)
        fields, parameters = moment.adjoint(self.quantities)
        more = self.state.like()
        more.set(fields)
        for own, total in zip(self.state.arrays(), more.arrays(), strict=True):
            add(own, total)
        return SnapshotAdjoint(more, self.colours, step=StepBar(moment.row, parameters))


ADJOINT_FIELDS = ("positions", "velocities", "mass_fractions")
"""What the arrays of an adjoint are derivatives with respect to, in their order."""
Adjoint = State | SnapshotAdjoint | tuple[np.ndarray, ...] | Mapping[str, np.ndarray]
"""Derivatives of a loss with respect to positions and velocities, (n, d) each, and, if there is a third array, mass
fractions (n, phases); or by the names of fields of a state and of quantities, what is left out being 0; or as Warp
arrays."""


def by_field(bar: Adjoint, dimension: int) -> dict[str, np.ndarray]:
    """An adjoint as arrays by the fields of a state, and the quantities, that they are derivatives with respect to,
    vectors (n, d)."""
    if isinstance(bar, Mapping):
        return dict(bar)
    if isinstance(bar, SnapshotAdjoint):
        return {**bar.state.numpy(dimension), **bar.quantities}
    return bar.numpy(dimension) if isinstance(bar, State) else dict(zip(ADJOINT_FIELDS, bar, strict=False))


def adjoint_on_device(bar: Adjoint, end: Snapshot) -> SnapshotAdjoint:
    """Any adjoint of a state, as Warp arrays and, of quantities, by name."""
    if isinstance(bar, SnapshotAdjoint):
        return bar
    no_colours = np.zeros_like(end.colours)
    if isinstance(bar, State):
        return SnapshotAdjoint(bar, no_colours)
    state, arrays = end.state.like(), by_field(bar, end.dimension)
    state.set(arrays)
    quantities = {name: array for name, array in arrays.items() if name not in state.names}
    return SnapshotAdjoint(state, no_colours, quantities)


def slope(bar: Adjoint, dots: Mapping[str, np.ndarray], leading: tuple[int, ...] = ()) -> np.ndarray:
    """The derivative of a loss along tangents of fields, quantities and ``colours`` (phases, 3), by name, what is left
    out being 0: a number, or of a batch in the shape ``leading``, (batch,). Vectors are (n, d), or all (n, 3)."""
    arrays = by_field(bar, np.shape(dots["positions"])[-1])
    arrays |= {"colours": bar.colours} if isinstance(bar, SnapshotAdjoint) else {}
    products = [
        array.astype(np.float64) * np.asarray(dots[name], dtype=np.float64)
        for name, array in arrays.items()
        if name in dots
    ]
    return sum((each.reshape(*leading, -1).sum(axis=-1) for each in products), np.zeros(leading))


class Loss(Protocol):
    """A differentiable number of the end of a trajectory.

    A loss of your own may have a method ``adjoint(end)``, of the derivatives alone, in the place of
    `value_and_adjoint`.
    """

    def value(self, end: Snapshot) -> float:
        """The value of the loss for a run."""

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        """The loss and its derivatives, in one call as they often share work: a tuple of NumPy arrays, or a table of
        them by the names of fields and quantities, ``{"density": array}``, or a `State` of Warp arrays, which
        ``end.state.like()`` makes, all 0, and ``set({"positions": array})`` of it fills."""


@fixed
class Frames:
    """The sum of losses of several states on the way, by the number of steps before each."""

    def __init__(self, losses: Mapping[int, Loss]):
        """``losses`` {number of steps: loss}; 0 is the first state."""
        if not isinstance(losses, Mapping) or not losses:
            raise InputError(f"losses is {shown(losses)}, but must be a table with a loss for at least one frame.")
        for step in losses:
            if not is_whole(step) and not (isinstance(step, float) and float(step).is_integer()):
                raise InputError(f"losses has the frame {shown(step)}, but must have whole numbers of steps.")
        self.losses = FixedDict(losses)

    def check(self, time_steps: np.ndarray) -> None:
        """Raises `InputError` where it does not fit a run with these time steps (scenes,) [s]."""

    @property
    def fingerprint(self) -> str:
        """Tells one set of targets from another, for checkpoints."""
        return " ".join(f"{step}:{fingerprint(loss)}" for step, loss in sorted(self.losses.items()))


def fingerprint(loss: Any) -> str:
    """A text that tells one loss from another: its own ``fingerprint``, the code of a function, or else the type."""
    return getattr(loss, "fingerprint", code_words(loss) if callable(loss) else type(loss).__qualname__)


@dataclass(frozen=True, eq=False)
class SnapshotBatch(Sequence[Snapshot]):
    """A state of a rollout of a batch: ``end[b]`` is the `Snapshot` of scene b."""

    state: State
    """Warp arrays (batch n,), in the scenes' order; `State.numbers` shows them as (batch, n, ...)."""
    dimension: int
    colours: np.ndarray
    """(batch, phases, 3) of the phases: red, green and blue, linear, from 0 to 1."""
    moment: Moment | None = None
    """As that of `Snapshot`."""

    def __repr__(self) -> str:
        particles = counted(len(self.state.positions) // len(self), "particle")
        return f"SnapshotBatch({counted(len(self), 'scene')} of {particles})"

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.colours)

    @overload
    def __getitem__(self, b: int) -> Snapshot: ...

    @overload
    def __getitem__(self, b: slice) -> Sequence[Snapshot]: ...

    def __getitem__(self, b: int | slice) -> Snapshot | Sequence[Snapshot]:
        if isinstance(b, slice):
            return [self[k] for k in range(len(self))[b]]
        number = range(len(self))[b]
        own = self.state.member(number), self.dimension, self.colours[number], self.moment
        return _Member(*own, batch=self, number=number)

    @property
    def precision(self) -> Precision:
        """The precision of the Warp arrays."""
        return precision_of(self.state)

    @property
    def positions(self) -> np.ndarray:
        """(batch, n, d) [m], float64, read-only"""
        return self.on_host["positions"]

    @property
    def velocities(self) -> np.ndarray:
        """(batch, n, d) [m / s], float64, read-only"""
        return self.on_host["velocities"]

    @property
    def mass_fractions(self) -> np.ndarray:
        """(batch, n, phases) [-], float64, read-only"""
        return self.on_host["mass_fractions"]

    @cached_property
    def on_host(self) -> dict[str, np.ndarray]:
        """All fields of all scenes by name, read from the device at once; float64, read-only."""
        return {name: _read_only(array) for name, array in self.state.numpy(self.dimension).items()}


@dataclass(frozen=True, repr=False, kw_only=True)
class _Member(Snapshot):
    """One scene of a batch, whose arrays come to the host with those of the others."""

    batch: SnapshotBatch
    number: int

    def _quantity(self, name: str) -> np.ndarray:
        return super()._quantity(name)[self.number]

    def _field(self, name: str) -> np.ndarray:
        return self.batch.on_host[name][self.number]


@runtime_checkable
class BatchedLoss(Protocol):
    """A loss that looks at all scenes of a batch at once, which saves a launch and a look of the host for each. Scene b
    gets the bits that it would get alone."""

    def values(self, end: SnapshotBatch) -> np.ndarray:
        """(batch,) the losses; of scenes that were lost they mean nothing."""

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        """The same, and the derivatives with respect to the states, as Warp arrays: ``end.state.like()`` makes them,
        all 0, and ``set({"positions": array})`` of it writes an array (batch, n, d)."""


def batch_values(loss: Loss, end: SnapshotBatch, members: Sequence[int]) -> np.ndarray:
    """(batch,) the losses of some scenes; NaN for others."""
    found = np.full(len(end), np.nan)
    if isinstance(loss, BatchedLoss):
        found[members] = loss.values(end)[members]
    else:
        found[members] = [loss.value(end[b]) for b in members]
    return found


def batch_values_and_adjoints(
    loss: Loss, end: SnapshotBatch, members: Sequence[int]
) -> tuple[np.ndarray, SnapshotAdjoint]:
    """(batch,) the losses of some scenes, NaN for others, and the adjoints of their states, 0 for others."""
    found = np.full(len(end), np.nan)
    if isinstance(loss, BatchedLoss):
        all_found, state = loss.values_and_adjoint(end)
        found[members] = all_found[members]
        for b in set(range(len(end))).difference(members):
            state.member(b).clear()
        return found, SnapshotAdjoint(state, np.zeros_like(end.colours))
    adjoint = SnapshotAdjoint(end.state.like(), np.zeros_like(end.colours))
    arrays: dict[str, np.ndarray] = {}
    for b in members:
        found[b], bar = loss.value_and_adjoint(end[b])
        more: Mapping[str, np.ndarray] = {}
        if isinstance(bar, SnapshotAdjoint):
            adjoint.colours[b], more, bar = bar.colours, bar.quantities, bar.state
        if isinstance(bar, State):
            adjoint.state.member(b).assign(bar)
        else:
            more = by_field(bar, end.dimension)
        for name, array in more.items():
            arrays.setdefault(name, np.zeros((len(end), *array.shape)))[b] = array
    adjoint.state.set(arrays)
    of_quantities = {name: array for name, array in arrays.items() if name not in end.state.names}
    return found, replace(adjoint, quantities=of_quantities)
