"""Filters of the adjoint a of a state between two backward steps: an average over neighbours, a limit, a drag.

    average:  a_i += strength sum_j w_ij (a_j - a_i),   w_ij = W_ij / max(s_i, s_j, W(h / 2)),   s_i = sum_j W_ij
    limit:    a_i *= min(1, times r / |a_i|),   r^2 = sum_j |a_j|^2 / particles
    drag:     a_i *= exp(-rate dt)

over fluid neighbours j of i. The weights of the average are symmetric, so that sum_i a_i is kept; and those of a
particle add up to at most 1, so that for 0 <= strength <= 1 the square norm cannot grow. Long waves of a are hardly
damped, those of a few spacings decay: the average is a viscosity of the adjoint. Owing to the division by s it acts at
a surface, and in a drop of a few particles, as it does within the fluid; W(h / 2) limits it for particles that hardly
touch.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@dataclass(frozen=True)
class FilterKernels:
    """The kernels of filters; vectors (n,) that are filtered are in the scene's order."""

    crowd: Any
    """Comes before ``average``."""
    average: Any
    limit: Any
    drag: Any
    squares: Any


@cache
def adjoint_filter_kernels(discretisation: Discretisation) -> FilterKernels:
    """The kernels for a smoothing kernel and a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, weight, vectors, numbers = pair.separation, pair.weight, pair.vectors, pair.numbers
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up, add_up_vectors = lanes.lane, lanes.add_up, lanes.add_up_vectors
    module = discretisation.module(False, "adjoint_filters")

    @wp.kernel(module=module, enable_backward=False)
    def crowd(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        most: wp.array(dtype=real),
    ):
        """max(s_i, W(h / 2))"""
        i = s.first + wp.tid() // LANES
        x_i = x[i]
        total = real(0.0)
        if lane() == 0:
            total = -real(s.filling[i]) * s.self_weight
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            for u in range(UNROLL):
                total += weight(separation(x_i, x_j[u], s), s)
        total = add_up(total)
        if lane() > 0:
            return
        most[i] = wp.max(total, weight(vector(real(0.5) * s.support, real(0.0), real(0.0)), s))

    @wp.kernel(module=module, enable_backward=False)
    def average(
        s: neighbourhood,
        order: wp.array(dtype=wp.int32),
        strength: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        most: wp.array(dtype=real),
        a: wp.array(dtype=vector),
        # out
        a_new: wp.array(dtype=vector),
    ):
        """``x`` and ``most`` are sorted, ``a`` is in the scene's order. A strength of 0 copies bit for bit."""
        i = s.first + wp.tid() // LANES
        x_i = x[i]
        most_i = most[i]
        a_i = a[order[i]]
        if strength[0] == real(0.0):
            if lane() == 0:
                a_new[order[i]] = a_i
            return
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            most_j = numbers(most, k, i, s)
            for u in range(UNROLL):
                w_ij = weight(separation(x_i, x_j[u], s), s) / wp.max(most_i, most_j[u])
                total += w_ij * (a[order[s.neighbours[k + u, i]]] - a_i)
        total = add_up_vectors(total)
        if lane() > 0:
            return
        a_new[order[i]] = a_i + strength[0] * total

    @wp.kernel(module=module, enable_backward=False)
    def drag(
        rate: real,
        particles: int,
        time_step: wp.array(dtype=real),
        # in and out
        a: wp.array(dtype=vector),
    ):
        i = wp.tid()
        a[i] = wp.exp(-rate * time_step[i // particles]) * a[i]

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
        times: wp.array(dtype=wp.float64),
        particles: int,
        squares: wp.array(dtype=wp.vec2d),
        sums: wp.array(dtype=wp.vec2d),
        field: int,
        # in and out
        a: wp.array(dtype=vector),
    ):
        """``squares`` of every particle and their ``sums`` over each scene, of field 0 or 1, which is ``a``."""
        i = wp.tid()
        most = times[0] * times[0] * sums[i // particles][field] / wp.float64(particles)
        own = squares[i][field]
        if own > most:
            a[i] = real(wp.sqrt(most / own)) * a[i]

    return FilterKernels(crowd, average, limit, drag, squares)
