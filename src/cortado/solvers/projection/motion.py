"""The three ways in which a step moves particles besides the repairs of density: the velocity x + dt v, the shift
delta, and velocities that follow both.

Particles of the interior are shifted to where they are fewer (Lind et al. 2012; Skillen, Lind, Stansby and Rogers
2013), and pairs that are nearer than 0.65 s are moved apart, wherever they are, at a rate that follows the velocity
gradient and the tension, so that a fluid at rest is not stirred:

    delta = r (4 sum_j p_ij - s^2 u P grad C),   p_ij = max(1 - |x_ij|^2 / (0.65 s)^2, 0)^2 x_ij,
    grad C = sum_j (1 + q_ij / (4 + q_ij)) g_ij + gamma,   q_ij = (W_ij / W(s))^4,
    r = 20 dt |grad v| + 60 c^2 / (c + 0.004)^1.5,   c = w dt^2 max(-p, 0) / (rho s^2),

with r softly at most 0.5, and |delta| softly at most 0.1 s. Where the pressure pulls, particles clump at the rate of
sqrt(-p / rho) / s (the tensile instability, Monaghan 2000), and the shift is faster. P takes out the direction
of the surface, g + gamma. Of the weights of `cortado.solvers.projection.effects`, u is 0 at surfaces, and w, that
of low densities in repairs, near them and beside walls. Velocities stay as they are: with a correction by
(delta . grad) v the fluid gains energy. In spray and in thin sheets pairs come together, to 0.00 s without p, which no
repair of the density parts, as theirs is too low.

With ``velocities_follow`` velocities are those of the places to which the shift and the repairs take particles, to
first order (Xu, Stansby and Laurence 2009):

    v' = v - A (1.05 (M + 0.05 I)^-1) (x_K - x - dt v),   A = sum_j v_ij g_ij^T,

where x_K are the positions after the last repair, and A is that of the last iteration of the pressure.

The repairs of density begin from x + dt v + delta.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.solvers.projection.effects import effect_functions, weights_type
from cortado.solvers.projection.surroundings import entries
from cortado.sph.integration import integration_module
from cortado.sph.moment_functions import matrix_type

RATE = 20.0
"""How fast particles are shifted."""
GREATEST = 0.5
"""Of 20 dt |grad v|, softly: beyond it a shift goes too far, and its derivatives grow from step to step."""
FARTHEST = 0.1
"""In spacings: how far a particle is shifted in a step, at most."""
SURFACE = 0.03
"""|g| s below which the direction of a surface is not known."""
AWAY = 4.0
"""How much faster pairs that are near are moved apart."""
LEAST = 1e-5
"""e in 20 (sqrt(q^2 + e^2) - e), q = dt |grad v|, which is 0 with a slope at rest."""
PULLED = 60.0
"""How fast particles are shifted where the pressure pulls."""
WEAK = 0.004
"""Of c, below which a pull counts with its square."""


@dataclass(frozen=True)
class ShiftFunctions:
    """Warp functions of one particle."""

    shift: Any
    """delta of A, the sums over j in grad C and of p, M, g, gamma, the weights, k = dt p, m, dt and s."""
    back: Any
    """For an adjoint of delta, those of all but s."""


@cache
def shift_functions(precision: Precision, dimension: int, module: Any) -> ShiftFunctions:
    """In 2 or 3 dimensions, in a Warp module. A is sum_j v_ij g_ij^T."""
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    inverse = effect_functions(precision, dimension, module).inverse
    rate, greatest, least = (wp.constant(real(value)) for value in (RATE, GREATEST, LEAST))
    farthest, away = wp.constant(real(FARTHEST)), wp.constant(real(AWAY))
    surface, pulled, weak = (wp.constant(real(value)) for value in (SURFACE**2, PULLED, WEAK))

    @wp.func
    def shift(
        A: matrix,
        crowd: vector,
        apart: vector,
        M: matrix,
        g: vector,
        gamma: vector,
        weights: weights4,
        k: real,
        m: real,
        dt: real,
        spacing: real,
    ) -> vector:
        G = A * inverse(M)
        turned = dt * dt * wp.ddot(G, G)
        strength = rate * turned / (wp.sqrt(turned + least * least) + least)
        pull = weights[3] * dt * wp.max(-k, real(0.0)) / (m * spacing * spacing)
        strength += pulled * pull * pull / ((pull + weak) * wp.sqrt(pull + weak))
        out, slope = g + gamma, crowd + gamma
        square = wp.dot(out, out) + surface / (spacing * spacing)
        along = slope - (wp.dot(out, slope) / square) * out
        strength = strength / wp.sqrt(real(1.0) + (strength / greatest) * (strength / greatest))
        wish = strength * (away * apart - (spacing * spacing * weights[2]) * along)
        most = farthest * spacing
        return wish / wp.sqrt(real(1.0) + wp.dot(wish, wish) / (most * most))

    @wp.func(module=module)
    def work(
        A: matrix,
        crowd: vector,
        apart: vector,
        M: matrix,
        g: vector,
        gamma: vector,
        weights: weights4,
        k: real,
        m: real,
        dt: real,
        spacing: real,
        bar: vector,
    ) -> real:
        return wp.dot(shift(A, crowd, apart, M, g, gamma, weights, k, m, dt, spacing), bar)

    @wp.func(module=module)
    def back(
        A: matrix,
        crowd: vector,
        apart: vector,
        M: matrix,
        g: vector,
        gamma: vector,
        weights: weights4,
        k: real,
        m: real,
        dt: real,
        spacing: real,
        bar: vector,
    ):
        by_A, by_crowd, by_apart, by_M, by_g, by_gamma, by_weights, by_k, by_m, by_dt, _s, _bar = wp.grad(work)(
            A, crowd, apart, M, g, gamma, weights, k, m, dt, spacing, bar
        )
        even = real(0.5) * (by_M + wp.transpose(by_M))
        return by_A, by_crowd, by_apart, even, by_g, by_gamma, by_weights, by_k, by_m, by_dt

    return ShiftFunctions(shift, back)


@cache
def shift_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """The kernels of delta."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    topic = f"projection_{dimension}d"
    module, tangent_module = discretisation.module(True, topic), discretisation.tangent_module(topic)
    adjoint_module = discretisation.module(False, topic)
    shift_of = shift_functions(precision, dimension, module).shift
    along = shift_functions(precision, dimension, tangent_module).back
    back = shift_functions(precision, dimension, adjoint_module).back
    names = ("M", "g", "crowd", "apart", "beside", "weights")
    own = {name: kind for name, kind in entries(precision).items() if name in names}
    seen = bundle(**own)

    @wp.kernel(module=module)
    def shift(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        k: wp.array(dtype=real),
        m: wp.array(dtype=real),
        of: seen,
        A: wp.array(dtype=matrix),
        # out
        delta: wp.array(dtype=vector),
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        delta[i] = shift_of(
            A[i],
            of.crowd[i],
            of.apart[i],
            of.M[i],
            of.g[i],
            of.beside[i],
            of.weights[i],
            k[i],
            m[i],
            dt,
            spacing,
        )

    @wp.kernel(module=tangent_module, enable_backward=False)
    def shift_tangent(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        k: wp.array(dtype=real),
        m: wp.array(dtype=real),
        of: seen,
        A: wp.array(dtype=matrix),
        dot: bundle(k=real, m=real, A=matrix, **own),
        # out
        delta_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        member = i // particles
        total = vector()
        count = int(3)  # not a number: Warp would write the gradient out for each
        for axis in range(count):
            unit = vector()
            unit[axis] = real(1.0)
            by_A, by_crowd, by_apart, by_M, by_g, by_gamma, by_weights, by_k, by_m, by_dt = along(
                A[i],
                of.crowd[i],
                of.apart[i],
                of.M[i],
                of.g[i],
                of.beside[i],
                of.weights[i],
                k[i],
                m[i],
                time_step[member],
                spacing,
                unit,
            )
            entry = wp.ddot(by_A, dot.A[i]) + wp.dot(by_crowd, dot.crowd[i]) + wp.ddot(by_M, dot.M[i])
            entry += wp.dot(by_apart, dot.apart[i]) + wp.dot(by_g, dot.g[i]) + wp.dot(by_gamma, dot.beside[i])
            entry += wp.dot(by_weights, dot.weights[i])
            total += (entry + by_k * dot.k[i] + by_m * dot.m[i] + by_dt * time_step_dot[member]) * unit
        delta_dot[i] = total

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def shift_adjoint(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        k: wp.array(dtype=real),
        m: wp.array(dtype=real),
        of: seen,
        A: wp.array(dtype=matrix),
        delta_bar: wp.array(dtype=vector),
        # in and out
        bar: bundle(time_step=real, k=real, m=real, A=matrix, **own),
    ):
        i = wp.tid()
        by_A, by_crowd, by_apart, by_M, by_g, by_gamma, by_weights, by_k, by_m, by_dt = back(
            A[i],
            of.crowd[i],
            of.apart[i],
            of.M[i],
            of.g[i],
            of.beside[i],
            of.weights[i],
            k[i],
            m[i],
            time_step[i // particles],
            spacing,
            delta_bar[i],
        )
        bar.A[i] = bar.A[i] + by_A
        bar.crowd[i] = bar.crowd[i] + by_crowd
        bar.apart[i] = bar.apart[i] + by_apart
        bar.M[i] = bar.M[i] + by_M
        bar.g[i] = bar.g[i] + by_g
        bar.beside[i] = bar.beside[i] + by_gamma
        bar.weights[i] = bar.weights[i] + by_weights
        bar.k[i] = bar.k[i] + by_k
        bar.m[i] = bar.m[i] + by_m
        bar.time_step[i] = bar.time_step[i] + by_dt

    return Kernels(shift, shift_tangent, shift_adjoint)


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


@cache
def moving_kernels(precision: Precision) -> Kernels:
    """The kernels of the positions before the first repair; that of the adjoint leaves the adjoint of delta, which is
    that of these positions."""
    real, vector = precision.real, precision.vector

    @wp.kernel(module=integration_module(precision, True))
    def move(
        particles: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v_new: wp.array(dtype=vector),
        delta: wp.array(dtype=vector),
        # out
        x_moved: wp.array(dtype=vector),
        x_now: wp.array(dtype=vector),
        c: wp.array(dtype=real),
    ):
        i = wp.tid()
        moved = x[i] + time_step[i // particles] * v_new[i] + delta[i]
        x_moved[i] = moved
        x_now[i] = moved
        c[i] = real(0.0)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def move_tangent(
        particles: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        v_new: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v_new_dot: wp.array(dtype=vector),
        delta_dot: wp.array(dtype=vector),
        # out
        x_moved_dot: wp.array(dtype=vector),
        x_now_dot: wp.array(dtype=vector),
        c_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        member = i // particles
        moved = x_dot[i] + time_step[member] * v_new_dot[i] + time_step_dot[member] * v_new[i] + delta_dot[i]
        x_moved_dot[i] = moved
        x_now_dot[i] = moved
        c_dot[i] = real(0.0)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def move_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        v_new: wp.array(dtype=vector),
        x_moved_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_new_bar: wp.array(dtype=vector),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        moved = x_moved_bar[i]
        x_bar[i] = x_bar[i] + moved
        v_new_bar[i] = v_new_bar[i] + time_step[i // particles] * moved
        time_step_bar[i] = time_step_bar[i] + wp.dot(moved, v_new[i])

    return Kernels(move, move_tangent, move_adjoint)
