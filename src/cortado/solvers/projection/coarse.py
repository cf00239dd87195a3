"""A coarse correction of the pressure, so that water that is shut in knows of its walls within one step.

An iteration of `cortado.solvers.projection.pressure` hands a pressure on by a spacing or two. Before each of them the
smooth part of what is missing is found at once, on a grid with nodes two spacings apart (Takahashi and Lin 2016 have a
multilevel particle solver; `cortado.solvers.projection.coarse_kernels` has the equations of this one).
"""

import warp as wp

from cortado.device.binding import Named
from cortado.device.cells import CellSort, Grid
from cortado.particles.arrays import zeros
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.solvers.projection.coarse_kernels import node_kernels, residual_kernels
from cortado.solvers.projection.coarse_sums import coarse_push_kernels
from cortado.sph.conjugate_gradients import ConjugateGradients, round_off
from cortado.sph.moment_functions import matrix_type, symmetric
from cortado.sph.parts import StepContext

SPACING = 2.0
"""Distance of nodes, in spacings of particles."""
LEAST = 1e-5
"""eps of all particles around a node over what A_II is on the lattice. It takes 0.7 % off the correction of the longest
wave in water that is 100 spacings deep, and 3 % where it is 200 deep."""
MOST = 1_000
"""Iterations of a solve."""


class Coarse:
    """The grid and the matrix of the particles of one solver, and the solves with it."""

    def __init__(self, discretisation: Discretisation, layout: Layout, dimension: int, grid: Grid, spacing: float):
        """Of particles with a ``spacing`` [m]."""
        precision, device = layout.precision, layout.device
        real, vector = precision.real, precision.vector
        self.push = coarse_push_kernels(discretisation, dimension)
        self.nodes, self.residual = node_kernels(precision, dimension), residual_kernels(discretisation, dimension)
        self._sort = CellSort(grid, layout.particles, precision, device, layout.members)
        self._layout = Layout(grid.cells, 1, precision, device, layout.batch)
        count = self._layout.all_particles
        self._A = wp.zeros((3**dimension, count), dtype=real, device=device)
        kinds = {"w": real, "r": real}
        self._node = zeros({name: (count, kind) for name, kind in kinds.items()}, device)
        self._solution = ConjugateGradients(self._layout, real, round_off(precision), MOST)
        energy = 8.0 / 3.0 * (SPACING / spacing**2 if dimension == 3 else spacing**-2)  # of the gradient of a hat
        touched = (2.0 * SPACING) ** dimension
        self.grid = {"grid": self._sort.grid, "order": self._sort.order, "eps": LEAST * energy / touched}
        """As kernels call them."""
        self.pushed = layout.arrays(h=vector, N=matrix_type(precision), T=symmetric(precision).kind)
        """h, N and c L of the sorted particles."""
        self.source = layout.arrays(s_value=real, s_slope=vector, s_bent=vector, s_own=real)
        """What is spread."""

    def numbers(self) -> wp.array:
        """(nodes,) of all scenes."""
        return wp.zeros_like(self._node["r"])

    def begin(self, context: StepContext, around: Named) -> None:
        """The matrix of a step."""
        for kernel in self.push.forward:
            context.launch(kernel, around, self.pushed)
        self._sort(context.fields["x"])
        step, (offsets, nodes) = (self.grid, self.pushed, self._node), self._A.shape
        context.launch(self.nodes.fill, *step, A=self._A, threads=offsets * nodes)
        context.launch(self.nodes.weigh, *step, A=self._A, threads=nodes)

    def solve(self, context: StepContext, before: wp.array, e: wp.array) -> None:
        """Write to ``e`` (nodes,) what solves A e = the `source`, spread with the e ``before``."""
        node, count = self._node, self._layout.all_particles
        context.launch(self.nodes.spread, self.grid, self.source, node, e=before, threads=count)

        def multiply(p: wp.array, found: dict[str, wp.array]) -> None:
            context.launch(self.nodes.multiply, self.grid, node, found, A=self._A, p=p, threads=count)

        self._solution.solve(context, multiply, node["w"], node["r"], e)

    def correct(self, context: StepContext, around: Named, at: Named, new: Named, T: wp.array) -> None:
        """From an iterate ``at``, whose A and divergence are written, to k and y of a ``new`` one, and to its r and e,
        those of the correction; ``around`` has the drift of walls."""
        context.launch(self.residual.residual, around, at, self.source, r=new["r"])
        self.solve(context, new["e"], new["e"])
        out = {"k_out": new["k"], "y_out": new["y"], "T": T, "e": new["e"]}
        context.launch(self.nodes.correct, out, around, at, self.grid)


class CoarseTangent:
    """Forward mode."""

    def __init__(self, coarse: Coarse, layout: Layout):
        precision = layout.precision
        self._coarse, self._e_dot = coarse, coarse.numbers()
        kinds = {"h": precision.vector, "N": matrix_type(precision), "T": symmetric(precision).kind}
        self._change = layout.arrays("_dot", **kinds, r=precision.real)

    def begin(self, context: StepContext, known: tuple[Named, ...]) -> None:
        """``known`` has the particles, what surrounds them, and the tangents of both."""
        for kernel in self._coarse.push.tangent:
            context.launch(kernel, *known, self._coarse.pushed, self._change)

    def correct(self, context: StepContext, known: tuple[Named, ...], at: Named, new: Named) -> None:
        """``at``: the iterate before, and k_dot, y_dot and u_dot, of which the first two are replaced by those of the
        ``new`` one."""
        own, change, (r, e) = self._coarse, self._change, (new["r"], new["e"])
        context.launch(own.residual.residual_tangent, at, *known, change)
        all_known = (own.grid, own.pushed, change, at, *known)
        context.launch(own.nodes.source_tangent, *all_known, own.source, r=r, e=e)
        own.solve(context, e, self._e_dot)
        out = {"k_out_dot": at["k_dot"], "y_out_dot": at["y_dot"]}
        context.launch(own.nodes.correct_tangent, *all_known, out, e=e, e_dot=self._e_dot)


class CoarseAdjoint:
    """Reverse mode."""

    def __init__(self, coarse: Coarse, layout: Layout):
        precision = layout.precision
        self._coarse, self._multiplier = coarse, coarse.numbers()
        self._bars = layout.arrays("_bar", h=precision.vector, N=matrix_type(precision))
        self._r_bar = layout.arrays(r_bar=precision.real)["r_bar"]

    def begin(self) -> None:
        for array in self._bars.values():
            array.zero_()

    def correct(self, context: StepContext, known: tuple[Named, ...], at: Named, new: Named, steps: Named) -> None:
        """From the adjoints k_bar and y_bar of the ``new`` iterate, in ``steps``, to those of the one before, ``at``,
        and to d_bar and S there."""
        own, (r, e) = self._coarse, (new["r"], new["e"])
        all_known = (own.grid, own.pushed, self._bars, *known)
        context.launch(own.nodes.correct_adjoint, *all_known, at, own.source, steps, e=e)
        own.solve(context, e, self._multiplier)
        found = {"r_bar": self._r_bar, "multiplier": self._multiplier}
        context.launch(own.nodes.source_adjoint, *all_known, found, r=r, e=e)
        context.launch(own.residual.residual_adjoint, steps, *known, found, at)

    def finish(self, context: StepContext, known: tuple[Named, ...]) -> None:
        """From the adjoints of h and N to those of particles and of what surrounds them."""
        for kernel in self._coarse.push.adjoint:
            context.launch(kernel, *known, self._bars, self._coarse.pushed)
