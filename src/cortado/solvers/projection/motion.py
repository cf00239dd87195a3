"""The three ways in which a step moves particles besides the repairs of density: the velocity x + dt v, the shift
delta, and velocities that follow both.

Particles of the interior are shifted to where they are fewer (Lind et al. 2012; Skillen, Lind, Stansby and Rogers
2013). Pairs that are nearer than 0.65 s are moved apart, wherever they are. The rate follows the velocity gradient and
the tension, so that a fluid at rest is not stirred:

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

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.solvers.projection.effects import effect_functions, weights_type
from cortado.sph.integration import integration_module
from cortado.sph.moment_functions import matrix_type

RATE = 20.0
"""Factor of dt |grad v| in the rate r of the shift."""
GREATEST = 0.5
"""The greatest 20 dt |grad v|, softly: beyond it a shift goes too far, and its derivatives grow from step to step."""
FARTHEST = 0.1
"""In spacings: the greatest shift of a particle in a step."""
SURFACE = 0.03
"""|g| s below which the direction of a surface is not known."""
AWAY = 4.0
"""Factor by which pairs that are near are moved apart faster than others are shifted."""
LEAST = 1e-5
"""The softness e in 20 (sqrt(q^2 + e^2) - e), q = dt |grad v|, which is 0 with a slope at rest."""
PULLED = 60.0
"""Factor of the rate of the shift where the pressure pulls."""
WEAK = 0.004
"""The c below which a pull counts with its square."""


def shift_of_particle(precision: Precision, dimension: int, module: Any) -> Callable[..., Any]:
    """Make the function of the shift delta by A = sum_j v_ij g_ij^T, k = dt p and surroundings; ``beside`` is gamma."""
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    inverse = effect_functions(precision, dimension, module).inverse
    rate, greatest, least = (wp.constant(real(value)) for value in (RATE, GREATEST, LEAST))
    farthest, away = wp.constant(real(FARTHEST)), wp.constant(real(AWAY))
    surface, pulled, weak = (wp.constant(real(value)) for value in (SURFACE**2, PULLED, WEAK))

    def shift(
        spacing: real,
        time_step: real,
        A_i: matrix,
        k_i: real,
        m_i: real,
        M_i: matrix,
        g_i: vector,
        beside_i: vector,
        crowd_i: vector,
        apart_i: vector,
        weights_i: weights4,
    ) -> vector:
        G = A_i * inverse(real(0.5) * (M_i + wp.transpose(M_i)))  # so that the adjoint of M is symmetric, as M is
        turned = time_step * time_step * wp.ddot(G, G)
        strength = rate * turned / (wp.sqrt(turned + least * least) + least)
        pull = weights_i[3] * time_step * wp.max(-k_i, real(0.0)) / (m_i * spacing * spacing)
        strength += pulled * pull * pull / ((pull + weak) * wp.sqrt(pull + weak))
        out, slope = g_i + beside_i, crowd_i + beside_i
        square = wp.dot(out, out) + surface / (spacing * spacing)
        along = slope - (wp.dot(out, slope) / square) * out
        strength = strength / wp.sqrt(real(1.0) + (strength / greatest) * (strength / greatest))
        wish = strength * (away * apart_i - (spacing * spacing * weights_i[2]) * along)
        most = farthest * spacing
        return wish / wp.sqrt(real(1.0) + wp.dot(wish, wish) / (most * most))

    return shift


@cache
def shift_kernels(d: Discretisation, dimension: int) -> Kernels:
    """Make the kernels of the shift delta, which spreads particles evenly."""
    make = partial(shift_of_particle, d.precision, dimension)
    modules = d.modules(f"projection_{dimension}d")
    return pointwise_kernels(d.precision, modules, make, ["delta"], numbers=["spacing"])


def followed_velocity(precision: Precision, dimension: int, module: Any) -> Callable[..., Any]:
    """Make the function of the velocity v' that follows the shift and the repairs of a particle."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    inverse = effect_functions(precision, dimension, module).inverse

    def follow(time_step: real, x_i: vector, M_i: matrix, A_i: matrix, x_now_i: vector, v_new_i: vector) -> vector:
        M = real(0.5) * (M_i + wp.transpose(M_i))  # so that the adjoint of M is symmetric, as M is
        return v_new_i - A_i * (inverse(M) * (x_now_i - x_i - time_step * v_new_i))

    return follow


@cache
def following_kernels(d: Discretisation, dimension: int) -> Kernels:
    """Make the kernels of velocities v' that follow; the adjoint of v' is stored where that of v is written."""
    make, modules = partial(followed_velocity, d.precision, dimension), d.modules(f"projection_following_{dimension}d")
    return pointwise_kernels(d.precision, modules, make, ["v_end"], {"v_end": "v_new"})


@cache
def moving_kernels(precision: Precision) -> Kernels:
    """Make the kernels of the positions before the first repair; the adjoint of these is that of delta too."""
    real, vector, derivatives = precision.real, precision.vector, integration_module(precision, False)

    @particle_kernel(integration_module(precision, True), "x_moved x_now c")
    def move(time_step: real, x_i: vector, v_new_i: vector, delta_i: vector) -> tuple[vector, vector, real]:
        moved = x_i + time_step * v_new_i + delta_i
        return moved, moved, real(0.0)

    @particle_kernel(derivatives, "x_moved_dot x_now_dot c_dot")
    def move_tangent(
        time_step: real,
        time_step_dot: real,
        v_new_i: vector,
        x_dot_i: vector,
        v_new_dot_i: vector,
        delta_dot_i: vector,
    ) -> tuple[vector, vector, real]:
        moved = x_dot_i + time_step * v_new_dot_i + time_step_dot * v_new_i + delta_dot_i
        return moved, moved, real(0.0)

    @particle_kernel(derivatives, "+x_bar +v_new_bar +time_step_bar")
    def move_adjoint(time_step: real, v_new_i: vector, x_moved_bar_i: vector) -> tuple[vector, vector, real]:
        return x_moved_bar_i, time_step * x_moved_bar_i, wp.dot(x_moved_bar_i, v_new_i)

    return Kernels(move, move_tangent, move_adjoint)
