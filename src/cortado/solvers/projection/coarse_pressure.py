"""A pressure on a coarse grid of hat functions phi_I, one at each node of a `CellSort`'s grid.

`docs/projection_step.md` has the equations. `cortado.solvers.projection.effects` computes the share c of each particle.
`cortado.solvers.projection.coarse_push` computes the moment N and the push h.

The operation `spread` transfers values s, t, R and o from particles to nodes. The result at node I is the sum of

    phi_I s_i + grad phi_I . t_i + hess phi_I : R_i + e_I o_i

over the particles i of the cells around the node, in the order of the particles. The operation `at` interpolates a node
array at a particle, and returns the value E, the gradient G and the mixed second derivatives. The product A e of the
matrix A and a node array e is `spread` of s = h . w, t = N^T w and o = (eps + h^2 / 100) / m, with w = (N G + h E) / m.

Free bodies add B^T B to the matrix A, with

    B_I = (F_I / sqrt(rho K), S R'^T T_I / sqrt(rho)),   S S = I^-1.

The pressure impulses phi_I c give a body the momentum F_I and the angular momentum T_I
(`cortado.solvers.projection.bodies`). For each body, B has three rows in 2-D and six rows in 3-D. For a body with
restricted motion, the smaller matrices of `cortado.sph.moving_solids` replace 1 / (rho K) and I^-1.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import cell_grid_type
from cortado.device.launching import Named, bundle
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.particles.state import Layout
from cortado.solvers.projection.bodies import Bodies, BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse_nodes import ALONE, hat_functions, node_functions
from cortado.solvers.projection.pressure import clamp_functions
from cortado.solvers.projection.wall_sums import types_by_name, weights_type
from cortado.sph.moment_functions import cross_terms_function, symmetric
from cortado.sph.moving_solids import hold_functions
from cortado.sph.parts import StepContext


@cache
def coarse_pressure_kernels(precision: Precision, dimension: int) -> SimpleNamespace:
    real, vector, matrix, weights4 = precision.real, precision.vector, precision.matrix, weights_type(precision)
    grid_type, hats = cell_grid_type(precision), hat_functions(precision, dimension)
    at, products, bend, held, alone = hats.at, hats.products, hats.bend, hats.held, wp.constant(real(2.0 * ALONE))
    packed, cross_terms = symmetric(precision), cross_terms_function(precision)
    six, pack, parts = packed.kind, packed.pack, clamp_functions(precision).parts
    module = kernel_module(f"coarse_pressure_{dimension}d_{precision.name}")

    numbers, values = ["grid", "particles"], wp.array(dtype=real)

    typed = types_by_name(precision, {grid_type: "grid", values: "e multiplier", int: "i particles"})

    @particle_kernel(module, "change T", numbers=numbers, typed=typed)
    def correct(i: int, grid, particles: int, x_i, L_i: matrix, coarse_i, weights_i, y_i, e) -> tuple[real, six]:
        """Return the change of a particle's pressure, and the change times the gradient correction matrix."""
        z, least = y_i + coarse_i * at(i, particles, x_i, e, grid).value, wp.min(y_i, real(0.0))
        new = z
        if z < least:
            new = least + weights_i[0] * (z - least)
        return new - y_i, (new - y_i) * pack(L_i)

    @particle_kernel(module, "s_value s_own s_slope s_bent", numbers=[*numbers, "eps"], typed=typed)
    def source_tangent(
        i, grid, particles, eps, x_i, x_dot_i, m_i, m_dot_i, coarse_i, coarse_dot_i, h_i, h_dot_i, N_i, N_dot_i, r_i,
        r_dot_i, e,
    ) -> tuple[real, real, vector, vector]:  # fmt: skip
        f = at(i, particles, x_i, e, grid)
        along = wp.dot(f.slope, x_dot_i)
        w = (N_i * f.slope + f.value * h_i) / m_i
        w_dot = N_dot_i * f.slope + N_i * bend(f.bent, x_dot_i) + along * h_i + f.value * h_dot_i
        w_dot = (w_dot - m_dot_i * w) / m_i
        p, cr = wp.transpose(N_i) * w, coarse_i * r_i
        value = coarse_dot_i * r_i + coarse_i * r_dot_i - wp.dot(h_dot_i, w) - wp.dot(h_i, w_dot)
        own = (held(eps, h_i) * m_dot_i / m_i - alone * wp.dot(h_i, h_dot_i)) / m_i
        slope = (cr - wp.dot(h_i, w)) * x_dot_i - wp.transpose(N_dot_i) * w - wp.transpose(N_i) * w_dot
        return value, own, slope, -(cross_terms(p, x_dot_i) + cross_terms(x_dot_i, p))

    @particle_kernel(module, "change_dot", numbers=numbers, typed=typed)
    def correct_tangent(
        i, grid, particles, x_i, x_dot_i, coarse_i, coarse_dot_i, weights_i, weights_dot_i, y_i, y_dot_i, e, e_dot
    ) -> real:
        f, f_dot = at(i, particles, x_i, e, grid), at(i, particles, x_i, e_dot, grid)
        z = y_i + coarse_i * f.value
        z_dot = y_dot_i + coarse_dot_i * f.value
        z_dot += coarse_i * (wp.dot(f.slope, x_dot_i) + f_dot.value)
        below, below_dot, sigma = z - wp.min(y_i, real(0.0)), z_dot, weights_i[0]
        if y_i < real(0.0):
            below_dot -= y_dot_i
        rise, fall = parts(below, below)
        return rise * z_dot + fall * (z_dot - below_dot + weights_dot_i[0] * below + sigma * below_dot) - y_dot_i

    back = "+weights_bar +coarse_bar +x_bar +y_bar s_value s_slope s_bent s_own"

    @particle_kernel(module, back, numbers=numbers, typed=typed)
    def correct_adjoint(
        i: int, grid, particles: int, x_i, coarse_i, weights_i, y_i, e, change_bar_i
    ) -> tuple[weights4, real, vector, real, real, vector, vector, real]:
        no, f = real(0.0), at(i, particles, x_i, e, grid)
        z = y_i + coarse_i * f.value
        below, sigma, least_bar = z - wp.min(y_i, no), weights_i[0], no
        rise, fall = parts(below, below)
        z_bar = (rise + fall * sigma) * change_bar_i
        if y_i < no:
            least_bar = fall * (real(1.0) - sigma) * change_bar_i
        tension_bar, y_part = fall * below * change_bar_i, z_bar + least_bar - change_bar_i
        source = coarse_i * z_bar
        kept = weights4(tension_bar, no, no, no)
        return kept, z_bar * f.value, source * f.slope, y_part, source, vector(), vector(), real(0.0)

    @particle_kernel(module, "+r_bar +coarse_bar +h_bar +N_bar +m_bar +x_bar", numbers=[*numbers, "eps"], typed=typed)
    def source_adjoint(
        i: int, grid, particles: int, eps, x_i, m_i, coarse_i, h_i, N_i: matrix, r_i, e, multiplier
    ) -> tuple[real, real, vector, matrix, real, vector]:
        f, g = at(i, particles, x_i, e, grid), at(i, particles, x_i, multiplier, grid)
        w, u = (N_i * f.slope + f.value * h_i) / m_i, (N_i * g.slope + g.value * h_i) / m_i
        both = products(i, particles, x_i, e, multiplier, grid)
        h_part = -g.value * w - f.value * u - (alone * both / m_i) * h_i
        N_part = -wp.outer(w, g.slope) - wp.outer(u, f.slope)
        x_part = (coarse_i * r_i - wp.dot(h_i, w)) * g.slope - wp.dot(h_i, u) * f.slope
        x_part -= bend(g.bent, wp.transpose(N_i) * w) + bend(f.bent, wp.transpose(N_i) * u)
        m_part = wp.dot(u, w) + held(eps, h_i) * both / (m_i * m_i)
        return coarse_i * g.value, g.value * r_i, h_part, N_part, m_part, x_part

    return by_name(correct, correct_tangent, source_tangent, correct_adjoint, source_adjoint)


SMALL = 1e-6
"""Speed for the regularisation of the step length [spacings per time step]."""


@cache
def length_kernels(precision: Precision) -> SimpleNamespace:
    real, vector, pair_of = precision.real, precision.vector, precision.pair
    small, typed = wp.constant(real(SMALL)), types_by_name(precision, {int: "first stays"})
    modules = [kernel_module(f"coarse_length_{precision.name}")] * 3

    @wp.func
    def length(sums: pair_of) -> real:
        """If a sum is NaN, the step length is NaN."""
        found = sums[0] / sums[1]
        return wp.where(found <= real(0.0), real(0.0), wp.where(found >= real(1.0), real(1.0), found))

    @wp.kernel(module=modules[0], enable_backward=False)
    def every(scenes: int, warm: wp.array(dtype=int), all_warm: wp.array(dtype=int)):
        found = int(1)
        for scene in range(scenes):
            found = wp.min(found, warm[scene])
        all_warm[0] = found

    @typed
    def share(first, spacing, stays, time_step, m_i, r_i, change_i, carried_i, thrust_i) -> pair_of:
        if stays != 0:
            return pair_of(real(0.0), m_i)
        v = small * spacing / time_step
        own = m_i * v * v
        energy = m_i * wp.dot(thrust_i, thrust_i) + change_i * carried_i + own
        return pair_of(r_i * change_i + real(1 - first) * own, energy)

    @typed
    def apply(sums, y_i, u_i, change_i, thrust_i) -> tuple[real, real, vector]:
        alpha = length(sums)
        new = y_i + alpha * change_i
        return new, new, u_i + alpha * thrust_i

    roles: dict[str, Any] = {"numbers": ["first", "spacing"], "known": ["stays"]}
    roles |= {"written": ["r", "carried"], "summed": ["parts"]}
    shares = pointwise_kernels(precision, modules, lambda _: share, ["parts"], **roles)
    results, replaced = ["k_out", "y_out", "u_out"], {"y_out": "y", "u_out": "u"}
    written = ["sums", "change", "thrust"]
    applied = pointwise_kernels(precision, modules, lambda _: apply, results, replaced, written=written)
    return SimpleNamespace(share=shares, apply=applied, every=every)


@cache
def coarse_body_kernels(precision: Precision, dimension: int) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    grid_type, hats, among = cell_grid_type(precision), hat_functions(precision, dimension), node_functions(dimension)
    hat, at, beside, corner_step = hats.hat, hats.at, among.beside, among.corner_step
    module, holds = kernel_module(f"coarse_bodies_{dimension}d_{precision.name}"), hold_functions(precision)
    CORNERS, FLAT = wp.constant(2**dimension), wp.constant(dimension == 2)

    root, held = holds.root, holds.kind
    typed = TypesByName(real, {grid_type: "grid", vector: "x", matrix: "turns", wp.int32: "order", held: "hold"})

    @typed.kernel(module)
    def gather(
        grid, order, first: int, density, volume: real, inertia: matrix, half: matrix, hold, turns, x,
        of: bundle(coarse=real, gamma_of=vector, arm=vector), B: wp.array2d(dtype=real),
    ):  # fmt: skip
        """Write rows of ``B`` from row ``first``. ``half`` is a square root of the inverse inertia."""
        node, force, torque = wp.tid(), vector(), vector()
        member = node // (grid.shape[0] * grid.shape[1] * grid.shape[2])
        for corner in range(CORNERS):
            cell = beside(node, -corner_step(corner), grid.shape)
            for p in range(grid.starts[cell], grid.starts[cell + 1]):
                i = order[p]
                pushed = (hat(x[i], corner, grid).value * of.coarse[i]) * of.gamma_of[i]
                force += pushed
                torque += wp.cross(of.arm[i], pushed)
        torque -= wp.cross(turns[member] * hold.arm, force)
        force = wp.cw_mul(hold.moving, force) / wp.sqrt(density[member] * volume)
        torque = root(turns[member], inertia, half, torque, hold) / wp.sqrt(density[member])
        B[first, node] = force[0]
        B[first + 1, node] = force[1]
        if FLAT:
            B[first + 2, node] = torque[2]
        else:
            B[first + 2, node] = force[2]
            for axis in range(3):
                B[first + 3 + axis, node] = torque[axis]

    numbers, values = ["grid", "particles"], wp.array(dtype=real)

    @particle_kernel(module, "lifted", numbers=[*numbers, "factor"])
    def lift(i: int, grid: grid_type, particles: int, factor: real, x_i: vector, coarse_i: real, e: values) -> real:
        return factor * coarse_i * at(i, particles, x_i, e, grid).value

    typed = types_by_name(precision, {grid_type: "grid", values: "e multiplier", int: "i particles", real: "lifted"})

    @particle_kernel(module, "lifted_dot", numbers=numbers, typed=typed)
    def lift_tangent(i: int, grid, particles: int, x_i, x_dot_i, coarse_i, coarse_dot_i, e) -> real:
        f = at(i, particles, x_i, e, grid)
        return coarse_dot_i * f.value + coarse_i * wp.dot(f.slope, x_dot_i)

    @particle_kernel(module, "+s_value +s_slope", typed=typed)
    def source_tangent(x_dot_i, coarse_i, coarse_dot_i, carried_i, carried_dot_i) -> tuple[real, vector]:
        return -coarse_dot_i * carried_i - coarse_i * carried_dot_i, -(coarse_i * carried_i) * x_dot_i

    @particle_kernel(module, "+coarse_bar +x_bar", numbers=numbers, typed=typed)
    def source_adjoint(
        i: int, grid, particles: int, x_i, coarse_i, e, multiplier, carried_i, lifted_bar_i
    ) -> tuple[real, vector]:
        f, g = at(i, particles, x_i, e, grid), at(i, particles, x_i, multiplier, grid)
        slope = lifted_bar_i * f.slope - carried_i * g.slope
        return lifted_bar_i * f.value - carried_i * g.value, coarse_i * slope

    return by_name(gather, lift, lift_tangent, source_tangent, source_adjoint)


class CoarseBodies:
    def __init__(self, bodies: Bodies, layout: Layout, dimension: int):
        precision, matrix = layout.precision, layout.precision.matrix
        self.bodies, self.kernels = bodies.at_rest(), coarse_body_kernels(precision, dimension)
        self._each = 3 * dimension - 3
        self._roots = []
        for held in bodies.held:
            values, axes = np.linalg.eigh(np.linalg.pinv(held.body.table.inertia))
            self._roots.append(matrix(*((axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T).ravel()))
        self.rows = self._each * len(bodies.held)
        self._none = layout.arrays(none=precision.real)["none"]

    def begin(self, context: StepContext, grid: Named, known: Named, B: wp.array) -> None:
        for number, (held, root) in enumerate(zip(self.bodies.held, self._roots, strict=True)):
            own, bodies = {"first": self._each * number, "half": root}, self.bodies.known(context, held)
            context.launch(self.kernels.gather, grid, own, *bodies, known, B=B, threads=B.shape[1])

    def carried(self, context: StepContext, y: wp.array) -> wp.array:
        """Return the divergence that pressures ``y`` remove by moving bodies. The next call overwrites the result."""
        return self.bodies.drifted(context, self._none, y)


class CoarseBodiesTangent:
    def __init__(self, own: CoarseBodies, bodies: BodiesTangent):
        self._own, self._bodies = own, bodies.at_rest(own.bodies)
        self._none = wp.zeros_like(own.bodies.drift)
        self._lifted = {"lifted": wp.zeros_like(self._none), "lifted_dot": wp.zeros_like(self._none)}

    def carried(self, context: StepContext, y: wp.array, y_dot: wp.array) -> dict[str, wp.array]:
        carried = self._own.carried(context, y)
        change = self._bodies.drifted(context, self._none, y, y_dot)
        return {"carried": carried, "carried_dot": change}

    def add_source(self, context: StepContext, known: tuple[Named, ...], source: Named) -> None:
        kernels, lifted = self._own.kernels, self._lifted
        context.launch(kernels.lift, *known, lifted, factor=1.0)
        context.launch(kernels.lift_tangent, *known, lifted)
        found = self.carried(context, lifted["lifted"], lifted["lifted_dot"])
        context.launch(kernels.source_tangent, found, *known, source)


class CoarseBodiesAdjoint:
    def __init__(self, own: CoarseBodies, bodies: BodiesAdjoint):
        self._own, self.bodies = own, bodies.at_rest(own.bodies)
        names = ("lifted", "lifted_bar", "carried_bar")
        self._lifted = {name: wp.zeros_like(own.bodies.drift) for name in names}

    def add_source(self, context: StepContext, known: tuple[Named, ...], e: wp.array, multiplier: wp.array) -> None:
        """``multiplier`` is the solution of the adjoint equations of the coarse pressure."""
        kernels, (lifted, lifted_bar, carried_bar) = self._own.kernels, self._lifted.values()
        context.launch(kernels.lift, *known, e=e, lifted=lifted, factor=1.0)
        context.launch(kernels.lift, *known, e=multiplier, lifted=carried_bar, factor=-1.0)
        lifted_bar.zero_()
        self.bodies.carried(context, carried_bar, lifted, lifted_bar)
        found = {"carried": self._own.carried(context, lifted), "lifted_bar": lifted_bar, "e": e}
        context.launch(kernels.source_adjoint, found, *known, multiplier=multiplier)
