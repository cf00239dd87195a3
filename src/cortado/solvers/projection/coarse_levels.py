"""Ever coarser grids, which make the solves on the coarse grid of the pressure take few iterations.

Each level has half of the nodes of the finer one along every axis that has an even number of them, and the matrix
R A R^T of that level (Galerkin), with bilinear R. `cortado.solvers.projection.coarse_solve` smooths it by steps of
Jacobi's method, x + w (r - A x), with w_I = W / (sqrt(A_II) sum_J |A_IJ| / sqrt(A_JJ)). With W below 2 that converges
for every matrix that is symmetric and not negative: those with W = 1 (Baker, Falgout, Kolev and Yang 2011, applied to
the matrix whose diagonal is scaled to 1) have no eigenvalue of w A above 1. The grids wrap around as those of cells do.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.solvers.projection.coarse_nodes import node_functions
from cortado.solvers.projection.coarse_solve import BLOCK, solve_kernel, system_type
from cortado.sph.parts import StepContext

FEWEST = 4
"""Fewest nodes along an axis that a coarser grid may halve."""
W = wp.constant(1.9)


class LevelKernels(NamedTuple):
    """Kernels that make the matrices of ever coarser grids."""

    coarsen: Any
    """The matrix of a level from that of the ``fine`` one."""
    weigh: Any
    """w of each node, 0 where there is no matrix."""


@cache
def level_kernels(precision: Precision, dimension: int) -> LevelKernels:
    """Make the kernels for the matrices of coarser grids, in 2 or 3 dimensions."""
    real = precision.real
    module = kernel_module(f"coarse_levels_{dimension}d_{precision.name}")
    AROUND, among = wp.constant(3**dimension), node_functions(dimension)
    number_of, node_of, step_of, offset_of = among.number_of, among.node_of, among.step_of, among.offset_of

    @wp.func
    def scaled(cell: wp.vec3i, factor: wp.vec3i) -> wp.vec3i:
        return wp.vec3i(cell[0] * factor[0], cell[1] * factor[1], cell[2] * factor[2])

    @wp.func
    def side(step: int) -> real:
        return wp.where(step == 0, real(1.0), real(0.5))

    @wp.func
    def weight_of(step: wp.vec3i) -> real:
        """Return the weight in R of a fine node a step, 0 or 1 along each axis, from the coarse one."""
        return side(step[0]) * side(step[1]) * side(step[2])

    @wp.func
    def least(left: int, factor: int) -> int:
        """Return the first step along an axis from a fine node that ends within reach of a node ``left`` away."""
        return wp.max(-1, left + 1 - factor)

    @wp.func
    def most(left: int, factor: int) -> int:
        """Return one more than the last step from a fine node that ends within reach of a node ``left`` away."""
        return wp.min(2, left + factor)

    @wp.kernel(module=module, enable_backward=False)
    def coarsen(
        fine: wp.vec3i,
        shape: wp.vec3i,
        factor: wp.vec3i,
        A_fine: wp.array2d(dtype=real),
        # out
        A: wp.array2d(dtype=real),
    ):
        """Compute a coarser symmetric matrix A, with a thread for each of the first half of each node's offsets."""
        offset = wp.tid() // A.shape[1]
        node = wp.tid() - offset * A.shape[1]
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        first = member * fine[0] * fine[1] * fine[2]
        here, step = node_of(node - member * nodes, shape), step_of(offset)
        own, far, total = scaled(here, factor), scaled(step, factor), real(0.0)
        for k in range(1 - factor[2], factor[2]):
            for j in range(1 - factor[1], factor[1]):
                for i in range(1 - factor[0], factor[0]):
                    near = wp.vec3i(i, j, k)
                    row = first + number_of(own + near, fine)
                    if A_fine[AROUND // 2, row] > real(0.0):
                        part, left = real(0.0), far - near
                        for c in range(least(left[2], factor[2]), most(left[2], factor[2])):
                            for b in range(least(left[1], factor[1]), most(left[1], factor[1])):
                                for a in range(least(left[0], factor[0]), most(left[0], factor[0])):
                                    there = wp.vec3i(a, b, c)
                                    part += weight_of(there - left) * A_fine[offset_of(there), row]
                        total += weight_of(near) * part
        A[offset, node] = total
        A[AROUND - 1 - offset, member * nodes + number_of(here + step, shape)] = total

    @wp.kernel(module=module, enable_backward=False)
    def weigh(shape: wp.vec3i, A: wp.array2d(dtype=real), weight: wp.array(dtype=real)):
        node = wp.tid()
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        here, own = node_of(node - member * nodes, shape), A[AROUND // 2, node]
        weight[node] = real(0.0)
        if own > real(0.0):
            total = real(0.0)
            for offset in range(AROUND):
                entry = wp.abs(A[offset, node])
                if entry > real(0.0):
                    total += entry / wp.sqrt(A[AROUND // 2, member * nodes + number_of(here + step_of(offset), shape)])
            weight[node] = real(W) / (wp.sqrt(own) * total)

    return LevelKernels(coarsen, weigh)


class Level(NamedTuple):
    """One of the multigrid's grids, with its part of the arrays of all levels."""

    shape: wp.vec3i
    factor: wp.vec3i
    """Ratio of the finer grid's number of nodes to this grid's, along each axis."""
    A: wp.array
    """(3^d, nodes) for each offset from a node and each node, of all scenes."""
    weight: wp.array


class Levels:
    """All grids of the multigrid for a solver's coarse pressure matrix."""

    def __init__(
        self,
        precision: Precision,
        dimension: int,
        shape: tuple[int, int, int],
        members: int,
        device: Any,
        rows: int = 0,
    ):
        """Allocate all levels below a finest grid of a ``shape``, to whose matrix B^T B with ``rows`` rows is added."""
        self._kernels, self._device = level_kernels(precision, dimension), device
        self._solve = solve_kernel(precision, dimension, device.is_cpu)
        factors: list[tuple[int, ...]] = [(1, 1, 1)]
        shapes: list[tuple[int, ...]] = [shape]
        while max(halved := tuple(2 if n % 2 == 0 and n >= FEWEST else 1 for n in shapes[-1])) == 2:
            factors.append(halved)
            shapes.append(tuple(n // factor for n, factor in zip(shapes[-1], halved, strict=True)))
        counts = [members * n[0] * n[1] * n[2] for n in shapes]
        at, around = np.cumsum([0, *counts]), 3**dimension

        def numbers(count: int) -> wp.array:
            return wp.zeros(int(count), dtype=precision.real, device=device)

        A, weight, residual = numbers(around * at[-1]), numbers(at[-1]), numbers(at[-1])
        self.levels = [
            Level(wp.vec3i(*n), wp.vec3i(*factor), A[around * i : around * j].reshape((around, j - i)), weight[i:j])
            for n, factor, i, j in zip(shapes, factors, at[:-1].tolist(), at[1:].tolist(), strict=True)
        ]
        self.A, self.r = self.levels[0].A, residual[: counts[0]]
        """The matrix of the finest grid, (3^d, nodes), and (nodes,) what is solved for."""
        self.B = numbers(rows * counts[0]).reshape((rows, counts[0]))
        """(rows, nodes) of which B^T B is added to that matrix."""
        self.count = wp.zeros(members, dtype=wp.int32, device=device)
        """(members,) iterations of the last solve."""
        table = [[*n, *factor] for n, factor in zip(shapes, factors, strict=True)]
        blocks = -(-counts[0] // members // BLOCK)
        teams, team = members, 1
        if not device.is_cpu:
            teams = min(members, device.sm_count)
            team = min(blocks, device.sm_count // teams)
        self._threads = teams * team * (1 if device.is_cpu else BLOCK)
        self._system = system = system_type(precision)()
        system.shapes = wp.array(np.ravel(table), dtype=wp.int32, device=device)
        system.starts = wp.array(at[:-1], dtype=wp.int64, device=device)
        system.members, system.team, system.count = members, team, self.count
        system.A, system.weight, system.residual = A, weight, residual
        system.x_values, system.z_values = numbers(at[-1]), numbers(at[-1])
        system.direction, system.image = numbers(counts[0]), numbers(counts[0])
        system.partial = numbers(teams * blocks)
        system.rows, system.B = rows, self.B.flatten()
        system.gate = wp.zeros(2 * teams, dtype=wp.int32, device=device)

    def begin(self, context: StepContext) -> None:
        """Compute the matrices and weights of all coarser levels from the finest matrix."""
        for finer, level in zip([None, *self.levels], self.levels, strict=False):
            if finer is not None:
                both = {"fine": finer.shape, "shape": level.shape, "factor": level.factor, "A_fine": finer.A}
                entries = (len(level.A) // 2 + 1) * len(level.weight)
                context.launch(self._kernels.coarsen, both, A=level.A, threads=entries)
            context.launch(self._kernels.weigh, level._asdict(), threads=len(level.weight))

    def solve(self, e: wp.array, tolerance: float, most: int) -> None:
        """Write to ``e`` (nodes,) the solution of (A + B^T B) e = `r`, which is overwritten."""
        limits = {"tolerance": tolerance, "most": most}
        launch(self._solve, self._threads, self._device, limits, system=self._system, e=e, block=BLOCK)
