"""A force between neighbours that is one function of a user's: the force [N], in 2-D per metre, on a particle from each
neighbour within the support is (W(x_ij) / W(0)) f(x_ij, v_ij, t, theta), so that

a_i = 1 / (m_i s^d) sum_j (W_ij / W_0) f(x_ij, v_ij, t, theta)

ends smoothly at the support; m_i s^d is the mass of a particle, with the spacing s. Momentum is kept where f is odd,
f(-x, -v) = -f(x, v), and angular momentum where f is along x too. A particle exerts none on itself, and walls have no
part in it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.sph.formula import Formula
from cortado.sph.formula_kernels import applied
from cortado.sph.own_force import OwnForce, topic
from cortado.sph.packed import theta_of


def term(
    discretisation: Discretisation, text: Formula, ranks: tuple[int, ...], dimension: int, module: Any
) -> Callable[..., Any]:
    """What a pair adds to the acceleration times the volume of a particle, in a Warp module."""
    precision = discretisation.precision
    real, vector, theta_type = precision.real, precision.vector, theta_of(precision, ranks)
    neighbourhood, weight = neighbourhood_type(precision), pair_functions(discretisation).weight
    force = applied(text, precision, ranks, dimension, module)

    def pair(x_ij: vector, v_ij: vector, m_i: real, theta: theta_type, i: int, j: int, s: neighbourhood) -> vector:
        acceleration = vector()
        if i != j:
            acceleration = (weight(x_ij, s) / (s.self_weight * m_i)) * force(x_ij, v_ij, theta)
        return acceleration

    return pair


@cache
def pair_kernels(discretisation: Discretisation, text: Formula, ranks: tuple[int, ...], dimension: int) -> Kernels:
    """Of a function as that of `body_kernels`."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    theta_type = theta_of(precision, ranks)
    neighbourhood = neighbourhood_type(precision)
    name, own = topic("pair", text, ranks, dimension), (text, ranks, dimension)
    module = discretisation.module(True, name)
    tangent_module, adjoint_module = discretisation.tangent_module(name), discretisation.module(False, name)
    accelerations = fluid_sum(discretisation, module=module)(term(discretisation, *own, module))
    tangents = made_tangent(discretisation, lambda taped: term(taped, *own, tangent_module), tangent_module)
    adjoints = made_adjoint(discretisation, lambda taped: term(taped, *own, adjoint_module), adjoint_module)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def pair_force(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        cell: real,
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = accelerations(i, x, v, m, theta[i // s.particles], s)
        if lane() > 0:
            return
        acceleration[i] = acceleration_in[i] + total / cell

    @wp.kernel(module=tangent_module, enable_backward=False)
    def pair_tangent(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        theta_dot: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        cell: real,
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = tangents(i, x, x_dot, v, v_dot, m, m_dot, theta[member], theta_dot[member], s)
        if lane() > 0:
            return
        acceleration_dot[i] = acceleration_in_dot[i] + total / cell

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def pair_adjoint(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        cell: real,
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        # out
        theta_bar: wp.array(dtype=theta_type),
    ):
        i = s.first + wp.tid() // LANES
        x_sum, v_sum, m_sum, theta_sum = adjoints(i, x, v, m, acceleration_bar, theta[i // s.particles], s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum / cell
        v_bar[i] = v_bar[i] + v_sum / cell
        m_bar[i] = m_bar[i] + m_sum / cell
        theta_bar[i] = theta_sum / cell

    return Kernels(pair_force, pair_tangent, pair_adjoint)


class Pair(OwnForce):
    """A force between neighbours: ``function(x_ij, v_ij, t, ...)`` returns the force [N], in 2-D per metre, on a
    particle from a neighbour, from how far [m] and how fast [m/s] the particle is from it; time may be left out. It is
    weighted with W(x_ij) / W(0), which is 1 at no distance and 0 at the support. Momentum is kept where
    f(-x, -v) = -f(x, v). Walls exert none."""

    kind = "Pair"

    def kernels(self, discretisation: Discretisation, dimension: int) -> Kernels:
        return pair_kernels(discretisation, self._formula, tuple(p.rank for p in self.parameters), dimension)
