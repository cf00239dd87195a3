"""Smoothing kernels W(r; h) of compact support h, their gradients and Hessians.

With q = r / h, s = x / h and the normalisation sigma [1 / m^d]:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,    H u = (sigma / h^2) (f(q) u + (f'(q) / q) (s . u) s),

where f(q) = w'(q) / q is finite at q = 0 for every kernel here, so that no direction is needed at r = 0.
Cubic spline: Monaghan (1992). Wendland C2 and C4: Dehnen and Aly (2012).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import pi
from types import SimpleNamespace

import numpy as np
import warp as wp

from cortado.errors import InputError
from cortado.precision import Precision


@dataclass(frozen=True)
class SmoothingKernel:
    """A radial kernel in the dimensionless form w(q), 0 <= q <= 1."""

    name: str
    normalisations: tuple[float, float]
    """sigma h^d in two and in three dimensions."""
    value: Callable[[np.ndarray], np.ndarray]
    """w(q)."""
    slope: Callable[[np.ndarray], np.ndarray]
    """f(q) = w'(q) / q."""
    functions: Callable[[Precision], SimpleNamespace]
    """Warp functions ``value``, ``slope`` and ``bend`` (w, f and f')."""

    def normalisation(self, dimension: int, support: float) -> float:
        """sigma [1 / m^d] for a support radius [m]."""
        return self.normalisations[dimension - 2] / support**dimension

    def weight(self, distance: np.ndarray, dimension: int, support: float) -> np.ndarray:
        """W [1 / m^d] at distances [m], any shape."""
        q = np.minimum(np.asarray(distance, dtype=np.float64) / support, 1.0)
        return self.normalisation(dimension, support) * self.value(q)

    def gradient(self, separation: np.ndarray, support: float) -> np.ndarray:
        """grad W [1 / m^(d+1)] at separations (n, d) [m]."""
        q = np.minimum(np.linalg.norm(separation, axis=-1, keepdims=True) / support, 1.0)
        return self.normalisation(separation.shape[-1], support) / support**2 * self.slope(q) * separation


def _cubic_spline(precision: Precision) -> SimpleNamespace:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(6.0) * q * q * (q - real(1.0)) + real(1.0)
        return real(2.0) * t * t * t

    @wp.func
    def slope(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(18.0) * q - real(12.0)
        return real(-6.0) * t * t / q

    @wp.func
    def bend(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        if q <= real(0.5):
            return real(18.0)
        return real(6.0) * t * (real(2.0) * q + t) / (q * q)

    return SimpleNamespace(value=value, slope=slope, bend=bend)


def _wendland_c2(precision: Precision) -> SimpleNamespace:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return t * t * t * t * (real(1.0) + real(4.0) * q)

    @wp.func
    def slope(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(-20.0) * t * t * t

    @wp.func
    def bend(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        return real(60.0) * t * t

    return SimpleNamespace(value=value, slope=slope, bend=bend)


def _wendland_c4(precision: Precision) -> SimpleNamespace:
    real = precision.real

    @wp.func
    def value(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return t_2 * t_2 * t_2 * (real(1.0) + real(6.0) * q + (real(35.0) / real(3.0)) * q * q)

    @wp.func
    def slope(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return (real(-56.0) / real(3.0)) * (real(1.0) + real(5.0) * q) * t_2 * t_2 * t

    @wp.func
    def bend(q: real) -> real:
        t = wp.max(real(1.0) - q, real(0.0))
        t_2 = t * t
        return real(560.0) * q * t_2 * t_2

    return SimpleNamespace(value=value, slope=slope, bend=bend)


CUBIC_SPLINE = SmoothingKernel(
    "cubic_spline",
    (40 / (7 * pi), 8 / pi),
    lambda q: np.where(q <= 0.5, 6 * q * q * (q - 1) + 1, 2 * (1 - q) ** 3),
    lambda q: np.where(q <= 0.5, 18 * q - 12, -6 * (1 - q) ** 2 / np.maximum(q, 0.5)),
    _cubic_spline,
)
WENDLAND_C2 = SmoothingKernel(
    "wendland_c2",
    (7 / pi, 21 / (2 * pi)),
    lambda q: (1 - q) ** 4 * (1 + 4 * q),
    lambda q: -20 * (1 - q) ** 3,
    _wendland_c2,
)
WENDLAND_C4 = SmoothingKernel(
    "wendland_c4",
    (9 / pi, 495 / (32 * pi)),
    lambda q: (1 - q) ** 6 * (1 + 6 * q + 35 / 3 * q**2),
    lambda q: -56 / 3 * (1 + 5 * q) * (1 - q) ** 5,
    _wendland_c4,
)
KERNELS = {kernel.name: kernel for kernel in (CUBIC_SPLINE, WENDLAND_C2, WENDLAND_C4)}


def smoothing_kernel(name: str) -> SmoothingKernel:
    """The kernel of that name; raises `InputError` where there is none."""
    if name not in KERNELS:
        raise InputError(f"kernel is {name!r}, but must be one of {', '.join(KERNELS)}.")
    return KERNELS[name]


@cache
def smoothing_functions(kernel: SmoothingKernel, precision: Precision) -> SimpleNamespace:
    """Warp functions of a separation x [m]: ``weight``, ``gradient`` and ``hessian_product`` (H u).

    Each takes the support radius h [m] and the normalisation sigma [1 / m^d].
    """
    real, vector = precision.real, precision.vector
    radial = kernel.functions(precision)
    value, slope, bend = radial.value, radial.slope, radial.bend
    tiny = wp.constant(real(precision.tiny))

    @wp.func
    def weight(x: vector, h: real, sigma: real) -> real:
        return sigma * value(wp.length(x) / h)

    @wp.func
    def gradient(x: vector, h: real, sigma: real) -> vector:
        return (sigma / (h * h) * slope(wp.length(x) / h)) * x

    @wp.func
    def hessian_product(x: vector, u: vector, h: real, sigma: real) -> vector:
        q = wp.length(x) / h
        # tiny guards coincident particles: there s = 0, the second term is 0 and H = W''(0) I, as it should be.
        radial_part = bend(q) / ((q + tiny) * h * h) * wp.dot(x, u)
        return (sigma / (h * h)) * (slope(q) * u + radial_part * x)

    return SimpleNamespace(weight=weight, gradient=gradient, hessian_product=hessian_product)
