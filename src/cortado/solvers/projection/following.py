"""Velocities follow the particles to where the shift and the repairs take them, to first order (Xu, Stansby and
Laurence 2009):

    v' = v - A (1.05 (M + 0.05 I)^-1) (x_K - x - dt v),   A = sum_j v_ij g_ij^T,

where x_K are the positions after the last repair, and A is that of the last iteration of the pressure.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.solvers.projection.effects import effect_functions
from cortado.sph.moment_functions import matrix_type


@cache
def change_functions(precision: Precision, dimension: int, module: Any) -> tuple[Any, Any]:
    """The change of a velocity by A, M and the way, and for an adjoint of it those of A, M and the way."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    inverse = effect_functions(precision, dimension, module).inverse

    @wp.func
    def change(A: matrix, M: matrix, way: vector) -> vector:
        return -(A * (inverse(M) * way))

    @wp.func(module=module)
    def work(A: matrix, M: matrix, way: vector, bar: vector) -> real:
        return wp.dot(change(A, M, way), bar)

    @wp.func(module=module)
    def back(A: matrix, M: matrix, way: vector, bar: vector):
        by_A, by_M, by_way, _bar = wp.grad(work)(A, M, way, bar)
        return by_A, real(0.5) * (by_M + wp.transpose(by_M)), by_way

    return change, back


@cache
def following_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """The kernels of v'."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    topic = f"projection_following_{dimension}d"
    module, tangent_module = discretisation.module(True, topic), discretisation.tangent_module(topic)
    adjoint_module = discretisation.module(False, topic)
    change = change_functions(precision, dimension, module)[0]
    along = change_functions(precision, dimension, tangent_module)[1]
    back = change_functions(precision, dimension, adjoint_module)[1]

    @wp.kernel(module=module)
    def follow(
        particles: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        M: wp.array(dtype=matrix),
        A: wp.array(dtype=matrix),
        x_now: wp.array(dtype=vector),
        v_new: wp.array(dtype=vector),
        # out
        v_end: wp.array(dtype=vector),
    ):
        i = wp.tid()
        way = x_now[i] - x[i] - time_step[i // particles] * v_new[i]
        v_end[i] = v_new[i] + change(A[i], M[i], way)

    @wp.kernel(module=tangent_module, enable_backward=False)
    def follow_tangent(
        particles: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        M: wp.array(dtype=matrix),
        A: wp.array(dtype=matrix),
        x_now: wp.array(dtype=vector),
        v_new: wp.array(dtype=vector),
        dot: bundle(x=vector, x_now=vector, v_new=vector, M=matrix, A=matrix),
        # out
        v_end_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        member = i // particles
        dt = time_step[member]
        way = x_now[i] - x[i] - dt * v_new[i]
        way_dot = dot.x_now[i] - dot.x[i] - dt * dot.v_new[i] - time_step_dot[member] * v_new[i]
        total = dot.v_new[i]
        count = int(3)  # not a number: Warp would write the gradient out for each
        for k in range(count):
            unit = vector()
            unit[k] = real(1.0)
            by_A, by_M, by_way = along(A[i], M[i], way, unit)
            total += (wp.ddot(by_A, dot.A[i]) + wp.ddot(by_M, dot.M[i]) + wp.dot(by_way, way_dot)) * unit
        v_end_dot[i] = total

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def follow_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        M: wp.array(dtype=matrix),
        A: wp.array(dtype=matrix),
        x_now: wp.array(dtype=vector),
        v_new: wp.array(dtype=vector),
        # in and out: v_new_bar is at first the adjoint of v'
        v_new_bar: wp.array(dtype=vector),
        x_now_bar: wp.array(dtype=vector),
        bar: bundle(x=vector, time_step=real, M=matrix, A=matrix),
    ):
        i = wp.tid()
        dt, v_bar = time_step[i // particles], v_new_bar[i]
        way = x_now[i] - x[i] - dt * v_new[i]
        by_A, by_M, by_way = back(A[i], M[i], way, v_bar)
        bar.A[i] = bar.A[i] + by_A
        v_new_bar[i] = v_bar - dt * by_way
        x_now_bar[i] = x_now_bar[i] + by_way
        bar.M[i] = bar.M[i] + by_M
        bar.x[i] = bar.x[i] - by_way
        bar.time_step[i] = bar.time_step[i] - wp.dot(by_way, v_new[i])

    return Kernels(follow, follow_tangent, follow_adjoint)
