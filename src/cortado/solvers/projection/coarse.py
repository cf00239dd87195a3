"""A coarse correction of the pressure, so that water that is shut in knows of its walls within one step.

An iteration of `cortado.solvers.projection.pressure` hands a pressure on by a spacing or two. Before each of them but
the first, which has the pressure of the step before, the smooth part of what is missing is found at once, on a grid
with nodes two spacings apart. Takahashi and Lin 2016 have a multilevel particle solver;
`cortado.solvers.projection.coarse_pressure` has the equations of this one. Before the first as well it would cost twice
as much and gain a tenth at most, but in a cold scene, which has no pressure of the step before.

Ever coarser grids make the solves take few iterations. Each level has half of the nodes of the finer one along every
axis that has an even number of them, and the matrix R A R^T of that level (Galerkin), with bilinear R.
`cortado.solvers.projection.coarse_solve` smooths it by steps of Jacobi's method, x + w (r - A x), with
w_I = W / (sqrt(A_II) sum_J |A_IJ| / sqrt(A_JJ)). With W below 2 that converges for every matrix that is symmetric and
not negative: those with W = 1 (Baker, Falgout, Kolev and Yang 2011, applied to the matrix whose diagonal is scaled to
1) have no eigenvalue of w A above 1. The grids wrap around as those of cells do.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.launching import Named, launch
from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT32, Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.solvers.projection.bodies import Bodies, BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse_bodies import CoarseBodies, CoarseBodiesAdjoint, CoarseBodiesTangent
from cortado.solvers.projection.coarse_nodes import node_functions, node_kernels
from cortado.solvers.projection.coarse_pressure import coarse_pressure_kernels, length_kernels
from cortado.solvers.projection.coarse_residual import coarse_push_kernels, residual_kernels
from cortado.solvers.projection.coarse_solve import BLOCK, solve_kernel, system_type
from cortado.solvers.projection.lattice import SPACING
from cortado.solvers.projection.sums import velocity_kernels
from cortado.sph.conjugate_gradients import round_off
from cortado.sph.moment_functions import matrix_type, symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents

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
    """A grid of the multigrid, with its part of the arrays of all levels."""

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


LEAST = 1e-5
"""The regularisation eps of all particles around a node, relative to A_II on the lattice. It takes 0.7 % off the
correction of the longest wave in water that is 100 spacings deep, and 3 % where it is 200 deep."""
CLOSE = 1e-3
"""The part of the first residual, in the norm of A^-1, at which a solve in float32 ends. From 3e-7 to 1e-3 the gradient
of a dam's place after 80 steps with respect to gravity differs by less than 4e-7, beside float64 too."""
MOST = 1_000
"""Greatest number of iterations of a solve."""


class Coarse:
    """The grid and the matrix of the coarse pressure correction for the particles of one solver, and its solves."""

    def __init__(
        self,
        discretisation: Discretisation,
        layout: Layout,
        dimension: int,
        grid: Grid,
        spacing: float,
        bodies: Bodies | None,
        endless: bool,
    ):
        """Allocate a correction for particles with a ``spacing`` [m] and free ``bodies``, none if ``endless``."""
        self.endless = endless
        precision, device = layout.precision, layout.device
        real, vector = precision.real, precision.vector
        self.push = coarse_push_kernels(discretisation, dimension)
        self.nodes, self.residual = node_kernels(precision, dimension), residual_kernels(discretisation, dimension)
        self.pressure, self.length = coarse_pressure_kernels(precision, dimension), length_kernels(precision)
        self.velocity = velocity_kernels(discretisation, dimension)
        self._sort = CellSort(grid, layout.particles, precision, device, layout.members)
        self._particles, self._kinds = layout, (real, vector, precision.pair)
        self._tolerance = CLOSE if precision is FLOAT32 else round_off(precision)
        self.bodies = None if bodies is None else CoarseBodies(bodies, layout, dimension)
        """Free ones; None without any."""
        rows = 0 if self.bodies is None else self.bodies.rows
        self._levels = Levels(precision, dimension, grid.shape, layout.members, device, rows)
        pairs = 2**dimension * (2**dimension + 1) // 2
        self._cells = wp.zeros((pairs, len(self._levels.r)), dtype=real, device=device)
        """The part of A of each cell, for each two of its corners."""
        energy = 8.0 / 3.0 * (SPACING / spacing**2 if dimension == 3 else spacing**-2)  # of the gradient of a hat
        touched = (2.0 * SPACING) ** dimension
        self.spaced = {"spacing": spacing}
        """As kernels call it."""
        self.grid = {"grid": self._sort.grid, "order": self._sort.order, "eps": LEAST * energy / touched}
        """As kernels call them."""
        self.pushed = layout.arrays(h=vector, N=matrix_type(precision), T=symmetric(precision).kind)
        """h, N and c L of the sorted particles."""
        self.sums, self.parts = layout.sum_of(precision.pair), layout.arrays(parts=precision.pair)
        """Of alpha."""
        self.warm, self._none_stays = (wp.zeros(layout.members, dtype=wp.int32, device=device) for _ in range(2))
        """Whether scenes are (`cortado.solvers.projection.pressure`)."""
        self._all_warm = wp.zeros(1, dtype=wp.int32, device=device)
        self._none = self.numbers()
        """Nothing: what a correction left may not be finite, if its run was lost."""
        self.still = layout.arrays(still=vector)["still"]
        """No velocities."""
        self.unmoved = {"carried": layout.arrays(carried=real)["carried"]}
        """What a scene without bodies has of them."""
        self.source = layout.arrays(s_value=real, s_slope=vector, s_bent=vector, s_own=real)
        """What is spread."""

    def numbers(self) -> wp.array:
        """Make an array (nodes,) of zeros for the nodes of all scenes."""
        return wp.zeros_like(self._levels.r)

    def room(self) -> dict[str, wp.array]:
        """Make arrays for a correction's results besides a new iterate: r, e, d, the thrust and the sums of alpha."""
        layout, (real, vector, pair) = self._particles, self._kinds
        kept = layout.arrays(r=real, change=real, thrust=vector)
        return {**kept, "e": self.numbers(), "sums": wp.zeros(layout.members, dtype=pair, device=layout.device)}

    def begin(self, context: StepContext, around: Named) -> None:
        """Compute the matrix of a step, and note whether all scenes are warm and need no first correction."""
        if self.endless:
            return
        scenes = {"scenes": len(self.warm), "warm": self.warm}
        context.launch(self.length.every, scenes, all_warm=self._all_warm, threads=1)
        for kernel in self.push.forward:
            context.launch(kernel, around, self.pushed)
        self._sort(context.fields["x"])
        cells = self._cells
        context.launch(self.nodes.add_up, self.grid, self.pushed, cells=cells, threads=cells.shape[1])
        context.launch(self.nodes.fill, self.grid, cells=cells, A=self._levels.A, threads=cells.shape[1])
        self._levels.begin(context)
        if self.bodies is not None:
            self.bodies.begin(context, self.grid, around, self._levels.B)

    def where_due(self, k: int, correct: Callable[[], None]) -> None:
        """Call ``correct`` before iteration k, before the first one only if a scene is cold. An endless scene has no
        correction, as the level that it would give to pressures moves particles that are not on a lattice."""
        if self.endless:
            return
        if k > 0:
            correct()
        else:
            wp.capture_if(self._all_warm, on_false=correct)

    def solve(self, context: StepContext, before: wp.array, e: wp.array) -> None:
        """Write to ``e`` (nodes,) the solution of A e = the `source`, spread with the e ``before``."""
        r = self._levels.r
        context.launch(self.nodes.spread, self.grid, self.source, r=r, e=before, threads=len(r))
        self._levels.solve(e, self._tolerance, MOST)

    def correct(self, context: StepContext, k: int, around: Named, at: Named, new: Named, T: wp.array) -> None:
        """Correct the pressure before iteration k: from an iterate ``at`` with A and divergence, write k, y and u of a
        ``new`` one, which has `room` for the rest. ``around`` has the drift of walls; ``T`` is overwritten."""
        context.launch(self.residual.residual, around, at, self.source, r=new["r"])
        self.solve(context, self._none, new["e"])
        own = {name: new[name] for name in ("r", "e", "change", "thrust", "sums")}
        context.launch(self.pressure.correct, own, around, at, self.grid, T=T)
        thrown = {"y": new["change"], "T": T, "kick": new["thrust"], "u": new["u"]}
        context.launch(self.velocity.velocity.forward, around, thrown, v_star=self.still)
        stays = self.warm if k == 0 else self._none_stays
        carried = self.carried(context, new["change"])
        context.launch(self.length.share, own, carried, self.spaced, self.parts, first=int(k == 0), stays=stays)
        wp.copy(new["sums"], self.sums(self.parts["parts"]))
        out = {"k_out": new["k"], "y_out": new["y"], "u_out": new["u"]}
        context.launch(self.length.apply, out, own, at)

    def carried(self, context: StepContext, change: wp.array) -> dict[str, wp.array]:
        """Return the divergence G d that a pressure change d takes away by moving free bodies."""
        return self.unmoved if self.bodies is None else {"carried": self.bodies.carried(context, change)}


class CoarseTangent:
    """The tangent of the coarse pressure correction, for forward mode."""

    def __init__(self, coarse: Coarse, layout: Layout, bodies: BodiesTangent | None, dot: Tangents):
        precision = layout.precision
        real, vector, six = precision.real, precision.vector, symmetric(precision).kind
        self._coarse, self._e_dot = coarse, coarse.numbers()
        self._bodies = None
        if coarse.bodies is not None and bodies is not None:
            self._bodies = CoarseBodiesTangent(coarse.bodies, bodies, dot)
        self._unmoved = {**coarse.unmoved, "carried_dot": coarse.unmoved["carried"]}
        kinds = {"h": vector, "N": matrix_type(precision), "r": real, "change": real, "thrust": vector}
        self._change = layout.arrays("_dot", **kinds, T=six, u=vector)
        self._T = layout.arrays(T=six)

    def begin(self, context: StepContext, known: tuple[Named, ...]) -> None:
        """Compute tangents of the coarse push; ``known`` has particles and surroundings with their tangents."""
        for kernel in self._coarse.push.tangent:
            context.launch(kernel, *known, self._coarse.pushed, self._change)

    def correct(self, context: StepContext, k: int, known: tuple[Named, ...], at: Named, new: Named) -> None:
        """Write k_dot, y_dot and u_dot of the ``new`` iterate from those of the iterate ``at``, before iteration k."""
        own, change = self._coarse, {name: self._change[f"{name}_dot"] for name in ("change", "thrust", "r", "T", "u")}
        found = {f"{name}_dot": change[name] for name in ("change", "thrust", "r")}
        left = {name: new[name] for name in ("r", "e", "change", "thrust", "sums")}
        context.launch(own.residual.residual_tangent, at, *known, found)
        every = (own.grid, left, own.pushed, self._change, *known)
        context.launch(own.pressure.source_tangent, *every, own.source)
        if self._bodies is not None:
            self._bodies.add_source(context, every, own.source)
        own.solve(context, new["e"], self._e_dot)
        context.launch(own.pressure.correct_tangent, at, *every, e_dot=self._e_dot)
        pull = {"y": new["change"], "y_dot": change["change"], **self._T, "T_dot": change["T"]}
        context.launch(own.velocity.pull_tangent, pull, *known)
        thrown = {"u": new["thrust"], "v_star": own.still, "v_star_dot": own.still}
        thrown |= {"kick_dot": change["thrust"], "u_dot": change["u"]}
        context.launch(own.velocity.velocity.tangent, pull, thrown, *known)
        carried = self._unmoved
        if self._bodies is not None:
            carried = self._bodies.carried(context, new["change"], change["change"])
        given = {**own.spaced, "first": int(k == 0)}
        context.launch(own.length.share_tangent, given, found, left, carried, own.parts, *known)
        steps = {name: at[name] for name in ("k_dot", "y_dot", "u_dot")}
        context.launch(own.length.apply_tangent, steps, found, left, sums_dot=own.sums(own.parts["parts"]))


class CoarseAdjoint:
    """The adjoint of the coarse pressure correction, for reverse mode."""

    def __init__(self, coarse: Coarse, layout: Layout, bodies: BodiesAdjoint | None, bar: Adjoints):
        precision = layout.precision
        real, vector, six = precision.real, precision.vector, symmetric(precision).kind
        self._coarse, self._multiplier = coarse, coarse.numbers()
        self._bodies = None
        if coarse.bodies is not None and bodies is not None:
            self._bodies = CoarseBodiesAdjoint(coarse.bodies, bodies, bar)
        self._bars = layout.arrays("_bar", h=vector, N=matrix_type(precision))
        self._steps = layout.arrays("_bar", r=real, change=real, carried=real, thrust=vector, alpha=real)
        self._through = layout.arrays(T=six, f=vector, kick_bar=vector, v_bar=vector)
        self._sum = layout.sum_of(real)

    def begin(self) -> None:
        for array in self._bars.values():
            array.zero_()

    def correct(
        self,
        context: StepContext,
        k: int,
        known: tuple[Named, ...],
        at: Named,
        new: Named,
        steps: Named,
        u_bar: wp.array,
    ) -> None:
        """Apply the adjoint of the correction before iteration k: from k_bar and y_bar of the ``new`` iterate, in
        ``steps``, and ``u_bar``, to k and y of the iterate ``at``. It adds to d_bar and S there, which give the rest of
        the adjoint of u."""
        own, through, found = self._coarse, self._through, self._steps
        left = {name: new[name] for name in ("r", "e", "change", "thrust", "sums")}
        context.launch(own.length.along_adjoint, steps, left, u_bar=u_bar, alpha_bar=found["alpha_bar"])
        total = self._sum(found["alpha_bar"])
        left |= own.carried(context, new["change"])
        given = {"alpha_bar": total, **own.spaced, "first": int(k == 0)}
        context.launch(own.length.apply_adjoint, given, left, steps, found, *known, u_bar=u_bar)
        if self._bodies is not None:
            self._bodies.carried(context, found["carried_bar"], new["change"], found["change_bar"])
        thrown = {"u": new["thrust"], "v_star": own.still, "y": new["change"], "u_bar": found["thrust_bar"]}
        context.launch(own.velocity.own_adjoint, thrown, through, *known)
        context.launch(own.velocity.velocity.adjoint, thrown, through, *known, y_bar=found["change_bar"])
        every = (own.grid, left, own.pushed, self._bars, found, *known)
        context.launch(own.pressure.correct_adjoint, at, {"y_bar": steps["y_bar"]}, own.source, *every)
        own.solve(context, new["e"], self._multiplier)
        context.launch(own.pressure.source_adjoint, *every, multiplier=self._multiplier)
        if self._bodies is not None:
            self._bodies.add_source(context, every, new["e"], self._multiplier)
        context.launch(own.residual.residual_adjoint, steps, found, at, *known)

    def finish(self, context: StepContext, known: tuple[Named, ...]) -> None:
        """Turn the adjoints of the coarse push h and N into those of particles and their surroundings."""
        for kernel in self._coarse.push.adjoint:
            context.launch(kernel, *known, self._bars, self._coarse.pushed)
