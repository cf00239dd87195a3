"""A counting sort of particles by the cells of a grid, for each scene of a batch.

The grid wraps around in every direction, so that every position has a cell. Along a periodic axis the cells divide the
period. Along an axis without a period, distant particles may share a cell. A distance test rejects distant particles.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.grid import Grid
from cortado.device.launching import launch, launch_together
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of

FURTHEST = 2.0**24
"""Greatest distance of a position from the grid [cells]. Particles further away count as lost."""


@cache
def cell_grid_type(precision: Precision) -> Any:
    """``frequency`` is the inverse cell length [1 / m]. ``starts`` is the first sorted particle of each cell."""
    vectors, starts = dict.fromkeys(("origin", "frequency"), precision.vector), wp.array(dtype=wp.int32)
    return struct_of("CellGrid", precision, **vectors, shape=wp.vec3i, starts=starts)


@cache
def cell_functions(precision: Precision) -> SimpleNamespace:
    """``below`` and ``above`` return the range of offsets of neighbouring cells along an axis with n cells."""
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
        return wp.where(n > 2, -1, 0)

    @wp.func
    def above(n: int) -> int:
        return wp.where(n > 1, 2, 1)

    return by_name(wrap, cell_of, below, above)


@cache
def cell_kernels(precision: Precision) -> SimpleNamespace:
    """``rank`` restores the given order within each cell, because the order of atomic additions is random."""
    vector, real = precision.vector, precision.real
    grid_type = cell_grid_type(precision)
    cell_of = cell_functions(precision).cell_of
    module = kernel_module(f"cells_{precision.name}")
    typed = TypesByName(wp.int32, {grid_type: "grid", vector: "x", wp.vec2i: "arrivals"})

    @wp.func
    def is_astray(x: vector, grid: grid_type) -> bool:
        s = wp.cw_mul(x - grid.origin, grid.frequency)
        furthest = real(wp.static(FURTHEST))
        return not (wp.abs(s[0]) < furthest and wp.abs(s[1]) < furthest and wp.abs(s[2]) < furthest)

    @typed.kernel(module)
    def count(grid, particles: int, x, counts, arrivals):
        """``counts`` must be 0 before the launch."""
        i = wp.tid()
        member = i // particles
        cells = grid.shape[0] * grid.shape[1] * grid.shape[2]
        c = cell_of(x[i], grid)
        cell = (c[2] * grid.shape[1] + c[1]) * grid.shape[0] + c[0]
        if is_astray(x[i], grid):
            cell = (i - member * particles) % cells
        cell = member * cells + cell
        arrivals[i] = wp.vec2i(cell, wp.atomic_add(counts, cell, 1))

    @typed.kernel(module)
    def place(arrivals, starts, counts, placed, before):
        """``counts`` is reset to 0 for the next sort."""
        i = wp.tid()
        arrival = arrivals[i]
        p = starts[arrival[0]] + arrival[1]
        placed[p] = i
        before[p] = arrival[1]
        counts[arrival[0]] = 0

    @typed.kernel(module)
    def rank(placed, before, order):
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
    """Lost particles are spread over all cells, because a GPU is slow with many particles in one cell."""

    def __init__(self, grid: Grid, particles: int, precision: Precision, device: Any, members: int = 1):
        self._particles, self._all, self._device = particles, members * particles, device
        self._kernels = cell_kernels(precision)
        cells = members * grid.cells
        self._counts = wp.zeros(cells + 1, dtype=wp.int32, device=device)
        self._arrivals = wp.empty(self._all, dtype=wp.vec2i, device=device)
        self._before = wp.full(self._all + 1, -1, dtype=wp.int32, device=device)
        self.order = wp.empty(self._all, dtype=wp.int32, device=device)
        """Original index of each sorted particle (members * n,)."""
        self._placed = self.order if device.is_cpu else wp.empty_like(self.order)
        self.grid = cell_grid_type(precision)()
        self.grid.origin = precision.vector(*grid.origin)
        self.grid.frequency = precision.vector(*(1.0 / grid.cell))
        self.grid.shape = wp.vec3i(*grid.shape)
        self.grid.starts = wp.zeros(cells + 1, dtype=wp.int32, device=device)

    def __call__(self, positions: wp.array) -> None:
        """Sort positions (members * n,) [m] by cell into `order`. The sort keeps the order of particles in a cell."""
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
