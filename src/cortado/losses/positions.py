"""Distances of particles to their targets."""

from hashlib import sha256
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_numbers
from cortado.device.arrays import to_device
from cortado.device.launching import launch, sum_of
from cortado.device.precision import Precision
from cortado.device.state import State
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.losses.loss import Snapshot
from cortado.losses.matching import matching_kernels


class FinalPositions:
    """Mean over particles of the squared distance to their targets [m2] (the report's 6.2.2, for one particle)."""

    def __init__(self, target: np.ndarray):
        """``target`` (n, d) [m], in the scene's order."""
        self.target = as_numbers("target", target).copy()
        if self.target.ndim != 2 or not np.isfinite(self.target).all():
            raise InputError(f"target has shape {self.target.shape}, but must be (particles, dimension) and finite.")
        self.target.setflags(write=False)
        self.fingerprint = sha256(self.target.tobytes()).hexdigest()
        """Tells one target from another, for checkpoints."""
        self._on_device: dict[Any, wp.array] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FinalPositions, (self.target,)

    @WARP
    def value(self, end: Snapshot) -> float:
        x, target, device = self._positions_and_target(end)
        return self._mean_square(x, target, device, end.precision)

    @WARP
    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        x, target, device = self._positions_and_target(end)
        bar = end.state.like()
        factor, kernel = 2.0 / len(x), matching_kernels(end.precision).difference
        launch(kernel, len(x), device, factor=factor, x=x, target=target, bar=bar.positions)
        return self._mean_square(x, target, device, end.precision), bar

    def _mean_square(self, x: wp.array, target: wp.array, device: Any, precision: Precision) -> float:
        squares = wp.empty(len(x), dtype=wp.float64, device=device)
        launch(matching_kernels(precision).squared_distance, len(x), device, x=x, target=target, squares=squares)
        total = sum_of(wp.float64, len(x), device)(squares)
        return float(total.numpy()[0]) / len(x)

    def _positions_and_target(self, end: Snapshot) -> tuple[wp.array, wp.array, Any]:
        x = end.state.positions
        if (len(x), end.dimension) != self.target.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {(len(x), end.dimension)}.")
        key = (str(x.device), end.precision)
        if key not in self._on_device:
            self._on_device[key] = to_device(self.target, end.precision, x.device)
        return x, self._on_device[key], x.device
