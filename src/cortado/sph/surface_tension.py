"""Surface tension as a stress of pairs (the continuum surface stress of Lafaurie et al. 1994, between particles):

    n_i = (1 / N) sum_j (1 - s)^2 x_ij,   s = |x|^2 / h^2
    S_i = (|n_i|^2 1 - PART n_i n_i) / sqrt(1 + |n_i|^2)
    m_i V a_i = -(sigma / Gamma) sum_j s (1 - s)^2 (S_i + S_j) x_ij

m is the mass over the rest volume V. n points out of the fluid; its size is 1 in the outermost layer of a lattice that
is cut, and about 0 inside. S pulls along the surface, and with PART below 1 also a little across it: a stress along the
surface alone lets particles go, and one that is the same in all directions makes a solid. The force of a pair grows
with its distance up to 0.65 h, so that particles of the surface do not clump. Gamma is the tension of a cut lattice
without it, times `RELAXED`.

Forces of pairs are opposite, so that momentum is kept; as they are not along the pair, angular momentum is so only
nearly. They are the gradient of no energy either: a fluid that has hardly any viscosity takes up energy from them, see
`LEAST_VISCOSITY`. Walls have no part in it, as if there were air between: a surface meets them at 180 degrees.
"""

import warnings
from dataclasses import dataclass
from functools import cache
from math import pi, sqrt
from typing import Any

import numpy as np
import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.errors import CortadoWarning
from cortado.lattice.calibration import lattice_offsets
from cortado.scene.scene import Scene
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents

PART = 2.0 / 3.0
"""How much less of the stress acts across the surface than along it; see above."""
RELAXED = {2: 1.1, 3: 1.25}
"""By dimension: the tension of a surface that has flown over that of a cut lattice, measured in drops: see
docs/discretisation.md."""
LEAST_VISCOSITY = 0.05
"""Over sqrt(rho sigma R) [-], with the radius R of a ball of all the fluid: drops of 16 to 64 particles across hold."""
LEAST_SUPPORT = 1.8
"""In spacings: with 1.5, where a particle sees its nearest neighbours only, drops fall apart."""


@dataclass(frozen=True)
class TensionFunctions:
    """Warp functions of a separation x, where ``h2`` is h^2."""

    arrow: Any
    """(1 - s)^2 x"""
    arrow_change: Any
    """Its derivative along a vector, which is symmetric."""
    pull: Any
    """s (1 - s)^2"""
    pull_derivative: Any
    """Its derivative by |x|^2 / 2, times h^2."""
    stress: Any
    """S(n) x"""
    stress_change: Any
    """Its derivative along a change of n."""
    stress_derivative: Any
    """The derivative of w . S(n) x by n."""


@cache
def tension_functions(discretisation: Discretisation) -> TensionFunctions:
    """The functions for a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    part, one, two = wp.constant(real(PART)), wp.constant(real(1.0)), wp.constant(real(2.0))

    @wp.func
    def arrow(x: vector, h2: real) -> vector:
        d = wp.max(one - wp.dot(x, x) / h2, real(0.0))
        return (d * d) * x

    @wp.func
    def arrow_change(x: vector, v: vector, h2: real) -> vector:
        d = wp.max(one - wp.dot(x, x) / h2, real(0.0))
        return (d * d) * v - (real(4.0) * d * wp.dot(x, v) / h2) * x

    @wp.func
    def pull(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return s * d * d

    @wp.func
    def pull_derivative(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return two * d * (d - two * s)

    @wp.func
    def stress(n: vector, x: vector) -> vector:
        return (wp.dot(n, n) * x - (part * wp.dot(n, x)) * n) / wp.sqrt(one + wp.dot(n, n))

    @wp.func
    def stress_change(n: vector, n_dot: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(n, n_dot) * x - part * (wp.dot(n_dot, x) * n + wp.dot(n, x) * n_dot)
        return turn / wp.sqrt(size) - (wp.dot(n, n_dot) / size) * stress(n, x)

    @wp.func
    def stress_derivative(n: vector, w: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(w, x) * n - part * (wp.dot(n, w) * x + wp.dot(n, x) * w)
        return turn / wp.sqrt(size) - (wp.dot(w, stress(n, x)) / size) * n

    return TensionFunctions(arrow, arrow_change, pull, pull_derivative, stress, stress_change, stress_derivative)


@cache
def normal_kernels(discretisation: Discretisation) -> Kernels:
    """The kernels of n; ``inverse`` is 1 / N."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair, functions = pair_functions(discretisation), tension_functions(discretisation)
    separation, vectors = pair.separation, pair.vectors
    arrow, arrow_change = functions.arrow, functions.arrow_change

    @wp.func
    def arrows(i: int, x: wp.array(dtype=vector), s: neighbourhood) -> vector:
        x_i = x[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            for u in range(UNROLL):
                total += arrow(separation(x_i, x_j[u], s), h2)
        return total

    @wp.func
    def change(i: int, x: wp.array(dtype=vector), v: wp.array(dtype=vector), s: neighbourhood) -> vector:
        """Its tangent along v, and likewise what the adjoint of positions is for an adjoint v of every n."""
        x_i = x[i]
        v_i = v[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            for u in range(UNROLL):
                total += arrow_change(separation(x_i, x_j[u], s), v_i - v_j[u], h2)
        return total

    @wp.kernel(module=discretisation.module(True, "surface_tension"))
    def normal(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        # out
        normals: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total = arrows(i, x, s)
        normals[i] = inverse * total

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def normal_tangent(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        # out
        normals_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        normals_dot[i] = inverse * change(i, x, x_dot, s)

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def normal_adjoint(
        s: neighbourhood,
        inverse: real,
        x: wp.array(dtype=vector),
        normals_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        x_bar[i] = x_bar[i] + inverse * change(i, x, normals_bar, s)

    return Kernels(normal, normal_tangent, normal_adjoint)


@cache
def surface_tension_kernels(discretisation: Discretisation) -> Kernels:
    """The kernels of the acceleration; ``scale`` is 1 / (Gamma V)."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair, functions = pair_functions(discretisation), tension_functions(discretisation)
    separation, vectors, numbers = pair.separation, pair.vectors, pair.numbers
    pull, pull_derivative = functions.pull, functions.pull_derivative
    stress, stress_change, stress_derivative = functions.stress, functions.stress_change, functions.stress_derivative

    @wp.func
    def pulls(i: int, x: wp.array(dtype=vector), normals: wp.array(dtype=vector), s: neighbourhood) -> vector:
        x_i = x[i]
        n_i = normals[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            n_j = vectors(normals, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                total += pull(x_ij, h2) * (stress(n_i, x_ij) + stress(n_j[u], x_ij))
        return total

    @wp.func
    def pulls_change(
        i: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        normals: wp.array(dtype=vector),
        normals_dot: wp.array(dtype=vector),
        s: neighbourhood,
    ) -> vector:
        x_i = x[i]
        n_i = normals[i]
        h2 = s.support * s.support
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            for u in range(UNROLL):
                j = s.neighbours[k + u, i]
                x_ij = separation(x_i, x[j], s)
                x_dot_ij = x_dot[i] - x_dot[j]
                pull_dot = pull_derivative(x_ij, h2) * wp.dot(x_ij, x_dot_ij) / h2
                total += pull_dot * (stress(n_i, x_ij) + stress(normals[j], x_ij))
                turn = stress_change(n_i, normals_dot[i], x_ij) + stress_change(normals[j], normals_dot[j], x_ij)
                total += pull(x_ij, h2) * (turn + stress(n_i, x_dot_ij) + stress(normals[j], x_dot_ij))
        return total

    @wp.kernel(module=discretisation.module(True, "surface_tension"))
    def accelerate(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total = pulls(i, x, normals, s)
        acceleration[i] = acceleration_in[i] - (scale * surface_tension[0] / m[i]) * total

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def accelerate_tangent(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        surface_tension_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        normals_dot: wp.array(dtype=vector),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        sigma = surface_tension[0]
        rate = surface_tension_dot[0] - sigma * m_dot[i] / m[i]
        total = rate * pulls(i, x, normals, s) + sigma * pulls_change(i, x, x_dot, normals, normals_dot, s)
        acceleration_dot[i] = acceleration_in_dot[i] - (scale / m[i]) * total

    @wp.kernel(module=discretisation.module(False, "surface_tension"), enable_backward=False)
    def accelerate_adjoint(
        s: neighbourhood,
        scale: real,
        surface_tension: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        normals: wp.array(dtype=vector),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        surface_tension_bar: wp.array(dtype=real),
        # out
        normals_bar: wp.array(dtype=vector),
    ):
        """w is the adjoint of a force."""
        i = s.first + wp.tid()
        x_i = x[i]
        n_i = normals[i]
        w_i = acceleration_bar[i] / m[i]
        h2 = s.support * s.support
        total = vector()
        x_sum = vector()
        n_sum = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            n_j = vectors(normals, k, i, s)
            m_j = numbers(m, k, i, s)
            bar_j = vectors(acceleration_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                w_ij = w_i - bar_j[u] / m_j[u]
                force = stress(n_i, x_ij) + stress(n_j[u], x_ij)
                g = pull(x_ij, h2)
                total += g * force
                x_sum += g * (stress(n_i, w_ij) + stress(n_j[u], w_ij))
                x_sum += (pull_derivative(x_ij, h2) * wp.dot(force, w_ij) / h2) * x_ij
                n_sum += g * stress_derivative(n_i, w_ij, x_ij)
        sigma = surface_tension[0]
        work = scale * wp.dot(total, w_i)
        x_bar[i] = x_bar[i] - (scale * sigma) * x_sum
        m_bar[i] = m_bar[i] + sigma * work / m[i]
        surface_tension_bar[i] = surface_tension_bar[i] - work
        normals_bar[i] = -(scale * sigma) * n_sum

    return Kernels(accelerate, accelerate_tangent, accelerate_adjoint)


class SurfaceTension:
    """Surface tension of a number of particles; its arrays are those of the last step."""

    shares: tuple[str, ...] = ("surface_tension",)

    def __init__(self, discretisation: Discretisation, inverse: float, scale: float, particles: int, device: Any):
        """``inverse`` and ``scale`` as `tension_constants` gives them."""
        self._normal, self._kernels = normal_kernels(discretisation), surface_tension_kernels(discretisation)
        self._inverse, self._scale = inverse, scale
        vector = discretisation.precision.vector
        self._n = wp.zeros(particles, dtype=vector, device=device, requires_grad=True)
        self._change = wp.zeros(particles, dtype=vector, device=device)

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


def tension_constants(spacing: float, support: float, volume: float, dimension: int) -> tuple[float, float]:
    """1 / N [1 / m] and 1 / (Gamma V) [1 / m^(d + 2)] of a lattice that is cut along an axis."""
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
    return 1.0 / float(sums[0]), 1.0 / (RELAXED[dimension] * tension * volume)


def force(setting: Setting) -> SurfaceTension:
    """Surface tension in a scene that has it; warns where it is likely to tear the fluid apart."""
    scene, lattice = setting.scene, setting.lattice
    _check_support(scene)
    _check_viscosity(scene, setting.particles)
    constants = tension_constants(scene.discretisation.spacing, lattice.support, lattice.volume, scene.dimension)
    return SurfaceTension(setting.discretisation, *constants, setting.particles, setting.device)


def _check_support(scene: Scene) -> None:
    support = scene.discretisation.support
    if support < LEAST_SUPPORT:
        warnings.warn(
            f"discretisation.support is {support:g}, but surface tension needs at least {LEAST_SUPPORT:g} to hold a "
            "fluid together.",
            CortadoWarning,
            stacklevel=2,
        )


def _check_viscosity(scene: Scene, particles: int) -> None:
    spacing, tension, dimension = scene.discretisation.spacing, scene.forces.surface_tension, scene.dimension
    radius = spacing * (particles / (pi if dimension == 2 else 4.0 * pi / 3.0)) ** (1.0 / dimension)
    for phase in scene.phase:
        least = LEAST_VISCOSITY * sqrt(phase.rest_density * tension * radius)
        viscosity = 0.0 if scene.forces.viscosity == "none" else phase.viscosity
        if viscosity < least:
            warnings.warn(
                f"the viscosity of phase {phase.name!r} is {viscosity:g} Pa s, but for so much fluid with a surface "
                f"tension of {tension:g} N/m it should be at least {least:.2g} Pa s: with less, the surface takes up "
                "energy and throws out particles.",
                CortadoWarning,
                stacklevel=2,
            )
