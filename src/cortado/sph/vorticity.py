"""Vorticity by summation over the fluid around a particle (Monaghan 1992):

c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

mu = -(V / d) sum_j x_j . G_j is that of the rest lattice, on which a fluid that turns as a whole has twice its rate of
turning. Walls have no part in it. A pair adds the same to both of its particles, so that adjoints are gathers:

v_i^ = V sum_j G_ij x (c_i^ + c_j^),   x_i^ = V sum_j H_ij ((c_i^ + c_j^) x (v_i - v_j)).
"""

from functools import cache

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@cache
def circulation_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the sum c."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, gradient, hessian_product = pair.separation, pair.gradient, pair.hessian_product
    vectors, neighbour = pair.vectors, pair.neighbour
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up_vectors = lanes.lane, lanes.add_up_vectors

    @wp.kernel(module=discretisation.module(False, "vorticity"), enable_backward=False)
    def circulation(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        # out
        circulation: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            for u in range(UNROLL):
                total += wp.cross(v[i] - v_j[u], gradient(separation(x[i], x_j[u], s), s))
        total = add_up_vectors(total)
        if lane() > 0:
            return
        circulation[i] = s.volume * total

    @wp.kernel(module=discretisation.tangent_module("vorticity"), enable_backward=False)
    def circulation_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        # out
        circulation_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for u in range(UNROLL):
                j = neighbour(k + u, i, s)
                x_ij = separation(x[i], x[j], s)
                total += wp.cross(v_dot[i] - v_dot[j], gradient(x_ij, s))
                total += wp.cross(v[i] - v[j], hessian_product(x_ij, x_dot[i] - x_dot[j], s))
        total = add_up_vectors(total)
        if lane() > 0:
            return
        circulation_dot[i] = s.volume * total

    @wp.kernel(module=discretisation.module(False, "vorticity"), enable_backward=False)
    def circulation_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        circulation_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        x_total = vector()
        v_total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            bar_j = vectors(circulation_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x[i], x_j[u], s)
                bar_ij = circulation_bar[i] + bar_j[u]
                v_total += wp.cross(gradient(x_ij, s), bar_ij)
                x_total += hessian_product(x_ij, wp.cross(bar_ij, v[i] - v_j[u]), s)
        x_total = add_up_vectors(x_total)
        v_total = add_up_vectors(v_total)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + s.volume * x_total
        v_bar[i] = v_bar[i] + s.volume * v_total

    return Kernels(circulation, circulation_tangent, circulation_adjoint)
