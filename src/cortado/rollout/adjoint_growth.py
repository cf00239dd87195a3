"""The growth of the adjoint of a state over chained calls, with a warning where it is chaos."""

import math
from typing import Any

import numpy as np
import warp as wp

from cortado.errors import warn
from cortado.particles.state import State
from cortado.rollout.device_states import clocks_after
from cortado.rollout.rollout import Rollout

MOST = 10.0
"""Growth from which on there is a warning [e-folds]: what began the chain is then 1/22,000 of the adjoint."""


class AdjointGrowth:
    """The growth of the adjoint of a simulation's states from call to call of a way back.

    A call continues the chain of the call before where it ends at the time at which that one began. The growth in
    e-folds is the smaller one of two: that of the norm since the chain began, and the sum of those within calls. So
    neither a loss of each segment, nor what a policy takes away again, counts as growth. The norm is that of
    `cortado.certificate`, sqrt(|x^|^2 + |v^|^2 / T^2) with the time T of the chain.
    """

    def __init__(self) -> None:
        self._reached, self._ended, self._within, self._steps = math.nan, 0.0, 0.0, 0
        self._begun: Any = np.zeros(2)
        self._warned = False

    def follow(self, rollout: Rollout, last: State, first: State) -> None:
        """Note a call that took the adjoint of the ``last`` state to that of the ``first``; warn once, in the call in
        which the growth exceeds `MOST`."""
        start, end = (clocks_after(rollout, steps)[0].time for steps in (0, rollout.steps))
        into, out = _norms(last), _norms(first)
        if not (abs(end - self._reached) < 0.5 * (end - start) / rollout.steps and self._begun.any()):
            self._begun, self._ended, self._within, self._steps = into, end, 0.0, 0
        self._reached, self._steps = start, self._steps + rollout.steps
        per = np.array([1.0, 1.0 / (self._ended - start)])
        with np.errstate(divide="ignore", invalid="ignore"):
            begun, into, out = (np.log(np.linalg.norm(per * one)) for one in (self._begun, into, out))
        self._within += out - into
        growth = min(out - begun, self._within)
        if growth > MOST and not self._warned:
            self._warned = True
            found = f"by e^{growth:.1f}" if math.isfinite(growth) else "beyond 1e19, whose square overflows,"
            warn(
                f"The adjoint of the state has grown {found} over {self._steps} steps, back from "
                f"{self._ended:.4g} s to {start:.4g} s, so that gradients of earlier steps point anywhere: chain fewer "
                "steps, or take gradient=cortado.gradients.AdjointViscosity()."
            )


def _norms(bar: State) -> Any:
    """Return the norms (2,) of the adjoints of positions and velocities over all particles; infinite where squares
    overflow."""
    return np.sqrt([wp.utils.array_inner(one, one) for one in (bar.positions, bar.velocities)])
