"""What a smooth pressure pushes a particle with, from two sums over its neighbours: the push by the share c alone, and
the moment that its gradient has.

For a pressure k_j = c_j phi(x_j) with a linear function phi, and T = c L, D^T k of
`cortado.solvers.projection.pressure` is exactly

    (D^T k)_i = N_i grad phi + phi(x_i) h_i,
    N_i = -sum_j (T_j g_ij) x_ij^T,   h_i = sum_j T_j g_ij + T_i g_i + c_i gamma_i.

N is 1 inside of the fluid, and h is 0 there.

The residual r of `cortado.solvers.projection.coarse_pressure` is the divergence that the coarse pressure takes away.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum, tangent_of
from cortado.solvers.projection.coarse_nodes import source_type
from cortado.solvers.projection.effects import weights_type
from cortado.solvers.projection.images import image_sums
from cortado.solvers.projection.pressure import clamp_functions
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.sph.moment_functions import cross_terms_function, matrix_type, moment_functions, symmetric


@dataclass(frozen=True)
class CoarseSums:
    """Warp functions."""

    push: Any
    """sum T_j g_ij, which T_i g_i and c_i gamma_i complete, and the rows of N, for T = c L."""
    push_tangent: Any
    push_back: Any
    """For adjoints of h and N: the symmetric part of that of T, as its diagonal and its other entries, and what x is
    given."""


@cache
def coarse_sums(discretisation: Discretisation) -> CoarseSums:
    """Of a discretisation."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, pair = neighbourhood_type(precision), pair_functions(discretisation)
    packed, cross_terms = symmetric(precision), cross_terms_function(precision)
    six, times = packed.kind, packed.times
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @fluid_sum(discretisation)
    def push(x_ij: vector, T_j: six, s: neighbourhood) -> tuple[vector, vector, vector, vector]:
        f = times(T_j, s.volume * gradient(x_ij, s))
        return f, -f[0] * x_ij, -f[1] * x_ij, -f[2] * x_ij

    @tangent_of(push)
    @fluid_sum(discretisation, ahead=False)
    def push_tangent(
        x_ij: vector, x_dot_ij: vector, T_j: six, T_dot_j: six, s: neighbourhood
    ) -> tuple[vector, vector, vector, vector]:
        g, g_dot = s.volume * gradient(x_ij, s), s.volume * hessian_product(x_ij, x_dot_ij, s)
        f, c = times(T_j, g), times(T_dot_j, g) + times(T_j, g_dot)
        return c, -c[0] * x_ij - f[0] * x_dot_ij, -c[1] * x_ij - f[1] * x_dot_ij, -c[2] * x_ij - f[2] * x_dot_ij

    @fluid_sum(discretisation)
    def push_back(
        x_ij: vector,
        T_i: six,
        T_j: six,
        h_bar_i: vector,
        h_bar_j: vector,
        N_bar_i: matrix,
        N_bar_j: matrix,
        s: neighbourhood,
    ) -> tuple[vector, vector, vector]:
        g = s.volume * gradient(x_ij, s)
        from_i, from_j = h_bar_i - N_bar_i * x_ij, h_bar_j + N_bar_j * x_ij
        pulled = s.volume * hessian_product(x_ij, times(T_j, from_i) - times(T_i, from_j), s)
        x_part = pulled - wp.transpose(N_bar_i) * times(T_j, g) - wp.transpose(N_bar_j) * times(T_i, g)
        others = real(-0.5) * (cross_terms(from_j, g) + cross_terms(g, from_j))
        return -wp.cw_mul(from_j, g), others, x_part

    return CoarseSums(push, push_tangent, push_back)


@cache
def coarse_push_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """The kernels of h and N in 2 or 3 dimensions: each time that of T comes first."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, sums, packed = neighbourhood_type(precision), coarse_sums(discretisation), symmetric(precision)
    push, push_tangent, push_back = sums.push, sums.push_tangent, sums.push_back
    six, pack, times = packed.kind, packed.pack, packed.times
    whole, topic = moment_functions(precision, dimension).change, f"projection_{dimension}d"
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    own = {name: kind for name, kind in entries(precision).items() if name in ("L", "g", "beside", "coarse")}
    seen, bars = bundle(**own), bundle(x=vector, **own)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def pull(of: seen, T: wp.array(dtype=six)):
        i = wp.tid()
        T[i] = of.coarse[i] * pack(of.L[i])

    @wp.kernel(module=module)
    def coarse_push(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        of: seen,
        T: wp.array(dtype=six),
        # out
        h: wp.array(dtype=vector),
        N: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        total, row_x, row_y, row_z = push(i, x, T, s)
        if lane() > 0:
            return
        h[i] = total + times(T[i], of.g[i]) + of.coarse[i] * of.beside[i]
        N[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=tangent_module, enable_backward=False)
    def pull_tangent(of: seen, dot: seen, T: wp.array(dtype=six), T_dot: wp.array(dtype=six)):
        i = wp.tid()
        T[i] = of.coarse[i] * pack(of.L[i])
        T_dot[i] = dot.coarse[i] * pack(of.L[i]) + of.coarse[i] * pack(dot.L[i])

    @wp.kernel(module=tangent_module, enable_backward=False)
    def coarse_push_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        of: seen,
        dot: seen,
        T: wp.array(dtype=six),
        T_dot: wp.array(dtype=six),
        # out
        h_dot: wp.array(dtype=vector),
        N_dot: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        total, row_x, row_y, row_z = push_tangent(i, x, x_dot, T, T_dot, s)
        if lane() > 0:
            return
        own_part = times(T_dot[i], of.g[i]) + times(T[i], dot.g[i])
        own_part += dot.coarse[i] * of.beside[i] + of.coarse[i] * dot.beside[i]
        h_dot[i] = total + own_part
        N_dot[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def coarse_push_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        of: seen,
        T: wp.array(dtype=six),
        h_bar: wp.array(dtype=vector),
        N_bar: wp.array(dtype=matrix),
        # in and out
        bar: bars,
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, x_part = push_back(i, x, T, h_bar, N_bar, s)
        if lane() > 0:
            return
        c, g, f = of.coarse[i], of.g[i], h_bar[i]
        T_bar = whole(diagonal, others) + real(0.5) * (wp.outer(f, g) + wp.outer(g, f))
        bar.x[i] = bar.x[i] + x_part
        bar.L[i] = bar.L[i] + c * T_bar
        bar.coarse[i] = bar.coarse[i] + wp.ddot(of.L[i], T_bar) + wp.dot(of.beside[i], f)
        bar.g[i] = bar.g[i] + times(T[i], f)
        bar.beside[i] = bar.beside[i] + c * f

    return Kernels((pull, coarse_push), (pull_tangent, coarse_push_tangent), (pull, coarse_push_adjoint))


@dataclass(frozen=True)
class ResidualKernels:
    """Of r, what of the divergence a coarse pressure is to take away."""

    residual: Any
    residual_tangent: Any
    residual_adjoint: Any
    """To the adjoint d_bar of D u and to S = d_bar L, with which that of the pressure's update goes on."""


@cache
def residual_kernels(discretisation: Discretisation, dimension: int) -> ResidualKernels:
    """In 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), projection_sums(discretisation)
    spread, spread_tangent = image_sums(discretisation).spread, image_sums(discretisation).spread_tangent
    gradient, gradient_tangent = sums.velocity_gradient, sums.velocity_gradient_tangent
    packed, clamp = symmetric(precision), clamp_functions(precision)
    wanted, wanted_tangent = clamp.wanted, clamp.wanted_tangent
    six, pack, topic = packed.kind, packed.pack, f"projection_{dimension}d"
    own = {
        name: kind for name, kind in entries(precision).items() if name in ("L", "gamma", "drift", "weights", "image")
    }
    seen = bundle(**own, coarse=real)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.func
    def counts(y: real, tension: real, left: real) -> real:
        """Which part of a divergence does. Where iterations let through but a part of a tension, they leave one that
        the coarse grid must not take away; at the corner between it is the mean of both sides. NaN counts, which must
        not be hidden."""
        if y > real(0.0) or tension >= real(1.0) or not (left <= real(0.0)):
            return real(1.0)
        return wp.where(left == real(0.0), real(0.5), real(0.0))

    @wp.kernel(module=discretisation.module(True, topic))
    def residual(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        # out
        r: wp.array(dtype=real),
        out: source_type(precision),
    ):
        """A and the divergence are written to ``at``."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient(i, x, at.u, s)
        widened = spread(i, x, at.u, s)
        if lane() > 0:
            return
        A = wp.matrix_from_rows(row_x, row_y, row_z)
        D = wp.ddot(of.L[i], A) + wp.dot(of.gamma[i], at.u[i]) - of.drift[i] + of.image[i] * widened
        left = D - wanted(n[i], of.weights[i][1], time_step[i // s.particles])
        left *= counts(at.y[i], of.weights[i][0], left)
        at.A[i] = A
        at.d[i] = D
        r[i] = left
        out.s_value[i] = of.coarse[i] * left
        out.s_slope[i] = vector()
        out.s_bent[i] = vector()
        out.s_own[i] = real(0.0)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def residual_tangent(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        dot: bundle(u=vector, **own),
        # out
        r_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient_tangent(i, x, x_dot, at.u, dot.u, s)
        widened, widened_dot = spread(i, x, at.u, s), spread_tangent(i, x, x_dot, at.u, dot.u, s)
        if lane() > 0:
            return
        member = i // s.particles
        D_dot = wp.ddot(of.L[i], wp.matrix_from_rows(row_x, row_y, row_z)) + wp.ddot(dot.L[i], at.A[i]) - dot.drift[i]
        D_dot += wp.dot(of.gamma[i], dot.u[i]) + wp.dot(dot.gamma[i], at.u[i])
        D_dot += of.image[i] * widened_dot + dot.image[i] * widened
        dt, full = time_step[member], of.weights[i][1]
        b = wanted(n[i], full, dt)
        b_dot = wanted_tangent(n[i], n_dot[i], full, dot.weights[i][1], dt, time_step_dot[member])
        r_dot[i] = counts(at.y[i], of.weights[i][0], at.d[i] - b) * (D_dot - b_dot)

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def residual_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        of: seen,
        d: wp.array(dtype=real),
        y: wp.array(dtype=real),
        r_bar: wp.array(dtype=real),
        # in and out
        bar: bundle(n=real, time_step=real, drift=real, weights=weights4),
        # out
        d_bar: wp.array(dtype=real),
        S: wp.array(dtype=six),
    ):
        i = wp.tid()
        no, dt, full = real(0.0), time_step[i // particles], of.weights[i][1]
        b = wanted(n[i], full, dt)
        found = counts(y[i], of.weights[i][0], d[i] - b) * r_bar[i]
        if n[i] < real(1.0):
            bar.n[i] = bar.n[i] + (real(1.0) - full) / dt * found
            bar.weights[i] = bar.weights[i] + weights4(no, (real(1.0) - n[i]) / dt * found, no, no)
        bar.time_step[i] = bar.time_step[i] + b / dt * found
        bar.drift[i] = bar.drift[i] - found
        d_bar[i] = found
        S[i] = found * pack(of.L[i])

    return ResidualKernels(residual, residual_tangent, residual_adjoint)
