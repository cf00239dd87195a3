"""A rigid body in the projection: it takes part by its velocities, which pressures change as they change those of
fluid.

Walls of a body push particle i by gamma_i = sum w_b (N_b g_ib + e_i (g_ib - N_b g_ib)), N_b = n_b n_b^T, over its own
wall particles, with e_i of all walls (`cortado.solvers.projection.walls`). With r_i = x_i - c', the pressure
impulses y, the body's density rho and its volume K in those of a particle,

    V = V_0 + dt g + sum y_i gamma_i / (rho K),   L = L_0 + sum y_i r_i x gamma_i,   W = R' I^-1 R'^T L / rho

is the transpose of what its velocity adds to the divergence, - gamma_i . (V + W x r_i), of which that with the velocity
(V_0, W_0) of its walls is counted with those of all walls. Linear momentum is kept to round-off.

The particles around a light body all move it. The diagonal a_i of the iteration gets |gamma_i| sum_j |gamma_j| / (rho
K) + lambda |r_i x gamma_i| sum_j |r_j x gamma_j| / rho, with lambda the largest eigenvalue of I^-1, divided by which
the body's part of the matrix has no eigenvalue beyond 2.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import solid_sum
from cortado.solvers.projection.walls import normal_part


@dataclass(frozen=True)
class BodyKernels:
    """With their tangents and adjoints."""

    hold: Kernels
    """gamma, r, and their sizes."""
    weigh: Kernels
    """What is added to a."""
    pull: Kernels
    """y gamma and y r x gamma."""


@cache
def body_kernels(discretisation: Discretisation) -> BodyKernels:
    """Of a discretisation."""
    precision = discretisation.precision
    real, vector, pair_of = precision.real, precision.vector, precision.pair
    neighbourhood, pair = neighbourhood_type(precision), pair_functions(discretisation)
    gradient, hessian_product, separation = pair.gradient, pair.hessian_product, pair.separation
    normal = normal_part(discretisation)
    topic = "projection_bodies"
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    held = bundle(gamma_of=vector, arm=vector)
    held_dots = bundle(gamma_of_dot=vector, arm_dot=vector)
    held_bars = bundle(gamma_of_bar=vector, arm_bar=vector)

    @wp.func
    def between(a: vector, foot: vector, edge: real) -> vector:
        """The part along the normal of a wall, and of the rest as much as e says."""
        part = normal(a, foot)
        return part + edge * (a - part)

    @solid_sum(discretisation)
    def push(x_ij: vector, edge_i: real, foot: vector, solid: int, s: neighbourhood) -> vector:
        return s.volume * between(gradient(x_ij, s), foot, edge_i)

    @solid_sum(discretisation)
    def push_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        edge_i: real,
        edge_dot_i: real,
        foot: vector,
        turn_dot: vector,
        solid: int,
        s: neighbourhood,
    ) -> vector:
        G, rest = gradient(x_ij, s), x_dot_ij - wp.cross(turn_dot, x_ij)
        change = between(hessian_product(x_ij, rest, s), foot, edge_i) + edge_dot_i * (G - normal(G, foot))
        return s.volume * (change + wp.cross(turn_dot, between(G, foot, edge_i)))

    @solid_sum(discretisation)
    def push_back(
        x_ij: vector, edge_i: real, bar_i: vector, foot: vector, solid: int, s: neighbourhood
    ) -> tuple[vector, real]:
        G = gradient(x_ij, s)
        pushed = s.volume * hessian_product(x_ij, between(bar_i, foot, edge_i), s)
        return pushed, s.volume * wp.dot(G - normal(G, foot), bar_i)

    @wp.func
    def direction(a: vector) -> vector:
        size = wp.length(a)
        found = vector()
        if size > real(0.0):
            found = a / size
        return found

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        s: neighbourhood,
        solid: int,
        after: wp.array2d(dtype=vector),
        x: wp.array(dtype=vector),
        edge: wp.array(dtype=real),
        # out
        gamma_of: wp.array(dtype=vector),
        arm: wp.array(dtype=vector),
        sizes: wp.array(dtype=pair_of),
    ):
        i = s.first + wp.tid() // LANES
        total = push(i, x, edge, solid, s)
        if lane() > 0:
            return
        r = separation(x[i], after[i // s.particles, solid], s)
        gamma_of[i] = total
        arm[i] = r
        sizes[i] = pair_of(wp.length(total), wp.length(wp.cross(r, total)))

    @wp.kernel(module=tangent_module, enable_backward=False)
    def hold_tangent(
        s: neighbourhood,
        solid: int,
        after_dot: wp.array2d(dtype=vector),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        edge: wp.array(dtype=real),
        edge_dot: wp.array(dtype=real),
        of: held,
        # out
        gamma_of_dot: wp.array(dtype=vector),
        arm_dot: wp.array(dtype=vector),
        sizes_dot: wp.array(dtype=pair_of),
    ):
        i = s.first + wp.tid() // LANES
        total = push_tangent(i, x, x_dot, edge, edge_dot, solid, s)
        if lane() > 0:
            return
        r, r_dot, gamma = of.arm[i], x_dot[i] - after_dot[i // s.particles, solid], of.gamma_of[i]
        torque, torque_dot = wp.cross(r, gamma), wp.cross(r_dot, gamma) + wp.cross(r, total)
        gamma_of_dot[i] = total
        arm_dot[i] = r_dot
        sizes_dot[i] = pair_of(wp.dot(direction(gamma), total), wp.dot(direction(torque), torque_dot))

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def hold_adjoint(
        s: neighbourhood,
        solid: int,
        x: wp.array(dtype=vector),
        edge: wp.array(dtype=real),
        of: held,
        own: held_bars,
        # in and out
        x_bar: wp.array(dtype=vector),
        edge_bar: wp.array(dtype=real),
        force_bar: wp.array(dtype=vector),
        torque_bar: wp.array(dtype=vector),
    ):
        """Of gamma, whose sizes have given to ``own``; a further turn of the body turns gamma and takes it along."""
        i = s.first + wp.tid() // LANES
        bar = own.gamma_of_bar[i]
        total, edge_part = push_back(i, x, edge, own.gamma_of_bar, solid, s)
        if lane() > 0:
            return
        edge_bar[i] = edge_bar[i] + edge_part
        x_bar[i] = x_bar[i] + total + own.arm_bar[i]
        force_bar[i] = force_bar[i] - total - own.arm_bar[i]
        torque_bar[i] = torque_bar[i] + wp.cross(of.gamma_of[i], bar) - wp.cross(of.arm[i], total)

    @wp.func
    def stiff(density: real, volume: real, greatest: real, whole: pair_of) -> pair_of:
        return pair_of(whole[0] / (density * volume), greatest * whole[1] / density)

    @wp.kernel(module=module, enable_backward=False)
    def weigh(
        particles: int,
        density: wp.array(dtype=real),
        volume: real,
        greatest: real,
        sizes: wp.array(dtype=pair_of),
        whole: wp.array(dtype=pair_of),
        # in and out
        a: wp.array(dtype=real),
    ):
        """``whole`` has the sums of the sizes."""
        i = wp.tid()
        b = i // particles
        a[i] = a[i] + wp.dot(sizes[i], stiff(density[b], volume, greatest, whole[b]))

    @wp.kernel(module=tangent_module, enable_backward=False)
    def weigh_tangent(
        particles: int,
        density: wp.array(dtype=real),
        density_dot: wp.array(dtype=real),
        volume: real,
        greatest: real,
        sizes: wp.array(dtype=pair_of),
        sizes_dot: wp.array(dtype=pair_of),
        whole: wp.array(dtype=pair_of),
        whole_dot: wp.array(dtype=pair_of),
        # in and out
        a_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        b = i // particles
        by = stiff(density[b], volume, greatest, whole[b])
        by_dot = stiff(density[b], volume, greatest, whole_dot[b]) - (density_dot[b] / density[b]) * by
        a_dot[i] = a_dot[i] + wp.dot(sizes_dot[i], by) + wp.dot(sizes[i], by_dot)

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def weigh_begin_adjoint(
        sizes: wp.array(dtype=pair_of),
        a_bar: wp.array(dtype=real),
        # out
        sizes_share: wp.array(dtype=pair_of),
    ):
        i = wp.tid()
        sizes_share[i] = a_bar[i] * sizes[i]

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def weigh_adjoint(
        particles: int,
        density: wp.array(dtype=real),
        volume: real,
        greatest: real,
        of: held,
        whole: wp.array(dtype=pair_of),
        weighed: wp.array(dtype=pair_of),
        a_bar: wp.array(dtype=real),
        # in and out
        bar: held,
    ):
        """``weighed`` is the sum of a_bar times the sizes."""
        i = wp.tid()
        b = i // particles
        by = a_bar[i] * whole[b] + weighed[b]
        own = stiff(density[b], volume, greatest, by)
        r, gamma = of.arm[i], of.gamma_of[i]
        torque_bar = own[1] * direction(wp.cross(r, gamma))
        bar.gamma_of[i] = bar.gamma_of[i] + own[0] * direction(gamma) + wp.cross(torque_bar, r)
        bar.arm[i] = bar.arm[i] + wp.cross(gamma, torque_bar)

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def weigh_end_adjoint(
        density: wp.array(dtype=real),
        volume: real,
        greatest: real,
        whole: wp.array(dtype=pair_of),
        weighed: wp.array(dtype=pair_of),
        # in and out
        density_bar: wp.array(dtype=real),
    ):
        b = wp.tid()
        by = stiff(density[b], volume, greatest, whole[b])
        density_bar[b] = density_bar[b] - wp.dot(weighed[b], by) / density[b]

    @wp.kernel(module=module, enable_backward=False)
    def pull(
        y: wp.array(dtype=real),
        of: held,
        # out
        pulled: wp.array(dtype=vector),
        twisted: wp.array(dtype=vector),
    ):
        i = wp.tid()
        pulled[i] = y[i] * of.gamma_of[i]
        twisted[i] = y[i] * wp.cross(of.arm[i], of.gamma_of[i])

    @wp.kernel(module=tangent_module, enable_backward=False)
    def pull_tangent(
        y: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        of: held,
        dots: held_dots,
        # out
        pulled_dot: wp.array(dtype=vector),
        twisted_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        gamma, r, gamma_dot, r_dot = of.gamma_of[i], of.arm[i], dots.gamma_of_dot[i], dots.arm_dot[i]
        pulled_dot[i] = y_dot[i] * gamma + y[i] * gamma_dot
        twisted_dot[i] = y_dot[i] * wp.cross(r, gamma) + y[i] * (wp.cross(r_dot, gamma) + wp.cross(r, gamma_dot))

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def pull_adjoint(
        particles: int,
        y: wp.array(dtype=real),
        of: held,
        total_bar: bundle(pulled_sum_bar=vector, twisted_sum_bar=vector),
        # in and out
        y_bar: wp.array(dtype=real),
        bar: held,
    ):
        """From the adjoints (members,) of the sums."""
        i = wp.tid()
        b = i // particles
        gamma, r, f, t = of.gamma_of[i], of.arm[i], total_bar.pulled_sum_bar[b], total_bar.twisted_sum_bar[b]
        y_bar[i] = y_bar[i] + wp.dot(gamma, f) + wp.dot(wp.cross(r, gamma), t)
        bar.gamma_of[i] = bar.gamma_of[i] + y[i] * (f + wp.cross(t, r))
        bar.arm[i] = bar.arm[i] + y[i] * wp.cross(gamma, t)

    return BodyKernels(
        Kernels(hold, hold_tangent, hold_adjoint),
        Kernels(weigh, weigh_tangent, (weigh_begin_adjoint, weigh_adjoint, weigh_end_adjoint)),
        Kernels(pull, pull_tangent, pull_adjoint),
    )
