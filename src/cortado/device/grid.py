"""A grid of cells, without Warp, because the reference engine uses it too."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """A cell is at least as wide as the search radius."""

    origin: np.ndarray
    """Lower corner of cell 0 [m], (3,)."""
    cell: np.ndarray
    """Edge lengths of a cell [m], (3,)."""
    shape: tuple[int, int, int]
    """Number of cells along each axis. In 2-D, the number along z is 1."""

    @property
    def cells(self) -> int:
        return int(np.prod(self.shape))

    @classmethod
    def around(cls, lower: np.ndarray, upper: np.ndarray, period: np.ndarray, reach: float, most: int) -> "Grid":
        """A grid of more than about ``most`` cells is reduced and wraps around. Lengths are in [m]."""
        origin, cell, shape = np.zeros(3), np.full(3, reach), [1, 1, 1]
        for axis in range(len(lower)):
            if period[axis] > 0:
                origin[axis] = lower[axis]
                shape[axis] = max(int(period[axis] / reach * (1 + 1e-12)), 1)
            else:
                origin[axis] = lower[axis] - reach
                shape[axis] = max(int(np.ceil((upper[axis] - lower[axis]) / reach)) + 2, 3)
        while np.prod(shape, dtype=float) > most and max(shape) > 3:
            axis = int(np.argmax(shape))
            shape[axis] = max(shape[axis] // 2, 3)
        for axis in range(len(lower)):
            if period[axis] > 0:
                cell[axis] = period[axis] / shape[axis]
        return cls(origin, cell, (shape[0], shape[1], shape[2]))
