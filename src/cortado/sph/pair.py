"""A force between neighbours that is one function of a user's: the force [N], in 2-D per metre, on a particle from each
neighbour within the support is (W(x_ij) / W(0)) f(x_ij, v_ij, t, theta), so that

a_i = 1 / (m_i V) sum_j (W_ij / W_0) f(x_ij, v_ij, t, theta)

ends smoothly at the support. Momentum is kept where f is odd, f(-x, -v) = -f(x, v), and angular momentum where f is
along x too. A particle exerts none on itself, and walls have no part in it.
"""

from functools import cache

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.sph.formula import Formula
from cortado.sph.formula_kernels import applied, change_along, work_of
from cortado.sph.own_force import OwnForce, topic
from cortado.sph.packed import theta_of


@cache
def pair_kernels(discretisation: Discretisation, text: Formula, ranks: tuple[int, ...]) -> Kernels:
    """Of a function as that of `body_kernels`. The adjoint gathers: what the pair (i, j) adds to i is seen from i, of
    the force on i and of that on j."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    theta_type = theta_of(precision, ranks)
    neighbourhood = neighbourhood_type(precision)
    pair = pair_functions(discretisation)
    neighbour, separation, weight, gradient = pair.neighbour, pair.separation, pair.weight, pair.gradient
    name = topic("pair", text, ranks)
    module = discretisation.module(True, name)
    tangent_module, adjoint_module = discretisation.tangent_module(name), discretisation.module(False, name)
    force = applied(text, precision, ranks, module)
    force_tangent = applied(text, precision, ranks, tangent_module)
    force_adjoint = applied(text, precision, ranks, adjoint_module)
    change_of = change_along(text, precision, ranks, tangent_module)
    work_adjoint = work_of(text, precision, ranks, adjoint_module)

    @wp.func(module=module)
    def force_sum(
        i: int, theta: theta_type, x: wp.array(dtype=vector), v: wp.array(dtype=vector), s: neighbourhood
    ) -> vector:
        total = vector()
        for k in range(s.fluid_count[i]):
            j = neighbour(k, i, s)
            if j != i:
                x_ij = separation(x[i], x[j], s)
                total += (weight(x_ij, s) / s.self_weight) * force(x_ij, v[i] - v[j], theta)
        return total

    @wp.kernel(module=module)
    def pair_force(
        s: neighbourhood,
        plane: vector,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total = force_sum(i, theta[i // s.particles], x, v, s)
        acceleration[i] = acceleration_in[i] + wp.cw_mul(plane, total) / (m[i] * s.volume)

    @wp.kernel(module=tangent_module, enable_backward=False)
    def pair_tangent(
        s: neighbourhood,
        plane: vector,
        theta: wp.array(dtype=theta_type),
        theta_dot: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        member = i // s.particles
        total = vector()
        total_dot = vector()
        for k in range(s.fluid_count[i]):
            j = neighbour(k, i, s)
            if j != i:
                x_ij = separation(x[i], x[j], s)
                v_ij = v[i] - v[j]
                x_dot_ij = x_dot[i] - x_dot[j]
                f = force_tangent(x_ij, v_ij, theta[member])
                f_dot = change_of(x_ij, v_ij, theta[member], x_dot_ij, v_dot[i] - v_dot[j], theta_dot[member])
                total += weight(x_ij, s) * f
                total_dot += wp.dot(gradient(x_ij, s), x_dot_ij) * f + weight(x_ij, s) * f_dot
        change = total_dot - (m_dot[i] / m[i]) * total
        scale = m[i] * s.volume * s.self_weight
        acceleration_dot[i] = acceleration_in_dot[i] + wp.cw_mul(plane, change) / scale

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def pair_adjoint(
        s: neighbourhood,
        plane: vector,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        # out
        theta_bar: wp.array(dtype=theta_type),
    ):
        i = s.first + wp.tid()
        own_theta = theta[i // s.particles]
        scale = real(1.0) / (s.volume * s.self_weight)
        bar_i = (scale / m[i]) * wp.cw_mul(plane, acceleration_bar[i])
        x_sum = vector()
        v_sum = vector()
        theta_sum = theta_type()
        work = real(0.0)
        for k in range(s.fluid_count[i]):
            j = neighbour(k, i, s)
            if j != i:
                x_ij = separation(x[i], x[j], s)
                v_ij = v[i] - v[j]
                w = weight(x_ij, s)
                bar_j = (scale / m[j]) * wp.cw_mul(plane, acceleration_bar[j])
                own = wp.dot(force_adjoint(x_ij, v_ij, own_theta), bar_i)
                other = wp.dot(force_adjoint(-x_ij, -v_ij, own_theta), bar_j)
                x_own, v_own, theta_own, _own = wp.grad(work_adjoint)(x_ij, v_ij, own_theta, bar_i)
                x_other, v_other, _theta_other, _other = wp.grad(work_adjoint)(-x_ij, -v_ij, own_theta, bar_j)
                x_sum += w * (x_own - x_other) + (own + other) * gradient(x_ij, s)
                v_sum += w * (v_own - v_other)
                theta_sum += w * theta_own
                work += w * own
        x_bar[i] = x_bar[i] + x_sum
        v_bar[i] = v_bar[i] + v_sum
        m_bar[i] = m_bar[i] - work / m[i]
        theta_bar[i] = theta_sum

    return Kernels(pair_force, pair_tangent, pair_adjoint)


class Pair(OwnForce):
    """A force between neighbours: ``function(x_ij, v_ij, t, ...)`` returns the force [N], in 2-D per metre, on a
    particle from a neighbour, from how far [m] and how fast [m/s] the particle is from it; time may be left out. It is
    weighted with W(x_ij) / W(0), which is 1 at no distance and 0 at the support. Momentum is kept where
    f(-x, -v) = -f(x, v). Walls exert none."""

    kind = "Pair"

    def kernels(self, discretisation: Discretisation) -> Kernels:
        return pair_kernels(discretisation, self._formula, tuple(p.rank for p in self.parameters))
