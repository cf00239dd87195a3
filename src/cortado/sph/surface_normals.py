"""The normals n of a fluid's surface that surface tension works with: see `cortado.sph.surface_stress`."""

from functools import cache

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.by_hand import adjoint_of, tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import fluid_sum


@cache
def normal_kernels(discretisation: Discretisation) -> Kernels:
    """The kernels of n; ``inverse`` is 1 / N."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    one = wp.constant(real(1.0))
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane

    @fluid_sum(discretisation)
    def arrows(x_ij: vector, s: neighbourhood) -> vector:
        """(1 - s)^2 x"""
        d = wp.max(one - wp.dot(x_ij, x_ij) / (s.support * s.support), real(0.0))
        return (d * d) * x_ij

    @adjoint_of(arrows)
    @tangent_of(arrows)
    @fluid_sum(discretisation)
    def change(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        """Its tangent along v, and likewise what the adjoint of positions is for an adjoint v of every n, as the
        derivative of a pair is symmetric."""
        h2 = s.support * s.support
        d = wp.max(one - wp.dot(x_ij, x_ij) / h2, real(0.0))
        return (d * d) * v_ij - (real(4.0) * d * wp.dot(x_ij, v_ij) / h2) * x_ij

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
