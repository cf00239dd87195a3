"""Check user-defined losses, and assign losses to states by the number of steps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import warp as wp

from cortado.arrays import as_numbers, as_one_number, require_arguments
from cortado.calls import fixed
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.losses.loss import Adjoint, Frames, Snapshot, SnapshotAdjoint, SnapshotBatch, bar_on_device, moment_of
from cortado.particles.state import State
from cortado.runs.sensor import SensedScene
from cortado.scene.parameters import check_readable
from cortado.sph.function_text import code_words

WarpFunction = Callable[[wp.array, wp.array, wp.array], Any]
LAUNCHED = "positions", "velocities", "an array for the loss"


@fixed
class Recorded:
    """A loss made from a function of Warp arrays, differentiated by Warp's tape.

    ``function(positions, velocities, loss)`` launches kernels that add to ``loss``. ``loss`` is an array (1,) in the
    precision of the vectors (n,). If the value of a sum is used non-linearly, compute the sum in a separate Warp
    function. Warp's derivatives of loops in kernels would be wrong.

    Example::

        def heights(positions, velocities, loss):
            wp.launch(add_heights, dim=positions.shape, inputs=[positions], outputs=[loss])

        problem = cortado.Problem(simulation, 100, cortado.losses.Recorded(heights))
    """

    def __init__(self, function: WarpFunction):
        require_arguments("function", function, LAUNCHED)
        self.function = function

    @property
    def fingerprint(self) -> str:
        return f"{type(self).__qualname__} {code_words(self.function)}"

    @WARP
    def value(self, end: Snapshot) -> float:
        loss, _, _ = self._run(end)
        return float(loss.numpy()[0])

    @WARP
    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        with wp.Tape() as tape:
            loss, positions, velocities = self._run(end)
        tape.backward(loss)
        bars = tuple(array.grad.numpy()[:, : end.dimension].astype(np.float64) for array in (positions, velocities))
        return float(loss.numpy()[0]), bars

    def _run(self, end: Snapshot) -> tuple[wp.array, wp.array, wp.array]:
        copies = [wp.clone(a, requires_grad=True) for a in (end.state.positions, end.state.velocities)]
        loss = wp.zeros(1, dtype=end.precision.real, device=copies[0].device, requires_grad=True)
        self.function(copies[0], copies[1], loss)
        return loss, copies[0], copies[1]


FORMS = "positions", "velocities", "mass fractions"


class CheckedLoss:
    def __init__(self, loss: Any):
        self._loss = loss

    def value(self, end: Snapshot) -> float:
        return as_one_number("the loss's value", self._loss.value(end))

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        if hasattr(self._loss, "adjoint"):
            return self.value(end), self._checked(self._loss.adjoint(end), end)
        value, bar = self._loss.value_and_adjoint(end)
        return as_one_number("the loss's value", value), self._checked(bar, end)

    def values(self, end: SnapshotBatch, members: Sequence[int]) -> np.ndarray:
        """Return the losses (batch,), which are NaN for scenes outside ``members``."""
        return _among(members, [self.value(end[b]) for b in members], len(end))

    def values_and_adjoints(self, end: SnapshotBatch, members: Sequence[int]) -> tuple[np.ndarray, SnapshotAdjoint]:
        """Return the `values` and their derivatives, which are 0 for scenes outside ``members``."""
        found, state, colours = np.full(len(end), np.nan), end.state.like(), np.zeros_like(end.colours)
        quantities: dict[str, np.ndarray] = {}
        for b in members:
            found[b], given = self.value_and_adjoint(end[b])
            bar = bar_on_device(given, end[b])
            state.member(b).assign(bar.state)
            colours[b] = bar.colours
            for name, array in bar.quantities.items():
                quantities.setdefault(name, np.zeros((len(end), *array.shape)))[b] = array
        return found, SnapshotAdjoint(state, colours, quantities)

    def _checked(self, bar: Any, end: Snapshot) -> Adjoint:
        if isinstance(bar, State):
            return _checked_state(bar, end)
        if isinstance(bar, SnapshotAdjoint):
            colours = _checked_share("adjoint of colours", bar.colours, end.colours.shape)
            return SnapshotAdjoint(_checked_state(bar.state, end), colours, _checked_table(bar.quantities, end))
        if isinstance(bar, Mapping):
            return _checked_table(bar, end)
        if not isinstance(bar, (tuple, list, np.ndarray)) or len(bar) not in (2, 3):
            count = f" of {len(bar)}" if isinstance(bar, (tuple, list)) else ""
            each = f"the derivatives with respect to {', '.join(FORMS[:2])} and {FORMS[2]}"
            forms = f"a tuple of two or three arrays, {each}, or a State, or a SnapshotAdjoint"
            raise InputError(f"the loss's adjoint is a {type(bar).__name__}{count}, but must be {forms}.")
        wanted = (end.positions.shape, end.velocities.shape, end.mass_fractions.shape)
        names = (f"adjoint of {form}" for form in FORMS)
        return tuple(_checked_share(*entry) for entry in zip(names, bar, wanted, strict=False))


@runtime_checkable
class BatchedLoss(Protocol):
    """Protocol of a loss for all scenes of a batch. Results must be bitwise equal to losses of single scenes."""

    def values(self, end: SnapshotBatch) -> np.ndarray:
        """Return the losses (batch,). The loss of a diverged scene is arbitrary."""

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        """Return the losses (batch,) and derivatives as a state of Warp arrays. ``end.state.like()`` makes zeros."""


class CheckedBatchedLoss(CheckedLoss):
    def values(self, end: SnapshotBatch, members: Sequence[int]) -> np.ndarray:
        found = _checked_array("values", self._loss.values(end), (len(end),))
        return _among(members, found[members], len(end))

    def values_and_adjoints(self, end: SnapshotBatch, members: Sequence[int]) -> tuple[np.ndarray, SnapshotAdjoint]:
        values, bar = self._loss.values_and_adjoint(end)
        found, state = _checked_array("values", values, (len(end),)), _checked_state(bar, end)
        for b in set(range(len(end))).difference(members):
            state.member(b).clear()
        return _among(members, found[members], len(end)), SnapshotAdjoint(state, np.zeros_like(end.colours))


def _among(members: Sequence[int], values: Any, batch: int) -> np.ndarray:
    found = np.full(batch, np.nan)
    found[members] = values
    return found


def as_loss(loss: Any) -> CheckedLoss:
    if isinstance(loss, type):
        raise InputError(f"loss is the class {loss.__name__}, but must be an object of this class.")
    derivative = next((name for name in ("adjoint", "value_and_adjoint") if hasattr(loss, name)), None)
    if derivative is not None and hasattr(loss, "value"):
        for name in ("value", derivative):
            require_arguments(f"the loss's {name}", getattr(loss, name), ("the end of a trajectory",))
        return CheckedBatchedLoss(loss) if isinstance(loss, BatchedLoss) else CheckedLoss(loss)
    if not callable(loss):
        raise InputError(f"loss is a {type(loss).__name__}, but must be a function, or have methods value and adjoint.")
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
    for name in bar:
        check_readable(name, "a name in the loss's adjoint", end.state.names)
    return {name: _checked_share(f"adjoint of {name}", array, end[name].shape) for name, array in bar.items()}


def _checked_array(what: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = as_numbers(f"the loss's {what}", values)
    if array.shape != shape:
        raise InputError(f"the loss's {what} has shape {array.shape}, but must be {shape}.")
    return array


def _checked_share(what: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = _checked_array(what, values, shape)
    if not np.isfinite(array).all():
        row = np.argwhere(~np.isfinite(array))[0][0]
        raise InputError(f"the loss's {what} is not finite in row {row}, but must be finite everywhere.")
    return array


def _layout(array: wp.array) -> str:
    return f"a Warp array of {wp.types.type_repr(array.dtype)} of shape {array.shape} on {array.device}"


class LossesByStep(dict[int, CheckedLoss]):
    def __init__(self, loss: Any, steps: int, chosen: bool = False):
        """``loss`` reads the last state, or is a `Frames`. ``chosen`` is true if the run chooses its time steps."""
        if chosen and getattr(loss, "time_step", None) is not None:
            wanted = 'a loss without a time step, as solver.time_step is "auto"'
            raise InputError(
                f"loss is a {type(loss).__name__} with the time step {loss.time_step:g} s, but must be {wanted}."
            )
        by_step = loss.losses if isinstance(loss, Frames) else {steps: loss}
        for step in by_step:
            if step not in range(steps + 1):
                raise InputError(f"losses has the frame {step!r}, but must have frames from 0 to {steps}.")
        super().__init__({step: as_loss(one) for step, one in by_step.items()})
        self._sensors = {step: one.sensor for step, one in by_step.items() if hasattr(one, "sensor")}
        self.sensors = {repr(sensor): sensor for sensor in self._sensors.values()}
        self._frames = loss if isinstance(loss, Frames) else None

    def _check(self, ends: Mapping[int, Any]) -> None:
        if self._frames is not None:
            self._frames.check(np.ravel(moment_of(next(iter(ends.values()))).parameters["time_step"]))

    def quantities(self, scene: Callable[[], SensedScene]) -> dict[int, str]:
        sums = {step: one.summed(scene()) for step, one in self._sensors.items() if hasattr(one, "summed")}
        return {step: one.quantity for step, one in sums.items() if one.quantity is not None}

    def total(self, ends: Mapping[int, Any], going: Sequence[int] | None) -> Any:
        """Return the sum of all losses. The sum for a batch has the shape (batch,), with NaN outside ``going``."""
        self._check(ends)
        each = ((ends[step], loss) for step, loss in self.items())
        return sum(loss.value(end) if going is None else loss.values(end, going) for end, loss in each)

    def total_and_adjoints(
        self, ends: Mapping[int, Any], going: Sequence[int] | None
    ) -> tuple[Any, dict[int, SnapshotAdjoint]]:
        self._check(ends)
        total: Any = 0.0
        bars = dict[int, SnapshotAdjoint]()
        for step, loss in self.items():
            if going is None:
                value, bar = loss.value_and_adjoint(ends[step])
                total, bars[step] = total + value, bar_on_device(bar, ends[step])
            else:
                values, bars[step] = loss.values_and_adjoints(ends[step], going)
                total = total + values
        return total, bars
