"""Distances of particles to their targets."""

from hashlib import sha256
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import read_only
from cortado.device.launching import TreeReduction, launch, sum_of
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.losses.batch import SnapshotBatch
from cortado.losses.loss import Snapshot
from cortado.losses.matching import matching_kernels
from cortado.particles.arrays import to_device
from cortado.particles.state import State


@fixed
class FinalPositions:
    """Mean over particles of the squared distance to their targets [m2]."""

    def __init__(self, target: np.ndarray):
        """``target`` (n, d) [m], in the scene's order."""
        self.target = read_only("target", target)
        if self.target.ndim != 2 or not np.isfinite(self.target).all():
            raise InputError(f"target has shape {self.target.shape}, but must be (particles, dimension) and finite.")
        self.fingerprint = sha256(self.target.tobytes()).hexdigest()
        """Tells one target from another, for checkpoints."""
        self._on_device: dict[Any, tuple[wp.array, TreeReduction]] = {}
        """The target and the sum over particles, by device, precision and number of scenes."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FinalPositions, (self.target,)

    def value(self, end: Snapshot) -> float:
        return float(self._mean_squares(end)[0])

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        return self.value(end), self._adjoint(end)

    def values(self, end: SnapshotBatch) -> np.ndarray:
        """See `losses.batch.BatchedLoss`."""
        return self._mean_squares(end)

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        """See `losses.batch.BatchedLoss`."""
        return self.values(end), self._adjoint(end)

    @WARP
    def _mean_squares(self, end: Snapshot | SnapshotBatch) -> np.ndarray:
        x, (target, total) = end.state.positions, self._made(end)
        squares = wp.empty(len(x), dtype=wp.float64, device=x.device)
        launch(matching_kernels(end.precision).squared_distance, len(x), x.device, x=x, target=target, squares=squares)
        return total(squares).numpy() / len(target)

    @WARP
    def _adjoint(self, end: Snapshot | SnapshotBatch) -> State:
        x, bar, (target, _) = end.state.positions, end.state.like(), self._made(end)
        factor, kernel = 2.0 / len(target), matching_kernels(end.precision).difference
        launch(kernel, len(x), x.device, factor=factor, x=x, target=target, bar=bar.positions)
        return bar

    def _made(self, end: Snapshot | SnapshotBatch) -> tuple[wp.array, TreeReduction]:
        x, members = end.state.positions, end.state.batch or 1
        shape = (len(x) // members, end.dimension)
        if shape != self.target.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {shape}.")
        key = (str(x.device), end.precision, members)
        if key not in self._on_device:
            total = sum_of(wp.float64, len(self.target), x.device, members)
            self._on_device[key] = to_device(self.target, end.precision, x.device), total
        return self._on_device[key]
