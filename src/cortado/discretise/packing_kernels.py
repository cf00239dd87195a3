"""Kernels of the packing, in float64: neighbour search, densities, and products with derivatives.

Each pair of neighbours is listed once and adds to the sums of both particles. Kernels over pairs therefore run in one
thread, in a fixed order and without atomic additions.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import FLOAT64, TypesByName
from cortado.discretise.smoothing import SmoothingKernel
from cortado.discretise.smoothing_functions import smoothing_functions

real, vector = FLOAT64.real, FLOAT64.vector
grid_type = cell_grid_type(FLOAT64)
_cells = cell_functions(FLOAT64)
cell_of, wrap, below, above = _cells.cell_of, _cells.wrap, _cells.below, _cells.above


@wp.struct
class Around:
    x: wp.array(dtype=vector)
    """Positions [m]."""
    weights: wp.array(dtype=real)
    """Weights, relative to a particle [-]."""
    air: wp.int32
    """Index of the first point of air, and the index after the last point of air. Some particles ignore air."""
    behind_air: wp.int32
    is_periodic: wp.bool
    period: vector
    """Lengths of the periodic box [m], or 0 along axes without a period."""
    frequency: vector
    """Inverse lengths of the periodic box [1/m]."""
    per_support: real
    """Inverse support radius [1/m]."""
    normalisation: real
    """Normalisation of the smoothing kernel [1 / m^d]."""


@wp.struct
class Placed:
    """Points sorted by cell."""

    x: wp.array(dtype=vector)
    numbers: wp.array(dtype=wp.int32)


@wp.struct
class Equations:
    """Derivatives of densities and of the distances of close pairs. The pairs of particle i begin at ``starts[i]``."""

    starts: wp.array(dtype=wp.int32)
    others: wp.array(dtype=wp.int32)
    """Second particle of each pair within the support radius."""
    gradients: wp.array(dtype=vector)
    """Derivative of each pair's smoothing kernel with respect to the separation [1 / m^(d + 1)]."""
    own: wp.array(dtype=vector)
    """Gradient of each particle's sum of smoothing kernels over the fixed points [1 / m^(d + 1)]."""
    close_starts: wp.array(dtype=wp.int32)
    close_others: wp.array(dtype=wp.int32)
    """Second particle of each close pair."""
    directions: wp.array(dtype=vector)
    """Unit vectors from the second to the first particle of close pairs."""


@wp.func
def separation(x_i: vector, x_j: vector, around: Around) -> vector:
    """Return the separation from x_j to x_i, or to the nearest periodic image [m]."""
    x_ij = x_i - x_j
    if around.is_periodic:
        s = wp.cw_mul(x_ij, around.frequency)
        x_ij -= wp.cw_mul(vector(wp.rint(s[0]), wp.rint(s[1]), wp.rint(s[2])), around.period)
    return x_ij


@cache
def packing_kernels(smoothing: SmoothingKernel) -> SimpleNamespace:
    functions = smoothing_functions(smoothing, FLOAT64)
    weight, slope = functions.weight, functions.slope
    module = kernel_module(f"packing_{smoothing.name}")
    structs = {Around: "around", Placed: "placed", Equations: "equations", grid_type: "grid"}
    whole = "starts counts others ends listed"
    typed = TypesByName(real, {**structs, wp.bool: "free blind", wp.int32: whole, vector: "x moves"})

    @typed.kernel(module)
    def look_around(
        first: int, x, blind, are_own: bool, around, placed, grid, reach: real, most: int, starts, counts, sums, others
    ):
        """At most ``most`` points are listed for each particle. Particles in ``blind`` ignore air. If ``are_own`` is
        true, particle i is also point i, and only points with an index above i are listed."""
        i = first + wp.tid()
        x_i = x[i]
        c = cell_of(x_i, grid)
        total = real(0.0)
        count = int(0)
        for o_z in range(below(grid.shape[2]), above(grid.shape[2])):
            for o_y in range(below(grid.shape[1]), above(grid.shape[1])):
                row = wrap(c[2] + o_z, grid.shape[2]) * grid.shape[1] + wrap(c[1] + o_y, grid.shape[1])
                for o_x in range(below(grid.shape[0]), above(grid.shape[0])):
                    cell = row * grid.shape[0] + wrap(c[0] + o_x, grid.shape[0])
                    for p in range(grid.starts[cell], grid.starts[cell + 1]):
                        x_ij = separation(x_i, placed.x[p], around)
                        if wp.length_sq(x_ij) <= reach * reach and count < most:
                            j = placed.numbers[p]
                            is_seen = not (blind[i] and j >= around.air and j < around.behind_air)
                            if is_seen and not (are_own and j <= i):
                                total += around.weights[j] * weight(x_ij, around.per_support, around.normalisation)
                                if starts[i] + count < starts[i + 1]:
                                    others[starts[i] + count] = j
                                count += 1
        counts[i] = count
        sums[i] = total

    @typed.kernel(module)
    def linearise(around, free, starts, ends, listed, close: real, sums, equations, distances):
        """Add pairs with a free particle to ``equations``, and pairs closer than ``close`` [m] to ``distances`` too."""
        i = wp.tid()
        particles = free.shape[0]
        limit = real(1.0) / (around.per_support * around.per_support)
        x_i = around.x[i]
        total = real(0.0)
        own = vector()
        place = equations.starts[i]
        close_place = equations.close_starts[i]
        for k in range(starts[i], ends[i]):
            j = listed[k]
            x_ij = separation(x_i, around.x[j], around)
            square = wp.length_sq(x_ij)
            if square < limit:
                w = around.weights[j] * weight(x_ij, around.per_support, around.normalisation)
                total += w
                g = (around.weights[j] * slope(x_ij, around.per_support, around.normalisation)) * x_ij
                if j >= particles:
                    own += g
                else:
                    sums[j] = sums[j] + w
                    if free[i] or free[j]:
                        equations.others[place] = j
                        equations.gradients[place] = g
                        place += 1
                        if square < close * close:
                            equations.close_others[close_place] = j
                            equations.directions[close_place] = wp.normalize(x_ij)  # 0 where both are at one place
                            distances[close_place] = wp.length(x_ij)
                            close_place += 1
        sums[i] = sums[i] + total
        equations.own[i] = own
        equations.starts[i + 1] = place
        equations.close_starts[i + 1] = close_place

    @typed.kernel(module)
    def multiply(equations, moves, changes, approaches):
        i = wp.tid()
        move = moves[i]
        change = wp.dot(equations.own[i], move)
        for k in range(equations.starts[i], equations.starts[i + 1]):
            j = equations.others[k]
            both = wp.dot(equations.gradients[k], move - moves[j])
            change += both
            changes[j] = changes[j] + both
        changes[i] = changes[i] + change
        for k in range(equations.close_starts[i], equations.close_starts[i + 1]):
            approaches[k] = wp.dot(equations.directions[k], move - moves[equations.close_others[k]])

    @typed.kernel(module)
    def multiply_back(equations, changes, approaches, moves):
        """Add the vector-Jacobian product of the equations to ``moves``."""
        i = wp.tid()
        change = changes[i]
        move = change * equations.own[i]
        for k in range(equations.starts[i], equations.starts[i + 1]):
            j = equations.others[k]
            both = (change + changes[j]) * equations.gradients[k]
            move += both
            moves[j] = moves[j] - both
        for k in range(equations.close_starts[i], equations.close_starts[i + 1]):
            both = approaches[k] * equations.directions[k]
            move += both
            moves[equations.close_others[k]] = moves[equations.close_others[k]] - both
        moves[i] = moves[i] + move

    kernels = by_name(look_around, linearise, multiply, multiply_back)
    return SimpleNamespace(**vars(kernels), around=Around, placed=Placed, grid=grid_type, equations=Equations)
