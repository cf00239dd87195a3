"""The smoothing kernels of `cortado.discretise.smoothing` as Warp functions, with their gradients and Hessians:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,    H u = (sigma / h^2) (f(q) u + (f'(q) / q) (s . u) s),

with the kernel W, its Hessian H, the normalisation sigma, the separation x, the distance r, the support radius h and
any vector u. The ratios are q = r / h, s = x / h and f(q) = w'(q) / q. The functions avoid divisions, which are slow on
GPUs.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name
from cortado.device.precision import Precision, arithmetic
from cortado.discretise.smoothing import CUBIC_SPLINE, WENDLAND_C2, WENDLAND_C4, SmoothingKernel

Radial = tuple[Any, Any, Any]
"""Warp functions of a smoothing kernel: its value, and the radial factors of its gradient and its Hessian."""


def _cubic_spline(precision: Precision) -> Radial:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return wp.where(q <= real(0.5), real(6.0) * q * q * (q - real(1.0)) + real(1.0), real(2.0) * t * t * t)

    @wp.func
    def gradient_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return wp.where(q <= real(0.5), real(18.0) * q - real(12.0), real(-6.0) * t * t * per_q)

    @wp.func
    def hessian_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return wp.where(q <= real(0.5), real(18.0), real(6.0) * t * (real(2.0) * q + t) * per_q * per_q) * per_q

    return value, gradient_factor, hessian_factor


def _wendland_c2(precision: Precision) -> Radial:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return t * t * t * t * (real(1.0) + real(4.0) * q)

    @wp.func
    def gradient_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(-20.0) * t * t * t

    @wp.func
    def hessian_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(60.0) * t * t * per_q

    return value, gradient_factor, hessian_factor


def _wendland_c4(precision: Precision) -> Radial:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return t_2 * t_2 * t_2 * (real(1.0) + real(6.0) * q + (real(35.0) / real(3.0)) * q * q)

    @wp.func
    def gradient_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return (real(-56.0) / real(3.0)) * (real(1.0) + real(5.0) * q) * t_2 * t_2 * t

    @wp.func
    def hessian_factor(q: real, per_q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return real(560.0) * t_2 * t_2

    return value, gradient_factor, hessian_factor


RADIAL_FUNCTIONS = {
    CUBIC_SPLINE.name: _cubic_spline,
    WENDLAND_C2.name: _wendland_c2,
    WENDLAND_C4.name: _wendland_c4,
}


@cache
def smoothing_functions(kernel: SmoothingKernel, precision: Precision, taped: bool = False) -> SimpleNamespace:
    """The functions take a separation x [m], the inverse support radius [1/m] and the normalisation [1 / m^d].
    ``slope`` is the factor a in the kernel's gradient a x. ``slope_change`` is the derivative of a along a vector u.
    Warp's tape can differentiate ``taped`` functions."""
    real, vector = precision.real, precision.vector
    value, gradient_factor, hessian_factor = RADIAL_FUNCTIONS[kernel.name](precision)
    functions = arithmetic(precision, taped)
    root, inverse_root = functions.root, functions.inverse_root
    tiny = wp.constant(real(precision.tiny))

    @wp.func
    def square(x: vector, per_h: real) -> real:
        """A tiny number is added, so that the result for x = 0 has a finite reciprocal."""
        return wp.dot(x, x) * (per_h * per_h) + tiny

    @wp.func
    def weight(x: vector, per_h: real, sigma: real) -> real:
        return sigma * value(root(square(x, per_h)))

    @wp.func
    def slope(x: vector, per_h: real, sigma: real) -> real:
        q_2 = square(x, per_h)
        per_q = inverse_root(q_2)
        return sigma * (per_h * per_h) * gradient_factor(q_2 * per_q, per_q)

    @wp.func
    def slope_change(x: vector, u: vector, per_h: real, sigma: real) -> real:
        q_2 = square(x, per_h)
        per_q = inverse_root(q_2)
        # the parentheses avoid 1 / h^4, which overflows for small spacings
        return sigma * (per_h * per_h) * hessian_factor(q_2 * per_q, per_q) * (per_h * per_h * wp.dot(x, u))

    @wp.func
    def slope_gradient(x: vector, per_h: real, sigma: real) -> vector:
        q_2 = square(x, per_h)
        per_q = inverse_root(q_2)
        return (sigma * (per_h * per_h) * hessian_factor(q_2 * per_q, per_q) * (per_h * per_h)) * x

    @wp.func
    def gradient(x: vector, per_h: real, sigma: real) -> vector:
        return slope(x, per_h, sigma) * x

    return by_name(weight, slope, slope_change, slope_gradient, gradient)
