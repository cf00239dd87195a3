"""A grid of cells over a region, without Warp, because the reference engine uses the grid, too."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """A grid of cells over a region, each at least as wide as a search reaches."""

    origin: np.ndarray
    """Lower corner of cell 0 [m], (3,)."""
    cell: np.ndarray
    """Edge lengths of a cell [m], (3,)."""
    shape: tuple[int, int, int]
    """Number of cells along each axis; an axis without extent (2-D) has one."""

    @property
    def cells(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    @classmethod
    def around(cls, lower: np.ndarray, upper: np.ndarray, period: np.ndarray, reach: float, most: int) -> "Grid":
        """Make a grid over a region (d,) to (d,) [m]; beyond about ``most`` cells, the region wraps around."""
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
