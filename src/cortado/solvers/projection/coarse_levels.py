"""A V-cycle over ever coarser grids, which makes the solves on the coarse grid of the pressure take few iterations.

Each level has half of the nodes of the finer one along every axis that has an even number of them, and the matrix
R A R^T of that level (Galerkin), with bilinear R. It is smoothed once before and once after by Jacobi's method with the
sums of |A_ij| of each row, which converges for every matrix that is symmetric and not negative (Baker, Falgout, Kolev
and Yang 2011). The cycle is symmetric, as conjugate gradients need it, and the grids wrap around as those of cells do.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.particles.arrays import zeros
from cortado.solvers.projection.coarse_hats import node_functions
from cortado.sph.parts import StepContext

FEWEST = 4
"""Nodes along an axis below which it is not halved."""
SWEEPS = 8
"""Smoothings of the coarsest level."""


@dataclass(frozen=True)
class LevelKernels:
    """By what they do; a kernel of two levels has the finer one's nodes in ``fine``."""

    coarsen: Any
    """The matrix of the coarser level."""
    measure: Any
    """The sums of |A_ij| of each row, 1 where there are none."""
    defect: Any
    """r - A x of the first smoothing x."""
    restrict: Any
    """To the coarser level."""
    prolong: Any
    """The first smoothing, and what the coarser level adds to it."""
    smooth: Any


@cache
def level_kernels(precision: Precision, dimension: int) -> LevelKernels:
    """In 2 or 3 dimensions."""
    real = precision.real
    module = kernel_module(f"coarse_levels_{dimension}d_{precision.name}")
    AROUND, among = wp.constant(3**dimension), node_functions(dimension)
    number_of, node_of, step_of = among.number_of, among.node_of, among.step_of

    @wp.func
    def scaled(cell: wp.vec3i, factor: wp.vec3i) -> wp.vec3i:
        return wp.vec3i(cell[0] * factor[0], cell[1] * factor[1], cell[2] * factor[2])

    @wp.func
    def weight(step: int, factor: int) -> real:
        """Of R, for a fine node that is a step from where the coarse one is, along an axis that is halved or not."""
        if step == 0:
            return real(1.0)
        if factor == 2 and (step == 1 or step == -1):
            return real(0.5)
        return real(0.0)

    @wp.func
    def weight_of(step: wp.vec3i, factor: wp.vec3i) -> real:
        return weight(step[0], factor[0]) * weight(step[1], factor[1]) * weight(step[2], factor[2])

    @wp.kernel(module=module, enable_backward=False)
    def coarsen(
        fine: wp.vec3i,
        shape: wp.vec3i,
        factor: wp.vec3i,
        A_fine: wp.array2d(dtype=real),
        # out
        A: wp.array2d(dtype=real),
    ):
        """With a thread for each entry (offset, node)."""
        offset = wp.tid() // A.shape[1]
        node = wp.tid() - offset * A.shape[1]
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        first = member * fine[0] * fine[1] * fine[2]
        here = scaled(node_of(node - member * nodes, shape), factor)
        far = scaled(step_of(offset), factor)
        total = real(0.0)
        for a in range(AROUND):
            own = step_of(a)
            part = weight_of(own, factor)
            if part > real(0.0):
                i = first + number_of(here + own, fine)
                for b in range(AROUND):
                    other = weight_of(own + step_of(b) - far, factor)
                    if other > real(0.0):
                        total += part * other * A_fine[b, i]
        A[offset, node] = total

    @wp.kernel(module=module, enable_backward=False)
    def measure(A: wp.array2d(dtype=real), rows: wp.array(dtype=real)):
        node, total = wp.tid(), real(0.0)
        for offset in range(AROUND):
            total += wp.abs(A[offset, node])
        rows[node] = wp.where(total > real(0.0), total, real(1.0))

    @wp.kernel(module=module, enable_backward=False)
    def defect(
        shape: wp.vec3i,
        A: wp.array2d(dtype=real),
        rows: wp.array(dtype=real),
        r: wp.array(dtype=real),
        # out
        left: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        here, total = node_of(node - member * nodes, shape), real(0.0)
        for offset in range(AROUND):
            there = member * nodes + number_of(here + step_of(offset), shape)
            total += A[offset, node] * (r[there] / rows[there])
        left[node] = r[node] - total

    @wp.kernel(module=module, enable_backward=False)
    def restrict(
        fine: wp.vec3i, shape: wp.vec3i, factor: wp.vec3i, left: wp.array(dtype=real), r: wp.array(dtype=real)
    ):
        node = wp.tid()
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        first = member * fine[0] * fine[1] * fine[2]
        here, total = scaled(node_of(node - member * nodes, shape), factor), real(0.0)
        for a in range(AROUND):
            part = weight_of(step_of(a), factor)
            if part > real(0.0):
                total += part * left[first + number_of(here + step_of(a), fine)]
        r[node] = total

    @wp.func
    def ends(cell: int, factor: int) -> int:
        """How many coarse nodes a fine one lies between along an axis."""
        return wp.where(factor == 2 and cell % 2 == 1, 2, 1)

    @wp.kernel(module=module, enable_backward=False)
    def prolong(
        fine: wp.vec3i,
        shape: wp.vec3i,
        factor: wp.vec3i,
        rows: wp.array(dtype=real),
        r: wp.array(dtype=real),
        z: wp.array(dtype=real),
        # out
        x: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = fine[0] * fine[1] * fine[2]
        member = node // nodes
        first = member * shape[0] * shape[1] * shape[2]
        here, total = node_of(node - member * nodes, fine), real(0.0)
        i_n, j_n, k_n = ends(here[0], factor[0]), ends(here[1], factor[1]), ends(here[2], factor[2])
        for k in range(k_n):
            for j in range(j_n):
                for i in range(i_n):
                    there = wp.vec3i(here[0] // factor[0] + i, here[1] // factor[1] + j, here[2] // factor[2] + k)
                    total += z[first + number_of(there, shape)]
        x[node] = r[node] / rows[node] + total / real(i_n * j_n * k_n)

    @wp.kernel(module=module, enable_backward=False)
    def smooth(
        shape: wp.vec3i,
        A: wp.array2d(dtype=real),
        rows: wp.array(dtype=real),
        r: wp.array(dtype=real),
        x: wp.array(dtype=real),
        # out
        z: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = shape[0] * shape[1] * shape[2]
        member = node // nodes
        here, total = node_of(node - member * nodes, shape), real(0.0)
        for offset in range(AROUND):
            total += A[offset, node] * x[member * nodes + number_of(here + step_of(offset), shape)]
        z[node] = x[node] + (r[node] - total) / rows[node]

    return LevelKernels(coarsen, measure, defect, restrict, prolong, smooth)


class Level:
    """One grid: its matrix, and room for a residual and for what solves it nearly."""

    def __init__(self, shape: tuple[int, int, int], factor: tuple[int, int, int], A: wp.array):
        """``factor``: by how much the finer grid has more nodes along each axis."""
        self.shape, self.factor, self.A = wp.vec3i(*shape), wp.vec3i(*factor), A
        self.nodes, device = A.shape[1], A.device
        kinds = dict.fromkeys(("rows", "r", "left", "x", "z"), (self.nodes, A.dtype))
        self.arrays = zeros(kinds, device)


class Levels:
    """All grids of one matrix, (3^d, nodes) for each offset from a node and each node."""

    def __init__(self, precision: Precision, dimension: int, shape: tuple[int, int, int], A: wp.array):
        self._kernels, members = level_kernels(precision, dimension), A.shape[1] // (shape[0] * shape[1] * shape[2])
        self._levels = [Level(shape, (1, 1, 1), A)]
        while any(factors := [2 if n % 2 == 0 and n >= FEWEST else 1 for n in shape]) and max(factors) == 2:
            shape = (shape[0] // factors[0], shape[1] // factors[1], shape[2] // factors[2])
            count = members * shape[0] * shape[1] * shape[2]
            coarser = wp.zeros((len(A), count), dtype=A.dtype, device=A.device)
            self._levels.append(Level(shape, (factors[0], factors[1], factors[2]), coarser))
        self._device = A.device

    def begin(self, context: StepContext) -> None:
        """The matrices of all levels."""
        for finer, level in zip([None, *self._levels], self._levels, strict=False):
            if finer is not None:
                both = {"fine": finer.shape, "shape": level.shape, "factor": level.factor, "A_fine": finer.A}
                context.launch(self._kernels.coarsen, both, A=level.A, threads=len(level.A) * level.nodes)
            context.launch(self._kernels.measure, level.arrays, A=level.A, threads=level.nodes)

    def cycle(self, context: StepContext, r: wp.array, z: wp.array) -> None:
        """Write to ``z`` (nodes,) what nearly solves A z = ``r``."""
        self._cycle(context, 0, {"r": r, "z": z})

    def _cycle(self, context: StepContext, number: int, given: dict[str, wp.array]) -> None:
        level, kernels = self._levels[number], self._kernels
        own = {**level.arrays, **given}
        matrix = {"shape": level.shape, "A": level.A, "rows": own["rows"], "r": own["r"]}
        if number + 1 == len(self._levels):
            own["x"].zero_()
            for _ in range(SWEEPS // 2):
                context.launch(kernels.smooth, matrix, x=own["x"], z=own["left"], threads=level.nodes)
                context.launch(kernels.smooth, matrix, x=own["left"], z=own["x"], threads=level.nodes)
            wp.copy(own["z"], own["x"])
            return
        coarser = self._levels[number + 1]
        both = {"fine": level.shape, "shape": coarser.shape, "factor": coarser.factor}
        context.launch(kernels.defect, matrix, left=own["left"], threads=level.nodes)
        context.launch(kernels.restrict, both, left=own["left"], r=coarser.arrays["r"], threads=coarser.nodes)
        self._cycle(context, number + 1, {})
        added = {"rows": own["rows"], "r": own["r"], "z": coarser.arrays["z"], "x": own["x"]}
        context.launch(kernels.prolong, both, added, threads=level.nodes)
        context.launch(kernels.smooth, matrix, x=own["x"], z=own["z"], threads=level.nodes)
