"""The kernels of the nodes of the coarse grid: the matrix A of `cortado.solvers.projection.coarse_pressure` and sums
over the particles around a node.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_grid_type
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.solvers.projection.coarse_hats import hat_functions, node_functions, source_type
from cortado.sph.moment_functions import matrix_type


@dataclass(frozen=True)
class NodeKernels:
    """By what they do."""

    add_up: Any
    """The part of A that the particles of a cell have, for each two of its corners."""
    fill: Any
    """A, for each node and each of its neighbours, itself among them."""
    spread: Any
    """A sum over particles."""


@cache
def node_kernels(precision: Precision, dimension: int) -> NodeKernels:
    """In 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    grid_type, source, own = cell_grid_type(precision), source_type(precision), hat_functions(precision, dimension)
    hat, corner_step, held, among = own.hat, own.corner_step, own.held, node_functions(dimension)
    number_of, node_of, step_of = among.number_of, among.node_of, among.step_of
    module = kernel_module(f"coarse_nodes_{dimension}d_{precision.name}")
    CORNERS, AROUND = wp.constant(2**dimension), wp.constant(3**dimension)
    square = wp.types.matrix(shape=(2**dimension, 2**dimension), dtype=real)
    pushes = wp.types.matrix(shape=(2**dimension, 3), dtype=real)

    @wp.func
    def pair_of(a: int, b: int) -> int:
        """The number of two corners of a cell, in any order."""
        i, j = wp.min(a, b), wp.max(a, b)
        return i * (2 * CORNERS - 1 - i) // 2 + j

    @wp.kernel(module=module, enable_backward=False)
    def add_up(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        eps: real,
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        h: wp.array(dtype=vector),
        N: wp.array(dtype=matrix),
        # out
        cells: wp.array2d(dtype=real),
    ):
        """With a thread for each cell."""
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
    def fill(
        grid: grid_type,
        cells: wp.array2d(dtype=real),
        # out
        A: wp.array2d(dtype=real),
    ):
        """With a thread for each node, which has half of the offsets and itself; A is symmetric."""
        node = wp.tid()
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        first, here = member * nodes, node_of(node - member * nodes, grid.shape)
        for offset in range(AROUND // 2 + 1):
            step, total = step_of(offset), real(0.0)
            for corner in range(CORNERS):
                own = corner_step(corner)
                to = own + step
                if wp.min(wp.min(to[0], to[1]), to[2]) >= 0 and wp.max(wp.max(to[0], to[1]), to[2]) <= 1:
                    cell = first + number_of(here - own, grid.shape)
                    total += cells[pair_of(corner, to[0] + 2 * to[1] + 4 * to[2]), cell]
            A[offset, node] = total
            A[AROUND - 1 - offset, first + number_of(here + step, grid.shape)] = total

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        of: source,
        e: wp.array(dtype=real),
        # out
        r: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, total = node_of(node - member * nodes, grid.shape), real(0.0)
        for corner in range(CORNERS):
            cell = member * nodes + number_of(here - corner_step(corner), grid.shape)
            for p in range(grid.starts[cell], grid.starts[cell + 1]):
                i = order[p]
                phi = hat(x[i], corner, grid)
                total += phi.value * of.s_value[i] + wp.dot(phi.slope, of.s_slope[i]) + wp.dot(phi.bent, of.s_bent[i])
                total += e[node] * of.s_own[i]
        r[node] = total

    return NodeKernels(add_up, fill, spread)
