"""A correction that removes the smooth part of the pressure error on a grid with nodes two spacings apart.

`docs/projection_step.md` has the equations. Takahashi and Lin (2016) describe a multilevel solver for particles.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.launching import Named
from cortado.device.precision import FLOAT32
from cortado.particles.state import clear
from cortado.solvers.particles import ParticleSystem
from cortado.solvers.projection.bodies import Bodies, BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse_levels import Levels
from cortado.solvers.projection.coarse_nodes import node_kernels
from cortado.solvers.projection.coarse_pressure import (
    CoarseBodies,
    CoarseBodiesAdjoint,
    CoarseBodiesTangent,
    coarse_pressure_kernels,
    length_kernels,
)
from cortado.solvers.projection.coarse_push import coarse_push_kernels, residual_kernels
from cortado.solvers.projection.lattice import SPACING
from cortado.solvers.projection.sums import velocity_kernels
from cortado.solvers.projection.wall_sums import FaceShares
from cortado.sph.moment_functions import round_off, symmetric
from cortado.sph.parts import Adjoints, StepContext

LEAST = 1e-5
"""Regularisation of the coarse matrix, relative to its diagonal on the lattice."""
CLOSE = 1e-3
"""Relative tolerance of a coarse solve in float32."""
MOST = 1_000


class Coarse:
    def __init__(self, system: ParticleSystem, grid: Grid, bodies: Bodies | None, endless: bool):
        """An ``endless`` scene, with all axes periodic, has no coarse correction."""
        self.endless, dimension, spacing = endless, system.walled.dimension, system.walled.spacing
        discretisation, layout = system.discretisation, system.layout
        precision, device = layout.precision, layout.device
        real, vector = precision.real, precision.vector
        self.push = coarse_push_kernels(discretisation, dimension)
        self.nodes, self.residual = node_kernels(precision, dimension), residual_kernels(discretisation, dimension)
        self.pressure, self.length = coarse_pressure_kernels(precision, dimension), length_kernels(precision)
        self.velocity = velocity_kernels(discretisation, dimension)
        self._sort = CellSort(grid, layout.particles, precision, device, layout.members)
        self.layout = layout
        self._tolerance = CLOSE if precision is FLOAT32 else round_off(precision)
        self.bodies = None if bodies is None else CoarseBodies(bodies, layout, dimension)
        rows = 0 if self.bodies is None else self.bodies.rows
        self._levels = Levels(layout, dimension, grid.shape, rows)
        self._parts = wp.zeros((2**dimension, len(self._levels.r)), dtype=real, device=device)
        energy = 8.0 / 3.0 * (SPACING / spacing**2 if dimension == 3 else spacing**-2)  # of the gradient of a hat
        touched = (2.0 * SPACING) ** dimension
        self.grid = {"grid": self._sort.grid, "order": self._sort.order, "eps": LEAST * energy / touched}
        self.pushed = layout.arrays(h=vector, N=precision.matrix, T=symmetric(precision).kind)
        """Force of a coarse pressure on sorted particles (`cortado.solvers.projection.coarse_push`)."""
        self.sums, self.parts = layout.sum_of(precision.pair), layout.arrays(parts=precision.pair)
        self.warm, self._none_stays = (wp.zeros(layout.members, dtype=wp.int32, device=device) for _ in range(2))
        """``warm`` is 1 for each scene in which the step starts from an earlier pressure."""
        self._all_warm = wp.zeros(1, dtype=wp.int32, device=device)
        self._none = self.numbers()
        self.still = layout.arrays(still=vector)["still"]
        self.unmoved = layout.arrays(carried=real)
        self.source = layout.arrays(s_value=real, s_slope=vector, s_bent=vector, s_own=real)

    def numbers(self) -> wp.array:
        return wp.zeros_like(self._levels.r)

    def room(self) -> dict[str, wp.array]:
        layout, precision = self.layout, self.layout.precision
        kept = layout.arrays(r=precision.real, change=precision.real, thrust=precision.vector)
        kept["sums"] = wp.zeros(layout.members, dtype=precision.pair, device=layout.device)
        return {**kept, "e": self.numbers()}

    def begin(self, context: StepContext, known: Named) -> None:
        if self.endless:
            return
        scenes = {"scenes": len(self.warm), "warm": self.warm}
        context.launch(self.length.every, scenes, all_warm=self._all_warm, threads=1)
        for kernel in self.push.forward:
            context.launch(kernel, self.pushed, known)
        self._sort(context.fields["x"])
        cells = self._levels.cells
        context.launch(self.nodes.add_up, self.grid, self.pushed, cells=cells, threads=cells.shape[1])
        self._levels.begin(context)
        if self.bodies is not None:
            self.bodies.begin(context, self.grid, known, self._levels.B)

    def where_due(self, k: int, correct: Callable[[], None]) -> None:
        if self.endless:
            return
        if k > 0:
            correct()
        else:
            wp.capture_if(self._all_warm, on_false=correct)

    def solve(self, context: StepContext, before: wp.array, e: wp.array) -> None:
        """Solve for the coarse pressure ``e`` (nodes,). ``before`` is an earlier coarse pressure."""
        parts, r = self._parts, self._levels.r
        context.launch(self.nodes.spread, self.grid, self.source, e=before, parts=parts, threads=len(r))
        context.launch(self.nodes.gather, self.grid, parts=parts, r=r, threads=len(r))
        self._levels.solve(e, self._tolerance, MOST)

    def correct(self, context: StepContext, k: int, known: Named, at: Named, new: Named) -> None:
        """``at`` contains the arrays before the correction, and ``new`` the arrays after the correction."""
        context.launch(self.residual.forward, at, new, self.source, known)
        self.solve(context, self._none, new["e"])
        context.launch(self.pressure.correct, at, new, self.grid, known)
        thrown = {"y": new["change"], "kick": new["thrust"], "u": new["u"], "v_star": self.still}
        context.launch(self.velocity.velocity.forward, thrown, known)
        carried = self.carried(context, new["change"])
        context.launch(self.length.share.forward, new, carried, self.parts, self.staying(k), known)
        wp.copy(new["sums"], self.sums(self.parts["parts"]))
        out = {"k_out": new["k"], "y_out": new["y"], "u_out": new["u"]}
        context.launch(self.length.apply.forward, out, at, new)

    def staying(self, k: int) -> dict[str, Any]:
        return {"first": int(k == 0), "stays": self.warm if k == 0 else self._none_stays}

    def carried(self, context: StepContext, change: wp.array) -> dict[str, wp.array]:
        """Return the divergence that a pressure change removes by moving free bodies."""
        return self.unmoved if self.bodies is None else {"carried": self.bodies.carried(context, change)}


class CoarseTangent:
    def __init__(self, coarse: Coarse, bodies: BodiesTangent | None, known: tuple[Named, ...]):
        layout, precision = coarse.layout, coarse.layout.precision
        real, vector = precision.real, precision.vector
        self._coarse, self._e_dot, self._known = coarse, coarse.numbers(), known
        self._bodies = CoarseBodiesTangent(coarse.bodies, bodies) if coarse.bodies and bodies else None
        self._unmoved = {**coarse.unmoved, "carried_dot": coarse.unmoved["carried"]}
        self._pushed = {**coarse.pushed, **layout.arrays("_dot", h=vector, N=precision.matrix, T=precision.six)}
        self._dots = layout.arrays("_dot", r=real, change=real, thrust=vector)
        self._thrown = {"v_star": coarse.still, "v_star_dot": coarse.still, **layout.arrays("_dot", u=vector)}

    def begin(self, context: StepContext) -> None:
        for kernel in self._coarse.push.tangent:
            context.launch(kernel, self._pushed, *self._known)

    def correct(self, context: StepContext, k: int, drift: Named, at: Named, new: Named) -> None:
        own, dots, known = self._coarse, self._dots, self._known
        context.launch(own.residual.tangent, drift, at, dots, *known)
        every = new, own.grid, self._pushed, dots, *known
        context.launch(own.pressure.source_tangent, own.source, *every)
        if self._bodies is not None:
            self._bodies.add_source(context, every, own.source)
        own.solve(context, new["e"], self._e_dot)
        context.launch(own.pressure.correct_tangent, at, *every, e_dot=self._e_dot)
        thrown = {**self._thrown, "y": new["change"], "y_dot": dots["change_dot"], "u": new["thrust"]}
        context.launch(own.velocity.pull_tangent, thrown, *known)
        context.launch(own.velocity.velocity.tangent, thrown, *known, kick_dot=dots["thrust_dot"])
        own_bodies, changes = self._bodies, (new["change"], dots["change_dot"])
        carried = self._unmoved if own_bodies is None else own_bodies.carried(context, *changes)
        parts = own.parts["parts"]
        context.launch(own.length.share.tangent, own.staying(k), new, dots, carried, *known, parts_dot=parts)
        context.launch(own.length.apply.tangent, at, new, dots, *known, sums_dot=own.sums(parts))


class CoarseAdjoint:
    def __init__(
        self, coarse: Coarse, bodies: BodiesAdjoint | None, bar: Adjoints, faces: FaceShares, known: tuple[Named, ...]
    ):
        layout, precision = coarse.layout, coarse.layout.precision
        self._bar, self._faces, self._known = bar, faces, known
        real, vector = precision.real, precision.vector
        self._coarse, self._multiplier = coarse, coarse.numbers()
        self._bodies = CoarseBodiesAdjoint(coarse.bodies, bodies) if coarse.bodies and bodies else None
        self._bars = layout.arrays("_bar", h=vector, N=precision.matrix)
        self._steps = layout.arrays("_bar", r=real, change=real, carried=real, thrust=vector, sums=precision.pair)
        self._thrown = {"v_star": coarse.still, **layout.arrays("_bar", kick=vector, v=vector)}
        self._sum = layout.sum_of(precision.pair)

    def begin(self) -> None:
        clear(self._bars.values())

    def correct(self, context: StepContext, k: int, drift: Named, at: Named, new: Named) -> None:
        """``at`` has the adjoints before the coarse correction, and ``new`` has the adjoints after the correction."""
        own, found, known = self._coarse, self._steps, self._known
        context.launch(own.length.apply.adjoint, at, new, found, *known)
        known[0]["k_bar"].zero_()
        given = {"parts_sum_bar": self._sum(found["sums_bar"]), **own.staying(k)}
        context.launch(own.length.share.adjoint, given, new, own.carried(context, new["change"]), found, *known)
        if self._bodies is not None:
            self._bodies.bodies.carried(context, found["carried_bar"], new["change"], found["change_bar"])
        thrown = {**self._thrown, "u": new["thrust"], "y": new["change"], "u_bar": found["thrust_bar"]}
        context.launch(own.velocity.own_adjoint, thrown, *known)
        context.launch(own.velocity.velocity.adjoint, thrown, *known, y_bar=found["change_bar"])
        self._faces.add(context, self._bar, *known, u=known[0]["f"], spread=new["change"])
        every = new, own.grid, own.pushed, self._bars, found, *known
        context.launch(own.pressure.correct_adjoint, at, own.source, *every)
        own.solve(context, new["e"], self._multiplier)
        context.launch(own.pressure.source_adjoint, *every, multiplier=self._multiplier)
        if self._bodies is not None:
            self._bodies.add_source(context, every, new["e"], self._multiplier)
        context.launch(own.residual.adjoint, drift, at, found, *known)

    def finish(self, context: StepContext) -> None:
        for kernel in self._coarse.push.adjoint:
            context.launch(kernel, self._bars, self._coarse.pushed, *self._known)
        given = {"u": self._bars["h_bar"], "slope": self._bars["N_bar"]}
        self._faces.add(context, self._bar, *self._known, given, spread=self._known[-1]["coarse"])
