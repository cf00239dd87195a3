"""The sum over neighbours of viscosity as a stress, m_i a_i of `cortado.sph.stress_kernels`; mu is that of the stress.
A wall without slip is a neighbour at the point of its surface below the particle, at rest.

With the normal n of the wall, the distance d of particle i from its surface, and a particle b of the wall at x_b,

    y_ib = d n,   s_w = w_b s_ib max(n . x_ib, 0) / max(d, e),

for the weight s_ib of two particles of the fluid (`cortado.sph.stress_kernels`), as if velocities went on behind the
wall with their sign turned (Morris, Fox and Zhu 1997). d is 0 behind the surface, and e is a distance, ``least``,
closer than which a wall pulls no harder. n . x_ib is below 0 where b belongs to the other side of a thin wall, or to
another face of an edge, and then b does not count: with a weight below 0 it would drive the particle on. At all three
the derivative has a corner. Functions know n by the ``foot``, the vector from x_b to the surface.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import rubbing_sum, tangent_of
from cortado.sph.moment_functions import matrix_type


@cache
def contact_functions(discretisation: Discretisation) -> SimpleNamespace:
    """Make the Warp functions of the viscous contact between a particle and a wall, by x_ib and the foot on the
    surface."""
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    slope, slope_gradient = pair.slope, pair.slope_gradient

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        """Return s of a separation of two particles, -V a of grad W = a x."""
        return -s.volume * slope(x, s)

    @wp.func
    def rise(x_ib: vector, foot: vector) -> real:
        """Return n . x_ib, the distance of a particle from a wall particle along the wall's normal."""
        return wp.dot(x_ib, foot) / wp.length(foot)

    @wp.func
    def height(x_ib: vector, foot: vector) -> real:
        """Return the distance d of a particle from the surface of a wall, negative behind it."""
        return rise(x_ib, foot) - wp.length(foot)

    @wp.func
    def fall(x_ib: vector, foot: vector) -> vector:
        """Return the vector y from the surface to the particle."""
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        """Return s_w / w_b."""
        return weight(x_ib, s) * wp.max(rise(x_ib, foot), real(0.0)) / wp.max(height(x_ib, foot), least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
        """Return the derivative of y along a change u of x, which is symmetric."""
        square = wp.dot(foot, foot)
        return wp.where(height(x_ib, foot) > real(0.0), wp.dot(u, foot) / square, real(0.0)) * foot

    @wp.func
    def hold_gradient(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> vector:
        above, d = rise(x_ib, foot), height(x_ib, foot)
        if above <= real(0.0):
            return vector()
        per = real(1.0) / wp.max(d, least)
        along = weight(x_ib, s) * per * (real(1.0) - wp.where(d > least, above * per, real(0.0)))
        return (-s.volume * above * per) * slope_gradient(x_ib, s) + (along / wp.length(foot)) * foot

    return by_name(weight, fall, fall_change, hold, hold_gradient)


@cache
def stress_sums(discretisation: Discretisation, sticks: bool) -> SimpleNamespace:
    """Make the sums of the viscous acceleration, ``force`` and ``force_tangent``, and from its adjoint those of the
    rows of T and of mu, ``traction_back``, and of x, v and m, ``force_back``. Walls have no slip if fluid ``sticks``;
    ``control`` is C."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    slope_gradient, contact = pair_functions(discretisation).slope_gradient, contact_functions(discretisation)
    weight, fall, fall_change = contact.weight, contact.fall, contact.fall_change
    hold, hold_gradient = contact.hold, contact.hold_gradient
    summed = rubbing_sum(discretisation, sticks)
    matrix = matrix_type(precision)

    typed = TypesByName(real, {vector: "x v foot turn bar", matrix: "T", neighbourhood: "s"})

    @typed
    def wall_force(x_ij, v_ij, m_i, T_i, mu_i, control, least, foot, s) -> vector:
        return (-hold(x_ij, foot, least, s) / m_i) * (T_i * fall(x_ij, foot) + (control * mu_i) * v_ij)

    @summed(wall_force)
    @typed
    def force(x_ij, v_ij, m_i, T_i, T_j, mu_i, mu_j, control, least, s) -> vector:
        return (-weight(x_ij, s) / m_i) * ((T_i + T_j) * x_ij + (control * (mu_i + mu_j)) * v_ij)

    @typed
    def wall_force_tangent(
        x_ij, x_dot_ij, v_ij, v_dot_ij, m_i, m_dot_i, T_i, T_dot_i, mu_i, mu_dot_i, control, least, foot, turn_dot, s
    ) -> vector:
        """Return the tangent of a wall's viscous pull; a wall that turns turns its pull."""
        w, y, rest = hold(x_ij, foot, least, s), fall(x_ij, foot), x_dot_ij - wp.cross(turn_dot, x_ij)
        u = fall_change(x_ij, rest, foot) + wp.cross(turn_dot, y)
        w_dot = wp.dot(hold_gradient(x_ij, foot, least, s), rest) - w * m_dot_i / m_i
        pull = T_i * y + (control * mu_i) * v_ij
        change = T_dot_i * y + T_i * u + control * (mu_dot_i * v_ij + mu_i * v_dot_ij)
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    @tangent_of(force)
    @summed(wall_force_tangent, ahead=False, grows=force)
    @typed
    def force_tangent(
        x_ij,
        x_dot_ij,
        v_ij,
        v_dot_ij,
        m_i,
        m_dot_i,
        T_i,
        T_j,
        T_dot_i,
        T_dot_j,
        mu_i,
        mu_j,
        mu_dot_i,
        mu_dot_j,
        control,
        least,
        s,
    ) -> vector:
        w = weight(x_ij, s)
        w_dot = -s.volume * wp.dot(slope_gradient(x_ij, s), x_dot_ij) - w * m_dot_i / m_i
        T, mu = T_i + T_j, control * (mu_i + mu_j)
        pull = T * x_ij + mu * v_ij
        change = (T_dot_i + T_dot_j) * x_ij + T * x_dot_ij + (control * (mu_dot_i + mu_dot_j)) * v_ij + mu * v_dot_ij
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    @typed
    def wall_traction_back(x_ij, v_ij, m_i, bar_i, control, least, foot, s) -> tuple[vector, vector, vector, real]:
        z = (-hold(x_ij, foot, least, s) / m_i) * bar_i
        y = fall(x_ij, foot)
        return z[0] * y, z[1] * y, z[2] * y, control * wp.dot(z, v_ij)

    @summed(wall_traction_back)
    @typed
    def traction_back(x_ij, v_ij, m_i, m_j, bar_i, bar_j, control, least, s) -> tuple[vector, vector, vector, real]:
        """Return a pair's part in the adjoints of the rows of T and of mu."""
        z = -weight(x_ij, s) * (bar_i / m_i - bar_j / m_j)
        return z[0] * x_ij, z[1] * x_ij, z[2] * x_ij, control * wp.dot(z, v_ij)

    @typed
    def wall_force_back(x_ij, v_ij, m_i, T_i, mu_i, bar_i, control, least, foot, s) -> tuple[vector, vector, real]:
        w, y, u = hold(x_ij, foot, least, s), fall(x_ij, foot), bar_i / m_i
        level = -wp.dot(u, T_i * y + (control * mu_i) * v_ij)
        x_part = level * hold_gradient(x_ij, foot, least, s) - w * fall_change(x_ij, wp.transpose(T_i) * u, foot)
        return x_part, (-w * control * mu_i) * u, -level * w / m_i

    @summed(wall_force_back)
    @typed
    def force_back(
        x_ij, v_ij, m_i, m_j, T_i, T_j, mu_i, mu_j, bar_i, bar_j, control, least, s
    ) -> tuple[vector, vector, real]:
        """Return a pair's part in the adjoints of x, v and m of i, for an adjoint of the acceleration."""
        w, T, mu, own_u = weight(x_ij, s), T_i + T_j, control * (mu_i + mu_j), bar_i / m_i
        u, pull = own_u - bar_j / m_j, T * x_ij + mu * v_ij
        x_part = (s.volume * wp.dot(u, pull)) * slope_gradient(x_ij, s) - w * (wp.transpose(T) * u)
        return x_part, (-w * mu) * u, w * wp.dot(own_u, pull) / m_i

    return by_name(force, force_tangent, traction_back, force_back)


def work_types(precision: Precision) -> TypesByName:
    """Return the Warp types, by name, of what the works of viscous stress on solids compute with."""
    kinds = {precision.vector: "x v foot acceleration couple", matrix_type(precision): "T M A"}
    return TypesByName(precision.real, {**kinds, precision.pair: "constants", neighbourhood_type(precision): "s"})


def stress_work(d: Discretisation) -> Any:
    """Make the work of the viscous sum on solids, for the adjoint ``acceleration_bar``, with ``least`` and ``control``
    as ``constants`` (`cortado.particles.wall_terms.solid_kernel`)."""
    precision, real, contact = d.precision, d.precision.real, contact_functions(d)
    fall, hold = contact.fall, contact.hold

    @work_types(precision)
    def stress_work(x_ij, v_ij, m_i, T_i, eta_i, acceleration_bar_i, constants, foot, s) -> real:
        pull = T_i * fall(x_ij, foot) + (constants[1] * eta_i) * v_ij
        return (-hold(x_ij, foot, constants[0], s) / m_i) * wp.dot(pull, acceleration_bar_i)

    return stress_work


def stress_couple_work(d: Discretisation) -> Any:
    """Make the Warp function of a wall's viscous couple on a particle, y_ib x a_ib, times its adjoint."""
    real, fall, force = d.precision.real, contact_functions(d).fall, wp.func(stress_work(d))

    @work_types(d.precision)
    def stress_couple_work(x_ij, v_ij, m_i, T_i, eta_i, couple_bar_i, constants, foot, s) -> real:
        return force(x_ij, v_ij, m_i, T_i, eta_i, wp.cross(couple_bar_i, fall(x_ij, foot)), constants, foot, s)

    return stress_couple_work
