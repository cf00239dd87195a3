"""Hat functions of the nodes of a grid, and sums over the particles around nodes.

The hat function of a node is 1 at the node and falls linearly along each axis to 0 at the next nodes. The nodes are the
lower corners of the cells of a `CellSort`, and a node has the number of its cell.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.launching import bundle
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName

ALONE = 0.01


@cache
def node_functions(dimension: int) -> SimpleNamespace:
    flat, CORNERS = wp.constant(dimension == 2), wp.constant(2**dimension)

    @wp.func
    def wrapped(i: int, n: int) -> int:
        return wp.where(i < 0, i + n, wp.where(i < n, i, i - n))

    @wp.func
    def number_of(node: wp.vec3i, shape: wp.vec3i) -> int:
        x, y, z = wrapped(node[0], shape[0]), wrapped(node[1], shape[1]), wrapped(node[2], shape[2])
        return (z * shape[1] + y) * shape[0] + x

    @wp.func
    def corner_step(corner: int) -> wp.vec3i:
        return wp.vec3i(corner & 1, (corner >> 1) & 1, (corner >> 2) & 1)

    @wp.func
    def pair_of(a: int, b: int) -> int:
        i, j = wp.min(a, b), wp.max(a, b)
        return i * (2 * CORNERS - 1 - i) // 2 + j

    @wp.func
    def node_of(number: int, shape: wp.vec3i) -> wp.vec3i:
        row = number // shape[0]
        return wp.vec3i(number % shape[0], row % shape[1], row // shape[1])

    @wp.func
    def step_of(offset: int) -> wp.vec3i:
        if flat:
            return wp.vec3i(offset % 3 - 1, offset // 3 - 1, 0)
        return wp.vec3i(offset % 3 - 1, (offset // 3) % 3 - 1, offset // 9 - 1)

    @wp.func
    def beside(node: int, step: wp.vec3i, shape: wp.vec3i) -> int:
        nodes = shape[0] * shape[1] * shape[2]
        first = node // nodes * nodes
        return first + number_of(node_of(node - first, shape) + step, shape)

    return by_name(number_of, node_of, step_of, beside, corner_step, pair_of)


@cache
def hat_functions(precision: Precision, dimension: int) -> SimpleNamespace:
    """``products`` sums the products of two node arrays over the nodes around a particle."""
    real, vector = precision.real, precision.vector
    grid_type, cell_of = cell_grid_type(precision), cell_functions(precision).cell_of
    number_of, corner_step = node_functions(dimension).number_of, node_functions(dimension).corner_step
    CORNERS = wp.constant(2**dimension)
    flat = wp.constant(dimension == 2)
    alone = wp.constant(real(ALONE))

    @wp.struct
    class Hat:
        """A hat function at a point: its value, its gradient and its mixed second derivatives yz, xz and xy."""

        value: real
        slope: vector
        bent: vector

    @wp.func
    def side(t: real, upper: int) -> real:
        return wp.where(upper == 1, t, real(1.0) - t)

    @wp.func
    def bit(corner: int, axis: int) -> int:
        return (corner >> axis) & 1

    @wp.func
    def hat(x: vector, corner: int, grid: grid_type) -> Hat:
        s = wp.cw_mul(x - grid.origin, grid.frequency)
        t = s - vector(wp.floor(s[0]), wp.floor(s[1]), wp.floor(s[2]))
        f, found = grid.frequency, Hat()
        a, b = side(t[0], bit(corner, 0)), side(t[1], bit(corner, 1))
        p = wp.where(bit(corner, 0) == 1, f[0], -f[0])
        q = wp.where(bit(corner, 1) == 1, f[1], -f[1])
        c, r = real(1.0), real(0.0)
        if not flat:
            c = side(t[2], bit(corner, 2))
            r = wp.where(bit(corner, 2) == 1, f[2], -f[2])
        found.value = a * b * c
        found.slope = vector(p * b * c, a * q * c, a * b * r)
        found.bent = vector(a * q * r, p * b * r, p * q * c)
        return found

    @wp.func
    def first_corner(i: int, particles: int, x: vector, grid: grid_type):
        return cell_of(x, grid), (i // particles) * (grid.shape[0] * grid.shape[1] * grid.shape[2])

    @wp.func
    def at(i: int, particles: int, x: vector, e: wp.array(dtype=real), grid: grid_type) -> Hat:
        own, first = first_corner(i, particles, x, grid)
        found = Hat()
        for corner in range(CORNERS):
            phi = hat(x, corner, grid)
            value = e[first + number_of(own + corner_step(corner), grid.shape)]
            found.value += value * phi.value
            found.slope += value * phi.slope
            found.bent += value * phi.bent
        return found

    @wp.func
    def products(
        i: int, particles: int, x: vector, e: wp.array(dtype=real), u: wp.array(dtype=real), grid: grid_type
    ) -> real:
        own, first = first_corner(i, particles, x, grid)
        total = real(0.0)
        for corner in range(CORNERS):
            node = first + number_of(own + corner_step(corner), grid.shape)
            total += e[node] * u[node]
        return total

    @wp.func
    def bend(bent: vector, v: vector) -> vector:
        """Return the product of a symmetric matrix with zero diagonal and a vector."""
        return vector(bent[2] * v[1] + bent[1] * v[2], bent[2] * v[0] + bent[0] * v[2], bent[1] * v[0] + bent[0] * v[1])

    @wp.func
    def held(eps: real, h: vector) -> real:
        return eps + alone * wp.dot(h, h)

    return by_name(hat, at, products, bend, held)


@cache
def node_kernels(precision: Precision, dimension: int) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    grid_type, own = cell_grid_type(precision), hat_functions(precision, dimension)
    source = bundle(s_value=real, s_slope=vector, s_bent=vector, s_own=real)
    hat, held, among = own.hat, own.held, node_functions(dimension)
    beside, corner_step, pair_of = among.beside, among.corner_step, among.pair_of
    module = kernel_module(f"coarse_nodes_{dimension}d_{precision.name}")
    CORNERS = wp.constant(2**dimension)
    square = wp.types.matrix(shape=(2**dimension, 2**dimension), dtype=real)
    row = wp.types.vector(length=2**dimension, dtype=real)
    pushes = wp.types.matrix(shape=(2**dimension, 3), dtype=real)

    typed = TypesByName(real, {grid_type: "grid", wp.int32: "order", vector: "x h", matrix: "N"})

    @typed.kernel(module)
    def add_up(grid, order, eps: real, x, m, h, N, cells: wp.array2d(dtype=real)):
        cell = wp.tid()
        total, own = square(), pushes()
        for p in range(grid.starts[cell], grid.starts[cell + 1]):
            i = order[p]
            for corner in range(CORNERS):
                phi = hat(x[i], corner, grid)
                q = N[i] * phi.slope + phi.value * h[i]
                for axis in range(3):
                    own[corner, axis] = q[axis]
            total += own * wp.transpose(own) / m[i]
            for corner in range(CORNERS):
                total[corner, corner] += held(eps, h[i]) / m[i]
        for a in range(CORNERS):
            for b in range(a, CORNERS):
                cells[pair_of(a, b), cell] = total[a, b]

    @typed.kernel(module)
    def spread(grid, order, x, of: source, e, parts: wp.array2d(dtype=real)):
        cell, total, own = wp.tid(), row(), row()
        for corner in range(CORNERS):
            own[corner] = e[beside(cell, corner_step(corner), grid.shape)]
        for p in range(grid.starts[cell], grid.starts[cell + 1]):
            i = order[p]
            for corner in range(CORNERS):
                phi = hat(x[i], corner, grid)
                value = phi.value * of.s_value[i] + wp.dot(phi.slope, of.s_slope[i]) + wp.dot(phi.bent, of.s_bent[i])
                total[corner] += value + own[corner] * of.s_own[i]
        for corner in range(CORNERS):
            parts[corner, cell] = total[corner]

    @wp.kernel(module=module, enable_backward=False)
    def gather(grid: grid_type, parts: wp.array2d(dtype=real), r: wp.array(dtype=real)):
        node, total = wp.tid(), real(0.0)
        for corner in range(CORNERS):
            total += parts[corner, beside(node, -corner_step(corner), grid.shape)]
        r[node] = total

    return by_name(add_up, spread, gather)
