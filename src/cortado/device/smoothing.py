"""The smoothing kernels of `cortado.lattice.smoothing` as Warp functions, with their gradients and Hessians:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,    H u = (sigma / h^2) (f(q) u + (f'(q) / q) (s . u) s),

with q = r / h, s = x / h and f(q) = w'(q) / q.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.lattice.smoothing import CUBIC_SPLINE, WENDLAND_C2, WENDLAND_C4, SmoothingKernel


@dataclass(frozen=True)
class RadialFunctions:
    """Warp functions of a kernel's dimensionless form: w, f = w' / q, which its gradient needs, and f', its Hessian."""

    value: Any
    gradient_factor: Any
    hessian_factor: Any


def _cubic_spline(precision: Precision) -> RadialFunctions:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(6.0) * q * q * (q - real(1.0)) + real(1.0)
        return real(2.0) * t * t * t

    @wp.func
    def gradient_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(18.0) * q - real(12.0)
        return real(-6.0) * t * t / q

    @wp.func
    def hessian_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(18.0)
        return real(6.0) * t * (real(2.0) * q + t) / (q * q)

    return RadialFunctions(value=value, gradient_factor=gradient_factor, hessian_factor=hessian_factor)


def _wendland_c2(precision: Precision) -> RadialFunctions:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return t * t * t * t * (real(1.0) + real(4.0) * q)

    @wp.func
    def gradient_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(-20.0) * t * t * t

    @wp.func
    def hessian_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(60.0) * t * t

    return RadialFunctions(value=value, gradient_factor=gradient_factor, hessian_factor=hessian_factor)


def _wendland_c4(precision: Precision) -> RadialFunctions:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return t_2 * t_2 * t_2 * (real(1.0) + real(6.0) * q + (real(35.0) / real(3.0)) * q * q)

    @wp.func
    def gradient_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return (real(-56.0) / real(3.0)) * (real(1.0) + real(5.0) * q) * t_2 * t_2 * t

    @wp.func
    def hessian_factor(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return real(560.0) * q * t_2 * t_2

    return RadialFunctions(value=value, gradient_factor=gradient_factor, hessian_factor=hessian_factor)


RADIAL_FUNCTIONS = {
    CUBIC_SPLINE.name: _cubic_spline,
    WENDLAND_C2.name: _wendland_c2,
    WENDLAND_C4.name: _wendland_c4,
}
"""By the kernel's name: for a precision, ``value`` w, ``gradient_factor`` f and ``hessian_factor`` f'."""


@dataclass(frozen=True)
class SmoothingFunctions:
    """Warp functions of W at a separation, of its gradient, and of its Hessian times a vector."""

    weight: Any
    gradient: Any
    hessian_product: Any


@cache
def smoothing_functions(kernel: SmoothingKernel, precision: Precision) -> SmoothingFunctions:
    """Warp functions of a separation x [m]: ``weight``, ``gradient`` and ``hessian_product`` (H u).

    Each takes the support radius h [m] and the normalisation sigma [1 / m^d].
    """
    real, vector = precision.real, precision.vector
    radial = RADIAL_FUNCTIONS[kernel.name](precision)
    value, gradient_factor, hessian_factor = radial.value, radial.gradient_factor, radial.hessian_factor
    tiny = wp.constant(real(precision.tiny))

    @wp.func
    def weight(x: vector, h: real, sigma: real) -> real:
        return sigma * value(wp.length(x) / h)

    @wp.func
    def gradient(x: vector, h: real, sigma: real) -> vector:
        return (sigma / (h * h) * gradient_factor(wp.length(x) / h)) * x

    @wp.func
    def hessian_product(x: vector, u: vector, h: real, sigma: real) -> vector:
        q = wp.length(x) / h
        # tiny guards coincident particles: there s = 0, the second term is 0 and H = W''(0) I, as it should be.
        radial_part = hessian_factor(q) / ((q + tiny) * h * h) * wp.dot(x, u)
        return (sigma / (h * h)) * (gradient_factor(q) * u + radial_part * x)

    return SmoothingFunctions(weight=weight, gradient=gradient, hessian_product=hessian_product)
