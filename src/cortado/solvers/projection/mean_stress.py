"""The mean normal stress of the projection's pressures about a particle, which is the pressure that a gauge reads.

Particle j pushes i with the force -V (T_i + T_j) g_ij and wall particle b with -V k_i b_ib, where T = k L, and b_ib is
what b adds to gamma_i, all times 1 / dt. The momentum that these forces carry is spread evenly from particle to
particle, and to the point s_b of the wall's surface (the virial of Irving and Kirkwood 1950):

    dt p_i = (-1/2 sum_j x_ij . (T_i + T_j) g_ij - k_i r_i) / d,   r_i = sum_b b_ib . (x_i - s_b),

in d dimensions, where images and walls that mirror (`cortado.solvers.projection.images`) count h and 1 - h times.
The multiplier k / dt is no stress beside a wall, where neighbours are missing, and scatters where they
are uneven, so that the forces do not.

Kernels divide impulses, k or dt p, by the time step.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.lanes import lane_functions
from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum, image_sum
from cortado.particles.solid_shares import ALL_WALLS
from cortado.particles.state import Layout
from cortado.particles.wall_terms import WallTerm
from cortado.solvers.projection.images import CONTAINER
from cortado.solvers.projection.walls import normal_part
from cortado.sph.integration import integration_module
from cortado.sph.moment_functions import matrix_type, moment_functions, symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents
from cortado.sph.walls import WallSums

TOPIC = "mean_stress"
"""Of its Warp modules, with the dimension behind it where that counts."""


class MeanStress:
    """dt p of the sorted particles of a step, with its derivatives. ``around`` is what surrounds them
    (`cortado.solvers.projection.surroundings`), and ``at`` has k and T of the last iteration."""

    def __init__(self, discretisation: Discretisation, layout: Layout, dimension: int):
        self._kernels = mean_stress_kernels(discretisation, dimension)
        self._reach = WallSums(reach_term(discretisation), layout)
        self._mirrors = WallSums(mirror_term(discretisation), layout)
        self._arrays = layout.arrays(q=layout.precision.real, reach_bar=layout.precision.vector)

    def impulses(self, context: StepContext, around: Named, at: Named) -> wp.array:
        """(n,) dt p [Pa s]"""
        found, reach = self._arrays["q"], self._reach.total(context, ALL_WALLS, around)
        mirrors = self._mirrors.total(context, CONTAINER, around)
        context.launch(self._kernels.forward, around, at, reach=reach, mirrors=mirrors, q=found)
        return found

    def tangent(self, context: StepContext, dot: Tangents, around: tuple[Named, ...], at: Named) -> NDArray:
        """(n,) that of dt p; ``around`` and ``at`` with their tangents."""
        reach = self._reach.total(context, ALL_WALLS, *around)
        reach_dot = self._reach.tangent(context, dot, ALL_WALLS, *around)
        mirrors = self._mirrors.total(context, CONTAINER, *around)
        mirrors_dot = self._mirrors.tangent(context, dot, CONTAINER, *around)
        found, walls = self._arrays["q"], {"reach": reach, "mirrors": mirrors}
        walls |= {"reach_dot": reach_dot, "mirrors_dot": mirrors_dot}
        context.launch(self._kernels.tangent, *dot.named, *around, at, walls, q_dot=found)
        return np.array(found.numpy())

    def adjoint(self, context: StepContext, bar: Adjoints, around: tuple[Named, ...], at: Named) -> None:
        """From ``q_bar`` in ``at`` add to ``k_bar`` there, to the adjoints of particles, and to those of ``around``."""
        own, pairs = self._kernels.adjoint
        reach, reach_bar = self._reach.total(context, ALL_WALLS, *around), self._arrays["reach_bar"]
        mirrors = self._mirrors.total(context, CONTAINER, *around)
        context.launch(own, *bar.named, at, reach=reach, mirrors=mirrors, reach_bar=reach_bar)
        context.launch(pairs, *bar.named, *around, at)
        self._reach.adjoint(context, bar, ALL_WALLS, reach_bar, reach_bar, *around)
        self._mirrors.adjoint(context, bar, CONTAINER, reach_bar, reach_bar, *around)


def spread_term(d: Discretisation) -> Any:
    """The term -1/2 x_ij . (T_i + T_j) g_ij of a pair."""
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient
    six, times = symmetric(d.precision).kind, symmetric(d.precision).times

    def spread(x_ij: vector, T_i: six, T_j: six, s: neighbourhood_type(d.precision)) -> real:
        return real(-0.5) * s.volume * wp.dot(gradient(x_ij, s), times(T_i + T_j, x_ij))

    return spread


@cache
def mean_stress_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """The kernels of dt p, given r as the first component of the sum of the arrays ``reach`` and ``mirrors``."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, (six, pack) = neighbourhood_type(precision), (symmetric(precision).kind, symmetric(precision).pack)
    whole, per = moment_functions(precision, dimension).change, wp.constant(real(1.0 / dimension))
    topic = f"{TOPIC}_{dimension}d"
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    spread = fluid_sum(discretisation, module=module)(spread_term(discretisation))
    spread_tangent = made_tangent(discretisation, spread_term, tangent_module)
    spread_adjoint = made_adjoint(discretisation, spread_term, adjoint_module)
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @image_sum(discretisation)
    def images(x_ij: vector, k_i: real, k_j: real, image_i: real, image_j: real, s: neighbourhood) -> real:
        return real(-0.5) * s.volume * (image_i * k_i + image_j * k_j) * wp.dot(gradient(x_ij, s), x_ij)

    @image_sum(discretisation)
    def images_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        k_i: real,
        k_j: real,
        k_dot_i: real,
        k_dot_j: real,
        image_i: real,
        image_j: real,
        image_dot_i: real,
        image_dot_j: real,
        s: neighbourhood,
    ) -> real:
        c, g = image_i * k_i + image_j * k_j, gradient(x_ij, s)
        c_dot = image_dot_i * k_i + image_i * k_dot_i + image_dot_j * k_j + image_j * k_dot_j
        bent = wp.dot(hessian_product(x_ij, x_ij, s) + g, x_dot_ij)
        return real(-0.5) * s.volume * (c_dot * wp.dot(g, x_ij) + c * bent)

    @image_sum(discretisation)
    def images_back(
        x_ij: vector, k_i: real, k_j: real, image_i: real, image_j: real, q_bar_i: real, q_bar_j: real, s: neighbourhood
    ) -> tuple[vector, real]:
        bar, g = real(-0.5) * s.volume * (q_bar_i + q_bar_j), gradient(x_ij, s)
        bent = hessian_product(x_ij, x_ij, s) + g
        return (bar * (image_i * k_i + image_j * k_j)) * bent, bar * wp.dot(g, x_ij)

    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def mean_stress(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        T: wp.array(dtype=six),
        k: wp.array(dtype=real),
        image: wp.array(dtype=real),
        reach: wp.array(dtype=vector),
        mirrors: wp.array(dtype=vector),
        # out
        q: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = spread(i, x, T, s) + images(i, x, k, image, s)
        if lane() > 0:
            return
        q[i] = per * (total - k[i] * (reach[i][0] + mirrors[i][0]))

    @wp.kernel(module=tangent_module, enable_backward=False)
    def mean_stress_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        T: wp.array(dtype=six),
        T_dot: wp.array(dtype=six),
        k: wp.array(dtype=real),
        k_dot: wp.array(dtype=real),
        reach: wp.array(dtype=vector),
        reach_dot: wp.array(dtype=vector),
        image: wp.array(dtype=real),
        image_dot: wp.array(dtype=real),
        mirrors: wp.array(dtype=vector),
        mirrors_dot: wp.array(dtype=vector),
        # out
        q_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = spread_tangent(i, x, x_dot, T, T_dot, s) + images_tangent(i, x, x_dot, k, k_dot, image, image_dot, s)
        if lane() > 0:
            return
        change = k_dot[i] * (reach[i][0] + mirrors[i][0]) + k[i] * (reach_dot[i][0] + mirrors_dot[i][0])
        q_dot[i] = per * (total - change)

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def own_adjoint(
        k: wp.array(dtype=real),
        reach: wp.array(dtype=vector),
        mirrors: wp.array(dtype=vector),
        # in and out: ``q_bar`` at first that of q, at last that of the sum over neighbours
        q_bar: wp.array(dtype=real),
        k_bar: wp.array(dtype=real),
        # out
        reach_bar: wp.array(dtype=vector),
    ):
        i = wp.tid()
        bar = per * q_bar[i]
        k_bar[i] = k_bar[i] - bar * (reach[i][0] + mirrors[i][0])
        reach_bar[i] = vector(-bar * k[i], real(0.0), real(0.0))
        q_bar[i] = bar

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def mean_stress_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        L: wp.array(dtype=matrix),
        T: wp.array(dtype=six),
        k: wp.array(dtype=real),
        q_bar: wp.array(dtype=real),
        image: wp.array(dtype=real),
        # in and out
        image_bar: wp.array(dtype=real),
        x_bar: wp.array(dtype=vector),
        L_bar: wp.array(dtype=matrix),
        k_bar: wp.array(dtype=real),
    ):
        """T is k L."""
        i = s.first + wp.tid() // LANES
        x_part, T_part = spread_adjoint(i, x, T, q_bar, s)
        x_lift, lifted = images_back(i, x, k, image, q_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part + x_lift
        image_bar[i] = image_bar[i] + k[i] * lifted
        k_bar[i] = k_bar[i] + wp.dot(T_part, pack(L[i])) + image[i] * lifted
        L_bar[i] = L_bar[i] + k[i] * whole(
            vector(T_part[0], T_part[1], T_part[2]), real(0.5) * vector(T_part[3], T_part[4], T_part[5])
        )

    return Kernels(mean_stress, mean_stress_tangent, (own_adjoint, mean_stress_adjoint))


def reach_term(discretisation: Discretisation) -> WallTerm:
    """(r, 0, 0) of the walls of a solid, with the adjoint ``reach_bar``."""
    return WallTerm(discretisation, TOPIC, _reach_work, "reach_bar")


def _reach_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    def reach_work(
        x_ij: vector, edge_i: real, reach_bar_i: vector, foot: vector, s: neighbourhood_type(d.precision)
    ) -> real:
        whole, from_surface = s.volume * gradient(x_ij, s), x_ij - foot
        part = normal(whole, foot)
        return wp.dot(part + edge_i * (whole - part), from_surface) * reach_bar_i[0]

    return reach_work


def mirror_term(discretisation: Discretisation) -> WallTerm:
    """(-h r, 0, 0) of walls that mirror, which count 1 - h times, with the same adjoint."""
    return WallTerm(discretisation, TOPIC, _mirror_work, "reach_bar")


def _mirror_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    def mirror_work(
        x_ij: vector, image_i: real, reach_bar_i: vector, foot: vector, s: neighbourhood_type(d.precision)
    ) -> real:
        return -wp.dot(s.volume * normal(gradient(x_ij, s), foot), x_ij - foot) * image_i * reach_bar_i[0]

    return mirror_work


@cache
def pressed_adjoint_kernel(precision: Precision) -> Any:
    """From the adjoint of a pressure to those of its impulse and of dt."""
    real = precision.real

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def pressed_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        impulse: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
        # in and out
        impulse_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        impulse_bar[i] = impulse_bar[i] + p_bar[i] / dt
        time_step_bar[i] = time_step_bar[i] - impulse[i] / (dt * dt) * p_bar[i]

    return pressed_adjoint
