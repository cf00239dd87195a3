"""Surface tension by curvature, as a continuum surface force. `docs/discretisation.md` has the equations.

The vector g is the gradient of the fluid's colour. The average q of g (Shepard 1968) points into the fluid. A particle
has the weight w of 1 at the surface and 0 inside the fluid. The gradient D B^-1 of surface normals is exact if normals
vary linearly (Bonet and Lok 1999). The curvature needs only the symmetric part of the matrix D. Surface tension acts at
a mean depth delta below the surface, where the curvature 1 / R of the surface becomes 1 / (R - delta). The constant J
is the sum of w |q| over the layers of a flat surface, averaged over an axis-parallel and a diagonal cut of the lattice.

The constants in delta [spacings] were fitted to discs of concentric rings and balls of concentric shells. The fitted
values hold within 0.05 for every kernel with a support of at least 2.5 spacings. The computed curvature belongs to the
depth `DEEP`, and the sum of w |q| is (1 + `EXCESS` / R) J. With delta = DEEP / (d - 1) + EXCESS the pressure in a drop
would be (d - 1) sigma / R.

A surface wave has a smaller amplitude at the depth `ACTS`, where surface tension acts. The squared frequency of a
drop's mode n would therefore be too small by n ACTS / R in 2-D and (n + 1) ACTS / R in 3-D. As a compromise, delta is
smaller by ACTS d / (3 (d - 1)). The errors of the pressure and of the squared frequency of mode 2 are then equal and
opposite: 0.5 / R in 2-D and 0.75 / R in 3-D.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision, TypesByName
from cortado.discretise.smoothing import SmoothingKernel, lattice_offsets, rest_volume
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import fluid_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel, sum_kernel
from cortado.sph.moment_functions import cross_terms_function, moment_functions

DEEP, EXCESS, ACTS = 1.05, 0.6, 0.75
"""Lengths that determine the depth of the force [spacings]; see the docstring of `cortado.sph.curvature`."""


@dataclass(frozen=True)
class CurvatureConstants:
    spacing: float
    width: float
    """Sum of weighted normals over the layers of a flat surface [-]."""
    depth: float

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> "CurvatureConstants":
        width = float(np.mean([_width(kernel, support / spacing, dimension, cut) for cut in ((1, 0), (1, 1))]))
        shared = ACTS * dimension / (3.0 * (dimension - 1))
        return cls(spacing, width, spacing * (DEEP / (dimension - 1) + EXCESS - shared))


@cache
def _width(kernel: SmoothingKernel, support: float, dimension: int, cut: tuple[int, int]) -> float:
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
    t = np.clip((np.abs(q) - FAINT) / (CLEAR - FAINT), 0.0, 1.0)
    return float((t * t * (3.0 - 2.0 * t) * np.abs(q)).sum() * apart)


FAINT, CLEAR = 0.03, 0.1
SINGULAR = {2: 1e-3, 3: 1e-4}
"""Number added to a determinant, for each dimension, so that the curvature is 0 if neighbours lie on a line."""
LONE = 1e-6
"""Number added to the sum of weights, so that the mean curvature is 0 without neighbours in the surface."""
HOLLOW = 0.25
"""Curvature of a bubble times the depth of the force, above which the curvature is smoothly limited."""


@cache
def curvature_functions(precision: Precision, dimension: int, module: Any) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    smoothstep = moment_functions(precision, dimension).smoothstep
    faint, clear = wp.constant(real(FAINT)), wp.constant(real(CLEAR))
    singular, lone, hollow = wp.constant(real(SINGULAR[dimension])), wp.constant(real(LONE)), wp.constant(real(HOLLOW))

    @wp.func
    def normal(q: vector, spacing: real):
        size, w, e = wp.length(q), real(0.0), vector()
        if size * spacing > faint:
            w = smoothstep(size * spacing, faint, clear)
            e = q / size
        return w, e

    @wp.func(module=module)
    def normal_work(q: vector, spacing: real, w_bar: real, e_bar: vector) -> real:
        w, e = normal(q, spacing)
        return w * w_bar + wp.dot(e, e_bar)

    @wp.func(module=module)
    def curvature(B: matrix, D: matrix) -> real:
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
        mean = a / (b + lone)
        more = depth * mean
        rest = wp.clamp(real(3.0) * hollow + more, real(0.0), real(2.0) * hollow)
        divisor = real(1.0) - real(2.0) * hollow + rest * rest / (real(4.0) * hollow) + wp.max(more + hollow, real(0.0))
        return mean / divisor

    return by_name(normal, normal_work, curvature, outermost)


@cache
def curvature_sums(discretisation: Discretisation) -> SimpleNamespace:
    """A symmetric matrix is stored as its diagonal and its components yz, xz and xy."""
    (real, vector, neighbourhood), typed = discretisation.types, types_of(discretisation)
    pair, cross_terms = pair_functions(discretisation), cross_terms_function(discretisation.precision)
    weight, slope, gradient, hessian_product = pair.weight, pair.slope, pair.gradient, pair.hessian_product

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
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

    @fluid_sum(discretisation, typed)
    def average_back(x_ij, g_i, g_j, r_i, r_j, s) -> tuple[vector, vector]:
        both = wp.dot(r_i, g_j) + wp.dot(r_j, g_i)
        return (s.volume * weight(x_ij, s)) * r_j, (s.volume * both) * gradient(x_ij, s)

    @fluid_sum(discretisation, typed)
    def bend(x_ij, e_i, e_j, w_j, s) -> tuple[vector, vector, vector, vector]:
        g = (s.volume * w_j) * gradient(x_ij, s)
        turn = e_j - e_i
        return -wp.cw_mul(g, x_ij), -cross_terms(g, x_ij), wp.cw_mul(turn, g), even_terms(turn, g)

    @tangent_of(bend)
    @fluid_sum(discretisation, typed, ahead=False)
    def bend_tangent(
        x_ij, x_dot_ij, e_i, e_j, e_dot_i, e_dot_j, w_j, w_dot_j, s
    ) -> tuple[vector, vector, vector, vector]:
        g = (s.volume * w_j) * gradient(x_ij, s)
        g_dot = s.volume * (w_dot_j * gradient(x_ij, s) + w_j * hessian_product(x_ij, x_dot_ij, s))
        turn, turn_dot = e_j - e_i, e_dot_j - e_dot_i
        return (
            -wp.cw_mul(g_dot, x_ij) - wp.cw_mul(g, x_dot_ij),
            -cross_terms(g_dot, x_ij) - cross_terms(g, x_dot_ij),
            wp.cw_mul(turn_dot, g) + wp.cw_mul(turn, g_dot),
            even_terms(turn_dot, g) + even_terms(turn, g_dot),
        )

    @fluid_sum(discretisation, typed)
    def bend_back(x_ij, e_i, e_j, w_i, w_j, B_bar_i, B_bar_j, D_bar_i, D_bar_j, s) -> tuple[vector, real, vector]:
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
    @fluid_sum(discretisation, typed, ahead=False)
    def mean_tangent(x_ij, x_dot_ij, c_j, c_dot_j, w_j, w_dot_j, s) -> tuple[real, real]:
        W, W_dot = s.volume * weight(x_ij, s), s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)
        return W_dot * c_j + W * c_dot_j, W_dot * w_j + W * w_dot_j

    @fluid_sum(discretisation, typed)
    def mean_back(x_ij, c_i, c_j, w_i, w_j, a_i, a_j, b_i, b_j, s) -> tuple[real, real, vector]:
        W, both = s.volume * weight(x_ij, s), a_i * c_j + a_j * c_i + b_i * w_j + b_j * w_i
        return W * a_j, W * b_j, (s.volume * both) * gradient(x_ij, s)

    return SimpleNamespace(
        colour=Kernels(colour, colour_tangent, colour_back),
        average=Kernels(average, average_tangent, average_back),
        bend=Kernels(bend, bend_tangent, bend_back),
        mean=Kernels(mean, mean_tangent, mean_back),
    )


@cache
def curvature_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    matrix, sums, typed = precision.matrix, curvature_sums(discretisation), types_of(discretisation)
    moments = moment_functions(precision, dimension)
    whole, even = moments.whole, moments.change
    topic = f"surface_curvature_{dimension}d"
    module = discretisation.module(True, topic)
    own = curvature_functions(precision, dimension, module)
    normal_of, curvature_of, outermost = own.normal, own.curvature, own.outermost

    @particle_kernel(module, "g z", [over(sums.colour.forward, "g z_part")], typed=typed)
    def colour(i: int, g, z_part, s) -> tuple[vector, real]:
        return g, z_part + real(1 - s.filling[i]) * s.self_weight * s.volume

    @particle_kernel(module, "q w e", [over(sums.average.forward, "others")], numbers=["spacing"], typed=typed)
    def normal(i: int, others, spacing, g_i, z_i, s) -> tuple[vector, real, vector]:
        q = (others + (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_i) / z_i
        w, e = normal_of(q, spacing)
        return q, w, e

    @particle_kernel(module, "B D c", [over(sums.bend.forward, "diagonal others turned mixed")], typed=typed)
    def bend(diagonal, others, turned, mixed, w_i) -> tuple[matrix, matrix, real]:
        B, D = whole(diagonal, others), even(turned, mixed)
        return B, D, w_i * curvature_of(B, D)

    means, constants = over(sums.mean.forward, "a_part b_part"), ["depth", "per_width"]

    @particle_kernel(module, "a b acceleration:acceleration_in", [means], numbers=constants, typed=typed)
    def mean(
        i: int, a_part, b_part, depth, per_width, surface_tension, m_i, q_i, w_i, c_i, s
    ) -> tuple[real, real, vector]:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a, b = a_part + self_weight * c_i, b_part + self_weight * w_i
        strength = surface_tension * per_width / m_i
        return a, b, (strength * outermost(a, b, depth) * w_i) * q_i

    made = discretisation, dimension, topic
    three = zip((colour, normal, bend, mean), curvature_tangents(*made), curvature_adjoints(*made), strict=True)
    names = ("colour", "normal", "bend", "mean")
    return SimpleNamespace(**{name: Kernels(*each) for name, each in zip(names, three, strict=True)})


def types_of(discretisation: Discretisation) -> TypesByName:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    vectors = "q g r x e diagonal others turned mixed acceleration"
    return TypesByName(real, {vector: vectors, precision.matrix: "B D", neighbourhood: "s"})


@cache
def curvature_tangents(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    sums, typed = curvature_sums(discretisation), types_of(discretisation)
    even = moment_functions(precision, dimension).change
    module = discretisation.tangent_module(topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

    @particle_kernel(module, "q_dot w_dot e_dot", [over(sums.average.tangent, "others")], ["spacing"], typed=typed)
    def normal_tangent(i: int, others, spacing, g_dot_i, z_i, z_dot_i, q_i, s) -> tuple[vector, real, vector]:
        own_part = (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_dot_i
        q_dot = (others + own_part - z_dot_i * q_i) / z_i
        w_by_q, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(1.0), vector())
        e_dot, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(0.0), q_dot)
        return q_dot, wp.dot(w_by_q, q_dot), e_dot

    @particle_kernel(module, "c_dot", [over(sums.bend.tangent, "diagonal others turned mixed")], typed=typed)
    def bend_tangent(diagonal, others, turned, mixed, w_i, w_dot_i, B_i, D_i) -> real:
        by_B, by_D = wp.grad(curvature_of)(B_i, D_i)
        kappa_dot = wp.ddot(by_B, even(diagonal, others)) + wp.ddot(by_D, even(turned, mixed))
        return w_dot_i * curvature_of(B_i, D_i) + w_i * kappa_dot

    means, constants = over(sums.mean.tangent, "a_part b_part"), ["depth", "per_width"]

    @particle_kernel(module, "acceleration_dot:acceleration_in_dot", [means], numbers=constants, typed=typed)
    def mean_tangent(
        i: int, a_part, b_part, depth, per_width, surface_tension, surface_tension_dot, m_i, m_dot_i, q_i, q_dot_i, w_i,
        w_dot_i, c_dot_i, a_i, b_i, s,
    ) -> vector:  # fmt: skip
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a_dot, b_dot = a_part + self_weight * c_dot_i, b_part + self_weight * w_dot_i
        k = outermost(a_i, b_i, depth)
        by_a, by_b, _by_depth = wp.grad(outermost)(a_i, b_i, depth)
        k_dot = by_a * a_dot + by_b * b_dot
        strength = surface_tension * per_width / m_i
        strength_dot = (surface_tension_dot * per_width - strength * m_dot_i) / m_i
        along = strength_dot * k * w_i + strength * (k_dot * w_i + k * w_dot_i)
        return along * q_i + (strength * k * w_i) * q_dot_i

    colour_tangent = sum_kernel("colour_tangent", module, "g_dot z_dot", sums.colour.tangent)
    return colour_tangent, normal_tangent, bend_tangent, mean_tangent


@cache
def curvature_adjoints(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    matrix, sums, typed = precision.matrix, curvature_sums(discretisation), types_of(discretisation)
    module = discretisation.module(False, topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

    @particle_kernel(module, "+m_bar +surface_tension_bar q_bar w_bar a_bar b_bar", numbers=["depth", "per_width"])
    @typed
    def force_adjoint(
        depth, per_width, surface_tension, m_i, q_i, w_i, a_i, b_i, acceleration_bar_i
    ) -> tuple[real, real, vector, real, real, real]:
        k = outermost(a_i, b_i, depth)
        by_a, by_b, _by_depth = wp.grad(outermost)(a_i, b_i, depth)
        strength, work = surface_tension * per_width / m_i, wp.dot(q_i, acceleration_bar_i)
        return (
            -strength * k * w_i * work / m_i,
            per_width / m_i * k * w_i * work,
            (strength * k * w_i) * acceleration_bar_i,
            strength * k * work,
            strength * w_i * work * by_a,
            strength * w_i * work * by_b,
        )

    means = over(sums.mean.adjoint, "c_part w_part x_part", a="a_bar", b="b_bar")

    @particle_kernel(module, "+x_bar +w_bar B_bar D_bar", [means], typed=typed)
    def mean_adjoint(
        i: int, c_part, w_part, x_part, w_i, a_bar_i, b_bar_i, B_i, D_i, s
    ) -> tuple[vector, real, matrix, matrix]:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        c_bar = c_part + self_weight * a_bar_i
        by_B, by_D = wp.grad(curvature_of)(B_i, D_i)
        half = real(0.5) * w_i * c_bar  # of each matrix and of its transpose, as both are symmetric
        w_bar = w_part + self_weight * b_bar_i + curvature_of(B_i, D_i) * c_bar
        return x_part, w_bar, half * (by_B + wp.transpose(by_B)), half * (by_D + wp.transpose(by_D))

    @particle_kernel(module, "+x_bar r z_bar", [over(sums.bend.adjoint, "e_bar w_part x_part")], numbers=["spacing"])
    @typed
    def bend_adjoint(e_bar, w_part, x_part, spacing, q_i, z_i, w_bar_i, q_bar_i) -> tuple[vector, vector, real]:
        by_q, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, w_bar_i + w_part, e_bar)
        r = (q_bar_i + by_q) / z_i
        return x_part, r, -wp.dot(q_i, r)

    @particle_kernel(module, "g_bar +x_bar", [over(sums.average.adjoint, "g_part x_part")], typed=typed)
    def normal_adjoint(i: int, g_part, x_part, r_i, s) -> tuple[vector, vector]:
        return g_part + (real(1 - s.filling[i]) * s.self_weight * s.volume) * r_i, x_part

    colour_adjoint = sum_kernel("colour_adjoint", module, "+x_bar", sums.colour.adjoint)
    return colour_adjoint, normal_adjoint, bend_adjoint, (force_adjoint, mean_adjoint)
