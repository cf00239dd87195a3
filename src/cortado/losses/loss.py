"""What a loss is, what it is given, and the sum of several at several steps."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from cortado.arrays import is_whole
from cortado.code_words import code_words
from cortado.device.launching import add
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.errors import InputError, shown
from cortado.fixed import FixedDict, fixed
from cortado.particles.state import State
from cortado.runs.quantities.moment import Moment
from cortado.scene.containers import Container
from cortado.scene.discrete_scene import Lattice
from cortado.scene.quantities import check_readable
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
        """Of the Warp arrays."""
        return precision_of(self.state)

    @cached_property
    def positions(self) -> np.ndarray:
        """(n, d) [m], float64, read-only"""
        return _read_only(self.state.positions.numpy()[:, : self.dimension])

    @cached_property
    def velocities(self) -> np.ndarray:
        """(n, d) [m / s], float64, read-only"""
        return _read_only(self.state.velocities.numpy()[:, : self.dimension])

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """(n, phases) [-], float64, read-only"""
        return _read_only(self.state.mass_fractions.numpy())

    def __getitem__(self, name: str) -> np.ndarray:
        """A field of the state by its name, such as "velocities", or a quantity of its particles, such as "density" or
        "pressure", or the load on a solid, such as "rotor.load" (see `docs/sensors.md`); float64, read-only. Raises
        `InputError` for any other name."""
        if name in ADJOINT_FIELDS:
            return getattr(self, name)
        if isinstance(name, str) and name in self.state.names:
            return _read_only(self.state.numpy(self.dimension, only=[name])[name])
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
        """That of the scene."""
        return moment_of(self).container

    def _quantity(self, name: str) -> np.ndarray:
        return moment_of(self).value(name)


def _read_only(values: np.ndarray) -> np.ndarray:
    """A copy in float64 that a loss cannot change by mistake for what is computed from it next."""
    found = values.astype(np.float64)
    found.flags.writeable = False
    return found


class HasMoment(Protocol):
    """A state of one scene or of a batch, as its quantities see it."""

    @property
    def moment(self) -> Moment | None:
        """See `Snapshot`."""


def moment_of(end: HasMoment) -> Moment:
    """What quantities of a state follow from; raises `InputError` where it is not known."""
    if end.moment is None:
        raise InputError("a quantity is asked for of a state whose simulation is not known, but must be of a run's.")
    return end.moment


@dataclass(frozen=True, repr=False)
class StepBar:
    """Derivatives of a loss with respect to the parameters of one step."""

    row: int
    """Which of a run's steps it is, or how many there are: one after the last (`row_of` of
    `cortado.runs.quantities.moment`)."""
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

    def through_quantities(self, end: HasMoment) -> "SnapshotAdjoint":
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


class Loss(Protocol):
    """A differentiable number of the end of a trajectory.

    A loss of your own may have a method ``adjoint(end)``, of the derivatives alone, in the place of
    `value_and_adjoint`.
    """

    def value(self, end: Snapshot) -> float:
        """The loss."""

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
