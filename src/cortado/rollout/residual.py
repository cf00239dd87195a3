"""What one evaluation of a rollout leaves for ways back and along tangents, while others follow."""

from collections.abc import Mapping

import numpy as np

from cortado.particles.state import Parameters, State
from cortado.rollout.evaluation import PutAside
from cortado.rollout.rollout import Rollout
from cortado.scene.parameter_values import Arrays

OfLost = Mapping[int, float]
"""By the numbers of the scenes of a batch that were lost what derivatives of them are: 0 where only zeros were given,
else NaN."""


class Residual:
    """The present evaluation of a rollout, to come back to: whoever holds it may go back through its steps, also after
    other evaluations of the same rollout.

    Nothing is copied until another evaluation begins. From then on it keeps the first state and, as long as it is held,
    the checkpoints.
    """

    def __init__(self, rollout: Rollout):
        self.rollout = rollout
        self._aside: PutAside | None = None
        rollout.pending.add(self)

    def put_aside(self) -> None:
        """Copy what another evaluation is about to overwrite."""
        self._aside = PutAside(self.rollout)

    def bring_back(self) -> None:
        """Make this the rollout's present evaluation again."""
        if self._aside is not None:
            aside, self._aside = self._aside, None
            self.rollout.bring_back(aside)
            self.rollout.pending.add(self)


def of_lost(rollout: Rollout, given: State, times: np.ndarray, parameters: Parameters | None = None) -> OfLost:
    """Of derivatives that are linear in those that were ``given`` of a state and its time, (batch,), and of
    parameters."""
    found = {}
    for b in rollout.lost:
        own = [array.numpy() for array in given.member(b).arrays()]
        own += [] if parameters is None else [array.numpy()[b] for array in parameters.arrays()]
        found[b] = np.nan if times[b] or any(array.any() for array in own) else 0.0
    return found


def without_lost(lost: OfLost, found: Arrays) -> Arrays:
    """Derivatives, of a batch with a first axis for the scenes, without numbers for scenes that were lost."""
    for b, number in lost.items():
        for array in found.values():
            array[b] = number
    return found
