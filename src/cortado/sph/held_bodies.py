"""How free bodies go and turn by the momenta that they get, also those that are held: a body whose freedoms are few,
and one on a hinge.

A body's velocities are V = D (V_0 + dt g + F / (rho K)) + W x s and W = G L. D is 0 along held axes. A hinge is at the
arm a from the centre of mass in the body's frame, so that the centre is at s = - R a from the hinge, which stays where
it is: D is 0, L is the angular momentum about the hinge, and I the inertia about it. Without a hinge s is 0.

G is the inverse of the inertia J = R I R^T on the free axes A, G = A (A^T J A)^-1 A^T: J^-1 if all are free; a a^T / (a
. J a) for one axis a; J^-1 - (J^-1 b) (J^-1 b)^T / (b . J^-1 b) where b alone is held; 0 if none is free. Of an angular
velocity that a scene says counts the part along the free axes. What pressures do to the body, -G and D / (rho K), is so
the transpose of what its velocity does to the fluid, as that of a body that nothing holds.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.particles.moving_walls import matrix_of
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.scene.links import Hold


@cache
def hold_type(precision: Precision) -> Any:
    """Make the Warp struct of how a body is held."""
    vector = precision.vector

    class HoldNumbers:
        moving: vector
        """1 along the axes along which the body may go, else 0."""
        arm: vector
        """a, from the centre of mass to the hinge, in the body's frame [m]."""
        axis: vector
        """The axis about which it turns, if that is one; that about which it does not, if they are two."""
        turning: wp.int32
        """Number of axes about which it turns."""

    HoldNumbers.__name__ = HoldNumbers.__qualname__ = f"HoldNumbers_{precision.name}"
    return wp.struct(HoldNumbers)


def hold_numbers(hold: Hold, precision: Precision) -> Any:
    """Return a `hold_type` of how a body is held."""
    made = hold_type(precision)()
    for name in ("moving", "arm", "axis"):
        setattr(made, name, precision.vector(*getattr(hold, name)))
    made.turning = hold.turning
    return made


@cache
def hold_functions(precision: Precision) -> SimpleNamespace:
    """Make the Warp functions of a hold h: ``freed``, the part of an angular velocity w along free axes; ``rate``, R A
    R^T w of matrices R and A; ``spin``, G L; and ``root``, S T with S^T S = G, by a square root of I^-1."""
    vector, matrix, hold = precision.vector, matrix_of(precision), hold_type(precision)

    @wp.func
    def rate(R: matrix, A: matrix, w: vector) -> vector:
        return R * (A * (wp.transpose(R) * w))

    @wp.func
    def freed(w: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = w
        elif h.turning == 2:
            found = w - wp.dot(h.axis, w) * h.axis
        elif h.turning == 1:
            found = wp.dot(h.axis, w) * h.axis
        return found

    @wp.func
    def spin(R: matrix, inertia: matrix, inverse: matrix, L: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = rate(R, inverse, L)
        elif h.turning == 2:
            across = rate(R, inverse, h.axis)
            found = rate(R, inverse, L) - wp.dot(across, L) / wp.dot(h.axis, across) * across
        elif h.turning == 1:
            found = wp.dot(h.axis, L) / wp.dot(h.axis, rate(R, inertia, h.axis)) * h.axis
        return found

    @wp.func
    def root(R: matrix, inertia: matrix, half: matrix, T: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = half * (wp.transpose(R) * T)
        elif h.turning == 2:
            across = wp.normalize(half * (wp.transpose(R) * h.axis))
            whole = half * (wp.transpose(R) * T)
            found = whole - wp.dot(across, whole) * across
        elif h.turning == 1:
            found = wp.dot(h.axis, T) / wp.sqrt(wp.dot(h.axis, rate(R, inertia, h.axis))) * h.axis
        return found

    return SimpleNamespace(kind=hold, rate=rate, freed=freed, spin=spin, root=root)


def free_module(precision: Precision) -> Any:
    """Return the Warp module of kernels of free bodies that need no smoothing kernel."""
    return kernel_module(f"free_bodies_derivative_{precision.name}")


@cache
def move_kernels(precision: Precision) -> Kernels:
    """Make the kernels of V, L and W of a body by gravity and by the sums of momenta that it gets, with a thread for
    each scene. They also give the velocity changes V - V_0 and W - W_0, ``faster`` and ``turned_faster``. Adjoints of
    the sums are written."""
    real, vector, matrix, hold = precision.real, precision.vector, matrix_of(precision), hold_functions(precision)
    spin, vectors = hold.spin, "gravity V W L pulled twisted"

    @TypesByName(real, {vector: vectors, matrix: "inertia inverse turns", hold.kind: "hold"})
    def move(
        time_step_i,
        gravity_i,
        density_i,
        volume,
        inertia,
        inverse,
        hold,
        turns_i,
        V_0_i,
        W_0_i,
        L_0_i,
        pulled_sum_i,
        twisted_sum_i,
    ) -> tuple[vector, vector, vector, vector, vector]:
        arm = turns_i * hold.arm
        L = L_0_i + twisted_sum_i - wp.cross(arm, pulled_sum_i)
        W = spin(turns_i, inertia, inverse, L, hold) / density_i
        V = V_0_i + time_step_i * gravity_i + pulled_sum_i / (density_i * volume)
        V = wp.cw_mul(hold.moving, V) - wp.cross(W, arm)
        return V, L, W, V - V_0_i, W - W_0_i

    return pointwise_kernels(
        precision,
        [free_module(precision)] * 3,
        lambda _: move,
        ["V", "L", "W", "faster", "turned_faster"],
        numbers=["volume", "inertia", "inverse", "hold"],
        written=["pulled_sum", "twisted_sum"],
        told=["gravity"],
        turned={"turns": "turned"},
    )
