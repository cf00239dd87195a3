"""A rigid body in the projection: it takes part by its velocities, which pressures change as they change those of
fluid.

Walls of a body push particle i by gamma_i = sum w_b (N_b g_ib + e_i (g_ib - N_b g_ib)), N_b = n_b n_b^T, over its own
wall particles, with e_i of all walls (`cortado.solvers.projection.walls`). With r_i = x_i - c', the pressure
impulses y, the body's density rho and its volume K in those of a particle,

    V = V_0 + dt g + sum y_i gamma_i / (rho K),   L = L_0 + sum y_i r_i x gamma_i,   W = R' I^-1 R'^T L / rho

is the transpose of what its velocity adds to the divergence, - gamma_i . (V + W x r_i), of which that with the velocity
(V_0, W_0) of its walls is counted with those of all walls. Linear momentum is kept to round-off.

The particles around a light body all move it. The diagonal a_i of the iteration gets |gamma_i| sum_j |gamma_j| / (rho
K) + lambda |r_i x gamma_i| sum_j |r_j x gamma_j| / rho, with lambda the largest eigenvalue of I^-1. Divided by it the
body's part of the matrix has no eigenvalue beyond 2.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import solid_sum
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.solvers.projection.walls import normal_part


@dataclass(frozen=True)
class BodyKernels:
    """Kernels by which particles of the projection push rigid bodies, with their tangents and adjoints."""

    hold: Kernels
    """The push gamma, the arm r, and the sizes of gamma and r x gamma of each particle."""
    weigh: Kernels
    """The part of bodies in the diagonal a."""
    pull: Kernels
    """The momenta y gamma and y r x gamma that the pressure impulse y of each particle gives."""


@cache
def body_kernels(discretisation: Discretisation) -> BodyKernels:
    """Make the kernels by which the projection moves bodies, for a discretisation."""
    precision = discretisation.precision
    real, vector, pair_of = precision.real, precision.vector, precision.pair
    neighbourhood, pair = neighbourhood_type(precision), pair_functions(discretisation)
    gradient, hessian_product, separation = pair.gradient, pair.hessian_product, pair.separation
    normal = normal_part(discretisation)
    topic = "projection_bodies"
    module, tangent_module, adjoint_module = discretisation.modules(topic)

    @wp.func
    def between(a: vector, foot: vector, edge: real) -> vector:
        """Return the part of a vector along the normal of a wall plus the part across it times the edge factor e."""
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

    @particle_kernel(module, "gamma_of arm sizes", [over(push, "total")], numbers=["solid"])
    def hold(
        member: int, solid: int, total: vector, after: wp.array2d(dtype=vector), x_i: vector, s: neighbourhood
    ) -> tuple[vector, vector, pair_of]:
        r = separation(x_i, after[member, solid], s)
        return total, r, pair_of(wp.length(total), wp.length(wp.cross(r, total)))

    @particle_kernel(tangent_module, "gamma_of_dot arm_dot sizes_dot", [over(push_tangent, "total")], numbers=["solid"])
    def hold_tangent(
        member: int,
        solid: int,
        total: vector,
        after_dot: wp.array2d(dtype=vector),
        x_dot_i: vector,
        gamma_of_i: vector,
        arm_i: vector,
    ) -> tuple[vector, vector, pair_of]:
        r_dot = x_dot_i - after_dot[member, solid]
        torque, torque_dot = wp.cross(arm_i, gamma_of_i), wp.cross(r_dot, gamma_of_i) + wp.cross(arm_i, total)
        return total, r_dot, pair_of(wp.dot(direction(gamma_of_i), total), wp.dot(direction(torque), torque_dot))

    back = over(push_back, "total edge_part", bar="gamma_of_bar")

    @particle_kernel(adjoint_module, "+edge_bar +x_bar +force_bar +torque_bar", [back], numbers=["solid"])
    def hold_adjoint(
        total: vector, edge_part: real, gamma_of_i: vector, arm_i: vector, gamma_of_bar_i: vector, arm_bar_i: vector
    ) -> tuple[real, vector, vector, vector]:
        """Apply the adjoint of gamma and r, once the sizes have added to theirs; turning a body turns gamma."""
        torque = wp.cross(gamma_of_i, gamma_of_bar_i) - wp.cross(arm_i, total)
        return edge_part, total + arm_bar_i, -total - arm_bar_i, torque

    @wp.func
    def stiff(density: real, volume: real, greatest: real, whole: pair_of) -> pair_of:
        return pair_of(whole[0] / (density * volume), greatest * whole[1] / density)

    numbers = ["volume", "greatest"]

    @particle_kernel(module, "+a", numbers=numbers)
    def weigh(density: real, volume: real, greatest: real, sizes_i: pair_of, whole: pair_of) -> real:
        """Add a body's part to the diagonal a of a particle; ``whole`` has the sums of the sizes."""
        return wp.dot(sizes_i, stiff(density, volume, greatest, whole))

    @particle_kernel(tangent_module, "+a_dot", numbers=numbers)
    def weigh_tangent(
        density: real,
        density_dot: real,
        volume: real,
        greatest: real,
        sizes_i: pair_of,
        sizes_dot_i: pair_of,
        whole: pair_of,
        whole_dot: pair_of,
    ) -> real:
        by = stiff(density, volume, greatest, whole)
        by_dot = stiff(density, volume, greatest, whole_dot) - (density_dot / density) * by
        return wp.dot(sizes_dot_i, by) + wp.dot(sizes_i, by_dot)

    @particle_kernel(adjoint_module, "sizes_share")
    def weigh_begin_adjoint(sizes_i: pair_of, a_bar_i: real) -> pair_of:
        return a_bar_i * sizes_i

    @particle_kernel(adjoint_module, "+gamma_of_bar +arm_bar", numbers=numbers)
    def weigh_adjoint(
        density: real,
        volume: real,
        greatest: real,
        gamma_of_i: vector,
        arm_i: vector,
        whole: pair_of,
        weighed: pair_of,
        a_bar_i: real,
    ) -> tuple[vector, vector]:
        """Add to the adjoints of gamma and r from that of a; ``weighed`` is the sum of a_bar times the sizes."""
        own = stiff(density, volume, greatest, a_bar_i * whole + weighed)
        torque_bar = own[1] * direction(wp.cross(arm_i, gamma_of_i))
        gamma_part = own[0] * direction(gamma_of_i) + wp.cross(torque_bar, arm_i)
        return gamma_part, wp.cross(gamma_of_i, torque_bar)

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

    @particle_kernel(module, "pulled twisted")
    def pull(y_i: real, gamma_of_i: vector, arm_i: vector) -> tuple[vector, vector]:
        return y_i * gamma_of_i, y_i * wp.cross(arm_i, gamma_of_i)

    @particle_kernel(tangent_module, "pulled_dot twisted_dot")
    def pull_tangent(
        y_i: real, y_dot_i: real, gamma_of_i: vector, gamma_of_dot_i: vector, arm_i: vector, arm_dot_i: vector
    ) -> tuple[vector, vector]:
        turn = wp.cross(arm_dot_i, gamma_of_i) + wp.cross(arm_i, gamma_of_dot_i)
        return y_dot_i * gamma_of_i + y_i * gamma_of_dot_i, y_dot_i * wp.cross(arm_i, gamma_of_i) + y_i * turn

    @particle_kernel(adjoint_module, "+y_bar +gamma_of_bar +arm_bar")
    def pull_adjoint(
        y_i: real, gamma_of_i: vector, arm_i: vector, pulled_sum_bar: vector, twisted_sum_bar: vector
    ) -> tuple[real, vector, vector]:
        """Add to the adjoints of y, gamma and r from the adjoints (members,) of the summed momenta."""
        by_y = wp.dot(gamma_of_i, pulled_sum_bar) + wp.dot(wp.cross(arm_i, gamma_of_i), twisted_sum_bar)
        by_gamma = pulled_sum_bar + wp.cross(twisted_sum_bar, arm_i)
        return by_y, y_i * by_gamma, y_i * wp.cross(gamma_of_i, twisted_sum_bar)

    return BodyKernels(
        Kernels(hold, hold_tangent, hold_adjoint),
        Kernels(weigh, weigh_tangent, (weigh_begin_adjoint, weigh_adjoint, weigh_end_adjoint)),
        Kernels(pull, pull_tangent, pull_adjoint),
    )
