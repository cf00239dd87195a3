"""The kernels of surface tension, a stress of pairs (the continuum surface stress of Lafaurie et al. 1994, between
particles):

    n_i = (1 / N) sum_j (1 - s)^2 x_ij,   s = |x|^2 / h^2
    S_i = (|n_i|^2 1 - PART n_i n_i) / sqrt(1 + |n_i|^2)
    m_i V a_i = -(sigma / Gamma) sum_j s (1 - s)^2 (S_i + S_j) x_ij

m is the mass over the rest volume V. n points out of the fluid; its size is 1 in the outermost layer of a lattice that
is cut, and about 0 inside. S pulls along the surface, and with PART below 1 also a little across it: a stress along the
surface alone lets particles go, and one that is the same in all directions makes a solid. The force of a pair grows
with its distance up to 0.65 h, so that particles of the surface do not clump. N and Gamma: see
`cortado.sph.surface_tension`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions

PART = 2.0 / 3.0
"""How much less of the stress acts across the surface than along it; see above."""


@dataclass(frozen=True)
class TensionFunctions:
    """Warp functions of a separation x, where ``h2`` is h^2."""

    pull: Any
    """s (1 - s)^2"""
    pull_derivative: Any
    """Its derivative by |x|^2 / 2, times h^2."""
    stress: Any
    """S(n) x"""
    stress_change: Any
    """Its derivative along a change of n."""
    stress_derivative: Any
    """The derivative of w . S(n) x by n."""


@cache
def tension_functions(discretisation: Discretisation) -> TensionFunctions:
    """The functions for a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    part, one, two = wp.constant(real(PART)), wp.constant(real(1.0)), wp.constant(real(2.0))

    @wp.func
    def pull(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return s * d * d

    @wp.func
    def pull_derivative(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return two * d * (d - two * s)

    @wp.func
    def stress(n: vector, x: vector) -> vector:
        return (wp.dot(n, n) * x - (part * wp.dot(n, x)) * n) / wp.sqrt(one + wp.dot(n, n))

    @wp.func
    def stress_change(n: vector, n_dot: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(n, n_dot) * x - part * (wp.dot(n_dot, x) * n + wp.dot(n, x) * n_dot)
        return turn / wp.sqrt(size) - (wp.dot(n, n_dot) / size) * stress(n, x)

    @wp.func
    def stress_derivative(n: vector, w: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(w, x) * n - part * (wp.dot(n, w) * x + wp.dot(n, x) * w)
        return turn / wp.sqrt(size) - (wp.dot(w, stress(n, x)) / size) * n

    return TensionFunctions(pull, pull_derivative, stress, stress_change, stress_derivative)


@cache
def surface_tension_kernels(discretisation: Discretisation) -> Kernels:
    """The kernels of the acceleration; ``scale`` is 1 / (Gamma V)."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair, functions = pair_functions(discretisation), tension_functions(discretisation)
    separation, vectors, numbers = pair.separation, pair.vectors, pair.numbers
    pull, pull_derivative = functions.pull, functions.pull_derivative
    stress, stress_change, stress_derivative = functions.stress, functions.stress_change, functions.stress_derivative
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up_vectors = lanes.lane, lanes.add_up_vectors

    @wp.func
    def pulls(i: int, x: wp.array(dtype=vector), normals: wp.array(dtype=vector), s: neighbourhood) -> vector:
        x_i = x[i]
        n_i = normals[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            n_j = vectors(normals, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                total += pull(x_ij, h2) * (stress(n_i, x_ij) + stress(n_j[u], x_ij))
        return add_up_vectors(total)

    @wp.func
    def pulls_change(
        i: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        normals: wp.array(dtype=vector),
        normals_dot: wp.array(dtype=vector),
        s: neighbourhood,
    ) -> vector:
        x_i = x[i]
        n_i = normals[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for u in range(UNROLL):
                j = s.neighbours[k + u, i]
                x_ij = separation(x_i, x[j], s)
                x_dot_ij = x_dot[i] - x_dot[j]
                pull_dot = pull_derivative(x_ij, h2) * wp.dot(x_ij, x_dot_ij) / h2
                total += pull_dot * (stress(n_i, x_ij) + stress(normals[j], x_ij))
                turn = stress_change(n_i, normals_dot[i], x_ij) + stress_change(normals[j], normals_dot[j], x_ij)
                total += pull(x_ij, h2) * (turn + stress(n_i, x_dot_ij) + stress(normals[j], x_dot_ij))
        return add_up_vectors(total)

    @wp.kernel(module=discretisation.module(True, "surface_tension"))
    def accelerate(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = pulls(i, x, normals, s)
        if lane() > 0:
            return
        acceleration[i] = acceleration_in[i] - (scale * surface_tension[member] / m[i]) * total

    @wp.kernel(module=discretisation.tangent_module("surface_tension"), enable_backward=False)
    def accelerate_tangent(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        surface_tension_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        normals_dot: wp.array(dtype=vector),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        sigma = surface_tension[member]
        rate = surface_tension_dot[member] - sigma * m_dot[i] / m[i]
        total = rate * pulls(i, x, normals, s) + sigma * pulls_change(i, x, x_dot, normals, normals_dot, s)
        if lane() > 0:
            return
        acceleration_dot[i] = acceleration_in_dot[i] - (scale / m[i]) * total

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def accelerate_adjoint(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        surface_tension_bar: wp.array(dtype=real),
        # out
        normals_bar: wp.array(dtype=vector),
    ):
        """w is the adjoint of a force."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        x_i = x[i]
        n_i = normals[i]
        w_i = acceleration_bar[i] / m[i]
        h2 = s.support * s.support
        total = vector()
        x_sum = vector()
        n_sum = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            n_j = vectors(normals, k, i, s)
            m_j = numbers(m, k, i, s)
            bar_j = vectors(acceleration_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                w_ij = w_i - bar_j[u] / m_j[u]
                force = stress(n_i, x_ij) + stress(n_j[u], x_ij)
                g = pull(x_ij, h2)
                total += g * force
                x_sum += g * (stress(n_i, w_ij) + stress(n_j[u], w_ij))
                x_sum += (pull_derivative(x_ij, h2) * wp.dot(force, w_ij) / h2) * x_ij
                n_sum += g * stress_derivative(n_i, w_ij, x_ij)
        total = add_up_vectors(total)
        x_sum = add_up_vectors(x_sum)
        n_sum = add_up_vectors(n_sum)
        if lane() > 0:
            return
        sigma = surface_tension[member]
        work = scale * wp.dot(total, w_i)
        x_bar[i] = x_bar[i] - (scale * sigma) * x_sum
        m_bar[i] = m_bar[i] + sigma * work / m[i]
        surface_tension_bar[i] = surface_tension_bar[i] - work
        normals_bar[i] = -(scale * sigma) * n_sum

    return Kernels(accelerate, accelerate_tangent, accelerate_adjoint)
