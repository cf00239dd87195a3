"""A rigid body in the projection: pressures change the body's velocities as they change velocities of fluid.

Walls of a body push particle i by gamma_i = sum w_b (N_b g_ib + e_i (g_ib - N_b g_ib)), N_b = n_b n_b^T, summed over
its own wall particles, with e_i computed from all walls (`cortado.solvers.projection.wall_sums`). With r_i = x_i - c',
the pressure impulses y, the body's density rho and its volume K in units of a particle's volume,

    V = V_0 + dt g + sum y_i gamma_i / (rho K),   L = L_0 + sum y_i r_i x gamma_i,   W = R' I^-1 R'^T L / rho

is the transpose of the body's term in the divergence, - gamma_i . (V + W x r_i). The part of this term by the wall
velocity (V_0, W_0) is contained in the sum over all walls. For a held body smaller matrices replace 1 / (rho K) and R'
I^-1 R'^T (`cortado.sph.moving_solids`).

The diagonal a_i of the iteration gets the term |gamma_i| sum_j |gamma_j| / (rho K) + lambda |r_i x gamma_i| sum_j |r_j
x gamma_j| / rho, with lambda the largest eigenvalue of I^-1, because all particles around a light body move it. With
this diagonal the body's part of the matrix has no eigenvalue above 2.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import solid_sum
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels
from cortado.solvers.projection.wall_sums import normal_part, types_by_name
from cortado.sph.moving_solids import free_module, move_kernels


@cache
def body_kernels(discretisation: Discretisation) -> SimpleNamespace:
    """Make the kernels by which particles push bodies. ``hold`` computes gamma and r, ``measure`` |gamma| and |r x
    gamma|, ``weigh`` the bodies' term in the diagonal a from these and their sums ``whole``, and ``pull`` the momenta y
    gamma and y r x gamma. ``share`` adds the adjoint of ``whole`` to those of ``measure``."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    pair_of, pair = precision.pair, pair_functions(discretisation)
    gradient, hessian_product, separation = pair.gradient, pair.hessian_product, pair.separation
    normal, typed = normal_part(discretisation), types_by_name(precision)
    topic = "projection_bodies"
    modules = module, tangent_module, adjoint_module = discretisation.modules(topic)

    @wp.func
    def between(a: vector, foot: vector, edge: real) -> vector:
        """Return a's part along a wall's normal, plus e times its part across the normal."""
        part = normal(a, foot)
        return part + edge * (a - part)

    @solid_sum(discretisation)
    def push(x_ij: vector, edge_i: real, foot: vector, solid: int, s: neighbourhood) -> vector:
        return s.volume * between(gradient(x_ij, s), foot, edge_i)

    @solid_sum(discretisation)
    @typed
    def push_tangent(x_ij, x_dot_ij, edge_i, edge_dot_i, foot, turn_dot, solid: int, s) -> vector:
        G, rest = gradient(x_ij, s), x_dot_ij - wp.cross(turn_dot, x_ij)
        change = between(hessian_product(x_ij, rest, s), foot, edge_i) + edge_dot_i * (G - normal(G, foot))
        return s.volume * (change + wp.cross(turn_dot, between(G, foot, edge_i)))

    @solid_sum(discretisation)
    @typed
    def push_back(x_ij, edge_i, bar_i: vector, foot, solid: int, s) -> tuple[vector, real]:
        G = gradient(x_ij, s)
        pushed = s.volume * hessian_product(x_ij, between(bar_i, foot, edge_i), s)
        return pushed, s.volume * wp.dot(G - normal(G, foot), bar_i)

    @particle_kernel(module, "gamma_of arm", [over(push, "total")], numbers=["solid"])
    def hold(solid: int, total: vector, after: vector, x_i: vector, s: neighbourhood) -> tuple[vector, vector]:
        return total, separation(x_i, after, s)

    @particle_kernel(tangent_module, "gamma_of_dot arm_dot", [over(push_tangent, "total")], numbers=["solid"])
    def hold_tangent(solid: int, total: vector, after_dot: vector, x_dot_i: vector) -> tuple[vector, vector]:
        return total, x_dot_i - after_dot

    back = over(push_back, "total edge_part", bar="gamma_of_bar")

    @particle_kernel(adjoint_module, "+edge_bar +x_bar +force_bar +torque_bar", [back], numbers=["solid"])
    def hold_adjoint(
        total: vector, edge_part: real, gamma_of_i: vector, arm_i: vector, gamma_of_bar_i: vector, arm_bar_i: vector
    ) -> tuple[real, vector, vector, vector]:
        """Apply the adjoint of gamma and r; turning a body turns gamma."""
        torque = wp.cross(gamma_of_i, gamma_of_bar_i) - wp.cross(arm_i, total)
        return edge_part, total + arm_bar_i, -total - arm_bar_i, torque

    def measure(gamma_of_i: vector, arm_i: vector) -> pair_of:
        return pair_of(wp.length(gamma_of_i), wp.length(wp.cross(arm_i, gamma_of_i)))

    def weigh(density: real, pushed_volume: real, greatest: real, sizes_i: pair_of, whole: pair_of) -> real:
        return wp.dot(sizes_i, pair_of(whole[0] / pushed_volume, greatest * whole[1])) / density

    @particle_kernel(adjoint_module, "+sizes_bar")
    def share(whole_bar: pair_of) -> pair_of:
        return whole_bar

    def pull(y_i: real, gamma_of_i: vector, arm_i: vector) -> tuple[vector, vector]:
        return y_i * gamma_of_i, y_i * wp.cross(arm_i, gamma_of_i)

    @particle_kernel(tangent_module, "pulled_dot twisted_dot")
    @typed
    def pull_tangent(y_i, y_dot_i, gamma_of_i, gamma_of_dot_i, arm_i, arm_dot_i) -> tuple[vector, vector]:
        """Write the tangents of `pull` by hand, because a generated kernel is slower and each iteration runs this
        one."""
        turn = wp.cross(arm_dot_i, gamma_of_i) + wp.cross(arm_i, gamma_of_dot_i)
        return y_dot_i * gamma_of_i + y_i * gamma_of_dot_i, y_dot_i * wp.cross(arm_i, gamma_of_i) + y_i * turn

    def made(function: Any, results: list[str], **names: Any) -> Kernels:
        return pointwise_kernels(precision, modules, lambda _: function, results, **names)

    sums = ["pulled", "twisted"]
    return SimpleNamespace(
        hold=Kernels(hold, hold_tangent, hold_adjoint),
        measure=made(measure, ["sizes"]),
        weigh=made(weigh, ["a:a"], numbers=["pushed_volume", "greatest"], written=["sizes", "whole", "density"]),
        share=share,
        pull=replace(made(pull, sums, summed=sums), tangent=pull_tangent),
    )


@cache
def motion_kernels(precision: Precision) -> SimpleNamespace:
    """Make the kernels that move bodies by the sums of y gamma and y r x gamma, and those of the drift of walls by the
    velocity changes."""
    real, vector = precision.real, precision.vector

    def carry(faster: vector, turned_faster: vector, gamma_of_i: vector, arm_i: vector) -> real:
        return wp.dot(gamma_of_i, faster + wp.cross(turned_faster, arm_i))

    modules, written = [free_module(precision)] * 3, ["faster", "turned_faster"]
    carries = pointwise_kernels(precision, modules, lambda _: carry, ["drift:drift_in"], written=written)
    return SimpleNamespace(move=move_kernels(precision), carry=carries)
