"""Surface tension by curvature (`cortado.sph.curvature`), or for PCISPH as a stress between pairs of particles.

`docs/discretisation.md` has the equations of the stress (continuum surface stress, Lafaurie et al. 1994). The surface
normal points out of the fluid. The factor 1 / N makes the normal's length 1 in the outermost layer of a cut lattice,
and about 0 inside the fluid. The stress S pulls along the surface. If `PART` is below 1, the stress also pulls a little
across the surface, so that particles do not detach. The force of a pair grows with distance up to 0.65 h, so that
particles of the surface do not clump. The divisor Gamma is `RELAXED` times the surface tension that a cut lattice would
have for sigma / Gamma = 1.

The stress conserves only momentum exactly, because the forces of a pair are opposite, but not parallel to the pair.
Neither the curvature force nor the stress is the gradient of an energy. Fluids with very low viscosity therefore gain
energy; see `LEAST_VISCOSITY`.
"""

from collections.abc import Callable
from functools import cache
from math import pi, sqrt
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import TypesByName
from cortado.discretise.smoothing import lattice_offsets
from cortado.errors import warn
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.particles.particle_kernels import sum_kernel, sum_kernels
from cortado.particles.state import Layout
from cortado.sph.curvature import CurvatureConstants, curvature_kernels
from cortado.sph.parts import Adjoints, Force, Setting, StepContext, Tangents

PART = 2.0 / 3.0


def tension_term(discretisation: Discretisation) -> Callable[..., Any]:
    real, vector, neighbourhood = discretisation.types
    part, one = wp.constant(real(PART)), wp.constant(real(1.0))

    @wp.func
    def pull(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return s * d * d

    @wp.func
    def stress(n: vector, x: vector) -> vector:
        return (wp.dot(n, n) * x - (part * wp.dot(n, x)) * n) / wp.sqrt(one + wp.dot(n, n))

    @TypesByName(real, {vector: "x normals", neighbourhood: "s"})
    def tension(x_ij, normals_i, normals_j, m_i, sigma, s) -> vector:
        both = stress(normals_i, x_ij) + stress(normals_j, x_ij)
        return (-sigma / m_i * pull(x_ij, s.support * s.support)) * both

    return tension


@cache
def surface_tension_kernels(discretisation: Discretisation) -> Kernels:
    modules = discretisation.modules("surface_tension")
    total = fluid_sum(discretisation)(tension_term(discretisation))
    tangent = made_tangent(discretisation, tension_term, modules[1])
    adjoint = made_adjoint(discretisation, tension_term, modules[2])
    sums, named = (total, tangent, adjoint), {"before": "acceleration_in", "times": "scale", "sigma": "surface_tension"}
    return sum_kernels("accelerate", modules, sums, "acceleration", numbers=["scale"], written=["normals"], **named)


@cache
def normal_kernels(discretisation: Discretisation) -> Kernels:
    real, vector, neighbourhood = discretisation.types
    one = wp.constant(real(1.0))

    @fluid_sum(discretisation)
    def arrows(x_ij: vector, s: neighbourhood) -> vector:
        d = wp.max(one - wp.dot(x_ij, x_ij) / (s.support * s.support), real(0.0))
        return (d * d) * x_ij

    @adjoint_of(arrows)
    @tangent_of(arrows)
    @fluid_sum(discretisation)
    def change(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        h2 = s.support * s.support
        d = wp.max(one - wp.dot(x_ij, x_ij) / h2, real(0.0))
        return (d * d) * v_ij - (real(4.0) * d * wp.dot(x_ij, v_ij) / h2) * x_ij

    module, tangent_module, adjoint_module = discretisation.modules("surface_tension")
    scaled: dict[str, Any] = {"times": "inverse", "numbers": ["inverse"]}
    return Kernels(
        sum_kernel("normal", module, "normals", arrows, **scaled),
        sum_kernel("normal_tangent", tangent_module, "normals_dot", change, **scaled, v="x_dot"),
        sum_kernel("normal_adjoint", adjoint_module, "+x_bar", change, **scaled, v="normals_bar"),
    )


class CurvatureTension:
    shares: tuple[str, ...] = ("surface_tension",)
    batches = True

    def __init__(self, discretisation: Discretisation, dimension: int, constants: CurvatureConstants, layout: Layout):
        self._kernels = curvature_kernels(discretisation, dimension)
        self._constants = {"spacing": constants.spacing, "depth": constants.depth, "per_width": 1.0 / constants.width}
        real, vector, matrix = layout.precision.real, layout.precision.vector, layout.precision.matrix
        kinds = dict.fromkeys("gqe", vector) | dict.fromkeys("BD", matrix) | dict.fromkeys("zwcab", real)
        self._of = layout.arrays(requires_grad=discretisation.taped, **kinds)
        self._change = layout.arrays(**kinds, r=vector)
        self._dot, self._bar = ({f"{name}_{kind}": self._change[name] for name in kinds} for kind in ("dot", "bar"))

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        known = self._constants, self._of
        for kernels in self._kernels.colour, self._kernels.normal, self._kernels.bend:
            step.launch(kernels.forward, *known)
        step.launch(self._kernels.mean.forward, *known, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = *dot.named, self._constants, self._of, self._dot
        for kernels in self._kernels.colour, self._kernels.normal, self._kernels.bend:
            step.launch(kernels.tangent, *known)
        step.launch(self._kernels.mean.tangent, *known, acceleration_in_dot=before, acceleration_dot=after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        known = *bar.named, self._constants, self._of, self._bar, {"r": self._change["r"]}
        force, mean = self._kernels.mean.adjoint
        step.launch(force, *known, acceleration_bar=acceleration_bar)
        for kernel in mean, self._kernels.bend.adjoint, self._kernels.normal.adjoint, self._kernels.colour.adjoint:
            step.launch(kernel, *known)


RELAXED = {2: 1.1, 3: 1.25}
"""Surface tension after the particles have moved, relative to particles on a lattice, for each dimension."""
LEAST_SUPPORT = {"pairs": 1.8, "curvature": 2.5}
"""Smallest support radius for each kind of surface tension [spacings]."""
LEAST_VISCOSITY = 0.05
"""Smallest viscosity of stable drops, divided by sqrt(density * surface tension * radius) [-]."""


class SurfaceTension:
    shares: tuple[str, ...] = ("surface_tension",)
    batches = True

    def __init__(self, discretisation: Discretisation, inverse: float, scale: float, layout: Layout):
        self._normal, self._kernels = normal_kernels(discretisation), surface_tension_kernels(discretisation)
        self._inverse, self._scale = inverse, scale
        vector = layout.precision.vector
        self._n, self._change = layout.arrays(requires_grad=True, n=vector)["n"], layout.arrays(n=vector)["n"]

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._normal.forward, inverse=self._inverse, normals=self._n)
        now = {"normals": self._n, "acceleration_in": before, "acceleration": after}
        step.launch(self._kernels.forward, scale=self._scale, **now)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        step.launch(self._normal.tangent, *dot.named, inverse=self._inverse, normals_dot=self._change)
        now = {"normals": self._n, "normals_dot": self._change}
        accelerations = {"acceleration_in_dot": before, "acceleration_dot": after}
        step.launch(self._kernels.tangent, *dot.named, scale=self._scale, **now, **accelerations)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        now = {"normals": self._n, "normals_bar": self._change, "acceleration_bar": acceleration_bar}
        step.launch(self._kernels.adjoint, *bar.named, scale=self._scale, **now)
        step.launch(self._normal.adjoint, *bar.named, inverse=self._inverse, normals_bar=self._change)


def tension_constants(spacing: float, support: float, dimension: int) -> tuple[float, float]:
    """Return the factors of surface normals [1 / m] and of the force [1 / m^(d + 2)], from a cut lattice."""
    offsets = lattice_offsets(spacing, support, dimension)
    s = (offsets**2).sum(axis=1) / support**2
    outwards = np.rint(offsets[:, 0] / spacing).astype(int)
    planes = int(support / spacing) + 1
    arrows = (1.0 - s) ** 2 * offsets[:, 0]
    sums = np.array([-arrows[outwards <= depth].sum() for depth in range(planes)])
    squares = np.zeros(3 * planes)  # |n|^2 by depth in planes; 0 where a particle sees no surface
    squares[:planes] = (sums / sums[0]) ** 2
    along = squares / np.sqrt(1.0 + squares)
    pulls = s * (1.0 - s) ** 2 * offsets[:, 1] ** 2
    tension = 0.0
    for depth in range(2 * planes):
        inside = outwards <= depth
        both = along[depth] + along[np.where(inside, depth - outwards, 0)]
        tension += 0.5 * float((pulls * both)[inside].sum()) / spacing ** (dimension - 1)
    return 1.0 / float(sums[0]), 1.0 / (RELAXED[dimension] * tension * spacing**dimension)


def force(setting: Setting) -> Force:
    """Make the surface tension of a scene. Warn if the force is likely to tear the fluid apart."""
    scene, lattice = setting.scene, setting.lattice
    form = "pairs" if scene.solver.kind == "pcisph" else "curvature"
    support, least = scene.discretisation.support, LEAST_SUPPORT[form]
    if support < least:
        needed = f"surface tension needs at least {least:g} to hold a fluid together"
        warn(f"discretisation.support is {support:g}, but {needed}.")
    spacing, tension, dimension = scene.discretisation.spacing, scene.forces.surface_tension, scene.dimension
    unit_ball = pi if dimension == 2 else 4.0 * pi / 3.0
    radius = spacing * (setting.layout.particles / unit_ball) ** (1.0 / dimension)
    for phase in scene.phase:
        least = LEAST_VISCOSITY * sqrt(phase.rest_density * tension * radius)
        viscosity = 0.0 if scene.forces.viscosity == "none" else phase.viscosity
        if viscosity < least:
            warn(
                f"the viscosity of phase {phase.name!r} is {viscosity:g} Pa s, but should be at least "
                f"{least:.2g} Pa s for this amount of fluid and a surface tension of {tension:g} N/m. Otherwise the "
                "surface gains energy and throws out particles."
            )
    if form == "curvature":
        known = CurvatureConstants.of(setting.discretisation.smoothing, spacing, lattice.support, dimension)
        return CurvatureTension(setting.discretisation, dimension, known, setting.layout)
    constants = tension_constants(spacing, lattice.support, dimension)
    return SurfaceTension(setting.discretisation, *constants, setting.layout)
