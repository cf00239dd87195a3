"""Neighbours: particles sorted by cell, and a symmetric list that the step keeps.

The list reaches a little beyond the support radius (`SKIN`), because the density is also taken at predicted positions:
without it a pair that comes into touch within the step would count or not depending on which side of the support it
started, a jump in the map from one state to the next (and lattices start with pairs at just that distance).

The grid of cells wraps around in every direction, so that no position lies outside of it: along a periodic axis
the cells divide the period, elsewhere cells that share a number are told apart by the distance test. The list holds
j for i exactly when it holds i for j, because |x_i - x_j| is computed with the same bits from both sides.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.launching import MOST_PARTS, Launcher
from cortado.physics.surroundings import UNROLL, Discretisation, pair_functions, surroundings_type
from cortado.precision import Precision

SKIN = 0.03
"""How far the lists reach beyond the support radius, relative to it."""


@dataclass(frozen=True)
class Grid:
    """Cells at least as wide as the lists reach."""

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
def _grid_type(precision: Precision) -> Any:
    vector = precision.vector

    class CellGrid:
        origin: vector
        frequency: vector
        """1 / edge length of a cell [1 / m]."""
        shape: wp.vec3i
        starts: wp.array(dtype=wp.int32)
        """(cells + 1,): first sorted fluid particle of each cell."""
        wall_starts: wp.array(dtype=wp.int32)

    CellGrid.__name__ = CellGrid.__qualname__ = f"CellGrid_{precision.name}"
    return wp.struct(CellGrid)


@cache
def _cell_kernels(precision: Precision) -> SimpleNamespace:
    vector = precision.vector
    grid_type = _grid_type(precision)
    module = wp.get_module(f"cortado_cells_{precision.name}")
    module.options["enable_backward"] = False

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

    @wp.kernel(module=module, enable_backward=False)
    def number_cells(
        grid: grid_type,
        x: wp.array(dtype=vector),
        # out
        keys: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        c = cell_of(x[i], grid)
        keys[i] = (c[2] * grid.shape[1] + c[1]) * grid.shape[0] + c[0]
        order[i] = i

    @wp.kernel(module=module, enable_backward=False)
    def find_starts(keys: wp.array(dtype=wp.int32), count: int, starts: wp.array(dtype=wp.int32)):
        cell = wp.tid()
        first = wp.lower_bound(keys, 0, count, cell)
        # Warp's lower_bound names the last element where every key is smaller; there the cell starts behind it.
        if keys[first] < cell:
            first = first + 1
        starts[cell] = first

    return SimpleNamespace(wrap=wrap, cell_of=cell_of, number_cells=number_cells, find_starts=find_starts)


@cache
def _fill_kernel(discretisation: Discretisation) -> Any:
    precision = discretisation.precision
    vector = precision.vector
    grid_type = _grid_type(precision)
    surroundings = surroundings_type(precision)
    cells = _cell_kernels(precision)
    wrap, cell_of = cells.wrap, cells.cell_of
    separation = pair_functions(discretisation).separation

    @wp.func
    def below(n: int) -> int:
        """First cell to visit along an axis of n cells, seen from one's own: no cell is visited twice."""
        return wp.where(n > 2, -1, 0)

    @wp.func
    def above(n: int) -> int:
        """Behind the last cell to visit."""
        return wp.where(n > 1, 2, 1)

    @wp.func
    def scan(
        i: int,
        own: int,
        first: int,
        last: int,
        found: int,
        x_i: vector,
        positions: wp.array(dtype=vector),
        s: surroundings,
    ) -> int:
        """Append the particles first ... last - 1 that lie within reach; ``own`` is left out."""
        capacity = s.neighbours.shape[0]
        total = found
        limit = s.reach * s.reach
        for j in range(first, last):
            x_ij = separation(x_i, positions[j], s)
            if wp.dot(x_ij, x_ij) < limit and j != own:
                if total < capacity:
                    s.neighbours[total, i] = j
                total = total + 1
        return total

    @wp.func
    def scan_row(
        i: int,
        own: int,
        row: int,
        c_x: int,
        found: int,
        x_i: vector,
        positions: wp.array(dtype=vector),
        starts: wp.array(dtype=wp.int32),
        grid: grid_type,
        s: surroundings,
    ) -> int:
        """The cells c_x - 1, c_x, c_x + 1 of one row; away from the ends of the row they are one range."""
        n = grid.shape[0]
        total = found
        if c_x > 0 and c_x + 1 < n:
            total = scan(i, own, starts[row + c_x - 1], starts[row + c_x + 2], total, x_i, positions, s)
        else:
            for o in range(below(n), above(n)):
                cell = row + wrap(c_x + o, n)
                total = scan(i, own, starts[cell], starts[cell + 1], total, x_i, positions, s)
        return total

    @wp.kernel(module=discretisation.module(False, "neighbours"), enable_backward=False)
    def fill(
        s: surroundings,
        grid: grid_type,
        x: wp.array(dtype=vector),
        # out
        fluid_count: wp.array(dtype=wp.int32),
        filling: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        needed: wp.array(dtype=wp.int32),
    ):
        """``needed``, for each range, becomes the longest list, also where that is more than there is room for."""
        i = s.first + wp.tid()
        x_i = x[i]
        c = cell_of(x_i, grid)
        n_y = grid.shape[1]
        n_z = grid.shape[2]
        capacity = s.neighbours.shape[0]
        found = int(0)
        for o_z in range(below(n_z), above(n_z)):
            for o_y in range(below(n_y), above(n_y)):
                row = (wrap(c[2] + o_z, n_z) * n_y + wrap(c[1] + o_y, n_y)) * grid.shape[0]
                found = scan_row(i, i, row, c[0], found, x_i, x, grid.starts, grid, s)
        filled = (found + wp.static(UNROLL - 1)) // wp.static(UNROLL) * wp.static(UNROLL)
        for k in range(found, wp.min(filled, capacity)):
            s.neighbours[k, i] = i
        filling[i] = filled - found
        found = filled
        fluid_count[i] = wp.min(found, capacity)
        if s.wall_positions.shape[0] > 0:
            for o_z in range(below(n_z), above(n_z)):
                for o_y in range(below(n_y), above(n_y)):
                    row = (wrap(c[2] + o_z, n_z) * n_y + wrap(c[1] + o_y, n_y)) * grid.shape[0]
                    found = scan_row(i, -1, row, c[0], found, x_i, s.wall_positions, grid.wall_starts, grid, s)
        count[i] = wp.min(found, capacity)
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill


class NeighbourSearch:
    """Sorts a fixed number of particles by cell and lists their neighbours, on one device and without a host read.

    The list is stored [particle][neighbour] on a CPU and [neighbour][particle] on a GPU, whichever a device reads
    fastest; kernels index it [neighbour, particle] on both.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        grid: Grid,
        walls: np.ndarray,
        wall_weights: np.ndarray,
        particles: int,
        capacity: int,
        device: Any,
    ):
        """``walls`` (b, 3) [m], ``wall_weights`` (b,) [-]."""
        precision = discretisation.precision
        self.particles, self.device = particles, device
        self._kernels, self._fill = _cell_kernels(precision), _fill_kernel(discretisation)
        self._bits = max(int(grid.cells - 1).bit_length(), 1)
        self._keys = wp.empty(2 * particles, dtype=wp.int32, device=device)
        self.order = wp.empty(2 * particles, dtype=wp.int32, device=device)
        self.fluid_count = wp.zeros(particles, dtype=wp.int32, device=device)
        self.filling = wp.zeros(particles, dtype=wp.int32, device=device)
        self.count = wp.zeros(particles, dtype=wp.int32, device=device)
        self._launch = Launcher(particles, device, record_tape=False)
        self._needed = wp.zeros(MOST_PARTS, dtype=wp.int32, device=device)
        self._grid = _grid_type(precision)()
        self._grid.origin = precision.vector(*grid.origin)
        self._grid.frequency = precision.vector(*(1.0 / grid.cell))
        self._grid.shape = wp.vec3i(*grid.shape)
        self._grid.starts = wp.zeros(grid.cells + 1, dtype=wp.int32, device=device)
        self._grid.wall_starts = wp.zeros(grid.cells + 1, dtype=wp.int32, device=device)
        self.wall_positions = wp.array(walls, dtype=precision.vector, device=device)
        self.wall_weights = wp.array(wall_weights, dtype=precision.real, device=device)
        self.origin = self._grid.origin
        """Lower corner of the grid of cells [m], as a Warp vector."""
        self._sort_walls(walls, wall_weights, precision)
        self.allocate(capacity)

    def allocate(self, capacity: int) -> None:
        """Make room for lists of that length, rounded up to a multiple of `UNROLL`."""
        self.capacity = -(-capacity // UNROLL) * UNROLL
        shape = (self.particles, self.capacity)
        if self.device.is_cpu:
            self.neighbours = wp.empty(shape, dtype=wp.int32, device=self.device).transpose((1, 0))
        else:
            self.neighbours = wp.empty(shape[::-1], dtype=wp.int32, device=self.device)

    def sort(self, positions: wp.array) -> None:
        """Find the order of cells (``order``: sorted -> given) of positions (n,) [m]; ties keep the given order."""
        self._sort(positions, self.particles, self._keys, self.order, self._grid.starts)

    def fill(self, surroundings: Any, positions: wp.array) -> None:
        """List the neighbours of sorted positions (n,) [m]; `needed` tells whether the lists were long enough."""
        outputs = [self.fluid_count, self.filling, self.count, self._needed]
        self._launch(self._fill, [surroundings, self._grid, positions], outputs)

    @property
    def needed(self) -> int:
        """The longest list since `forget_needed`; more than the capacity if there was too little room."""
        return int(self._needed.numpy().max())

    def forget_needed(self) -> None:
        """Begin anew with `needed`."""
        self._needed.zero_()

    def _sort(self, positions: wp.array, count: int, keys: wp.array, order: wp.array, starts: wp.array) -> None:
        wp.launch(
            self._kernels.number_cells,
            count,
            inputs=[self._grid, positions],
            outputs=[keys, order],
            device=self.device,
            record_tape=False,
        )
        wp.utils.radix_sort_pairs(keys, order, count, 0, self._bits)
        wp.launch(
            self._kernels.find_starts,
            starts.shape[0],
            inputs=[keys, count],
            outputs=[starts],
            device=self.device,
            record_tape=False,
        )

    def _sort_walls(self, walls: np.ndarray, wall_weights: np.ndarray, precision: Precision) -> None:
        count = len(walls)
        if count == 0:
            return
        keys = wp.empty(2 * count, dtype=wp.int32, device=self.device)
        order = wp.empty(2 * count, dtype=wp.int32, device=self.device)
        self._sort(self.wall_positions, count, keys, order, self._grid.wall_starts)
        sorted_to_given = order.numpy()[:count]
        self.wall_positions.assign(walls[sorted_to_given])
        self.wall_weights.assign(wall_weights[sorted_to_given])
