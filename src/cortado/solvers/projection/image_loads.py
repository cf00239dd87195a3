"""What walls that mirror get from particles beside what `cortado.solvers.projection.walls` gives them: the forces of
images, in place of the share h of those of their own wall particles,

    sum (h_i p_i + h_j p_j) g_i' - h_i p_i gamma_m,

over the images by one solid, or by all walls, with gamma_m of its wall particles that mirror. With it walls get what
momentum the fluid loses to them. Loads are read now and then, so that h is differentiated on its own here.
"""

from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import TypesByName
from cortado.device.reduction import add
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import image_sum
from cortado.particles.state import Fields
from cortado.particles.wall_terms import WallTerm
from cortado.solvers.projection.faces import FaceShares
from cortado.solvers.projection.surroundings import Surroundings, SurroundingsAdjoint, SurroundingsTangent
from cortado.solvers.projection.walls import normal_part
from cortado.sph.parts import Adjoints, StepContext, Tangents
from cortado.sph.walls import WallSums


@cache
def image_load_kernels(discretisation: Discretisation) -> Kernels:
    """Make the kernels of the sum over images by the walls ``solid``, with ``y`` for p."""
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product
    module, tangent_module, adjoint_module = discretisation.modules("image_loads")
    LANES, lane = discretisation.lanes, discretisation.lane

    @image_sum(discretisation)
    def load(
        x_ij: vector, y_i: real, y_j: real, image_i: real, image_j: real, owned: real, solid: int, s: neighbourhood
    ) -> vector:
        return (owned * (image_i * y_i + image_j * y_j) * s.volume) * gradient(x_ij, s)

    typed = TypesByName(real, {neighbourhood: "s", vector: "x x_dot x_ij x_dot_ij f f_ij total total_dot x_bar"})

    @image_sum(discretisation)
    @typed
    def load_tangent(
        x_ij, x_dot_ij, y_i, y_j, y_dot_i, y_dot_j, image_i, image_j, image_dot_i, image_dot_j, owned, solid: int, s
    ) -> vector:
        c_dot = image_dot_i * y_i + image_i * y_dot_i + image_dot_j * y_j + image_j * y_dot_j
        bent = (image_i * y_i + image_j * y_j) * hessian_product(x_ij, x_dot_ij, s)
        return (owned * s.volume) * (c_dot * gradient(x_ij, s) + bent)

    @image_sum(discretisation)
    @typed
    def load_back(x_ij, y_i, y_j, image_i, image_j, f_ij, owned, solid: int, s) -> tuple[real, vector]:
        c = owned * (image_i * y_i + image_j * y_j) * s.volume
        return owned * s.volume * wp.dot(gradient(x_ij, s), f_ij), c * hessian_product(x_ij, f_ij, s)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def image_load(s, solid: int, x, y, image, total):
        i = s.first + wp.tid() // LANES
        found = load(i, x, y, image, solid, s)
        if lane() == 0:
            total[i] = found

    @wp.kernel(module=tangent_module, enable_backward=False)
    @typed.arrays
    def image_load_tangent(s, solid: int, x, x_dot, y, y_dot, image, image_dot, total_dot):
        i = s.first + wp.tid() // LANES
        found = load_tangent(i, x, x_dot, y, y_dot, image, image_dot, solid, s)
        if lane() == 0:
            total_dot[i] = found

    @wp.kernel(module=adjoint_module, enable_backward=False)
    @typed.arrays
    def image_load_adjoint(s, solid: int, x, y, image, f, y_bar, image_bar, x_bar):
        i = s.first + wp.tid() // LANES
        widened, x_part = load_back(i, x, y, image, f, solid, s)
        if lane() == 0:
            y_bar[i] = y_bar[i] + image[i] * widened
            image_bar[i] = image_bar[i] + y[i] * widened
            x_bar[i] = x_bar[i] + x_part

    return Kernels(image_load, image_load_tangent, image_load_adjoint)


def mirrored_term(discretisation: Discretisation) -> WallTerm:
    """Return the wall term -h y gamma_m of a solid, with the adjoint ``f``."""
    return WallTerm(discretisation, "image_loads", _mirrored_work, "f")


def _mirrored_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    def mirrored_work(
        x_ij: vector,
        image_i: real,
        y_i: real,
        f_i: vector,
        mirrored: real,
        foot: vector,
        s: neighbourhood_type(d.precision),
    ) -> real:
        return (-mirrored * image_i * y_i * s.volume) * wp.dot(normal(gradient(x_ij, s), foot), f_i)

    return mirrored_work


class ImageLoads:
    """The forces of images over the volume of a particle, vectors (n,) [N / m^d], of the sorted particles of a step on
    the device, which the next call overwrites."""

    def __init__(self, density: Surroundings):
        self._density, self._layout = density, density.layout
        self._kernels = image_load_kernels(density.discretisation)
        self._walls = WallSums(mirrored_term(density.discretisation), density.layout)
        self._faces = FaceShares(density.discretisation, density.layout, density.faces)

    def total(self, step: StepContext, solid: int, p: wp.array) -> wp.array:
        """Return the forces by pressures p (n,) [Pa] on the walls of a solid, or on all."""
        found, known = self._vectors["total"], {"y": p, "image": self._density.around["image"]}
        step.launch(self._kernels.forward, known, solid=solid, total=found)
        add(self._walls.total(step, solid, known), found)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int, p: wp.array, p_dot: wp.array) -> wp.array:
        """Return the tangents of the forces, after forward mode of the step."""
        found, around = self._vectors["total_dot"], self._tangent
        around.measure(step, dot)
        known = {"y": p, "image": self._density.around["image"]}
        known |= {"y_dot": p_dot, "image_dot": around.around["image_dot"]}
        step.launch(self._kernels.tangent, known, *dot.named, solid=solid, total_dot=found)
        add(self._walls.tangent(step, dot, solid, known), found)
        return found

    def adjoint(
        self, step: StepContext, bar: Adjoints, solid: int, p: wp.array, total_bar: wp.array, p_bar: wp.array
    ) -> None:
        """Add to the adjoints of particles, solids and pressures by that of the forces."""
        around = self._adjoint
        around.begin()
        known = {"y": p, "image": self._density.around["image"]}
        known |= {"y_bar": p_bar, "image_bar": around.around["image_bar"]}
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
