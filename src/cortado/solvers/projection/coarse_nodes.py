"""Hat functions of a grid's nodes: their values at particles, and sums over the particles around nodes.

A node's hat phi is 1 at the node and falls linearly along each axis to 0 at the next nodes. The cells of the grid are
those of a `CellSort`; node number k is at the lower corner of cell number k.

Kernels of the nodes sum over the particles around each, also for the matrix A of
`cortado.solvers.projection.coarse_pressure`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.launching import bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision, TypesByName

ALONE = 0.01
"""The factor of h^2 in the regularisation of the nodes around a particle."""


@dataclass(frozen=True)
class NodeFunctions:
    """Warp functions that number the nodes of a periodic grid of any shape."""

    number_of: Any
    """The number of a node, which may be outside of the grid by up to the grid's width."""
    node_of: Any
    """The node with a number."""
    step_of: Any
    """The step from a node to itself or to one of its neighbours, by the number of the step."""
    beside: Any
    """The number of the node a step away from a given node of the same scene; nodes are numbered over all scenes."""
    corner_step: Any
    """The step from the lower corner of a cell to one of its corners."""
    pair_of: Any
    """The number of two corners of a cell, in any order."""


@cache
def node_functions(dimension: int) -> NodeFunctions:
    """Make Warp functions that number nodes and steps between them, in 2 or 3 dimensions."""
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

    return NodeFunctions(number_of, node_of, step_of, beside, corner_step, pair_of)


@dataclass(frozen=True)
class HatFunctions:
    """Warp functions that evaluate hat functions of a grid's nodes at particles."""

    hat: Any
    """phi, its gradient and its mixed second derivatives, for a node at one of the corners of a position's cell."""
    at: Any
    """A sum of hats at a particle with its derivatives: E, G and H of values e at nodes."""
    products: Any
    """The sum of e u over the nodes whose hats are not 0 at a particle."""
    bend: Any
    """H v"""
    held: Any
    """The regularisation eps + h^2 / 100 by which a particle keeps the values at nodes around it small."""


@cache
def hat_functions(precision: Precision, dimension: int) -> HatFunctions:
    """Make Warp functions of the hats of nodes, in 2 or 3 dimensions."""
    real, vector = precision.real, precision.vector
    grid_type, cell_of = cell_grid_type(precision), cell_functions(precision).cell_of
    number_of, corner_step = node_functions(dimension).number_of, node_functions(dimension).corner_step
    CORNERS = wp.constant(2**dimension)
    flat = wp.constant(dimension == 2)
    alone = wp.constant(real(ALONE))

    @wp.struct
    class Hat:
        """The value phi of a hat function, its gradient and its mixed second derivatives yz, xz and xy."""

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
        """Return value and derivatives at x of the hat of the node at one of the corners of x's cell."""
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
        """Return the cell of a particle and the first node of its scene."""
        return cell_of(x, grid), (i // particles) * (grid.shape[0] * grid.shape[1] * grid.shape[2])

    @wp.func
    def at(i: int, particles: int, x: vector, e: wp.array(dtype=real), grid: grid_type) -> Hat:
        """Return the sum of hats with node values e at particle i: value E, gradient G, mixed second derivatives H."""
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
        """Return the sum of products e u of two fields over the nodes whose hats reach particle i."""
        own, first = first_corner(i, particles, x, grid)
        total = real(0.0)
        for corner in range(CORNERS):
            node = first + number_of(own + corner_step(corner), grid.shape)
            total += e[node] * u[node]
        return total

    @wp.func
    def bend(bent: vector, v: vector) -> vector:
        """Return H v for a matrix H of mixed second derivatives yz, xz and xy, with a diagonal of 0."""
        return vector(bent[2] * v[1] + bent[1] * v[2], bent[2] * v[0] + bent[0] * v[2], bent[1] * v[0] + bent[0] * v[1])

    @wp.func
    def held(eps: real, h: vector) -> real:
        return eps + alone * wp.dot(h, h)

    return HatFunctions(hat, at, products, bend, held)


@dataclass(frozen=True)
class NodeKernels:
    """Kernels that sum over the particles around each node of the coarse grid."""

    add_up: Any
    """Computes the terms of a cell's particles in A, for each pair of the cell's corners."""
    spread: Any
    """Computes the terms of a cell's particles in a sum over particles, for each of the cell's corners."""
    gather: Any
    """Computes the sum over particles at each node from the terms of cells."""


@cache
def node_kernels(precision: Precision, dimension: int) -> NodeKernels:
    """Make the kernels that sum over the particles around nodes, in 2 or 3 dimensions."""
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

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def add_up(grid, order, eps: real, x, m, h, N, cells: wp.array2d(dtype=real)):
        """Sum the particles of each cell into the matrix entries of its pairs of corners; a thread is a cell."""
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

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def spread(grid, order, x, of: source, e, parts: wp.array2d(dtype=real)):
        """Add up the source of the particles in a cell, with a thread for each cell."""
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

    return NodeKernels(add_up, spread, gather)
