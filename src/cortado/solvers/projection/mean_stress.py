"""The pressure that a sensor reads after a step of the projection, and the forces on mirroring walls.

`docs/projection_step.md` has the equation of the pressure. Kernels divide the impulses k and dt p by the time step.

On mirroring walls, the forces of images replace the fraction h of the forces on wall particles. The force on one solid,
or on all walls, changes by the sum over its images

    sum (h_i p_i + h_j p_j) g_i' - h_i p_i gamma_m

with the part gamma_m of gamma from mirroring wall particles.
"""

from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum, image_sum, image_sum_of_solid
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels
from cortado.particles.state import Fields
from cortado.particles.wall_terms import ALL_WALLS, WallTerm
from cortado.solvers.particles import ParticleSystem
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.surroundings import Surroundings, SurroundingsAdjoint, SurroundingsTangent
from cortado.solvers.projection.wall_sums import FaceShares, normal_part, types_by_name
from cortado.sph.density import WallSums
from cortado.sph.moment_functions import moment_functions, symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents, integration_module

TOPIC = "mean_stress"


class MeanStress:
    def __init__(self, system: ParticleSystem):
        discretisation, layout = system.discretisation, system.layout
        self._faces, self._kernels = FaceShares(system), mean_stress_kernels(discretisation, system.walled.dimension)
        works, own = {"reach": _reach_work, "mirrors": _mirror_work}, (discretisation, TOPIC)
        self._walls = {name: WallSums(WallTerm(*own, work, "reach_bar"), layout) for name, work in works.items()}
        self._arrays = layout.arrays(q=layout.precision.real, reach_bar=layout.precision.vector)

    def _totals(self, context: StepContext, known: tuple[Named, ...]) -> Named:
        return {name: sums.total(context, ALL_WALLS, *known) for name, sums in self._walls.items()}

    def impulses(self, context: StepContext, *known: Named) -> wp.array:
        """Return an array of shape (n,) with the mean normal stress times the time step [Pa s]."""
        found = self._arrays["q"]
        context.launch(self._kernels.forward, self._totals(context, known), *known, q=found)
        return found

    def tangent(self, context: StepContext, dot: Tangents, *known: Named) -> NDArray:
        found, walls = self._arrays["q"], self._totals(context, known)
        dots = {f"{name}_dot": one.tangent(context, dot, ALL_WALLS, *known) for name, one in self._walls.items()}
        context.launch(self._kernels.tangent, walls, dots, *dot.named, *known, q_dot=found)
        return np.array(found.numpy())

    def adjoint(self, context: StepContext, bar: Adjoints, at: Named, *known: Named) -> None:
        """``at`` contains the adjoint ``q_bar`` of the mean normal stress times the time step."""
        (own, pairs), reach_bar = self._kernels.adjoint, self._arrays["reach_bar"]
        context.launch(own, self._totals(context, known), *bar.named, at, *known, reach_bar=reach_bar)
        context.launch(pairs, *bar.named, at, *known)
        self._faces.add(context, bar, *known, k=at["k"], q=at["q_bar"])
        for sums in self._walls.values():
            sums.adjoint(context, bar, ALL_WALLS, reach_bar, reach_bar, *known)


def spread_term(d: Discretisation) -> Any:
    """Return the term of a pair of particles in the mean normal stress."""
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient
    six, times = symmetric(d.precision).kind, symmetric(d.precision).times

    def spread(x_ij: vector, T_i: six, T_j: six, s: neighbourhood_type(d.precision)) -> real:
        return real(-0.5) * s.volume * wp.dot(gradient(x_ij, s), times(T_i + T_j, x_ij))

    return spread


@cache
def mean_stress_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    neighbourhood, (six, pack) = neighbourhood_type(precision), (symmetric(precision).kind, symmetric(precision).pack)
    whole, per = moment_functions(precision, dimension).change, wp.constant(real(1.0 / dimension))
    module, tangent_module, adjoint_module = discretisation.modules(f"{TOPIC}_{dimension}d")
    spread = fluid_sum(discretisation, module=module)(spread_term(discretisation))
    spread_tangent = made_tangent(discretisation, spread_term, tangent_module)
    spread_adjoint = made_adjoint(discretisation, spread_term, adjoint_module)
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @image_sum(discretisation)
    def images(x_ij: vector, k_i: real, k_j: real, image_i: real, image_j: real, s: neighbourhood) -> real:
        return real(-0.5) * s.volume * (image_i * k_i + image_j * k_j) * wp.dot(gradient(x_ij, s), x_ij)

    typed = types_by_name(precision, {vector: "reach mirrors"})

    @image_sum(discretisation, typed)
    def images_tangent(
        x_ij, x_dot_ij, k_i, k_j, k_dot_i, k_dot_j, image_i, image_j, image_dot_i, image_dot_j, s
    ) -> real:
        c, g = image_i * k_i + image_j * k_j, gradient(x_ij, s)
        c_dot = image_dot_i * k_i + image_i * k_dot_i + image_dot_j * k_j + image_j * k_dot_j
        bent = wp.dot(hessian_product(x_ij, x_ij, s) + g, x_dot_ij)
        return real(-0.5) * s.volume * (c_dot * wp.dot(g, x_ij) + c * bent)

    @image_sum(discretisation, typed)
    def images_back(x_ij, k_i, k_j, image_i, image_j, q_bar_i, q_bar_j, s) -> tuple[vector, real]:
        bar, g = real(-0.5) * s.volume * (q_bar_i + q_bar_j), gradient(x_ij, s)
        bent = hessian_product(x_ij, x_ij, s) + g
        return (bar * (image_i * k_i + image_j * k_j)) * bent, bar * wp.dot(g, x_ij)

    @particle_kernel(module, "q", [over(spread, "fluid"), over(images, "mirrored")])
    def mean_stress(fluid: real, mirrored: real, k_i: real, reach_i: vector, mirrors_i: vector) -> real:
        return per * (fluid + mirrored - k_i * (reach_i[0] + mirrors_i[0]))

    both = [over(spread_tangent, "fluid"), over(images_tangent, "mirrored")]

    @particle_kernel(tangent_module, "q_dot", both, typed=typed)
    def mean_stress_tangent(fluid, mirrored, k_i, k_dot_i, reach_i, reach_dot_i, mirrors_i, mirrors_dot_i) -> real:
        change = k_dot_i * (reach_i[0] + mirrors_i[0]) + k_i * (reach_dot_i[0] + mirrors_dot_i[0])
        return per * (fluid + mirrored - change)

    @particle_kernel(adjoint_module, "q_bar +k_bar reach_bar")
    def own_adjoint(k_i: real, reach_i: vector, mirrors_i: vector, q_bar_i: real) -> tuple[real, real, vector]:
        bar = per * q_bar_i
        return bar, -bar * (reach_i[0] + mirrors_i[0]), vector(-bar * k_i, real(0.0), real(0.0))

    both = [over(spread_adjoint, "x_part T_part", _bar_0="q_bar"), over(images_back, "x_lift lifted")]

    @particle_kernel(adjoint_module, "+x_bar +image_bar +k_bar +L_bar", both)
    def mean_stress_adjoint(
        x_part: vector, T_part: six, x_lift: vector, lifted: real, k_i: real, L_i: matrix, image_i: real
    ) -> tuple[vector, real, real, matrix]:
        diagonal, others = vector(T_part[0], T_part[1], T_part[2]), vector(T_part[3], T_part[4], T_part[5])
        k_part = wp.dot(T_part, pack(L_i)) + image_i * lifted
        return x_part + x_lift, k_i * lifted, k_part, k_i * whole(diagonal, real(0.5) * others)

    return Kernels(mean_stress, mean_stress_tangent, (own_adjoint, mean_stress_adjoint))


def _reach_work(d: Discretisation) -> Any:
    real, gradient, normal = d.precision.real, pair_functions(d).gradient, normal_part(d)

    @types_by_name(d.precision, {d.precision.vector: "reach"})
    def reach_work(x_ij, edge_i, reach_bar_i, foot, s) -> real:
        whole, from_surface = s.volume * gradient(x_ij, s), x_ij - foot
        part = normal(whole, foot)
        return wp.dot(part + edge_i * (whole - part), from_surface) * reach_bar_i[0]

    return reach_work


def _mirror_work(d: Discretisation) -> Any:
    real, gradient, normal = d.precision.real, pair_functions(d).gradient, normal_part(d)

    @types_by_name(d.precision, {d.precision.vector: "reach"})
    def mirror_work(x_ij, image_i, reach_bar_i, mirrored, foot, s) -> real:
        part = s.volume * normal(gradient(x_ij, s), foot)
        return -mirrored * wp.dot(part, x_ij - foot) * image_i * reach_bar_i[0]

    return mirror_work


@cache
def pressed_kernels(precision: Precision) -> Kernels:
    """Make the kernels that divide pressure times time step by the time step."""
    real, modules = precision.real, [integration_module(precision, False, topic="impulses")] * 3

    def pressed(time_step: real, impulse_i: real) -> real:
        return impulse_i / time_step

    return pointwise_kernels(precision, modules, lambda _: pressed, ["p"])


@cache
def image_load_kernels(discretisation: Discretisation) -> Kernels:
    real, vector, _ = discretisation.types
    module, tangent_module, adjoint_module = discretisation.modules("image_loads")
    load, load_tangent, load_back = map(image_sum_of_solid, image_sums(discretisation).lift)

    @particle_kernel(module, "total", [over(load, "found")], numbers=["solid"])
    def image_load(found: vector) -> vector:
        return found

    @particle_kernel(tangent_module, "total_dot", [over(load_tangent, "found")], numbers=["solid"])
    def image_load_tangent(found: vector) -> vector:
        return found

    back = over(load_back, "widened x_part")

    @particle_kernel(adjoint_module, "+y_bar +image_bar +x_bar", [back], numbers=["solid"])
    def image_load_adjoint(widened: real, x_part: vector, y_i: real, image_i: real) -> tuple[real, real, vector]:
        return image_i * widened, y_i * widened, x_part

    return Kernels(image_load, image_load_tangent, image_load_adjoint)


def _mirrored_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    @TypesByName(real, {vector: "x f foot", neighbourhood_type(d.precision): "s"})
    def mirrored_work(x_ij, image_i, y_i, f_i, mirrored, foot, s) -> real:
        return (-mirrored * image_i * y_i * s.volume) * wp.dot(normal(gradient(x_ij, s), foot), f_i)

    return mirrored_work


class ImageLoads:
    """Forces of images on sorted particles, divided by the volume of a particle (n,) [N / m^d]."""

    def __init__(self, density: Surroundings):
        self._density, self._layout = density, density.system.layout
        self._image = {"image": density.around["image"]}
        self._kernels = image_load_kernels(density.discretisation)
        self._walls = WallSums(WallTerm(density.discretisation, "image_loads", _mirrored_work, "f"), self._layout)
        self._faces = FaceShares(density.system)

    def total(self, step: StepContext, solid: int, p: wp.array) -> wp.array:
        """Return the forces that pressures ``p`` (n,) [Pa] exert on the walls of a solid, or on all walls."""
        found, known = self._vectors["total"], {"y": p, **self._image}
        step.launch(self._kernels.forward, known, solid=solid, total=found)
        add(self._walls.total(step, solid, known), found)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int, p: wp.array, p_dot: wp.array) -> wp.array:
        found, around = self._vectors["total_dot"], self._tangent
        around.measure(step, dot)
        known = {"y": p, "y_dot": p_dot, **self._image, "image_dot": around.around["image_dot"]}
        step.launch(self._kernels.tangent, known, *dot.named, solid=solid, total_dot=found)
        add(self._walls.tangent(step, dot, solid, known), found)
        return found

    def adjoint(
        self, step: StepContext, bar: Adjoints, solid: int, p: wp.array, total_bar: wp.array, p_bar: wp.array
    ) -> None:
        around = self._adjoint
        around.begin()
        known = {"y": p, "y_bar": p_bar, **self._image, "image_bar": around.around["image_bar"]}
        step.launch(self._kernels.adjoint, known, *bar.named, solid=solid, f=total_bar)
        self._walls.adjoint(step, bar, solid, total_bar, total_bar, known)
        self._faces.add(step, bar, known, over=solid, u=total_bar, spread=p)
        fields = Fields.zeros(self._layout.all_particles, self._layout.precision, self._layout.device)
        around.measure(step, replace(bar, fields=fields))
        for given, total in zip(fields.arrays(), bar.fields.arrays(), strict=True):
            add(given, total)

    @cached_property
    def _vectors(self) -> dict[str, wp.array]:
        return self._layout.arrays(**dict.fromkeys(("total", "total_dot"), self._layout.precision.vector))

    @cached_property
    def _tangent(self) -> SurroundingsTangent:
        return self._density.new_tangent()

    @cached_property
    def _adjoint(self) -> SurroundingsAdjoint:
        return self._density.new_adjoint()
