"""Protocols of losses, the states that losses read, the adjoints of states, and sums of losses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, overload

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
    return FLOAT64 if state.positions.dtype == FLOAT64.vector else FLOAT32


class OnHost:
    """The arrays of the state of one scene or of a batch, copied from the device on first use."""

    state: State

    @property
    def precision(self) -> Precision:
        return precision_of(self.state)

    @cached_property
    def positions(self) -> np.ndarray:
        """Positions of the particles [m], as a read-only float64 array (n, d), or (batch, n, d) for a batch."""
        return self._field("positions")

    @cached_property
    def velocities(self) -> np.ndarray:
        """Velocities of the particles [m / s], as a read-only float64 array (n, d), or (batch, n, d) for a batch."""
        return self._field("velocities")

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """Mass fractions of the particles [-], a read-only float64 array (n, phases), or (batch, n, phases)."""
        return self._field("mass_fractions")

    def _field(self, name: str) -> np.ndarray:
        raise NotImplementedError


@dataclass(frozen=True)
class Snapshot(OnHost):
    """A state of a rollout, usually the last state, as NumPy and Warp arrays, in the order of the initial particles."""

    state: State
    """Warp arrays (n,): positions [m], velocities [m / s], mass fractions [-], and further fields of the solver."""
    dimension: int
    colours: np.ndarray
    """Colours of the phases (phases, 3) in linear RGB from 0 to 1."""
    moment: Moment | None = None
    """State and parameters of the next step, from which particle quantities are computed, or None."""

    def __repr__(self) -> str:
        return f"Snapshot({counted(len(self.state.positions), 'particle')}, {self.precision.name})"

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array by name: a field of the state ("velocities"), a quantity of its particles ("density",
        "pressure"), or the load on a solid ("rotor.load"). Arrays are float64 and read-only. `docs/sensors.md` lists
        the names. Raises `InputError` for an unknown name."""
        if name in ADJOINT_FIELDS:
            return getattr(self, name)
        if isinstance(name, str) and name in self.state.names:
            return self._field(name)
        check_readable(name, "a field of a state", self.state.names)
        return self._quantity(name)

    @property
    def lattice(self) -> Lattice:
        """Constants of the lattice of particles at rest, such as the volume of a particle."""
        return moment_of(self).evaluator().lattice

    @property
    def solids(self) -> tuple[SolidTable, ...]:
        """The scene's tables ``[[solid]]``, with initial positions. The positions of moving solids are in the state."""
        return moment_of(self).evaluator().solids

    @property
    def container(self) -> Container:
        return moment_of(self).evaluator().container

    def _field(self, name: str) -> np.ndarray:
        return _read_only(self.state.views(self.dimension, only=[name])[name])

    def _quantity(self, name: str) -> np.ndarray:
        return moment_of(self).value(name)


def _read_only(values: np.ndarray) -> np.ndarray:
    found = values.astype(np.float64)
    found.flags.writeable = False
    return found


def moment_of(end: "Snapshot | SnapshotBatch") -> Moment:
    if end.moment is None:
        raise InputError("The state has no simulation that could compute quantities: take a state of a run.")
    return end.moment


@dataclass(frozen=True, repr=False)
class StepBar:
    row: int
    """Number of the step in the run, counted from 0."""
    parameters: Mapping[str, np.ndarray]
    """Derivatives by parameter name, for one step. A batch adds a first axis for the scenes."""


@dataclass(frozen=True, repr=False)
class SnapshotAdjoint:
    """Derivatives of a loss with respect to a state, colours, particle quantities, and the parameters of a step."""

    state: State
    """Derivatives with respect to positions, velocities and mass fractions, as Warp arrays."""
    colours: np.ndarray
    """Derivatives (phases, 3) with respect to the phases' colours."""
    quantities: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Derivatives with respect to particle quantities, by name."""
    step: StepBar | None = None
    """Derivatives with respect to the parameters of the next step, computed by `through_quantities`."""

    def through_quantities(self, end: "Snapshot | SnapshotBatch") -> "SnapshotAdjoint":
        """Convert derivatives with respect to quantities to derivatives with respect to state and parameters."""
        if not self.quantities:
            return self
        moment = moment_of(end)
        fields, parameters = moment.evaluator().adjoint(self.quantities, moment)
        more = self.state.like()
        more.set(fields)
        for own, total in zip(self.state.arrays(), more.arrays(), strict=True):
            add(own, total)
        return SnapshotAdjoint(more, self.colours, step=StepBar(moment.row, parameters))


ADJOINT_FIELDS = ("positions", "velocities", "mass_fractions")
Adjoint = State | SnapshotAdjoint | tuple[np.ndarray, ...] | Mapping[str, np.ndarray]
"""Derivatives of a loss in one of three forms. The first form is a tuple of arrays for positions and velocities (n, d)
and, optionally, mass fractions (n, phases). The other forms are a `State` of Warp arrays and a table by state field and
quantity. Missing derivatives with respect to state fields are 0.
"""


def by_field(bar: Adjoint, dimension: int) -> dict[str, np.ndarray]:
    """Return derivatives by name of a state field or quantity. Vector fields have the shape (n, d)."""
    if isinstance(bar, Mapping):
        return dict(bar)
    if isinstance(bar, SnapshotAdjoint):
        return {**bar.state.numpy(dimension), **bar.quantities}
    return bar.numpy(dimension) if isinstance(bar, State) else dict(zip(ADJOINT_FIELDS, bar, strict=False))


def bar_on_device(bar: Adjoint, end: Snapshot) -> SnapshotAdjoint:
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
    """Return the derivative (``leading``) of a loss along the tangents ``dots``. A missing tangent counts as 0."""
    arrays = by_field(bar, np.shape(dots["positions"])[-1])
    arrays |= {"colours": bar.colours} if isinstance(bar, SnapshotAdjoint) else {}
    pairs = [(array.astype(np.float64), np.asarray(dots[n], np.float64)) for n, array in arrays.items() if n in dots]
    return sum(((bar * dot).reshape(*leading, -1).sum(axis=-1) for bar, dot in pairs), np.zeros(leading))


class Loss(Protocol):
    """Protocol of a loss, which is a differentiable number computed from the last state of a trajectory.

    A user-defined loss may have a method ``adjoint(end)`` instead of `value_and_adjoint`. `adjoint` returns only the
    derivatives of the loss.
    """

    def value(self, end: Snapshot) -> float:
        """Return the value of the loss for the last state of a run."""

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        """Return the loss and its derivatives.

        The derivatives are a tuple of NumPy arrays, a table of arrays by field or quantity such as ``{"density":
        array}``, or a `State` of Warp arrays. To make a `State`, call ``end.state.like()`` for zeros, and then
        ``set({"positions": array})``.
        """


@fixed
class Frames:
    """A sum of losses at several states of a run.

    Example: ``loss = cortado.losses.Frames({50: cortado.losses.CentreOfMass([0.4, 0.2]), 100: last})``
    """

    def __init__(self, losses: Mapping[int, Loss]):
        """Set ``losses``, a table from numbers of steps to losses. The initial state has number 0."""
        if not isinstance(losses, Mapping) or not losses:
            raise InputError(f"losses is {shown(losses)}, but must be a table with a loss for at least one frame.")
        for step in losses:
            if not is_whole(step) and not (isinstance(step, float) and float(step).is_integer()):
                raise InputError(f"losses has the frame {shown(step)}, but frames must be whole numbers of steps.")
        self.losses = FixedDict(losses)

    def check(self, time_steps: np.ndarray) -> None:
        """Raise `InputError` if a loss cannot be computed with the time steps of a run (scenes,) [s]."""

    @property
    def fingerprint(self) -> str:
        return " ".join(f"{step}:{fingerprint(loss)}" for step, loss in sorted(self.losses.items()))


def fingerprint(loss: Any) -> str:
    """Return a text that identifies a ``loss``: its ``fingerprint``, its code, or the name of its type.

    Example: ``print(cortado.losses.fingerprint(cortado.losses.CentreOfMass([1.0, 0.2])))``
    """
    return getattr(loss, "fingerprint", code_words(loss) if callable(loss) else type(loss).__qualname__)


@dataclass(frozen=True, eq=False)
class SnapshotBatch(OnHost, Sequence[Snapshot]):
    """A state of all scenes of a batch. ``end[b]`` is the `Snapshot` of scene b."""

    state: State
    """Warp arrays (batch * n,), with the scenes one after the other. `State.numbers` returns arrays (batch, n, ...)."""
    dimension: int
    colours: np.ndarray
    """Colours of the phases (batch, phases, 3) in linear RGB from 0 to 1."""
    moment: Moment | None = None

    def __repr__(self) -> str:
        particles = counted(len(self.state.positions) // len(self), "particle")
        return f"SnapshotBatch({counted(len(self), 'scene')} of {particles})"

    def __len__(self) -> int:
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

    @cached_property
    def on_host(self) -> dict[str, np.ndarray]:
        """Read-only float64 arrays of all fields of all scenes, by name, copied from the device together."""
        return {name: _read_only(array) for name, array in self.state.numpy(self.dimension).items()}

    def _field(self, name: str) -> np.ndarray:
        return self.on_host[name]


@dataclass(frozen=True, repr=False, kw_only=True)
class _Member(Snapshot):
    batch: SnapshotBatch
    number: int

    def _quantity(self, name: str) -> np.ndarray:
        return super()._quantity(name)[self.number]

    def _field(self, name: str) -> np.ndarray:
        return self.batch.on_host[name][self.number]
