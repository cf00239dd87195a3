"""What an iteration of the pressure wants of a particle, and which of its slopes it has: see
`cortado.solvers.projection.pressure`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


@dataclass(frozen=True)
class ClampFunctions:
    """Warp functions of one particle."""

    wanted: Any
    """b of n, f and dt."""
    wanted_tangent: Any
    """Its tangent, given each of them with its own."""
    parts: Any
    """The parts of two slopes that k' has."""


@cache
def clamp_functions(precision: Precision) -> ClampFunctions:
    """In a precision."""
    real = precision.real

    @wp.func
    def wanted(n: real, full: real, dt: real) -> real:
        """b"""
        return (real(1.0) - full) * wp.max(real(1.0) - n, real(0.0)) / dt

    @wp.func
    def wanted_tangent(n: real, n_dot: real, full: real, full_dot: real, dt: real, dt_dot: real) -> real:
        found = -wanted(n, full, dt) * dt_dot / dt
        if n < real(1.0):
            found -= ((real(1.0) - full) * n_dot + full_dot * (real(1.0) - n)) / dt
        return found

    @wp.func
    def parts(up: real, down: real):
        """How much of the slopes of z+ and of sigma z- k' has: all of one of them, or at a corner the mean of both
        sides. Fluid that moves as a whole is on the corner z+ = z- = 0 everywhere, and inside sigma is 1, so that
        there is no corner but in this formula."""
        rise, fall = real(0.0), real(0.0)
        if up > real(0.0):
            rise = real(1.0)
        elif up == real(0.0):
            rise = real(0.5)
        if up <= real(0.0):
            if down < real(0.0):
                fall = real(1.0)
            elif down == real(0.0):
                fall = real(0.5)
        return rise, fall

    return ClampFunctions(wanted, wanted_tangent, parts)
