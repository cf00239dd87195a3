"""Constants of surface tension by curvature (`cortado.sph.curvature_kernels`), from surfaces whose curvature is known.

J is that of flat surfaces: a lattice is cut across an axis and across a diagonal of a plane. In a layer all particles
are alike, so that the sums of a few layers are all that it takes.

What delta has to make up for was found on discs and balls whose particles lie in concentric rings and shells, a spacing
apart. It is in spacings, for every kernel with a support of 2.5 spacings or more within 0.05. The curvature is found
`DEEP` below the surface, where it is greater. And w |q| adds up to 1 + `EXCESS` / R times J, as more of what surrounds
a particle is outside of a curved surface. With delta = DEEP / (d - 1) + EXCESS, d - 1 being the number of curvatures in
the sum, the pressure in a drop is (d - 1) sigma / R. But the force acts `ACTS` below the surface, where a wave of the
surface moves less: the square of the frequency of the mode n would be n ACTS / R too small in the plane, and (n + 1)
ACTS / R in space. A smaller delta raises pressures, and twice as much the force that a change of the curvature makes.
So ACTS d / (3 (d - 1)) is taken off. Pressure and squared frequency of the mode 2 then err by as much, one to this side
and one to that: by 0.5 / R in the plane and 0.75 / R in space, which gets less where particles are finer.

Functions of Warp for these sums, and for what follows from them, are here too.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision, TypesByName
from cortado.discretise.calibration import lattice_offsets, rest_volume
from cortado.discretise.smoothing import SmoothingKernel
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum, tangent_of
from cortado.sph.moment_functions import cross_terms_function, matrix_type, moment_functions

DEEP, EXCESS, ACTS = 1.05, 0.6, 0.75
"""In spacings, see above."""


@dataclass(frozen=True)
class CurvatureConstants:
    """The constants of surface tension by curvature for a smoothing kernel and a particle spacing."""

    spacing: float
    """[m]"""
    width: float
    """J [-]"""
    depth: float
    """delta [m]"""

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> "CurvatureConstants":
        """Compute the constants on a lattice with a spacing [m], for a support radius [m]."""
        width = float(np.mean([_width(kernel, support / spacing, dimension, cut) for cut in ((1, 0), (1, 1))]))
        shared = ACTS * dimension / (3.0 * (dimension - 1))
        return cls(spacing, width, spacing * (DEEP / (dimension - 1) + EXCESS - shared))


def _indicator(size: np.ndarray) -> np.ndarray:
    """Return w, how much a particle is part of the surface, from s |q|: 0 below `FAINT`, 1 above `CLEAR`."""
    t = np.clip((size - FAINT) / (CLEAR - FAINT), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@cache
def _width(kernel: SmoothingKernel, support: float, dimension: int, cut: tuple[int, int]) -> float:
    """Return J of a surface cut across a direction in the plane of the first two axes, for a support in spacings."""
    offsets, volume = lattice_offsets(1.0, support, dimension), rest_volume(kernel, 1.0, support, dimension)
    apart = 1.0 / float(np.linalg.norm(cut))
    weights = volume * kernel.weight(np.linalg.norm(offsets, axis=1), dimension, support)
    upwards = offsets[:, :2] @ np.array(cut)
    slopes = volume * kernel.gradient(offsets, support)[:, :2] @ np.array(cut) * apart
    layers = 2 * int(support / apart) + 3
    above = np.arange(layers)[:, None] - np.rint(upwards).astype(int)[None, :]  # layer of each neighbour of a layer
    inside, place = above >= 0, np.clip(above, 0, 2 * layers)
    g = np.append((inside * slopes).sum(axis=1), np.zeros(layers + 1))
    q = (inside * weights * g[place]).sum(axis=1) / (inside * weights).sum(axis=1)
    return float((_indicator(np.abs(q)) * np.abs(q)).sum() * apart)


FAINT, CLEAR = 0.03, 0.1
"""s |q| below which a particle is no part of the surface, and above which all of it is."""
SINGULAR = {2: 1e-3, 3: 1e-4}
"""By dimension, the number added to det B: neighbours may lie on a line, or be missing. There kappa is 0."""
LONE = 1e-6
"""The number added to sum V W w: where no neighbour is part of the surface, the mean curvature is 0."""
HOLLOW = 0.25
"""delta kappa below which the depth of a hollow surface counts less, in a parabola, until it counts no more: bubbles of
a radius below 3 delta, which the divisor 1 + delta kappa would be 0 in."""


@cache
def curvature_functions(precision: Precision, dimension: int, module: Any) -> SimpleNamespace:
    """Make the Warp functions of one particle for the normal and the curvature of a surface, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    smoothstep = moment_functions(precision, dimension).smoothstep
    faint, clear = wp.constant(real(FAINT)), wp.constant(real(CLEAR))
    singular, lone, hollow = wp.constant(real(SINGULAR[dimension])), wp.constant(real(LONE)), wp.constant(real(HOLLOW))

    @wp.func
    def normal(q: vector, spacing: real):
        """Return the surface indicator w and the unit normal e of a particle; e is 0 where w is 0."""
        size, w, e = wp.length(q), real(0.0), vector()
        if size * spacing > faint:
            w = smoothstep(size * spacing, faint, clear)
            e = q / size
        return w, e

    @wp.func(module=module)
    def normal_work(q: vector, spacing: real, w_bar: real, e_bar: vector) -> real:
        """Return w w_bar + e . e_bar. Its gradient by q is the adjoint of q; with 0 for w_bar it is also the change of
        e along e_bar, as that is symmetric."""
        w, e = normal(q, spacing)
        return w * w_bar + wp.dot(e, e_bar)

    @wp.func(module=module)
    def curvature(B: matrix, D: matrix) -> real:
        """Return the curvature kappa = -tr(B^-1 D), by cofactors."""
        a = B[1, 1] * B[2, 2] - B[1, 2] * B[2, 1]
        b = B[0, 2] * B[2, 1] - B[0, 1] * B[2, 2]
        c = B[0, 1] * B[1, 2] - B[0, 2] * B[1, 1]
        e = B[0, 0] * B[2, 2] - B[0, 2] * B[2, 0]
        f = B[0, 2] * B[1, 0] - B[0, 0] * B[1, 2]
        h = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
        part = a * D[0, 0] + e * D[1, 1] + h * D[2, 2] + b * (D[0, 1] + D[1, 0])
        part += c * (D[0, 2] + D[2, 0]) + f * (D[1, 2] + D[2, 1])
        return -part / (B[0, 0] * a + B[1, 0] * b + B[2, 0] * c + singular)

    @wp.func(module=module)
    def outermost(a: real, b: real, depth: real) -> real:
        """Return the curvature k at the surface."""
        mean = a / (b + lone)
        more = depth * mean
        rest = wp.clamp(real(3.0) * hollow + more, real(0.0), real(2.0) * hollow)
        divisor = real(1.0) - real(2.0) * hollow + rest * rest / (real(4.0) * hollow) + wp.max(more + hollow, real(0.0))
        return mean / divisor

    return by_name(normal, normal_work, curvature, outermost)


@cache
def curvature_sums(discretisation: Discretisation) -> SimpleNamespace:
    """Make the Warp functions of the curvature's sums over the fluid, with derivatives. Symmetric matrices are
    diagonals and entries yz, xz, xy.

    ``colour``: g and z, without W(0). ``average``: V sum W_ij g_j. ``bend``: B and the symmetric part of D. ``mean``:
    V sum W_ij c_j and V sum W_ij w_j."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    neighbourhood, matrix = neighbourhood_type(precision), matrix_type(precision)
    pair, cross_terms = pair_functions(discretisation), cross_terms_function(precision)
    weight, slope, gradient, hessian_product = pair.weight, pair.slope, pair.gradient, pair.hessian_product

    typed = TypesByName(real, {vector: "x e g r", neighbourhood: "s", matrix: "B D"})

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
        """Return the entries yz, xz and xy of the symmetric matrix (a b^T + b a^T) / 2."""
        return real(0.5) * (cross_terms(a, b) + cross_terms(b, a))

    @fluid_sum(discretisation)
    def colour(x_ij: vector, s: neighbourhood) -> tuple[vector, real]:
        return s.volume * gradient(x_ij, s), s.volume * weight(x_ij, s)

    @tangent_of(colour)
    @fluid_sum(discretisation, ahead=False)
    def colour_tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> tuple[vector, real]:
        return s.volume * hessian_product(x_ij, x_dot_ij, s), s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)

    @fluid_sum(discretisation)
    def colour_back(x_ij: vector, g_bar_ij: vector, z_bar_i: real, z_bar_j: real, s: neighbourhood) -> vector:
        return s.volume * (hessian_product(x_ij, g_bar_ij, s) + (z_bar_i + z_bar_j) * gradient(x_ij, s))

    @fluid_sum(discretisation)
    def average(x_ij: vector, g_j: vector, s: neighbourhood) -> vector:
        return (s.volume * weight(x_ij, s)) * g_j

    @tangent_of(average)
    @fluid_sum(discretisation, ahead=False)
    def average_tangent(x_ij: vector, x_dot_ij: vector, g_j: vector, g_dot_j: vector, s: neighbourhood) -> vector:
        return s.volume * (weight(x_ij, s) * g_dot_j + wp.dot(gradient(x_ij, s), x_dot_ij) * g_j)

    @fluid_sum(discretisation)
    @typed
    def average_back(x_ij, g_i, g_j, r_i, r_j, s) -> tuple[vector, vector]:
        """Return a pair's terms of V sum W_ij r_j for the adjoint r of the average, and of the adjoint of x."""
        both = wp.dot(r_i, g_j) + wp.dot(r_j, g_i)
        return (s.volume * weight(x_ij, s)) * r_j, (s.volume * both) * gradient(x_ij, s)

    @fluid_sum(discretisation)
    @typed
    def bend(x_ij, e_i, e_j, w_j, s) -> tuple[vector, vector, vector, vector]:
        g = (s.volume * w_j) * gradient(x_ij, s)
        turn = e_j - e_i
        return -wp.cw_mul(g, x_ij), -cross_terms(g, x_ij), wp.cw_mul(turn, g), even_terms(turn, g)

    @tangent_of(bend)
    @fluid_sum(discretisation, ahead=False)
    @typed
    def bend_tangent(
        x_ij, x_dot_ij, e_i, e_j, e_dot_i, e_dot_j, w_j, w_dot_j, s
    ) -> tuple[vector, vector, vector, vector]:
        """Return a pair's tangents of B and D; g x^T is symmetric, and so is the sum of its tangent's two terms."""
        g = (s.volume * w_j) * gradient(x_ij, s)
        g_dot = s.volume * (w_dot_j * gradient(x_ij, s) + w_j * hessian_product(x_ij, x_dot_ij, s))
        turn, turn_dot = e_j - e_i, e_dot_j - e_dot_i
        return (
            -wp.cw_mul(g_dot, x_ij) - wp.cw_mul(g, x_dot_ij),
            -cross_terms(g_dot, x_ij) - cross_terms(g, x_dot_ij),
            wp.cw_mul(turn_dot, g) + wp.cw_mul(turn, g_dot),
            even_terms(turn_dot, g) + even_terms(turn, g_dot),
        )

    @fluid_sum(discretisation)
    @typed
    def bend_back(x_ij, e_i, e_j, w_i, w_j, B_bar_i, B_bar_j, D_bar_i, D_bar_j, s) -> tuple[vector, real, vector]:
        """Return a pair's adjoints of e, w and x; in the sums of i it has w_j, in those of j w_i as a factor."""
        g, turn = s.volume * gradient(x_ij, s), e_j - e_i
        moved = (w_j * B_bar_i + w_i * B_bar_j) * x_ij
        turned = w_j * D_bar_i + w_i * D_bar_j
        w_part = wp.dot(g, D_bar_j * turn - B_bar_j * x_ij)
        x_part = hessian_product(x_ij, turned * turn - moved, s) - slope(x_ij, s) * moved
        return -(turned * g), w_part, s.volume * x_part

    @fluid_sum(discretisation)
    def mean(x_ij: vector, c_j: real, w_j: real, s: neighbourhood) -> tuple[real, real]:
        W = s.volume * weight(x_ij, s)
        return W * c_j, W * w_j

    @tangent_of(mean)
    @fluid_sum(discretisation, ahead=False)
    @typed
    def mean_tangent(x_ij, x_dot_ij, c_j, c_dot_j, w_j, w_dot_j, s) -> tuple[real, real]:
        W, W_dot = s.volume * weight(x_ij, s), s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)
        return W_dot * c_j + W * c_dot_j, W_dot * w_j + W * w_dot_j

    @fluid_sum(discretisation)
    @typed
    def mean_back(x_ij, c_i, c_j, w_i, w_j, a_i, a_j, b_i, b_j, s) -> tuple[real, real, vector]:
        W, both = s.volume * weight(x_ij, s), a_i * c_j + a_j * c_i + b_i * w_j + b_j * w_i
        return W * a_j, W * b_j, (s.volume * both) * gradient(x_ij, s)

    return SimpleNamespace(
        colour=Kernels(colour, colour_tangent, colour_back),
        average=Kernels(average, average_tangent, average_back),
        bend=Kernels(bend, bend_tangent, bend_back),
        mean=Kernels(mean, mean_tangent, mean_back),
    )
