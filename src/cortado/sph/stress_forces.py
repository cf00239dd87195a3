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

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import TypesByName
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import rubbing_sum, tangent_of
from cortado.sph.moment_functions import matrix_type


@dataclass(frozen=True)
class ContactFunctions:
    """Warp functions of the viscous contact between a particle and a wall, by x_ib and the foot on the surface."""

    weight: Any
    """s of a separation of two particles, -V a of grad W = a x."""
    fall: Any
    """The vector y from the surface to the particle."""
    fall_change: Any
    """The derivative of y along a change of x, which is symmetric."""
    hold: Any
    """s_w / w_b"""
    hold_gradient: Any
    """The gradient of s_w / w_b."""


@cache
def contact_functions(discretisation: Discretisation) -> ContactFunctions:
    """Return the Warp functions by which walls and particles hold each other in the viscous stress."""
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    slope, slope_gradient = pair.slope, pair.slope_gradient

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
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
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        return weight(x_ib, s) * wp.max(rise(x_ib, foot), real(0.0)) / wp.max(height(x_ib, foot), least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
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

    return ContactFunctions(weight, fall, fall_change, hold, hold_gradient)


@dataclass(frozen=True)
class StressSums:
    """Warp functions of the viscous stress's sums over neighbours."""

    force: Any
    """The acceleration."""
    tangent: Any
    """Its tangent."""
    traction_back: Any
    """From the adjoint of the acceleration to those of the rows of T and of mu."""
    back: Any
    """From the adjoint of the acceleration to those of x, v and m."""


@cache
def stress_sums(discretisation: Discretisation, sticks: bool) -> StressSums:
    """Make the viscous acceleration's sums, with walls without slip if fluid ``sticks``; ``control`` is C."""
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
    def force_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_ij: vector,
        v_dot_ij: vector,
        m_i: real,
        m_dot_i: real,
        T_i: matrix,
        T_j: matrix,
        T_dot_i: matrix,
        T_dot_j: matrix,
        mu_i: real,
        mu_j: real,
        mu_dot_i: real,
        mu_dot_j: real,
        control: real,
        least: real,
        s: neighbourhood,
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

    return StressSums(force, force_tangent, traction_back, force_back)


def stress_work(d: Discretisation) -> Any:
    """Make the work of the viscous sum on solids, for the adjoint ``acceleration_bar``, with ``least`` and ``control``
    as ``constants`` (`cortado.particles.wall_terms.solid_kernel`)."""
    precision, contact = d.precision, contact_functions(d)
    real, vector, matrix, pair = precision.real, precision.vector, matrix_type(precision), precision.pair
    fall, hold = contact.fall, contact.hold

    def stress_work(
        x_ij: vector,
        v_ij: vector,
        m_i: real,
        T_i: matrix,
        eta_i: real,
        acceleration_bar_i: vector,
        constants: pair,
        foot: vector,
        s: neighbourhood_type(precision),
    ) -> real:
        pull = T_i * fall(x_ij, foot) + (constants[1] * eta_i) * v_ij
        return (-hold(x_ij, foot, constants[0], s) / m_i) * wp.dot(pull, acceleration_bar_i)

    return stress_work


def stress_couple_work(d: Discretisation) -> Any:
    """Make the Warp function of a wall's viscous couple on a particle, y_ib x a_ib, times its adjoint."""
    precision, fall, force = d.precision, contact_functions(d).fall, wp.func(stress_work(d))
    real, vector, matrix, pair = precision.real, precision.vector, matrix_type(precision), precision.pair

    def stress_couple_work(
        x_ij: vector,
        v_ij: vector,
        m_i: real,
        T_i: matrix,
        eta_i: real,
        couple_bar_i: vector,
        constants: pair,
        foot: vector,
        s: neighbourhood_type(precision),
    ) -> real:
        return force(x_ij, v_ij, m_i, T_i, eta_i, wp.cross(couple_bar_i, fall(x_ij, foot)), constants, foot, s)

    return stress_couple_work
