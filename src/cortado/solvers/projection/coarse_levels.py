"""A multigrid method that solves for the pressure on the coarse grid in few iterations.

Along every axis with an even number of nodes, a level has half of the nodes of the finer level. The matrix of a level
is R A R^T (Galerkin), with the matrix A of the finer level and a bilinear restriction R. Like A, the matrix R A R^T is
a sum over cells. The solve (`cortado.solvers.projection.coarse_solve`) smooths a solution x by Jacobi steps x + w (r -
A x) with the right-hand side r. Node I has the Jacobi weight

    w_I = W / (sqrt(A_II) sum_J |A_IJ| / sqrt(A_JJ)).

If the factor W is below 2, Jacobi's method converges for every symmetric positive semidefinite matrix. With W = 1, the
product w A has no eigenvalue above 1. The bound by Baker, Falgout, Kolev and Yang (2011) is applied to the matrix with
its diagonal scaled to 1.
"""

from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.particles.state import Layout
from cortado.solvers.projection.coarse_nodes import node_functions
from cortado.solvers.projection.coarse_solve import BLOCK, solve_kernel, system_type
from cortado.sph.parts import StepContext

FEWEST = 4
"""Smallest even number of nodes along an axis that a coarser level halves."""
W = wp.constant(1.9)


@cache
def level_kernels(precision: Precision, dimension: int) -> SimpleNamespace:
    real = precision.real
    module = kernel_module(f"coarse_levels_{dimension}d_{precision.name}")
    AROUND, CORNERS, among = wp.constant(3**dimension), wp.constant(2**dimension), node_functions(dimension)
    PAIRS, row = wp.constant(pairs_of_corners(dimension)), wp.types.vector(length=2**dimension, dtype=real)
    number_of, node_of, step_of = among.number_of, among.node_of, among.step_of
    corner_step, pair_of, terms = among.corner_step, among.pair_of, wp.array2d(dtype=real)

    @wp.struct
    class Place:
        start: int
        all: int
        shape: wp.vec3i
        number: int
        first: int
        here: wp.vec3i

    @wp.func
    def place_of(node: int, members: int, shapes: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int64)) -> Place:
        level, found = int(0), Place()
        for later in range(1, starts.shape[0]):
            if node >= int(starts[later]):
                level = later
        found.shape = wp.vec3i(shapes[6 * level], shapes[6 * level + 1], shapes[6 * level + 2])
        found.start = int(starts[level])
        nodes = found.shape[0] * found.shape[1] * found.shape[2]
        found.all = members * nodes
        found.number = node - found.start
        found.first = found.number // nodes * nodes
        found.here = node_of(found.number - found.first, found.shape)
        return found

    @wp.func
    def entry(rows: int, row: int, number: int, at: Place) -> wp.int64:
        return wp.int64(rows) * wp.int64(at.start) + wp.int64(row) * wp.int64(at.all) + wp.int64(number)

    @wp.func
    def entry_beside(rows: int, row: int, step: wp.vec3i, at: Place) -> wp.int64:
        return entry(rows, row, at.first + number_of(at.here + step, at.shape), at)

    @wp.func
    def share(child: int, corner: int, halved: int) -> real:
        """Return the interpolation weight from a corner of a coarse cell to a corner of a child cell."""
        if ((child | ~halved) & corner) != 0:
            return real(0.0)
        bits = (child | corner) & halved
        return real(0.125) * real(8 >> ((bits & 1) + ((bits >> 1) & 1) + ((bits >> 2) & 1)))

    @wp.kernel(module=module, enable_backward=False)
    def coarsen(fine: wp.vec3i, shape: wp.vec3i, factor: wp.vec3i, cells_fine: terms, cells: terms):
        a = wp.tid() // cells.shape[1]
        cell = wp.tid() - a * cells.shape[1]
        nodes = shape[0] * shape[1] * shape[2]
        member = cell // nodes
        here, first = node_of(cell - member * nodes, shape), member * fine[0] * fine[1] * fine[2]
        lower = wp.vec3i(here[0] * factor[0], here[1] * factor[1], here[2] * factor[2])
        halved, total, corners = (factor[0] - 1) + 2 * (factor[1] - 1) + 4 * (factor[2] - 1), row(), int(CORNERS)
        for child in range(corners):  # not a constant: Warp would write the loops out
            own = first + number_of(lower + corner_step(child), fine)
            if (child & ~halved) == 0 and cells_fine[0, own] > real(0.0):
                left = row()
                for u in range(corners):
                    weight = share(child ^ a, u ^ a, halved)
                    if weight > real(0.0):
                        for v in range(CORNERS):
                            left[v] += weight * cells_fine[pair_of(u, v), own]
                for b in range(CORNERS):
                    for v in range(CORNERS):
                        total[b] += share(child ^ b, v ^ b, halved) * left[v]
        for b in range(CORNERS):
            if b >= a:
                cells[pair_of(a, b), cell] = total[b]

    typed = TypesByName(real, {wp.int32: "shapes", wp.int64: "starts"})

    @typed.kernel(module)
    def fill(members: int, shapes, starts, cells, all_nodes: int, A):
        offset = wp.tid() // all_nodes
        at = place_of(wp.tid() - offset * all_nodes, members, shapes, starts)
        step, total = step_of(offset), real(0.0)
        for corner in range(CORNERS):
            own = corner_step(corner)
            to = own + step
            if wp.min(wp.min(to[0], to[1]), to[2]) >= 0 and wp.max(wp.max(to[0], to[1]), to[2]) <= 1:
                pair = pair_of(corner, to[0] + 2 * to[1] + 4 * to[2])
                total += cells[entry_beside(PAIRS, pair, -own, at)]
        A[entry(AROUND, offset, at.number, at)] = total
        A[entry_beside(AROUND, AROUND - 1 - offset, step, at)] = total

    @typed.kernel(module)
    def weigh(members: int, shapes, starts, A, weight):
        at = place_of(wp.tid(), members, shapes, starts)
        own, total = A[entry(AROUND, AROUND // 2, at.number, at)], real(0.0)
        if own > real(0.0):
            for offset in range(AROUND):
                coupling = wp.abs(A[entry(AROUND, offset, at.number, at)])
                if coupling > real(0.0):
                    total += coupling / wp.sqrt(A[entry_beside(AROUND, AROUND // 2, step_of(offset), at)])
            total = real(W) / (wp.sqrt(own) * total)
        weight[wp.tid()] = total

    return by_name(coarsen, fill, weigh)


def pairs_of_corners(dimension: int) -> int:
    """Return the number of pairs of corners of a cell, where a corner also forms a pair with itself."""
    return 2**dimension * (2**dimension + 1) // 2


class Level(NamedTuple):
    shape: wp.vec3i
    factor: wp.vec3i
    """Ratio of the finer level's number of nodes to this level's number of nodes, along each axis."""
    cells: wp.array
    """Array of shape (pairs of corners, cells) with the contribution of each cell to the matrix."""


class Levels:
    def __init__(self, layout: Layout, dimension: int, shape: tuple[int, int, int], rows: int):
        """``rows`` is the number of rows of the matrix `B` of rigid bodies."""
        precision, members, device = layout.precision, layout.members, layout.device
        self._kernels, self._device = level_kernels(precision, dimension), device
        self._solve = solve_kernel(precision, dimension, device.is_cpu)
        factors: list[tuple[int, ...]] = [(1, 1, 1)]
        shapes: list[tuple[int, ...]] = [shape]
        while max(halved := tuple(2 if n % 2 == 0 and n >= FEWEST else 1 for n in shapes[-1])) == 2:
            factors.append(halved)
            shapes.append(tuple(n // factor for n, factor in zip(shapes[-1], halved, strict=True)))
        counts = [members * n[0] * n[1] * n[2] for n in shapes]
        at, around, pairs = np.cumsum([0, *counts]).tolist(), 3**dimension, pairs_of_corners(dimension)

        def numbers(count: int) -> wp.array:
            return wp.zeros(count, dtype=precision.real, device=device)

        cells, A, weight, residual = (numbers(n * at[-1]) for n in (pairs, around, 1, 1))
        self.levels = [
            Level(wp.vec3i(*n), wp.vec3i(*factor), cells[pairs * i : pairs * j].reshape((pairs, j - i)))
            for n, factor, i, j in zip(shapes, factors, at[:-1], at[1:], strict=True)
        ]
        self.cells, self.r = self.levels[0].cells, residual[: counts[0]]
        """Contributions of the finest level's cells to the matrix (pairs of corners, cells), and the right-hand side
        (nodes,)."""
        self.B = numbers(rows * counts[0]).reshape((rows, counts[0]))
        self.count = wp.zeros(members, dtype=wp.int32, device=device)
        """Array of shape (members,) with the number of iterations in each scene's last solve."""
        table = [[*n, *factor] for n, factor in zip(shapes, factors, strict=True)]
        blocks, teams, team = -(-counts[0] // members // BLOCK), members, 1
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
        self._all = {"members": members, "shapes": system.shapes, "starts": system.starts, "A": A}
        self._filled = {"cells": cells, "all_nodes": at[-1], "threads": (around // 2 + 1) * at[-1]}
        self._weight, self._corners = weight, 2**dimension

    def begin(self, context: StepContext) -> None:
        for finer, level in pairwise(self.levels):
            both = {"fine": finer.shape, "shape": level.shape, "factor": level.factor, "cells_fine": finer.cells}
            threads = self._corners * level.cells.shape[1]
            context.launch(self._kernels.coarsen, both, cells=level.cells, threads=threads)
        context.launch(self._kernels.fill, self._all, **self._filled)
        context.launch(self._kernels.weigh, self._all, weight=self._weight, threads=len(self._weight))

    def solve(self, e: wp.array, tolerance: float, most: int) -> None:
        """Solve for the coarse pressure ``e`` (nodes,) with the right-hand side `r`, which is overwritten."""
        limits = {"tolerance": tolerance, "most": most}
        launch(self._solve, self._threads, self._device, limits, system=self._system, e=e, block=BLOCK)
