"""A user's loss, in whatever form it comes, with a sentence where it cannot be used or gives what cannot be used."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_numbers, as_one_number, require_arguments
from cortado.errors import InputError
from cortado.losses import Loss, Recorded, Snapshot, SnapshotAdjoint, SnapshotBatch
from cortado.losses.batch import BatchedLoss
from cortado.losses.loss import ADJOINT_FIELDS, Adjoint
from cortado.losses.recorded import LAUNCHED
from cortado.particles.state import State
from cortado.scene.quantities import check_readable

FORMS = tuple(name.replace("_", " ") for name in ADJOINT_FIELDS)
"""What the arrays of an adjoint are derivatives with respect to, in words."""


class CheckedLoss:
    """A loss whose value is a number, and whose adjoint fits the state."""

    def __init__(self, loss: Any):
        """A `Loss`; an ``adjoint`` of its own takes the place of ``value_and_adjoint``."""
        self._loss = loss

    def value(self, end: Snapshot) -> float:
        return as_one_number("the loss's value", self._loss.value(end))

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        """As that of `Loss`; arrays come in float64."""
        if hasattr(self._loss, "adjoint"):
            return self.value(end), self._checked(self._loss.adjoint(end), end)
        value, bar = self._loss.value_and_adjoint(end)
        return as_one_number("the loss's value", value), self._checked(bar, end)

    def _checked(self, bar: Any, end: Snapshot) -> Adjoint:
        if isinstance(bar, State):
            return _checked_state(bar, end)
        if isinstance(bar, SnapshotAdjoint):
            colours = _checked_adjoint("adjoint of colours", bar.colours, end.colours.shape)
            return SnapshotAdjoint(_checked_state(bar.state, end), colours, _checked_table(bar.quantities, end))
        if isinstance(bar, Mapping):
            return _checked_table(bar, end)
        if not isinstance(bar, (tuple, list, np.ndarray)) or len(bar) not in (2, 3):
            count = f" of {len(bar)}" if isinstance(bar, (tuple, list)) else ""
            raise InputError(
                f"the loss's adjoint is a {type(bar).__name__}{count}, but must be a tuple of two or three arrays, the "
                f"derivatives with respect to {', '.join(FORMS[:2])} and {FORMS[2]}, or a State, or a SnapshotAdjoint."
            )
        wanted = (end.positions.shape, end.velocities.shape, end.mass_fractions.shape)
        forms = (f"adjoint of {form}" for form in FORMS)
        return tuple(_checked_adjoint(*entry) for entry in zip(forms, bar, wanted, strict=False))


class CheckedBatchedLoss(CheckedLoss):
    """The same of a loss that looks at all scenes of a batch at once."""

    def values(self, end: SnapshotBatch) -> np.ndarray:
        return _checked_array("values", self._loss.values(end), (len(end),))

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        values, bar = self._loss.values_and_adjoint(end)
        return _checked_array("values", values, (len(end),)), _checked_state(bar, end)


def as_loss(loss: Any) -> Loss:
    """A loss with its results checked; a function of Warp arrays is made into one. Raises `InputError`."""
    if isinstance(loss, type):
        raise InputError(f"loss is the class {loss.__name__}, but must be an object that is made of it.")
    derivative = next((name for name in ("adjoint", "value_and_adjoint") if hasattr(loss, name)), None)
    if derivative is not None and hasattr(loss, "value"):
        for name in ("value", derivative):
            require_arguments(f"the loss's {name}", getattr(loss, name), ("the end of a trajectory",))
        return CheckedBatchedLoss(loss) if isinstance(loss, BatchedLoss) else CheckedLoss(loss)
    if not callable(loss):
        raise InputError(f"loss is a {type(loss).__name__}, but must have a value and an adjoint, or be a function.")
    other = ", of Warp arrays; a loss of the end of a trajectory is an object with value(end) and adjoint(end)"
    require_arguments("loss", loss, LAUNCHED, other)
    return CheckedLoss(Recorded(loss))


def _checked_state(bar: Any, end: Snapshot | SnapshotBatch) -> State:
    if not isinstance(bar, State):
        raise InputError(f"the loss's adjoint has a {type(bar).__name__} as its state, but must have a State.")
    if bar.names != end.state.names:
        raise InputError(f"the loss's adjoint has {', '.join(bar.names)}, but must have {', '.join(end.state.names)}.")
    for name in bar.names:
        form, found, wanted = name.replace("_", " "), bar[name], end.state[name]
        if not isinstance(found, wp.array) or _layout(found) != _layout(wanted):
            text = _layout(found) if isinstance(found, wp.array) else f"a {type(found).__name__}"
            raise InputError(f"the loss's adjoint of {form} is {text}, but must be {_layout(wanted)}.")
    return bar


def _checked_table(bar: Mapping[str, Any], end: Snapshot) -> dict[str, np.ndarray]:
    """Adjoints by the names of fields of a state and of quantities."""
    for name in bar:
        check_readable(name, "a name in the loss's adjoint", end.state.names)
    return {name: _checked_adjoint(f"adjoint of {name}", array, end[name].shape) for name, array in bar.items()}


def _checked_array(what: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = as_numbers(f"the loss's {what}", values)
    if array.shape != shape:
        raise InputError(f"the loss's {what} has shape {array.shape}, but must be {shape}.")
    return array


def _checked_adjoint(what: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = _checked_array(what, values, shape)
    if not np.isfinite(array).all():
        row = np.argwhere(~np.isfinite(array))[0][0]
        raise InputError(f"the loss's {what} has a value in row {row} that is not finite, but must be made of numbers.")
    return array


def _layout(array: wp.array) -> str:
    """What has to be the same for one array to be copied onto another."""
    return f"a Warp array of {wp.types.type_repr(array.dtype)} of shape {array.shape} on {array.device}"
