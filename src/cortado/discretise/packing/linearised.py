"""How densities, and distances of pairs, change with the places of particles: products without a matrix, in float64."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.cpu_launches import launched, shared
from cortado.discretise.packing.around import PointsAround, Which
from cortado.discretise.shapes import Points


@dataclass(frozen=True)
class Linearised:
    """Particles at some places, with products of the derivatives there."""

    kernels: Any
    equations: Any
    """What kernels see."""
    sums: Points
    """(n,) of kernels at the particles [1 / m^d]"""
    distances: Points
    """(m,) of pairs that are close [m]"""

    def multiply(self, moves: Points) -> tuple[Points, Points]:
        """By how much the sums (n,) [1 / m^d] and the distances (m,) [m] change with moves (n, 3) [m]."""
        changes, approaches = np.zeros_like(self.sums), np.empty_like(self.distances)
        self._launch(self.kernels.multiply, moves=moves, changes=changes, approaches=approaches)
        return changes, approaches

    def multiply_back(self, changes: Points, approaches: Points) -> Points:
        """(n, 3) the product with the transpose."""
        moves = np.zeros((len(changes), 3))
        self._launch(self.kernels.multiply_back, moves=moves, changes=changes, approaches=approaches)
        return moves

    def _launch(self, kernel: Any, **arrays: Points) -> None:
        launched(kernel, len(self.sums), equations=self.equations, **arrays)


class ListedPairs:
    """Particles, the first of the points around, and what each sees, as long as none moves further than it looks."""

    def __init__(self, around: PointsAround, stays: Which, free: Which):
        """Those that stay (n,) do not see air; pairs of which neither is ``free`` (n,) have no derivatives."""
        starts, ends, listed = around.lists(around.points[: len(free)], stays)
        self._around, self._count, self._most = around, len(free), int((ends - starts).sum())
        self._given = {"free": free, "starts": starts, "ends": ends, "listed": listed}

    def linearised(self, close: float) -> Linearised:
        """The derivatives where the particles are now, and those of distances that are less than ``close`` [m]."""
        kernels, count, most = self._around.kernels, self._count, self._most
        sums, distances = np.full(count, self._around.own_weight), np.empty(most)
        close_starts = np.zeros(count + 1, dtype=np.int32)
        arrays: dict[str, NDArray[Any]] = {
            "starts": np.zeros(count + 1, dtype=np.int32),
            "others": np.empty(most, dtype=np.int32),
            "gradients": np.empty((most, 3)),
            "own": np.empty((count, 3)),
            "close_starts": close_starts,
            "close_others": np.empty(most, dtype=np.int32),
            "directions": np.empty((most, 3)),
        }
        equations = kernels.equations()
        for name, array in arrays.items():
            setattr(equations, name, shared(array))
        given = {"around": self._around.on_cpu, "close": close, **self._given}
        launched(kernels.linearise, count, sums=sums, equations=equations, distances=distances, **given)
        return Linearised(kernels, equations, sums, distances[: close_starts[-1]])
