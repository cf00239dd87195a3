"""What one evaluation of a rollout leaves for ways back and along tangents, while others follow."""

import numpy as np

from cortado.rollout.evaluation import PutAside
from cortado.rollout.rollout import Rollout
from cortado.scene.parameters.values import Arrays


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
        self._aside = self.rollout.put_aside()

    def bring_back(self) -> None:
        """Make this the rollout's present evaluation again."""
        if self._aside is not None:
            aside, self._aside = self._aside, None
            self.rollout.bring_back(aside)
            self.rollout.pending.add(self)


def without_lost(rollout: Rollout, found: Arrays) -> Arrays:
    """Derivatives, of a batch with a first axis for the scenes, without numbers for scenes that were lost."""
    for b in rollout.lost:
        for array in found.values():
            array[b] = np.nan
    return found
