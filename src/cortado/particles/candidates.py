"""The particles in the cells around one's own that are within reach, appended to a list.

They come in the order of the cells, rows along x one after the other, and within a cell in the order of the particles,
whoever looks for them: one thread, or the lanes of a particle.

One thread compares 32 candidates, keeps a bit for each, and then appends those within reach: on a GPU threads that
compare go side by side, and threads that append wait for one another. Many lanes take the candidates of all rows as one
range, so that no lane waits for where the next row begins, or is idle at the end of a row.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.lanes import lane_functions
from cortado.device.precision import TypesByName
from cortado.particles.neighbourhood import UNROLL, Discretisation, loads, pair_functions

BITS = 32
"""Candidates that one thread compares before it appends."""
ROWS = 9
"""Most rows of cells to visit."""
LEAST_AT_ONCE = 8
"""Lanes that take the rows at once; fewer take one after the other. Measured on an H200."""


@cache
def append_function(discretisation: Discretisation) -> Any:
    """Make the Warp function that appends the particles which lanes have found to a list, in their order."""
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
    """Return by argument name the Warp types of the functions that search cells for neighbours: ``x_i`` is the position
    of particle i, ``positions`` (n,) are those of all particles, numbers are integers."""
    _, vector, neighbourhood = discretisation.types
    names = {wp.array(dtype=vector): "positions", cell_grid_type(discretisation.precision): "grid", wp.vec3i: "c"}
    return TypesByName(int, {vector: "x", neighbourhood: "s", **names})


@cache
def scan_by_bits(discretisation: Discretisation) -> Any:
    """Make the Warp function for one lane that appends particles first ... last - 1 within reach, without particle
    ``own``."""
    separation = pair_functions(discretisation).separation
    load = loads(discretisation.precision, discretisation.taped).load_vector

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
    """Make the Warp function for several lanes that appends particles first ... last - 1 within reach but ``own``."""
    separation = pair_functions(discretisation).separation
    load = loads(discretisation.precision, discretisation.taped).load_vector
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


def scan_around(discretisation: Discretisation) -> Any:
    """Make the Warp function that appends the particles within reach in the cells around cell c, without particle
    ``own``. The cells of the scene begin at layer ``bottom``."""
    return (scan_at_once if discretisation.lanes >= LEAST_AT_ONCE else scan_by_rows)(discretisation)


@cache
def scan_by_rows(discretisation: Discretisation) -> Any:
    """Make the Warp function of `scan_around` that visits one row of cells after the other."""
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
    """Make the Warp function of `scan_around` that visits all rows as one range, or row by row at the grid's ends."""
    cells = cell_functions(discretisation.precision)
    wrap, below, above = cells.wrap, cells.below, cells.above
    separation = pair_functions(discretisation).separation
    load = loads(discretisation.precision, discretisation.taped).load_vector
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
