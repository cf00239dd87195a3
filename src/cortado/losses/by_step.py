"""The losses of a run, each of the state after a number of steps."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.losses import Frames, Loss, Snapshot, SnapshotAdjoint, batch
from cortado.losses.checked import as_loss
from cortado.losses.loss import Adjoint, by_field, moment_of
from cortado.particles.state import State


class LossesByStep(Mapping[int, Loss]):
    """The losses by the number of steps before the states that they judge."""

    def __init__(self, loss: Any, steps: int, chosen: bool = False):
        """``loss`` of the state after all ``steps``, or `Frames` of several. Raises `InputError` for what is no loss,
        for frames that a run of so many steps does not have, and where the steps are ``chosen`` for frames at times of
        their own."""
        if chosen and getattr(loss, "time_step", None) is not None:
            raise InputError(
                f"loss is a {type(loss).__name__} of steps of {loss.time_step:g} s, but must be one of numbers of "
                'steps, as solver.time_step is "auto".'
            )
        by_step = loss.losses if isinstance(loss, Frames) else {steps: loss}
        for step in by_step:
            if step not in range(steps + 1):
                raise InputError(f"losses has the frame {step!r}, but must have frames from 0 to {steps}.")
        self._losses: dict[int, Loss] = {step: as_loss(one) for step, one in by_step.items()}
        self.sensors = {repr(one.sensor): one.sensor for one in by_step.values() if hasattr(one, "sensor")}
        """Those that losses read, by what they are."""
        self._frames = loss if isinstance(loss, Frames) else None

    def __getitem__(self, step: int) -> Loss:
        return self._losses[step]

    def __iter__(self) -> Iterator[int]:
        return iter(self._losses)

    def __len__(self) -> int:
        return len(self._losses)

    def _check(self, ends: Mapping[int, Any]) -> None:
        """Raises `InputError` for states of a run that the losses do not fit."""
        if self._frames is not None:
            end = next(iter(ends.values()))
            self._frames.check(np.ravel(moment_of(end).parameters["time_step"]))

    def total(self, ends: Mapping[int, Any], going: Sequence[int] | None) -> Any:
        """Their sum, given states by the number of steps before them; of a batch (batch,), NaN but for the scenes that
        are ``going``, which is None of a single scene."""
        self._check(ends)
        if going is None:
            return sum(loss.value(ends[step]) for step, loss in self._losses.items())
        return sum(batch.values(loss, ends[step], going) for step, loss in self._losses.items())

    def total_and_adjoints(
        self, ends: Mapping[int, Any], going: Sequence[int] | None
    ) -> tuple[Any, dict[int, SnapshotAdjoint]]:
        """The same, and the adjoints of the states by the number of steps before them."""
        self._check(ends)
        if going is None:
            one = {step: loss.value_and_adjoint(ends[step]) for step, loss in self._losses.items()}
            bars = {step: _on_device(bar, ends[step]) for step, (_, bar) in one.items()}
            return sum(value for value, _ in one.values()), bars
        each = {step: batch.values_and_adjoints(loss, ends[step], going) for step, loss in self._losses.items()}
        return sum(values for values, _ in each.values()), {step: bar for step, (_, bar) in each.items()}


def _on_device(bar: Adjoint, end: Snapshot) -> SnapshotAdjoint:
    if isinstance(bar, SnapshotAdjoint):
        return bar
    no_colours = np.zeros_like(end.colours)
    if isinstance(bar, State):
        return SnapshotAdjoint(bar, no_colours)
    state, arrays = end.state.like(), by_field(bar, end.dimension)
    state.set(arrays)
    of_quantities = {name: array for name, array in arrays.items() if name not in state.names}
    return SnapshotAdjoint(state, no_colours, of_quantities)
