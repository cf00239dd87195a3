"""What a particle sees: its neighbours and the walls, as one argument of every kernel that sums over them."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import kind_of
from cortado.device.lanes import set_lanes
from cortado.device.precision import Precision
from cortado.device.smoothing import smoothing_functions
from cortado.lattice.smoothing import SmoothingKernel

UNROLL = 4
"""Fluid neighbours that a loop takes at a time, so that their loads overlap; lists are filled up to a multiple of it
with the particle itself, which adds nothing to a sum but W(0) to the density's."""


@dataclass(frozen=True)
class Discretisation:
    """A smoothing kernel in a precision: what a kernel factory is asked for."""

    smoothing: SmoothingKernel
    precision: Precision
    lanes: int = 1
    """Threads for each particle, in kernels that are made for them: see `cortado.device.lanes`."""
    taped: bool = False
    """Whether a tape can differentiate the forward kernels: they get Warp's own adjoint, which takes one lane."""

    def module(self, forward: bool, topic: str = "pcisph") -> Any:
        """The Warp module of forward kernels, or of those of the adjoint; `tangent_module` has the others."""
        return self._module(kind_of(forward, self.taped), topic, forward and self.taped)

    def tangent_module(self, topic: str = "pcisph") -> Any:
        """The Warp module of the kernels of forward mode, which no gradient needs."""
        return self._module("tangent", topic, False)

    def _module(self, kind: str, topic: str, enable_backward: bool) -> Any:
        beside = "" if self.lanes == 1 else f"_{self.lanes}_lanes"
        module = wp.get_module(f"cortado_{topic}_{kind}_{self.smoothing.name}_{self.precision.name}{beside}")
        module.options["enable_backward"] = enable_backward
        set_lanes(module, self.lanes)
        return module


@cache
def neighbourhood_type(precision: Precision) -> Any:
    """The Warp struct of one precision; arrays are sorted by cell, lists are [neighbour, particle]."""
    real, vector = precision.real, precision.vector

    class Neighbourhood:
        first: wp.int32
        """Particle of a launch's first thread: a launch may be cut into ranges of particles."""
        part: wp.int32
        """Number of the range."""
        particles: wp.int32
        """Of one scene: particle i belongs to scene i // particles of a batch."""
        neighbours: wp.array2d(dtype=wp.int32)
        """First the fluid neighbours of a particle, filled up with itself, then its wall neighbours."""
        fluid_count: wp.array(dtype=wp.int32)
        """Of the filled list, a multiple of `UNROLL`."""
        filling: wp.array(dtype=wp.int32)
        """How many of them are the particle itself."""
        count: wp.array(dtype=wp.int32)
        wall_positions: wp.array(dtype=vector)
        """[m]"""
        wall_weights: wp.array(dtype=real)
        """w_b [-]: what a wall particle counts for in the density, a fluid particle being 1."""
        support: real
        """Support radius h [m]."""
        reach: real
        """Neighbours are listed up to this distance [m], a little beyond the support."""
        normalisation: real
        """sigma of the kernel [1 / m^d]."""
        self_weight: real
        """W(0) [1 / m^d]."""
        response_scale: real
        """(sum_j G_j . G_j)^(-1/2) of a filled neighbourhood [m^(d + 1)], for the relaxation beside walls."""
        laplacian_correction: real
        """What second derivatives are multiplied with [-], see `cortado.lattice.calibration`."""
        volume: real
        """Volume V of a particle on the rest lattice [m^d]: with it that lattice has the rest density."""
        periodic: wp.int32
        period: vector
        """[m], 0 along an axis that is not periodic."""
        frequency: vector
        """1 / period [1 / m], or 0."""

    Neighbourhood.__qualname__ = f"Surroundings_{precision.name}"
    Neighbourhood.__name__ = Neighbourhood.__qualname__
    return wp.struct(Neighbourhood)


@dataclass(frozen=True)
class PairFunctions:
    """Warp functions of a pair of particles: see `pair_functions`."""

    separation: Any
    weight: Any
    gradient: Any
    hessian_product: Any
    size: Any
    factor: Any
    factor_gradient: Any
    vectors: Any
    numbers: Any


@cache
def pair_functions(discretisation: Discretisation) -> PairFunctions:
    """Warp functions of a separation in given neighbourhood.

    ``separation``, ``weight``, ``gradient``, ``hessian_product``; ``size`` (|x|^2 + 0.01 h^2, which covers coincident
    particles), ``factor`` (F = laplacian_correction x . G / size, of second derivatives after Brookshaw 1985) and
    ``factor_gradient``;
    and ``vectors`` and ``numbers``, which load what `UNROLL` neighbours have before any of it is used, so that the
    loads do not wait for one another (on a GPU a tenth of a whole step).
    """
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    smooth = smoothing_functions(discretisation.smoothing, discretisation.precision)
    smooth_weight, smooth_gradient = smooth.weight, smooth.gradient
    smooth_hessian_product = smooth.hessian_product
    rows = wp.types.matrix(shape=(UNROLL, 3), dtype=real)
    row = wp.types.vector(length=UNROLL, dtype=real)

    @wp.func
    def separation(x_i: vector, x_j: vector, s: neighbourhood) -> vector:
        """x_i - x_j, of the nearest image."""
        x_ij = x_i - x_j
        if s.periodic != 0:
            turns = vector(
                wp.round(x_ij[0] * s.frequency[0]),
                wp.round(x_ij[1] * s.frequency[1]),
                wp.round(x_ij[2] * s.frequency[2]),
            )
            return x_ij - wp.cw_mul(turns, s.period)
        return x_ij

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        return smooth_weight(x, s.support, s.normalisation)

    @wp.func
    def gradient(x: vector, s: neighbourhood) -> vector:
        return smooth_gradient(x, s.support, s.normalisation)

    @wp.func
    def hessian_product(x: vector, u: vector, s: neighbourhood) -> vector:
        return smooth_hessian_product(x, u, s.support, s.normalisation)

    @wp.func
    def size(x: vector, s: neighbourhood) -> real:
        return wp.dot(x, x) + real(0.01) * s.support * s.support

    @wp.func
    def factor(x: vector, s: neighbourhood) -> real:
        return s.laplacian_correction * wp.dot(x, gradient(x, s)) / size(x, s)

    @wp.func
    def factor_gradient(x: vector, s: neighbourhood) -> vector:
        d = size(x, s)
        g = gradient(x, s)
        return (s.laplacian_correction / d) * (g + hessian_product(x, x, s) - (real(2.0) * wp.dot(x, g) / d) * x)

    @wp.func
    def vectors(a: wp.array(dtype=vector), k: int, i: int, s: neighbourhood) -> rows:
        return wp.matrix_from_rows(
            a[s.neighbours[k, i]], a[s.neighbours[k + 1, i]], a[s.neighbours[k + 2, i]], a[s.neighbours[k + 3, i]]
        )

    @wp.func
    def numbers(a: wp.array(dtype=real), k: int, i: int, s: neighbourhood) -> row:
        return row(
            a[s.neighbours[k, i]], a[s.neighbours[k + 1, i]], a[s.neighbours[k + 2, i]], a[s.neighbours[k + 3, i]]
        )

    return PairFunctions(
        separation=separation,
        weight=weight,
        gradient=gradient,
        hessian_product=hessian_product,
        size=size,
        factor=factor,
        factor_gradient=factor_gradient,
        vectors=vectors,
        numbers=numbers,
    )
