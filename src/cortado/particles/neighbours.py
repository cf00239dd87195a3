"""Neighbours: particles sorted by cell, and a symmetric list of neighbours for a time step.

The list reaches beyond the support radius by the margin `SKIN`, because the density is also computed at predicted
positions. Without a margin the next state would be discontinuous when a pair enters the support during the step.

The list of particle i contains j exactly if the list of j contains i.

The candidates for neighbours are the particles in the cells around a particle. A thread compares 32 candidates before
it appends neighbours, because threads of a GPU wait for one another when they append.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import CellSort, cell_functions, cell_grid_type
from cortado.device.grid import Grid
from cortado.device.launching import MOST_PARTS, HostCopy, KernelLauncher
from cortado.device.precision import TypesByName, lane_functions
from cortado.errors import InputError
from cortado.particles.mirrors import most_imaged, reflections
from cortado.particles.moving_walls import MovingWalls, WallArrays
from cortado.particles.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.particles.state import Layout

BITS = 32
ROWS = 9
LEAST_AT_ONCE = 8


@cache
def append_function(discretisation: Discretisation) -> Any:
    neighbourhood = discretisation.types[2]
    lanes = lane_functions(discretisation.precision, discretisation.lanes)
    vote, ones, before = lanes.vote, lanes.ones, lanes.before

    @wp.func
    def append(i: int, j: int, near: bool, found: int, s: neighbourhood) -> int:
        votes = vote(near)
        place = found + before(votes)
        if near and place < s.neighbours.shape[0]:
            s.neighbours[place, i] = j
        return found + ones(votes)

    return append


@cache
def scan_types(discretisation: Discretisation) -> TypesByName:
    _, vector, neighbourhood = discretisation.types
    names = {wp.array(dtype=vector): "positions", cell_grid_type(discretisation.precision): "grid", wp.vec3i: "c"}
    return TypesByName(int, {vector: "x", neighbourhood: "s", **names})


@cache
def scan_by_bits(discretisation: Discretisation) -> Any:
    """One thread per particle appends the neighbours from ``first`` to ``last`` - 1, except ``own``."""
    pair = pair_functions(discretisation)
    separation, load = pair.separation, pair.load_vector

    @wp.func
    @scan_types(discretisation)
    def scan(i, own, first, last, found, x_i, positions, s) -> int:
        capacity = s.neighbours.shape[0]
        limit = s.reach * s.reach
        total = found
        final = last - 1
        for begin in range(first, last, BITS):
            near = wp.uint32(0)
            for j in range(begin, wp.min(last, begin + BITS), UNROLL):
                x_0 = load(positions, j)
                x_1 = load(positions, wp.min(j + 1, final))
                x_2 = load(positions, wp.min(j + 2, final))
                x_3 = load(positions, wp.min(j + 3, final))
                x_j = wp.matrix_from_rows(x_0, x_1, x_2, x_3)
                of_four = wp.uint32(0)
                for u in range(wp.static(UNROLL)):
                    x_ij = separation(x_i, x_j[u], s)
                    if wp.dot(x_ij, x_ij) < limit:
                        of_four = of_four | wp.uint32(wp.static(1 << u))
                near = near | (of_four << wp.uint32(j - begin))
            if last - begin < BITS:
                near = near & ((wp.uint32(1) << wp.uint32(last - begin)) - wp.uint32(1))
            if own >= begin and own < begin + BITS:
                near = near & ~(wp.uint32(1) << wp.uint32(own - begin))
            while near != wp.uint32(0):
                others = near & (near - wp.uint32(1))
                lowest = near ^ others
                if total < capacity:
                    s.neighbours[total, i] = begin + int(wp.bit_count(lowest - wp.uint32(1)))
                total += 1
                near = others
        return total

    return scan


@cache
def scan_by_lanes(discretisation: Discretisation) -> Any:
    pair = pair_functions(discretisation)
    separation, load = pair.separation, pair.load_vector
    LANES, lane, append = discretisation.lanes, discretisation.lane, append_function(discretisation)

    @wp.func
    @scan_types(discretisation)
    def scan(i, own, first, last, found, x_i, positions, s) -> int:
        limit = s.reach * s.reach
        total = found
        for candidate in range(first, last, LANES):
            j = candidate + lane()
            near = False
            if j < last and j != own:
                x_ij = separation(x_i, load(positions, j), s)
                near = wp.dot(x_ij, x_ij) < limit
            total = append(i, j, near, total, s)
        return total

    return scan


@cache
def scan_by_rows(discretisation: Discretisation) -> Any:
    cells = cell_functions(discretisation.precision)
    wrap, below, above = cells.wrap, cells.below, cells.above
    scan = scan_by_bits(discretisation) if discretisation.lanes == 1 else scan_by_lanes(discretisation)

    @wp.func
    @scan_types(discretisation)
    def scan_rows(i, own, bottom, c, found, x_i, positions, grid, s) -> int:
        n_x = grid.shape[0]
        n_y = grid.shape[1]
        n_z = grid.shape[2]
        left = wrap(c[0] + below(n_x), n_x)
        right = left + above(n_x) - below(n_x)
        total = found
        for o_z in range(below(n_z), above(n_z)):
            for o_y in range(below(n_y), above(n_y)):
                row = ((bottom + wrap(c[2] + o_z, n_z)) * n_y + wrap(c[1] + o_y, n_y)) * n_x
                first = grid.starts[row + left]
                last = grid.starts[row + wp.min(right, n_x)]
                total = scan(i, own, first, last, total, x_i, positions, s)
                if right > n_x:  # around the end of the row
                    first = grid.starts[row]
                    last = grid.starts[row + right - n_x]
                    total = scan(i, own, first, last, total, x_i, positions, s)
        return total

    return scan_rows


@cache
def scan_at_once(discretisation: Discretisation) -> Any:
    cells = cell_functions(discretisation.precision)
    wrap, below, above = cells.wrap, cells.below, cells.above
    pair = pair_functions(discretisation)
    separation, load = pair.separation, pair.load_vector
    LANES, lane, append = discretisation.lanes, discretisation.lane, append_function(discretisation)
    scan_rows = scan_by_rows(discretisation)
    one_of_each_row = wp.types.vector(length=ROWS, dtype=wp.int32)
    candidates = wp.types.vector(length=UNROLL, dtype=wp.int32)

    @wp.func
    @scan_types(discretisation)
    def scan_all(i, own, bottom, c, found, x_i, positions, grid, s) -> int:
        n_x = grid.shape[0]
        n_y = grid.shape[1]
        n_z = grid.shape[2]
        left = wrap(c[0] + below(n_x), n_x)
        right = left + above(n_x) - below(n_x)
        if right > n_x:
            return scan_rows(i, own, bottom, c, found, x_i, positions, grid, s)
        # Candidate t of all is the particle t + shift[r] where it is in row r, which ends at candidate end[r].
        shift = one_of_each_row()
        end = one_of_each_row()
        for r in range(wp.static(ROWS)):
            o_z = r // 3 - 1
            o_y = r % 3 - 1
            row = ((bottom + wrap(c[2] + o_z, n_z)) * n_y + wrap(c[1] + o_y, n_y)) * n_x
            visited = o_z >= below(n_z) and o_z < above(n_z) and o_y >= below(n_y) and o_y < above(n_y)
            shift[r] = grid.starts[row + left]
            end[r] = wp.where(visited, grid.starts[row + right], shift[r])
        count = int(0)
        for r in range(wp.static(ROWS)):
            length = end[r] - shift[r]
            shift[r] = shift[r] - count
            count += length
            end[r] = count
        limit = s.reach * s.reach
        total = found
        for begin in range(0, count, wp.static(UNROLL * LANES)):
            j = candidates()
            for u in range(wp.static(UNROLL)):
                t = wp.min(begin + u * LANES + lane(), count - 1)
                j[u] = t + shift[0]
                for r in range(1, wp.static(ROWS)):
                    j[u] = wp.where(t >= end[r - 1], t + shift[r], j[u])
            x_j = wp.matrix_from_rows(
                load(positions, j[0]), load(positions, j[1]), load(positions, j[2]), load(positions, j[3])
            )
            for u in range(wp.static(UNROLL)):
                x_ij = separation(x_i, x_j[u], s)
                is_candidate = begin + u * LANES + lane() < count and j[u] != own
                total = append(i, j[u], is_candidate and wp.dot(x_ij, x_ij) < limit, total, s)
        return total

    return scan_all


@cache
def fill_kernel(discretisation: Discretisation) -> Any:
    precision, (_, vector, neighbourhood) = discretisation.precision, discretisation.types
    kinds = {neighbourhood: "s", cell_grid_type(precision): "grid wall_grid moving_grid", wp.bool: "near_walls"}
    typed = TypesByName(wp.int32, {**kinds, vector: "x"})
    cell_of = cell_functions(precision).cell_of
    scan = (scan_at_once if discretisation.lanes >= LEAST_AT_ONCE else scan_by_rows)(discretisation)
    LANES, lane = discretisation.lanes, discretisation.lane

    @typed.kernel(discretisation.module(True, "neighbours"), enable_backward=False)
    def fill(s, grid, wall_grid, moving_grid, near_walls, bad_step, x, fluid_count, filling, count, all_count, needed):
        """The greatest length of a list is written to ``needed``, even if the length exceeds the capacity."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if bad_step[member] >= 0:
            if lane() == 0:
                filling[i] = 0
                fluid_count[i] = 0
                count[i] = 0
                all_count[i] = 0
            return
        x_i = x[i]
        c = cell_of(x_i, grid)
        capacity = s.neighbours.shape[0]
        found = scan(i, i, member * grid.shape[2], c, 0, x_i, x, grid, s)
        filled = (found + wp.static(UNROLL - 1)) // wp.static(UNROLL) * wp.static(UNROLL)
        for k in range(found + lane(), wp.min(filled, capacity), LANES):
            s.neighbours[k, i] = i
        to_fill = filled - found
        found = filled
        if near_walls[(c[2] * grid.shape[1] + c[1]) * grid.shape[0] + c[0]]:
            found = scan(i, -1, 0, c, found, x_i, s.wall_positions, wall_grid, s)
        if wp.static(discretisation.moving):
            found = scan(i, -1, member * grid.shape[2], c, found, x_i, s.wall_positions, moving_grid, s)
        if lane() > 0:
            return
        filling[i] = to_fill
        fluid_count[i] = wp.min(filled, capacity)
        count[i] = wp.min(found, capacity)
        all_count[i] = count[i]
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill


@cache
def image_kernel(discretisation: Discretisation) -> Any:
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, sees, shows, sides = pair.separation, pair.sees, pair.shows, pair.sides
    reflection, turned, last_reflection = pair.reflection, pair.turned, pair.last_reflection
    load_vector, neighbour = pair.load_vector, pair.neighbour
    REFLECTIONS = wp.constant(reflections(discretisation.moving))
    LANES, lane, append = discretisation.lanes, discretisation.lane, append_function(discretisation)
    module, typed = discretisation.module(True, "neighbours"), TypesByName(wp.int32, {neighbourhood: "s", vector: "x"})

    @typed.kernel(module, enable_backward=False)
    def fill_images(s, bad_step, x, all_count, needed):
        i = s.first + wp.tid() // LANES
        x_i, limit, found = x[i], s.reach * s.reach, int(s.count[i])
        member = i // s.particles
        near = sides(x_i, s)
        last = last_reflection(near, x_i, member, s)
        if last == 0 or bad_step[member] >= 0:
            return
        others = s.fluid_count[i] - s.filling[i]
        for one in range(1, last + 1):
            if sees(one, near, x_i, member, s):
                R, offset = reflection(one, member, s)
                for first in range(0, others + 1, LANES):
                    place, j = first + lane(), int(i)
                    if place < others:
                        j = neighbour(place, i, s)
                    x_j = load_vector(x, j)
                    x_ij = separation(x_i, turned(R, x_j) + offset, s)
                    is_near = place <= others and wp.dot(x_ij, x_ij) < limit and shows(one, x_j, member, s)
                    found = append(i, REFLECTIONS * j + one, is_near, found, s)
        if lane() > 0:
            return
        all_count[i] = wp.min(found, s.neighbours.shape[0])
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill_images


class NeighbourSearch:
    """Lists are stored as [particle][neighbour] on a CPU and as [neighbour][particle] on a GPU. Kernels always index
    the lists as [neighbour, particle]."""

    def __init__(
        self,
        discretisation: Discretisation,
        grid: Grid,
        walls: WallArrays,
        layout: Layout,
        capacity: int,
        solids: int = 0,
        dimension: int = 3,
        mirrored: bool = False,
    ):
        """Lists contain mirror images if fluid is ``mirrored``."""
        precision, device, particles = discretisation.precision, layout.device, layout.all_particles
        if mirrored and particles > (most := most_imaged(discretisation.moving)):
            raise InputError(
                f"{particles:,} particles are too many for mirroring walls: take at most {most:,} particles, or "
                'container.slip = "no" for any number.'
            )
        self.particles, self.device = particles, device
        self._fill, self._fill_images = fill_kernel(discretisation), image_kernel(discretisation)
        self._mirrored = mirrored
        self._sort = CellSort(grid, layout.particles, precision, device, layout.members)
        self.order = self._sort.order
        names = "fluid_count", "filling", "count", "all_count"
        self.lists = {name: wp.zeros(particles, dtype=wp.int32, device=device) for name in names}
        """Arrays of shape (n,) with the lengths of the lists, by kernel argument."""
        self.fluid_count, self.filling, self.count, self.all_count = self.lists.values()
        self._launch = KernelLauncher(particles, device, record_tape=False)
        self._needed = wp.zeros(MOST_PARTS, dtype=wp.int32, device=device)
        self.needed_copy = HostCopy(self._needed)
        still, moving = walls.some(walls.solid < 0), walls.some(walls.solid >= 0)
        count = len(still) + layout.members * len(moving)
        kinds = {"positions": precision.vector, "feet": precision.vector, "velocities": precision.vector}
        kinds |= {"weights": precision.real, "grips": precision.real, "solids": wp.int32, "faces": wp.int32}
        own = dict.fromkeys(("positions_dot", "velocities_dot", "turns_dot"), precision.vector)
        own["growths_dot"] = precision.real
        sizes = {**dict.fromkeys(kinds, count), **dict.fromkeys(own, count if solids else 0)}
        self.walls = {
            f"wall_{name}": wp.zeros(sizes[name], dtype=kind, device=device) for name, kind in {**kinds, **own}.items()
        }
        """Arrays of wall particles by kernel argument name. Walls at rest come before moving walls."""
        self.walls["wall_faces"].fill_(-1)
        self._write_walls(still)
        self._wall_sort = CellSort(grid, len(still), precision, device)
        self._unsorted_walls: WallArrays | None = still
        self.moving = MovingWalls(moving, len(still), solids, dimension, grid, layout) if solids else None
        self._grid, self._near_walls = grid, wp.zeros(grid.cells, dtype=wp.bool, device=device)
        self.allocate(capacity)

    def allocate(self, capacity: int) -> None:
        """Make room for lists of ``capacity`` neighbours, rounded up to a multiple of `UNROLL`."""
        self.capacity = -(-capacity // UNROLL) * UNROLL
        shape = (self.particles, self.capacity)
        if self.device.is_cpu:
            self.neighbours = wp.empty(shape, dtype=wp.int32, device=self.device).transpose((1, 0))
        else:
            self.neighbours = wp.empty(shape[::-1], dtype=wp.int32, device=self.device)

    def sort(self, positions: wp.array) -> None:
        """Sort ``positions`` [m] by cell, and write the order of the particles to ``order``. The sort is stable."""
        walls, self._unsorted_walls = self._unsorted_walls, None
        if walls is not None:  # once, and not before kernels are compiled side by side
            dtype = self.walls["wall_positions"].dtype
            self._wall_sort(wp.array(walls.positions, dtype=dtype, device=self.device))
            self._write_walls(walls.some(self._wall_sort.order.numpy()))
            near = np.diff(self._wall_sort.grid.starts.numpy()).reshape(self._grid.shape[::-1]) > 0
            for axis in range(3):
                near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
            self._near_walls.assign(near.ravel())  # cells with walls inside or around them
        self._sort(positions)

    def _write_walls(self, walls: WallArrays) -> None:
        known = {name: getattr(walls, name) for name in ("positions", "weights", "grips", "feet")}
        for name, values in {**known, "solids": walls.solid}.items():
            array = self.walls[f"wall_{name}"]
            if len(values):
                wp.copy(array, wp.array(values, dtype=array.dtype, device=self.device), count=len(values))

    def fill(self, neighbourhood: Any, positions: wp.array, bad_step: wp.array) -> None:
        """List the neighbours of sorted positions ``x`` [m]. Scenes whose ``bad_step`` (members,) is not -1 get empty
        lists. Lists are incomplete if `needed` exceeds the capacity."""
        given = {"s": neighbourhood, "bad_step": bad_step, "x": positions, "needed": self._needed}
        grids = {"grid": self._sort.grid, "wall_grid": self._wall_sort.grid, "near_walls": self._near_walls}
        moving = self._wall_sort.grid if self.moving is None else self.moving.grid
        self._launch(self._fill, given, self.lists, grids, moving_grid=moving)
        if self._mirrored:
            self._launch(self._fill_images, given, self.lists)

    @property
    def needed(self) -> int:
        """Return the greatest list length since the last `forget_needed`, even beyond the capacity."""
        return int(self.needed_copy.read().max())

    def forget_needed(self) -> None:
        self._needed.zero_()
