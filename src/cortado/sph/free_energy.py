"""Helmholtz free energies F(c) = alpha f(c) of a mixture, and how mobile its phases are (Yang et al. 2015).

    double well  f = sum_k c_k^2 (1 - c_k)^2 / 2: phases separate, into pure ones (Lee and Kim 2015)
    miscible     f = sum_k c_k^2 / 2: phases mix, by Fick's law

    constant     m = 1
    degenerate   m = (z + sqrt(z^2 + delta^2)) / 2,   z = sum_(k<l) c_k c_l: where phases touch

For two phases the double well is c_1^2 c_2^2. The other generalisation, sum_(k < l) c_k^2 c_l^2, pulls a third phase
into the interface of two, and lets equal parts of three or more stay mixed.

delta keeps the mobility positive, and smooth, where a fraction strays out of [0, 1]: a negative one would feed the
excursion. It leaves a pure phase delta / 2, and z <= 1 / 4 for two phases is hardly touched.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_one_number, require_function
from cortado.calls import public
from cortado.code_words import code_words
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.sph.formula import compiled

FLOOR = 1e-3
"""delta of the degenerate mobility."""


@public
@dataclass(frozen=True)
class FreeEnergy:
    """A free energy f(c) of mass fractions c (phases,), for kernels and for NumPy. Users may make their own."""

    name: str
    """Name that tells kernels of one energy from those of another."""
    value: Callable[[np.ndarray], np.ndarray]
    """Function f of fractions (n, phases) -> (n,)."""
    curvature: float
    """The greatest eigenvalue of the Hessian of f, without its part along (1, ..., 1), for fractions in [0, 1]: it
    bounds the time step."""
    functions: Callable[[Precision, int], Any]
    """Warp functions of fractions, for a number of phases: ``gradient`` (grad f) and ``hessian_product`` (H u)."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InputError(f"FreeEnergy has the name {shown(self.name)}, but must have a text.")
        require_function(f"FreeEnergy {self.name}'s value", self.value, "fractions (n, phases)")
        require_function(f"FreeEnergy {self.name}'s functions", self.functions, "a precision", "a number of phases")
        if not 0.0 <= as_one_number(f"FreeEnergy {self.name}'s curvature", self.curvature) < np.inf:
            raise InputError(f"FreeEnergy {self.name}'s curvature is {self.curvature}, but must be at least 0.")

    def check(self, precision: Precision, phases: int, device: Any) -> None:
        """Raise `InputError` where the energy's ``functions`` fail, or return no functions of so many fractions."""
        what = f"FreeEnergy {self.name}'s functions"
        try:
            found = self.functions(precision, phases)
        except Exception as problem:
            reason = " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".")
            raise InputError(f"{what} fail: {reason}.") from problem
        for name in ("gradient", "hessian_product"):
            if not isinstance(given := getattr(found, name, None), wp.Function):
                wanted = "an object whose gradient and hessian_product are functions under wp.func"
                raise InputError(f"{what} must return {wanted}, but its {name} is {shown(given)}.")
        fractions, module = precision.fractions(phases), kernel_module(f"free_energy_{code_words(self.functions)}")
        gradient, hessian_product = found.gradient, found.hessian_product

        @wp.kernel(module=module)
        def trial(c: wp.array(dtype=fractions), found: wp.array(dtype=fractions)):
            i = wp.tid()
            found[i] = gradient(c[i]) + hessian_product(c[i], c[i])

        compiled(what, module, device, f"vector of {phases} fractions")


@dataclass(frozen=True)
class Mobility:
    """A mobility m(c) of mass fractions, from 0 to 1."""

    name: str
    greatest: Callable[[int], float]
    """The greatest m of so many phases."""
    functions: Callable[[Precision, int], Any]
    """Warp functions ``value`` and ``gradient`` (grad m) of fractions."""


@cache
def _double_well(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)

    @wp.func
    def gradient(c: fractions) -> fractions:
        squares = wp.cw_mul(c, c)
        return c - real(3.0) * squares + real(2.0) * wp.cw_mul(squares, c)

    @wp.func
    def hessian_product(c: fractions, u: fractions) -> fractions:
        return u - real(6.0) * wp.cw_mul(c, u) + real(6.0) * wp.cw_mul(wp.cw_mul(c, c), u)

    return by_name(gradient, hessian_product)


@cache
def _miscible(precision: Precision, phases: int) -> SimpleNamespace:
    fractions = precision.fractions(phases)

    @wp.func
    def gradient(c: fractions) -> fractions:
        return c

    @wp.func
    def hessian_product(c: fractions, u: fractions) -> fractions:
        return u

    return by_name(gradient, hessian_product)


@cache
def _constant(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)

    @wp.func
    def value(c: fractions) -> real:
        return real(1.0)

    @wp.func
    def gradient(c: fractions) -> fractions:
        return fractions()

    return by_name(value, gradient)


@cache
def _degenerate(precision: Precision, phases: int) -> SimpleNamespace:
    real, fractions = precision.real, precision.fractions(phases)
    floor = wp.constant(real(FLOOR))

    @wp.func
    def total(c: fractions) -> real:
        t = real(0.0)
        for k in range(wp.static(phases)):
            t += c[k]
        return t

    @wp.func
    def products(c: fractions) -> real:
        """Return sum_(k < l) c_k c_l over all pairs of phases."""
        t = total(c)
        return real(0.5) * (t * t - wp.dot(c, c))

    @wp.func
    def value(c: fractions) -> real:
        z = products(c)
        return real(0.5) * (z + wp.sqrt(z * z + floor * floor))

    @wp.func
    def gradient(c: fractions) -> fractions:
        z = products(c)
        t = total(c)
        along = fractions()
        for k in range(wp.static(phases)):
            along[k] = t - c[k]
        return (real(0.5) + real(0.5) * z / wp.sqrt(z * z + floor * floor)) * along

    return by_name(value, gradient)


def _double_well_value(c: np.ndarray) -> np.ndarray:  # a lambda would not be pickled
    return np.asarray(0.5 * (c**2 * (1.0 - c) ** 2).sum(1))


def _miscible_value(c: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (c**2).sum(1))


DOUBLE_WELL = FreeEnergy("double_well", _double_well_value, curvature=1.0, functions=_double_well)
MISCIBLE = FreeEnergy("miscible", _miscible_value, curvature=1.0, functions=_miscible)
FREE_ENERGIES = {energy.name: energy for energy in (DOUBLE_WELL, MISCIBLE)}

CONSTANT = Mobility("constant", lambda phases: 1.0, _constant)
DEGENERATE = Mobility("degenerate", lambda phases: 0.5 * (phases - 1) / phases, _degenerate)
MOBILITIES = {mobility.name: mobility for mobility in (CONSTANT, DEGENERATE)}
