"""Distances of particles to their targets."""

from hashlib import sha256
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_numbers
from cortado.device.arrays import to_device
from cortado.device.launching import TreeReduction, launch, sum_of
from cortado.device.state import State
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.losses.loss import Snapshot
from cortado.losses.matching import matching_kernels


class FinalPositions:
    """Mean over particles of the squared distance to their targets [m2]."""

    def __init__(self, target: np.ndarray):
        """``target`` (n, d) [m], in the scene's order."""
        self.target = as_numbers("target", target).copy()
        if self.target.ndim != 2 or not np.isfinite(self.target).all():
            raise InputError(f"target has shape {self.target.shape}, but must be (particles, dimension) and finite.")
        self.target.setflags(write=False)
        self.fingerprint = sha256(self.target.tobytes()).hexdigest()
        """Tells one target from another, for checkpoints."""
        self._on_device: dict[Any, tuple[wp.array, TreeReduction]] = {}
        """The target and the sum over particles, by device and precision."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FinalPositions, (self.target,)

    @WARP
    def value(self, end: Snapshot) -> float:
        return self._mean_square(end, *self._made(end))

    @WARP
    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        target, total = self._made(end)
        x, bar = end.state.positions, end.state.like()
        factor, kernel = 2.0 / len(x), matching_kernels(end.precision).difference
        launch(kernel, len(x), x.device, factor=factor, x=x, target=target, bar=bar.positions)
        return self._mean_square(end, target, total), bar

    def _mean_square(self, end: Snapshot, target: wp.array, total: TreeReduction) -> float:
        x = end.state.positions
        squares = wp.empty(len(x), dtype=wp.float64, device=x.device)
        launch(matching_kernels(end.precision).squared_distance, len(x), x.device, x=x, target=target, squares=squares)
        return float(total(squares).numpy()[0]) / len(x)

    def _made(self, end: Snapshot) -> tuple[wp.array, TreeReduction]:
        x = end.state.positions
        if (len(x), end.dimension) != self.target.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {(len(x), end.dimension)}.")
        key = (str(x.device), end.precision)
        if key not in self._on_device:
            total = sum_of(wp.float64, len(x), x.device)
            self._on_device[key] = to_device(self.target, end.precision, x.device), total
        return self._on_device[key]
