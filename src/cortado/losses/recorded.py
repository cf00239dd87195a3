"""Losses that are functions of Warp arrays."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import require_arguments
from cortado.code_words import code_words
from cortado.device.threads import WARP
from cortado.fixed import fixed
from cortado.losses.loss import Adjoint, Snapshot

WarpFunction = Callable[[wp.array, wp.array, wp.array], Any]
LAUNCHED = "positions", "velocities", "an array for the loss"
"""Its arguments, in words."""


@fixed
class Recorded:
    """A loss that is any function of Warp arrays, differentiated by Warp's tape.

    ``function(positions, velocities, loss)`` launches kernels that add to ``loss``, an array (1,) of the precision of
    the (n,) vectors it is given. Mind Warp's rules for kernels that loop: a sum that is used non-linearly belongs
    into a function of its own.
    """

    def __init__(self, function: WarpFunction):
        require_arguments("function", function, LAUNCHED)
        self.function = function

    @property
    def fingerprint(self) -> str:
        """Tells the loss from one of another function, or of other numbers, for searches that go on."""
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
