"""Particles sorted by cell, the scenes of a batch one behind the other.

The grid of cells wraps around in every direction, so that no position lies outside of it: along a periodic axis
the cells divide the period, elsewhere cells that share a number are told apart by the distance test.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch, sort_pairs
from cortado.device.precision import Precision


@dataclass(frozen=True)
class Grid:
    """Cells at least as wide as a search reaches."""

    origin: np.ndarray
    """Lower corner of cell 0 [m], (3,)."""
    cell: np.ndarray
    """Edge lengths of a cell [m], (3,)."""
    shape: tuple[int, int, int]
    """Number of cells along each axis; an axis without extent (2-D) has one."""

    @property
    def cells(self) -> int:
        return int(np.prod(self.shape))

    @classmethod
    def around(cls, lower: np.ndarray, upper: np.ndarray, period: np.ndarray, reach: float, most: int) -> "Grid":
        """A grid over a region (d,) to (d,) [m]; at most about ``most`` cells, the rest of the region wraps around."""
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


@cache
def cell_grid_type(precision: Precision) -> Any:
    """The Warp struct of a grid and of who is where in it."""
    vector = precision.vector

    class CellGrid:
        origin: vector
        frequency: vector
        """1 / edge length of a cell [1 / m]."""
        shape: wp.vec3i
        starts: wp.array(dtype=wp.int32)
        """(members cells + 1,): first sorted particle of each cell; each scene of a batch has cells of its own."""

    CellGrid.__name__ = CellGrid.__qualname__ = f"CellGrid_{precision.name}"
    return wp.struct(CellGrid)


@dataclass(frozen=True)
class CellFunctions:
    """Warp functions of a grid of cells."""

    wrap: Any
    cell_of: Any
    below: Any
    above: Any


@cache
def cell_functions(precision: Precision) -> CellFunctions:
    """Warp functions ``wrap`` and ``cell_of``, and ``below`` and ``above``: the cells to visit around one's own."""
    vector = precision.vector
    grid_type = cell_grid_type(precision)

    @wp.func
    def wrap(c: int, n: int) -> int:
        r = c % n
        if r < 0:
            r = r + n
        return r

    @wp.func
    def cell_of(x: vector, grid: grid_type) -> wp.vec3i:
        s = wp.cw_mul(x - grid.origin, grid.frequency)
        return wp.vec3i(
            wrap(int(wp.floor(s[0])), grid.shape[0]),
            wrap(int(wp.floor(s[1])), grid.shape[1]),
            wrap(int(wp.floor(s[2])), grid.shape[2]),
        )

    @wp.func
    def below(n: int) -> int:
        """First cell to visit along an axis of n cells, seen from one's own: no cell is visited twice."""
        return wp.where(n > 2, -1, 0)

    @wp.func
    def above(n: int) -> int:
        """Behind the last cell to visit."""
        return wp.where(n > 1, 2, 1)

    return CellFunctions(wrap=wrap, cell_of=cell_of, below=below, above=above)


@dataclass(frozen=True)
class _CellKernels:
    """The kernels of a sort by cell."""

    number_cells: Any
    find_starts: Any


@cache
def _cell_kernels(precision: Precision) -> _CellKernels:
    vector = precision.vector
    grid_type = cell_grid_type(precision)
    cell_of = cell_functions(precision).cell_of
    module = wp.get_module(f"cortado_cells_{precision.name}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def number_cells(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        # out
        keys: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        c = cell_of(x[i], grid)
        layer = i // particles * grid.shape[2] + c[2]
        keys[i] = (layer * grid.shape[1] + c[1]) * grid.shape[0] + c[0]
        order[i] = i

    @wp.kernel(module=module, enable_backward=False)
    def find_starts(keys: wp.array(dtype=wp.int32), count: int, starts: wp.array(dtype=wp.int32)):
        cell = wp.tid()
        first = wp.lower_bound(keys, 0, count, cell)
        # Warp's lower_bound names the last element where every key is smaller; there the cell starts behind it.
        if keys[first] < cell:
            first = first + 1
        starts[cell] = first

    return _CellKernels(number_cells=number_cells, find_starts=find_starts)


class CellSort:
    """Sorts a fixed number of particles by scene and by cell, on one device and without a host read."""

    def __init__(self, grid: Grid, particles: int, precision: Precision, device: Any, members: int = 1):
        """``particles`` of each of ``members`` scenes."""
        self._particles, self._all, self._device = particles, members * particles, device
        self._kernels = _cell_kernels(precision)
        self._bits = max(int(members * grid.cells - 1).bit_length(), 1)
        self._keys = wp.empty(2 * self._all, dtype=wp.int32, device=device)
        self.order = wp.empty(2 * self._all, dtype=wp.int32, device=device)
        """(2 n,): sorted -> given, in the first half."""
        self.grid = cell_grid_type(precision)()
        """What kernels see."""
        self.grid.origin = precision.vector(*grid.origin)
        self.grid.frequency = precision.vector(*(1.0 / grid.cell))
        self.grid.shape = wp.vec3i(*grid.shape)
        self.grid.starts = wp.zeros(members * grid.cells + 1, dtype=wp.int32, device=device)

    def __call__(self, positions: wp.array) -> None:
        """Find the order of cells of positions (members n,) [m]; ties keep the given order."""
        count, device = self._all, self._device
        if count == 0:
            return
        numbered = {"grid": self.grid, "keys": self._keys, "order": self.order}
        launch(self._kernels.number_cells, count, device, numbered, particles=self._particles, x=positions)
        sort_pairs(self._keys, self.order, count, self._bits)
        starts = self.grid.starts
        launch(self._kernels.find_starts, len(starts), device, keys=self._keys, count=count, starts=starts)
