"""Losses of the centre of mass."""

from hashlib import sha256
from typing import Any

import numpy as np

from cortado.arrays import read_only
from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.losses.loss import Adjoint, Snapshot


@fixed
class CentreOfMass:
    """Squared distance of the centre of mass to a target [m2]."""

    def __init__(self, target: Any, masses: np.ndarray | None = None):
        """``target`` (d,) [m]; ``masses`` (n,) of the particles in any unit, None where they are all the same."""
        self.target, self._weights = _finite("target", target, 1), _weights(masses)
        self.fingerprint = _checksum(self.target, self._weights)
        """Tells one target from another, for checkpoints."""

    def value(self, end: Snapshot) -> float:
        return float((self._miss(end) ** 2).sum())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        bar = 2.0 * _shares(self._weights, end)[:, None] * self._miss(end)
        return self.value(end), (bar, np.zeros_like(end.velocities))

    def _miss(self, end: Snapshot) -> np.ndarray:
        if self.target.shape != (end.dimension,):
            raise InputError(f"target has shape {self.target.shape}, but must be {(end.dimension,)}.")
        return _shares(self._weights, end) @ end.positions - self.target


@fixed
class CentreOfMassAlong:
    """Component of the centre of mass along a direction [m]: its gradient is that of the centre of mass itself."""

    def __init__(self, direction: Any, masses: np.ndarray | None = None):
        """``direction`` (d,) [-]; ``masses`` as those of `CentreOfMass`."""
        self.direction, self._weights = _finite("direction", direction, 1), _weights(masses)
        self.fingerprint = _checksum(self.direction, self._weights)
        """Tells one direction from another, for checkpoints."""

    def value(self, end: Snapshot) -> float:
        return float((self._slopes(end) * end.positions).sum())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        return self.value(end), (self._slopes(end), np.zeros_like(end.velocities))

    def _slopes(self, end: Snapshot) -> np.ndarray:
        if self.direction.shape != (end.dimension,):
            raise InputError(f"direction has shape {self.direction.shape}, but must be {(end.dimension,)}.")
        return _shares(self._weights, end)[:, None] * self.direction


def _finite(what: str, value: Any, dimensions: int) -> np.ndarray:
    """A read-only copy in float64, or an `InputError`."""
    array = read_only(what, value)
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise InputError(f"{what} has shape {array.shape}, but must have {dimensions} dimension and be finite.")
    return array


def _weights(masses: np.ndarray | None) -> np.ndarray | None:
    if masses is None:
        return None
    array = _finite("masses", masses, 1)
    if not (array >= 0.0).all() or not array.any():
        raise InputError("masses has a number below 0, or only zeros, but must be the masses of particles.")
    return array


def _shares(weights: np.ndarray | None, end: Snapshot) -> np.ndarray:
    """(n,) of the particles in the mass of all."""
    n = len(end.positions)
    if weights is None:
        return np.full(n, 1.0 / n)
    if weights.shape != (n,):
        raise InputError(f"masses has shape {weights.shape}, but must be {(n,)}.")
    return weights / weights.sum()


def _checksum(*arrays: np.ndarray | None) -> str:
    return sha256(b" ".join(b"" if array is None else array.tobytes() for array in arrays)).hexdigest()
