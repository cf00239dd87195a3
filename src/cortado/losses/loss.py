"""Losses: what they are given and return, of one scene and of a batch, and the sum of several at several steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, overload, runtime_checkable

import numpy as np

from cortado.arrays import is_whole
from cortado.calls import FixedDict, counted, fixed
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.device.reduction import add
from cortado.errors import InputError, shown
from cortado.particles.state import State
from cortado.runs.quantity_values import Moment
from cortado.scene.discrete_scene import Lattice
from cortado.scene.parameters import check_readable
from cortado.scene.shape_tables import Container
from cortado.scene.solids import SolidTable
from cortado.sph.function_text import code_words


def precision_of(state: State) -> Precision:
    """Return the precision of a state's arrays."""
    return FLOAT64 if state.positions.dtype == FLOAT64.vector else FLOAT32


@dataclass(frozen=True)
class Snapshot:
    """A state of a rollout, usually the last, as NumPy arrays or as Warp arrays, in the scene's order."""

    state: State
    """Warp arrays (n,): positions [m], velocities [m / s], mass fractions [-], and further fields that the solver
    carries from step to step."""
    dimension: int
    colours: np.ndarray
    """Colours of the phases, (phases, 3): red, green and blue, linear, from 0 to 1."""
    moment: Moment | None = None
    """State with the parameters of the step after it, which determine its quantities; None where unknown."""

    def __repr__(self) -> str:
        return f"Snapshot({counted(len(self.state.positions), 'particle')}, {self.precision.name})"

    @property
    def precision(self) -> Precision:
        """The precision of the Warp arrays."""
        return precision_of(self.state)

    @cached_property
    def positions(self) -> np.ndarray:
        """Positions of the particles, (n, d) [m], float64, read-only."""
        return self._field("positions")

    @cached_property
    def velocities(self) -> np.ndarray:
        """Velocities of the particles, (n, d) [m / s], float64, read-only."""
        return self._field("velocities")

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """Mass fractions of the particles, (n, phases) [-], float64, read-only."""
        return self._field("mass_fractions")

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a field of the state by its name, such as "velocities", or a quantity of its particles, such as
        "density" or "pressure", or the load on a solid, such as "rotor.load" (see `docs/sensors.md`). Float64,
        read-only. Raises `InputError` for any other name."""
        if name in ADJOINT_FIELDS:
            return getattr(self, name)
        if isinstance(name, str) and name in self.state.names:
            return self._field(name)
        check_readable(name, "a field of a state", self.state.names)
        return self._quantity(name)

    @property
    def lattice(self) -> Lattice:
        """Constants of the particles at rest, such as their volume."""
        return moment_of(self).evaluator().lattice

    @property
    def solids(self) -> tuple[SolidTable, ...]:
        """Tables of the scene's solids as they begin; fields of the state say where a moving one is now."""
        return moment_of(self).evaluator().solids

    @property
    def container(self) -> Container:
        """The container of the scene."""
        return moment_of(self).evaluator().container

    def _field(self, name: str) -> np.ndarray:
        return _read_only(self.state.views(self.dimension, only=[name])[name])

    def _quantity(self, name: str) -> np.ndarray:
        return moment_of(self).value(name)


def _read_only(values: np.ndarray) -> np.ndarray:
    """Return a read-only copy in float64, which a loss cannot change by mistake."""
    found = values.astype(np.float64)
    found.flags.writeable = False
    return found


def moment_of(end: "Snapshot | SnapshotBatch") -> Moment:
    """Return the state and parameters that determine quantities; raises `InputError` where they are unknown."""
    if end.moment is None:
        raise InputError("a quantity is asked for of a state whose simulation is not known, but must be of a run's.")
    return end.moment


@dataclass(frozen=True, repr=False)
class StepBar:
    """Derivatives of a loss with respect to the parameters of one step."""

    row: int
    """Number of the step in the run, or the number of steps: one after the last (`row_of` of
    `cortado.runs.quantity_values`)."""
    parameters: Mapping[str, np.ndarray]
    """Derivatives by parameter name, with a first axis for the scenes of a batch, and one row of those over time."""


@dataclass(frozen=True, repr=False)
class SnapshotAdjoint:
    """Derivatives of a loss that also looks at the colours."""

    state: State
    """Derivatives with respect to positions, velocities and mass fractions, as Warp arrays."""
    colours: np.ndarray
    """Derivatives with respect to the phases' colours, (phases, 3)."""
    quantities: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Derivatives with respect to quantities of the particles, by name."""
    step: StepBar | None = None
    """Derivatives with respect to the parameters of the step after the state, once those of quantities are included."""

    def through_quantities(self, end: "Snapshot | SnapshotBatch") -> "SnapshotAdjoint":
        """Return the derivatives with respect to the state and the parameters alone, from which quantities follow."""
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
"""Names of the fields that the arrays of an adjoint tuple differentiate by, in their order."""
Adjoint = State | SnapshotAdjoint | tuple[np.ndarray, ...] | Mapping[str, np.ndarray]
"""Derivatives of a loss with respect to positions and velocities, (n, d) each, and, if there is a third array, mass
fractions (n, phases). They may also come by the names of fields of a state and of quantities, where names left out mean
0; or as Warp arrays."""


def by_field(bar: Adjoint, dimension: int) -> dict[str, np.ndarray]:
    """Return an adjoint as arrays by the names of state fields and quantities, with vectors (n, d)."""
    if isinstance(bar, Mapping):
        return dict(bar)
    if isinstance(bar, SnapshotAdjoint):
        return {**bar.state.numpy(dimension), **bar.quantities}
    return bar.numpy(dimension) if isinstance(bar, State) else dict(zip(ADJOINT_FIELDS, bar, strict=False))


def bar_on_device(bar: Adjoint, end: Snapshot) -> SnapshotAdjoint:
    """Return any form of a state's adjoint as Warp arrays, and that of quantities by name."""
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
    """Return the derivative of a loss along tangents of fields, quantities and ``colours`` (phases, 3), by name, 0
    where left out: a number, or of a batch in the shape ``leading``, (batch,). Vectors are (n, d), or all (n, 3)."""
    arrays = by_field(bar, np.shape(dots["positions"])[-1])
    arrays |= {"colours": bar.colours} if isinstance(bar, SnapshotAdjoint) else {}
    products = [
        array.astype(np.float64) * np.asarray(dots[name], dtype=np.float64)
        for name, array in arrays.items()
        if name in dots
    ]
    return sum((each.reshape(*leading, -1).sum(axis=-1) for each in products), np.zeros(leading))


class Loss(Protocol):
    """Protocol of a loss: a differentiable number of the end of a trajectory.

    A loss of your own may have a method ``adjoint(end)``, of the derivatives alone, in the place of
    `value_and_adjoint`.
    """

    def value(self, end: Snapshot) -> float:
        """Return the value of the loss for the end of a run."""

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        """Return the loss and its derivatives, which often share work. They are a tuple of NumPy arrays, a table of
        them by the names of fields and quantities, ``{"density": array}``, or a `State` of Warp arrays. The method
        ``end.state.like()`` makes such a state, all 0, and its ``set({"positions": array})`` fills it."""


@fixed
class Frames:
    """A sum of losses of several states of a run, by the number of steps before each.

    Example: ``loss = cortado.losses.Frames({50: cortado.losses.CentreOfMass([0.4, 0.2]), 100: last})``
    """

    def __init__(self, losses: Mapping[int, Loss]):
        """Set ``losses`` {number of steps: loss}; 0 is the first state."""
        if not isinstance(losses, Mapping) or not losses:
            raise InputError(f"losses is {shown(losses)}, but must be a table with a loss for at least one frame.")
        for step in losses:
            if not is_whole(step) and not (isinstance(step, float) and float(step).is_integer()):
                raise InputError(f"losses has the frame {shown(step)}, but must have whole numbers of steps.")
        self.losses = FixedDict(losses)

    def check(self, time_steps: np.ndarray) -> None:
        """Raise `InputError` where the losses do not fit a run with these time steps (scenes,) [s]."""

    @property
    def fingerprint(self) -> str:
        """Text that tells sets of targets apart, for checkpoints."""
        return " ".join(f"{step}:{fingerprint(loss)}" for step, loss in sorted(self.losses.items()))


def fingerprint(loss: Any) -> str:
    """Return a text that tells losses apart: the loss's ``fingerprint``, the code of a function, or the type.

    Example: ``print(cortado.losses.fingerprint(cortado.losses.CentreOfMass([1.0, 0.2])))``
    """
    return getattr(loss, "fingerprint", code_words(loss) if callable(loss) else type(loss).__qualname__)


@dataclass(frozen=True, eq=False)
class SnapshotBatch(Sequence[Snapshot]):
    """A state of a batch's rollout: ``end[b]`` is the `Snapshot` of scene b."""

    state: State
    """Warp arrays (batch n,), in the scenes' order; `State.numbers` shows them as (batch, n, ...)."""
    dimension: int
    colours: np.ndarray
    """Colours of the phases, (batch, phases, 3): red, green and blue, linear, from 0 to 1."""
    moment: Moment | None = None
    """State with the parameters of the step after it; see `Snapshot.moment`."""

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
        """Positions of the particles, (batch, n, d) [m], float64, read-only."""
        return self.on_host["positions"]

    @property
    def velocities(self) -> np.ndarray:
        """Velocities of the particles, (batch, n, d) [m / s], float64, read-only."""
        return self.on_host["velocities"]

    @property
    def mass_fractions(self) -> np.ndarray:
        """Mass fractions of the particles, (batch, n, phases) [-], float64, read-only."""
        return self.on_host["mass_fractions"]

    @cached_property
    def on_host(self) -> dict[str, np.ndarray]:
        """All fields of all scenes by name, read from the device at once; float64, read-only."""
        return {name: _read_only(array) for name, array in self.state.numpy(self.dimension).items()}


@dataclass(frozen=True, repr=False, kw_only=True)
class _Member(Snapshot):
    """A snapshot of one scene of a batch, whose arrays come to the host with those of the others."""

    batch: SnapshotBatch
    number: int

    def _quantity(self, name: str) -> np.ndarray:
        return super()._quantity(name)[self.number]

    def _field(self, name: str) -> np.ndarray:
        return self.batch.on_host[name][self.number]


@runtime_checkable
class BatchedLoss(Protocol):
    """Protocol of a loss of all scenes of a batch at once, which saves a launch and a host read for each. Scene b gets
    the bits that it would get alone."""

    def values(self, end: SnapshotBatch) -> np.ndarray:
        """Return the losses (batch,); those of lost scenes are meaningless."""

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        """Return the losses (batch,) and the derivatives with respect to the states, as Warp arrays:
        ``end.state.like()`` makes them, all 0, and its ``set({"positions": array})`` writes an array (batch, n, d)."""


def batch_values(loss: Loss, end: SnapshotBatch, members: Sequence[int]) -> np.ndarray:
    """Return the losses (batch,) of some scenes; NaN for others."""
    found = np.full(len(end), np.nan)
    if isinstance(loss, BatchedLoss):
        found[members] = loss.values(end)[members]
    else:
        found[members] = [loss.value(end[b]) for b in members]
    return found


def batch_values_and_adjoints(
    loss: Loss, end: SnapshotBatch, members: Sequence[int]
) -> tuple[np.ndarray, SnapshotAdjoint]:
    """Return the losses (batch,) of some scenes, NaN for others, and the adjoints of their states, 0 for others."""
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
