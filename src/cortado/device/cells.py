"""Particles sorted by cell, scene after scene of a batch.

The grid of cells wraps around in every direction, so that no position lies outside of it. Along a periodic axis the
cells divide the period; elsewhere the distance test tells apart cells that share a number.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.grid import Grid
from cortado.device.launching import launch, launch_together
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName

FURTHEST = 2.0**24
"""Greatest distance from the grid, in cells: a position further away counts as lost."""


@cache
def cell_grid_type(precision: Precision) -> Any:
    """Return the Warp struct of a grid with the particles of each cell."""
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


@cache
def cell_functions(precision: Precision) -> SimpleNamespace:
    """Build the Warp functions of a grid of cells: ``wrap`` and ``cell_of``, and ``below`` and ``above``, the limits of
    the relative cells to visit along an axis."""
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
        """Return the first cell to visit along an axis of n cells, relative to one's own: no cell is visited twice."""
        return wp.where(n > 2, -1, 0)

    @wp.func
    def above(n: int) -> int:
        """Return the relative cell after the last one to visit along an axis of n cells."""
        return wp.where(n > 1, 2, 1)

    return by_name(wrap, cell_of, below, above)


@cache
def cell_kernels(precision: Precision) -> SimpleNamespace:
    """Build the kernels ``count``, ``place`` and ``rank`` of a counting sort. Atomic additions count each cell's
    particles and assign places, in an order that differs from run to run. So each particle then counts the particles of
    its cell before it in the given order, and takes the place of that number."""
    vector, real = precision.vector, precision.real
    grid_type = cell_grid_type(precision)
    cell_of = cell_functions(precision).cell_of
    module = kernel_module(f"cells_{precision.name}")
    typed = TypesByName(wp.int32, {grid_type: "grid", vector: "x", wp.vec2i: "arrivals"})

    @wp.func
    def is_astray(x: vector, grid: grid_type) -> bool:
        """Test if a position is further from the grid than `FURTHEST` cells, or is not a number."""
        s = wp.cw_mul(x - grid.origin, grid.frequency)
        furthest = real(wp.static(FURTHEST))
        return not (wp.abs(s[0]) < furthest and wp.abs(s[1]) < furthest and wp.abs(s[2]) < furthest)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def count(grid, particles: int, x, counts, arrivals):
        """Write to ``arrivals`` each particle's cell and its number of earlier arrivals; ``counts`` begins at 0."""
        i = wp.tid()
        member = i // particles
        cells = grid.shape[0] * grid.shape[1] * grid.shape[2]
        c = cell_of(x[i], grid)
        cell = (c[2] * grid.shape[1] + c[1]) * grid.shape[0] + c[0]
        if is_astray(x[i], grid):
            cell = (i - member * particles) % cells
        cell = member * cells + cell
        arrivals[i] = wp.vec2i(cell, wp.atomic_add(counts, cell, 1))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def place(arrivals, starts, counts, placed, before):
        """Write to ``placed`` the particle at each place, and to ``before`` the number of its cell's before it; clear
        ``counts``."""
        i = wp.tid()
        arrival = arrivals[i]
        p = starts[arrival[0]] + arrival[1]
        placed[p] = i
        before[p] = arrival[1]
        counts[arrival[0]] = 0

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def rank(placed, before, order):
        """Sort the particles of each cell by given order; ``before`` is -1 behind the last cell."""
        p = wp.tid()
        i = placed[p]
        first = p - before[p]
        smaller = int(0)
        q = int(first)
        while before[q] == q - first:
            if placed[q] < i:
                smaller += 1
            q += 1
        order[first + smaller] = i

    return by_name(count, place, rank)


class CellSort:
    """A sort of a fixed number of particles by scene and by cell, on one device and without a host read.

    On a GPU the work grows with the square of the number of particles in one cell. Filling the neighbour lists compares
    the same pairs and more, so it takes even longer. Particles too far away to be neighbours, perhaps all of an
    exploded scene, are spread over all cells. A CPU counts particles in the given order, so they need no rank.
    """

    def __init__(self, grid: Grid, particles: int, precision: Precision, device: Any, members: int = 1):
        """Allocate for ``particles`` in each of ``members`` scenes."""
        self._particles, self._all, self._device = particles, members * particles, device
        self._kernels = cell_kernels(precision)
        cells = members * grid.cells
        self._counts = wp.zeros(cells + 1, dtype=wp.int32, device=device)
        self._arrivals = wp.empty(self._all, dtype=wp.vec2i, device=device)
        self._before = wp.full(self._all + 1, -1, dtype=wp.int32, device=device)
        self.order = wp.empty(self._all, dtype=wp.int32, device=device)
        """(n,): given index of each sorted particle."""
        self._placed = self.order if device.is_cpu else wp.empty_like(self.order)
        self.grid = cell_grid_type(precision)()
        """The grid struct that kernels use."""
        self.grid.origin = precision.vector(*grid.origin)
        self.grid.frequency = precision.vector(*(1.0 / grid.cell))
        self.grid.shape = wp.vec3i(*grid.shape)
        self.grid.starts = wp.zeros(cells + 1, dtype=wp.int32, device=device)

    def __call__(self, positions: wp.array) -> None:
        """Sort positions (members n,) [m] by cell into `order`; ties keep the given order."""
        if self._all == 0:
            return
        seen = (positions, self.order, self.grid.starts)
        launch_together("cell_sort", self._all, seen, partial(self._sort, positions))

    def _sort(self, positions: wp.array) -> None:
        kernels, count, device, starts = self._kernels, self._all, self._device, self.grid.starts
        arrays = {"arrivals": self._arrivals, "counts": self._counts, "placed": self._placed, "before": self._before}
        try:
            launch(kernels.count, count, device, arrays, grid=self.grid, particles=self._particles, x=positions)
            wp.utils.array_scan(self._counts, starts, inclusive=False)
            launch(kernels.place, count, device, arrays, starts=starts)
        except BaseException:  # such as an interruption: the next sort begins with counts of 0 all the same
            self._counts.zero_()
            raise
        if not device.is_cpu:
            launch(kernels.rank, count, device, arrays, order=self.order)
