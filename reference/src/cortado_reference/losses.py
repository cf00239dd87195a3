"""What a run is judged by, in NumPy."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers
from cortado.errors import InputError
from cortado_reference.digits import Digits


class Loss(Protocol):
    """A differentiable number of the last state: positions [m] and velocities [m / s], (n, d) each."""

    def value(self, positions: Digits, velocities: Digits) -> float:
        """The loss."""

    def adjoint(self, positions: Digits, velocities: Digits) -> tuple[Digits | NDArray, Digits | NDArray]:
        """Its derivatives with respect to both, (n, d) each."""


class FinalPositions:
    """Mean over particles of the squared distance to their targets [m2], as `cortado.losses.FinalPositions`."""

    def __init__(self, target: NDArray):
        """``target`` (n, d) [m], in the scene's order."""
        self.target = as_numbers("target", target).copy()

    def value(self, positions: Digits, velocities: Digits) -> float:
        return float((self._distances(positions) ** 2).sum() / len(self.target))

    def adjoint(self, positions: Digits, velocities: Digits) -> tuple[NDArray, NDArray]:
        return 2.0 / len(self.target) * self._distances(positions), np.zeros_like(self.target)

    def _distances(self, positions: Digits) -> NDArray[np.float64]:
        if self.target.shape != positions.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {positions.shape}.")
        return positions - self.target
