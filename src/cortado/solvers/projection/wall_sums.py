"""Sums over walls for the force of walls on a particle in the projection, with derivatives.

`docs/projection_step.md` has the equations. The code names gamma_n ``normal`` and gamma_w ``whole``, so that gamma =
normal + e (whole - normal) with the edge factor e. The drifts of moving walls with velocities v_b are sum w_b (n_b
n_b^T g_ib) . v_b and sum w_b g_ib . v_b. The pressure of a particle pushes the walls of one solid s along gamma_s / V,

    gamma_s = normal_s + e (whole_s - normal_s).

The sums normal_s and whole_s are over the wall particles of solid s. The edge factor e is computed from all walls.

Flat faces of moving solids act through images of the fluid instead of wall particles. For reverse mode, a sum over
images is written as a work W, a number that is linear in the adjoints,

    W = sum V ((b_i + h_i c_i) W_i' + h_i d_i (u_i - R (u_j + B_j x_ij)) . g_i' + e_i swept . g_i' / dt
               - 1/2 h_i k_i (q_i + q_j) x_i' . g_i').

`NUMBERS` names h, b, c, d and e ``image``, ``density``, ``weighted``, ``spread`` and ``swept``. An image in the
reflection R has the kernel W_i', the kernel gradient g_i' and the separation x_i'. The matrix B is the slope of the
push by a coarse pressure. Warp differentiates W with respect to the poses of the solid before and after the step. Other
modules compute gradients with respect to particle positions, except the part through the edge factor e.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import Named, bundle
from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision, TypesByName
from cortado.particles.mirrors import FACES, reflections
from cortado.particles.moving_walls import turn_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import wall_sum
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.wall_terms import ALL_WALLS, WallTerm, share_kinds
from cortado.solvers.particles import ParticleSystem
from cortado.solvers.projection.lattice import ProjectionConstants
from cortado.sph.density import WallSums, wall_slope_term
from cortado.sph.moment_functions import moment_functions, symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents

EDGED = (0.1, 0.4)
"""Fractions of the wall gradient across the normals: a wall is flat up to the first fraction, and an edge from the
second fraction."""
DIRECTION = 0.01
"""Relative size of the wall gradient below which the direction of a wall is unknown."""


@cache
def edge_functions(precision: Precision, dimension: int, module: Any) -> SimpleNamespace:
    real, vector, smoothstep = precision.real, precision.vector, moment_functions(precision, dimension).smoothstep
    e_0, e_1, direction = (wp.constant(real(value)) for value in (*EDGED, DIRECTION))

    @wp.func
    def edge(normal: vector, whole: vector, least: real) -> real:
        square = wp.dot(whole, whole)
        return smoothstep((square - wp.dot(normal, normal)) / (square + direction * least), e_0, e_1)

    @wp.func(module=module)
    def back(normal: vector, whole: vector, least: real, bar: real):
        by_normal, by_whole, _least = wp.grad(edge)(normal, whole, least)
        return bar * by_normal, bar * by_whole

    return by_name(edge, back)


@cache
def normal_part(discretisation: Discretisation) -> Any:
    """``foot`` points from a wall particle to the surface."""
    vector = discretisation.precision.vector

    @wp.func
    def normal_part(a: vector, foot: vector) -> vector:
        return (wp.dot(a, foot) / wp.dot(foot, foot)) * foot

    return normal_part


@cache
def beside_sums(discretisation: Discretisation) -> Kernels:
    """Make the sums over the walls beside a particle: gradients, coverage, and the divergence by moving walls."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood, pair = neighbourhood_type(discretisation.precision), pair_functions(discretisation)
    weight, gradient, hessian_product = pair.weight, pair.gradient, pair.hessian_product
    normal, typed = normal_part(discretisation), types_by_name(discretisation.precision)

    @wall_sum(discretisation)
    def beside(x_ij: vector, v_j: vector, foot: vector, s: neighbourhood) -> tuple[vector, vector, real, real, real]:
        whole = s.volume * gradient(x_ij, s)
        part = normal(whole, foot)
        return part, whole, s.volume * weight(x_ij, s), wp.dot(part, v_j), wp.dot(whole, v_j)

    @wall_sum(discretisation, typed, grows=beside)
    def beside_tangent(x_ij, x_dot_ij, v_j, v_dot_j, foot, turn_dot, s) -> tuple[vector, vector, real, real, real]:
        rest = x_dot_ij - wp.cross(turn_dot, x_ij)
        whole, bent = s.volume * gradient(x_ij, s), s.volume * hessian_product(x_ij, rest, s)
        part = normal(whole, foot)
        part_dot, whole_dot = normal(bent, foot) + wp.cross(turn_dot, part), bent + wp.cross(turn_dot, whole)
        part_drift, whole_drift = wp.dot(part_dot, v_j) + wp.dot(part, v_dot_j), wp.dot(whole_dot, v_j)
        return part_dot, whole_dot, wp.dot(whole, rest), part_drift, whole_drift + wp.dot(whole, v_dot_j)

    @wall_sum(discretisation, typed)
    def beside_back(
        x_ij, v_j, normal_bar_i, whole_bar_i, nu_bar_i, normal_drift_bar_i: real, whole_drift_bar_i: real, foot, s
    ) -> vector:
        pushed = normal(normal_bar_i + normal_drift_bar_i * v_j, foot) + whole_bar_i + whole_drift_bar_i * v_j
        return s.volume * (hessian_product(x_ij, pushed, s) + nu_bar_i * gradient(x_ij, s))

    return Kernels(beside, beside_tangent, beside_back)


def _normal_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    def normal_work(x_ij: vector, push_bar_i: vector, foot: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(normal(gradient(x_ij, s), foot), push_bar_i)

    return normal_work


def beside_term(d: Discretisation) -> Any:
    real, pair, normal = d.precision.real, pair_functions(d), normal_part(d)
    weight, gradient = pair.weight, pair.gradient

    @types_by_name(d.precision)
    def beside_work(
        x_ij, v_j, normal_bar_i, whole_bar_i, nu_bar_i, normal_drift_bar_i: real, whole_drift_bar_i: real, mirror_bar_i,
        behind_bar_i, sweep_bar_i, mirrored, foot, s,
    ) -> real:  # fmt: skip
        whole, by_mirror = gradient(x_ij, s), mirrored * (mirror_bar_i - sweep_bar_i * v_j)
        part = wp.dot(normal(whole, foot), normal_bar_i + normal_drift_bar_i * v_j + by_mirror)
        part += wp.dot(whole, whole_bar_i + whole_drift_bar_i * v_j)
        return s.volume * (part + (nu_bar_i + mirrored * behind_bar_i) * weight(x_ij, s))

    return beside_work


@cache
def push_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision = discretisation.precision
    real, vector = precision.real, precision.vector

    def make(module: Any) -> Any:
        edge = edge_functions(precision, dimension, module).edge

        def push(least: real, normal_i: vector, whole_i: vector, all_normal_i: vector, all_whole_i: vector) -> vector:
            return normal_i + edge(all_normal_i, all_whole_i, least) * (whole_i - normal_i)

        return push

    bars = ["normal", "whole", "all_normal", "all_whole"]
    modules = discretisation.modules(f"projection_push_{dimension}d")
    return pointwise_kernels(precision, modules, make, ["push"], numbers=["least"], written=bars)


class ProjectionPush:
    def __init__(self, system: ParticleSystem, constants: ProjectionConstants):
        discretisation, layout = system.discretisation, system.layout
        self._kernels, self._layout = push_kernels(discretisation, system.walled.dimension), layout
        normal_term = WallTerm(discretisation, "projection", _normal_work, "push_bar")
        terms = {"normal": normal_term, "whole": wall_slope_term(discretisation)}
        self._sums = {name: WallSums(term, layout) for name, term in terms.items()}
        self._all_sums = {f"all_{name}": WallSums(term, layout) for name, term in terms.items()}
        self._least = {"least": constants.least_diagonal / system.lattice.volume**2}

    def total(self, step: StepContext, solid: int) -> wp.array:
        found = self._arrays["push"]
        step.launch(self._kernels.forward, self._totals(step, solid), self._least, push=found)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        found = self._arrays["push_dot"]
        dots = {f"{name}_dot": sums.tangent(step, dot, over) for name, sums, over in self._each(solid)}
        step.launch(self._kernels.tangent, self._totals(step, solid), dots, self._least, push_dot=found)
        return found

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        """Add to the adjoints of positions and solids, given the adjoint ``total_bar`` of the action."""
        bars = self._arrays
        step.launch(self._kernels.adjoint, self._totals(step, solid), self._least, bars, push_bar=total_bar)
        for name, sums, over in self._each(solid):
            sums.adjoint(step, bar, over, bars[f"{name}_bar"], v_star_bar)

    def _each(self, solid: int) -> Iterator[tuple[str, WallSums, int]]:
        for own, over in ((self._sums, solid), (self._all_sums, ALL_WALLS)):
            yield from ((name, sums, over) for name, sums in own.items())

    def _totals(self, step: StepContext, solid: int) -> dict[str, wp.array]:
        found = {name: sums.total(step, solid) for name, sums in self._sums.items()}
        if solid == ALL_WALLS:
            return found | {f"all_{name}": array for name, array in found.items()}
        return found | {name: sums.total(step, ALL_WALLS) for name, sums in self._all_sums.items()}

    @cached_property
    def _arrays(self) -> dict[str, wp.array]:
        names = "push", "push_dot", *(f"{name}_bar" for name, _, _ in self._each(ALL_WALLS))
        return self._layout.arrays(**dict.fromkeys(names, self._layout.precision.vector))


NUMBERS = ("image", "density", "weighted", "spread", "swept", "k", "q")
"""Names of the arrays with adjoints of sums over images."""


@cache
def face_share_kernel(discretisation: Discretisation) -> Any:
    d = replace(discretisation, lanes=1, taped=True)
    precision = d.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    pair, neighbourhood, turning = pair_functions(d), neighbourhood_type(precision), turn_functions(precision)[0]
    weight, gradient, separation = pair.weight, pair.gradient, pair.separation
    neighbour, mirrors_by = pair.neighbour, pair.mirrors_by
    module = replace(d, taped=False).module(False, "projection_faces")
    seen = bundle(x=vector, u=vector, slope=matrix, **dict.fromkeys(NUMBERS, real))
    bars = bundle(x=vector, time_step=real, **share_kinds(precision))
    REFLECTIONS, FIRST = wp.constant(reflections(d.moving)), wp.constant(FACES)

    @wp.func
    def mirrored(a: vector, n: vector) -> vector:
        return a - (real(2.0) * wp.dot(n, a)) * n

    @wp.func
    def image_of(x: vector, c: vector, R: matrix, scale: real, place: vector, normal: vector) -> vector:
        n = R * normal
        return x - (real(2.0) * wp.dot(n, x - c - scale * (R * place))) * n

    typed = TypesByName(real, {vector: "x u c place normal", matrix: "R", neighbourhood: "s"})

    @wp.func(module=module)
    @typed
    def work(x_i, x_j, u_i, u_j, near, spread, pushed, c, R, scale, place, normal, s) -> real:
        x_ij = x_i - image_of(x_j, c, R, scale, place, normal)
        along = spread * (u_i - mirrored(u_j, R * normal)) - (real(0.5) * pushed) * x_ij
        return s.volume * (near * weight(x_ij, s) + wp.dot(gradient(x_ij, s), along))

    @wp.func
    def carried(x: vector, c: vector, R: matrix, c_0: vector, R_0: matrix) -> vector:
        return x - c_0 - R_0 * (wp.transpose(R) * (x - c))

    @wp.func(module=module)
    @typed
    def sweep(x_i, x_j, c, R, c_0, R_0, scale, place, normal, s) -> real:
        image = image_of(x_j, c, R, scale, place, normal)
        swept = carried(image, c, R, c_0, R_0) - mirrored(carried(x_j, c, R, c_0, R_0), R * normal)
        return s.volume * wp.dot(gradient(x_i - image, s), swept)

    @wp.func(module=module)
    def shares(i: int, solid: int, per: real, at: seen, s: neighbourhood):
        force, torque, before, turned, x_part = vector(), vector(), vector(), vector(), vector()
        growth, total, member = real(0.0), real(0.0), i // s.particles
        c, c_0, scale = s.after[member, solid], s.before[member, solid], s.scales[member, solid]
        R, R_0 = s.turns[member, solid], s.turns_before[member, solid]
        x_i, u_i, h, e_i = at.x[i], at.u[i], at.image[i], per * at.swept[i]
        near, spread = at.density[i] + h * at.weighted[i], h * at.spread[i]
        for k in range(s.count[i], s.all_count[i]):
            image = neighbour(k, i, s)
            j, f = image // REFLECTIONS, image % REFLECTIONS - FIRST
            if mirrors_by(f + FIRST, solid, s):
                x_j, e_j, place, normal = at.x[j], per * at.swept[j], s.face_places[f], s.face_frames[f][0]
                pushed, u_j = h * at.k[i] * (at.q[i] + at.q[j]), at.u[j] + at.slope[j] * separation(x_i, x_j, s)
                _i, _j, _u, _v, _a, _b, _d, by_c, by_R, by_scale, _p, _m, _ = wp.grad(work)(
                    x_i, x_j, u_i, u_j, near, spread, pushed, c, R, scale, place, normal, s
                )
                by_x, _j, along_c, along_R, by_c_0, by_R_0, along_scale, _p, _m, _ = wp.grad(sweep)(
                    x_i, x_j, c, R, c_0, R_0, scale, place, normal, s
                )
                _i, by_other, _c, _R, _c_0, _R_0, _s, _p, _m, _ = wp.grad(sweep)(
                    x_j, x_i, c, R, c_0, R_0, scale, place, normal, s
                )
                force += by_c + e_i * along_c
                torque += turning(R, by_R + e_i * along_R)
                before += e_i * by_c_0
                turned += e_i * turning(R_0, by_R_0)
                growth += by_scale + e_i * along_scale
                x_part += e_i * by_x + e_j * by_other
                total += e_i * sweep(x_i, x_j, c, R, c_0, R_0, scale, place, normal, s)
        return force, torque, before, turned, growth, x_part, per * total

    @wp.kernel(module=module, enable_backward=False)
    def face_share(s: neighbourhood, solid: int, time_step: wp.array(dtype=real), at: seen, bar: bars):
        i = s.first + wp.tid()
        if s.all_count[i] > s.count[i]:
            per = real(1.0) / time_step[i // s.particles]
            force, torque, before, turned, growth, x_part, rate = shares(i, solid, per, at, s)
            bar.force[i] = bar.force[i] + force
            bar.torque[i] = bar.torque[i] + torque
            bar.force_before[i] = bar.force_before[i] + before
            bar.torque_before[i] = bar.torque_before[i] + turned
            bar.growth[i] = bar.growth[i] + growth
            bar.x[i] = bar.x[i] + x_part
            bar.time_step[i] = bar.time_step[i] - rate

    return face_share


class FaceShares:
    """The contributions of particles, through mirror images, to the adjoints of solids."""

    def __init__(self, system: ParticleSystem):
        self._kernel, self._faces = partial(face_share_kernel, system.discretisation), len(system.faces.solids)
        precision = system.layout.precision
        kinds = {"u": precision.vector, "slope": precision.matrix, **dict.fromkeys(NUMBERS, precision.real)}
        self._nothing = system.layout.arrays(**kinds) if self._faces else {}

    def add(self, context: StepContext, bar: Adjoints, *groups: Named, over: int = ALL_WALLS, **arrays: Any) -> None:
        """Add the terms of images in all walls or in the solid ``over``. Missing ``arrays`` of adjoints count as 0."""
        if self._faces:
            known = {**self._nothing, **{name: array for group in groups for name, array in group.items()}, **arrays}
            bar.solids.add(context.launch, self._kernel, *bar.named, known, over=over)


@cache
def weights_type(precision: Precision) -> Any:
    return wp.types.vector(length=4, dtype=precision.real)


def types_by_name(precision: Precision, more: Mapping[Any, str] | None = None) -> TypesByName:
    """Return Warp types by name. Names that are not listed have the type of a number. ``more`` takes precedence."""
    common = {
        neighbourhood_type(precision): "s",
        precision.vector: "x v u g f h gamma beside mirror normal whole crowd apart arm kick thrust delta foot turn "
        "total lifted row lift direct diagonal others",
        precision.matrix: "A L M N Q",
        symmetric(precision).kind: "S T",
        weights_type(precision): "weights",
        precision.pair: "error sums sizes",
    }
    return TypesByName(precision.real, common, more or {})
