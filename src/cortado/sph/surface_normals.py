"""The normals n of a fluid's surface that surface tension works with: see `cortado.sph.surface_stress`."""

from functools import cache

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@cache
def normal_kernels(discretisation: Discretisation) -> Kernels:
    """The kernels of n; ``inverse`` is 1 / N."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, vectors = pair.separation, pair.vectors
    one = wp.constant(real(1.0))
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up_vectors = lanes.lane, lanes.add_up_vectors

    @wp.func
    def arrow(x: vector, h2: real) -> vector:
        """(1 - s)^2 x, where h2 is h^2."""
        d = wp.max(one - wp.dot(x, x) / h2, real(0.0))
        return (d * d) * x

    @wp.func
    def arrow_change(x: vector, v: vector, h2: real) -> vector:
        """Its derivative along a vector, which is symmetric."""
        d = wp.max(one - wp.dot(x, x) / h2, real(0.0))
        return (d * d) * v - (real(4.0) * d * wp.dot(x, v) / h2) * x

    @wp.func
    def arrows(i: int, x: wp.array(dtype=vector), s: neighbourhood) -> vector:
        x_i = x[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            for u in range(UNROLL):
                total += arrow(separation(x_i, x_j[u], s), h2)
        return add_up_vectors(total)

    @wp.func
    def change(i: int, x: wp.array(dtype=vector), v: wp.array(dtype=vector), s: neighbourhood) -> vector:
        """Its tangent along v, and likewise what the adjoint of positions is for an adjoint v of every n."""
        x_i = x[i]
        v_i = v[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            for u in range(UNROLL):
                total += arrow_change(separation(x_i, x_j[u], s), v_i - v_j[u], h2)
        return add_up_vectors(total)

    @wp.kernel(module=discretisation.module(True, "surface_tension"))
    def normal(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        # out
        normals: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = arrows(i, x, s)
        if lane() > 0:
            return
        normals[i] = inverse * total

    @wp.kernel(module=discretisation.tangent_module("surface_tension"), enable_backward=False)
    def normal_tangent(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        # out
        normals_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = change(i, x, x_dot, s)
        if lane() > 0:
            return
        normals_dot[i] = inverse * total

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def normal_adjoint(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        normals_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = change(i, x, normals_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + inverse * total

    return Kernels(normal, normal_tangent, normal_adjoint)
