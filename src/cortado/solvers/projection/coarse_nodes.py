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

    fill: Any
    """A, for each node and each of its neighbours, itself among them."""
    spread: Any
    """A sum over particles."""


@cache
def node_kernels(precision: Precision, dimension: int) -> NodeKernels:
    """In 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    grid_type, source, own = cell_grid_type(precision), source_type(precision), hat_functions(precision, dimension)
    hat, corner_step, among = own.hat, own.corner_step, node_functions(dimension)
    number_of, node_of, step_of = among.number_of, among.node_of, among.step_of
    module = kernel_module(f"coarse_nodes_{dimension}d_{precision.name}")
    CORNERS, AROUND = wp.constant(2**dimension), wp.constant(3**dimension)

    @wp.kernel(module=module, enable_backward=False)
    def fill(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        eps: real,
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        h: wp.array(dtype=vector),
        N: wp.array(dtype=matrix),
        # out
        A: wp.array2d(dtype=real),
    ):
        """With a thread for each of the first half of the offsets of each node, itself among them; A is symmetric."""
        offset = wp.tid() // A.shape[1]
        node = wp.tid() - offset * A.shape[1]
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, step = node_of(node - member * nodes, grid.shape), step_of(offset)
        total = real(0.0)
        for corner in range(CORNERS):
            own = corner_step(corner)
            other = own + step
            if wp.min(wp.min(other[0], other[1]), other[2]) >= 0 and wp.max(wp.max(other[0], other[1]), other[2]) <= 1:
                cell = member * nodes + number_of(here - own, grid.shape)
                far = other[0] + 2 * other[1] + 4 * other[2]
                for p in range(grid.starts[cell], grid.starts[cell + 1]):
                    i = order[p]
                    a, b = hat(x[i], corner, grid), hat(x[i], far, grid)
                    q_a, q_b = N[i] * a.slope + a.value * h[i], N[i] * b.slope + b.value * h[i]
                    total += wp.dot(q_a, q_b) / m[i]
                    if offset == AROUND // 2:
                        total += eps / m[i]
        A[offset, node] = total
        A[AROUND - 1 - offset, member * nodes + number_of(here + step, grid.shape)] = total

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

    return NodeKernels(fill, spread)
