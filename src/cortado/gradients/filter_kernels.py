"""Filters of the adjoint of a state between two backward steps: an eddy viscosity, and a limit.

    viscosity:  a_i += sum_j max(s_i, s_j) w_ij (a_j - a_i),    s_i = min(C dt gamma_i, 0.6),
                gamma_i^2 = sum_j w_ij |v_i - v_j|^2 / (|x_i - x_j|^2 + 0.01 h^2),
                w_ij = W_ij / max(S_i, S_j, W(h / 2)),          S_i = sum_j W_ij
    limit:      a_i *= min(1, times r / |a_i|),                 r^2 = sum_j |a_j|^2 / particles

over fluid neighbours j of i, for each field a of the adjoint. x and v are those of the state that the adjoint belongs
to: gamma is the strain rate of the forward flow.

The weights of the viscosity are symmetric, so that sum_i a_i is kept; and those of a particle add up to at most 0.6,
so that the square norm cannot grow. Long waves of a are hardly damped, those of a few spacings decay. Owing to the
division by S it acts at a surface, and in a drop of a few particles, as it does within the fluid; W(h / 2) limits it
for particles that hardly touch.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum

STRONGEST = 0.6
"""Strength s of the viscosity at most: waves of two spacings are damped by a factor, and do not change their sign."""


@dataclass(frozen=True)
class FilterKernels:
    """The kernels of filters. Adjoints are in the scene's order, and are sorted for the viscosity."""

    crowd: Any
    """Comes before ``strength``."""
    strength: Any
    """Comes before ``viscosity``."""
    sort: Any
    viscosity: Any
    limit: Any
    squares: Any


@cache
def adjoint_filter_kernels(discretisation: Discretisation) -> FilterKernels:
    """The kernels for a smoothing kernel and a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    weight, per_size = pair.weight, pair.per_size
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane
    module = discretisation.module(False, "adjoint_filters")
    strongest = wp.constant(real(STRONGEST))

    @fluid_sum(discretisation)
    def weights(x_ij: vector, s: neighbourhood) -> real:
        return weight(x_ij, s)

    @fluid_sum(discretisation)
    def strain(x_ij: vector, v_ij: vector, most_i: real, most_j: real, s: neighbourhood) -> real:
        """gamma_i^2"""
        return weight(x_ij, s) / wp.max(most_i, most_j) * wp.dot(v_ij, v_ij) * per_size(x_ij, s)

    @fluid_sum(discretisation)
    def exchange(
        x_ij: vector,
        most_i: real,
        most_j: real,
        strengths_i: real,
        strengths_j: real,
        a_ij: vector,
        b_ij: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector]:
        share = wp.max(strengths_i, strengths_j) * (weight(x_ij, s) / wp.max(most_i, most_j))
        return share * a_ij, share * b_ij

    @wp.kernel(module=module, enable_backward=False)
    def crowd(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        most: wp.array(dtype=real),
    ):
        """max(S_i, W(h / 2))"""
        i = s.first + wp.tid() // LANES
        total = weights(i, x, s) - real(s.filling[i]) * s.self_weight
        if lane() > 0:
            return
        most[i] = wp.max(total, weight(vector(real(0.5) * s.support, real(0.0), real(0.0)), s))

    @wp.kernel(module=module, enable_backward=False)
    def strength(
        s: neighbourhood,
        coefficient: real,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        most: wp.array(dtype=real),
        # out
        strengths: wp.array(dtype=real),
    ):
        """s_i, of sorted particles as all arguments"""
        i = s.first + wp.tid() // LANES
        total = strain(i, x, v, most, s)
        if lane() > 0:
            return
        strengths[i] = wp.min(coefficient * time_step[i // s.particles] * wp.sqrt(total), strongest)

    @wp.kernel(module=module, enable_backward=False)
    def sort(
        order: wp.array(dtype=wp.int32),
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        # out
        a_sorted: wp.array(dtype=vector),
        b_sorted: wp.array(dtype=vector),
    ):
        i = wp.tid()
        a_sorted[i] = a[order[i]]
        b_sorted[i] = b[order[i]]

    @wp.kernel(module=module, enable_backward=False)
    def viscosity(
        s: neighbourhood,
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        most: wp.array(dtype=real),
        strengths: wp.array(dtype=real),
        a_sorted: wp.array(dtype=vector),
        b_sorted: wp.array(dtype=vector),
        # out
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
    ):
        """Two fields of an adjoint at once, which are written in the scene's order."""
        i = s.first + wp.tid() // LANES
        a_total, b_total = exchange(i, x, most, strengths, a_sorted, b_sorted, s)
        if lane() > 0:
            return
        a[order[i]] = a_sorted[i] - a_total
        b[order[i]] = b_sorted[i] - b_total

    @wp.kernel(module=module, enable_backward=False)
    def squares(
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        # out
        found: wp.array(dtype=wp.vec2d),
    ):
        """|a_i|^2 and |b_i|^2, in float64: adjoints grow beyond what a square in float32 may be."""
        i = wp.tid()
        a_i = wp.vec3d(a[i])
        b_i = wp.vec3d(b[i])
        found[i] = wp.vec2d(wp.dot(a_i, a_i), wp.dot(b_i, b_i))

    @wp.kernel(module=module, enable_backward=False)
    def limit(
        times: wp.float64,
        particles: int,
        squares: wp.array(dtype=wp.vec2d),
        sums: wp.array(dtype=wp.vec2d),
        strengths: wp.array(dtype=real),
        # in and out
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
    ):
        """``squares`` of every particle, of a and of b; their ``sums`` over each scene, and that of all strengths of
        the viscosity: a flow without strain is not limited."""
        i = wp.tid()
        if strengths[i // particles] == real(0.0):
            return
        most = (times * times / wp.float64(particles)) * sums[i // particles]
        own = squares[i]
        if own[0] > most[0]:
            a[i] = real(wp.sqrt(most[0] / own[0])) * a[i]
        if own[1] > most[1]:
            b[i] = real(wp.sqrt(most[1] / own[1])) * b[i]

    return FilterKernels(crowd, strength, sort, viscosity, limit, squares)
