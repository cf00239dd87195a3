"""What a smooth pressure pushes a particle with, from two sums over its neighbours: the push by the share c alone, and
the moment that its gradient has.

For a pressure k_j = c_j phi(x_j) with a linear function phi, and T = c L, D^T k of
`cortado.solvers.projection.pressure` is exactly

    (D^T k)_i = N_i grad phi + phi(x_i) h_i,
    N_i = -sum_j (T_j g_ij) x_ij^T,   h_i = sum_j T_j g_ij + T_i g_i + c_i gamma_i.

N is 1 inside of the fluid, and h is 0 there.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.by_hand import tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
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
    module, tangent_module = discretisation.module(True, topic), discretisation.tangent_module(topic)
    adjoint_module = discretisation.module(False, topic)
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
