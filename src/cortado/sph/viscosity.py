"""The viscous force of pairs of particles (Monaghan 2005), which PCISPH may use instead of the viscous stress.

`docs/discretisation.md` has the equations. The viscosity of a pair is the harmonic mean of two viscosities, which keeps
the shear stress continuous between fluids (Cleary and Monaghan 1999). The forces of a pair are opposite and parallel to
the pair, so that momentum and angular momentum are conserved.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, by_name
from cortado.device.precision import TypesByName, arithmetic
from cortado.device.reduction import add
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import adjoint_of, fluid_sum, rubbing_sum, tangent_of
from cortado.particles.particle_kernels import sum_kernels
from cortado.particles.wall_terms import ALL_WALLS, WallTerm
from cortado.sph.density import WallSums
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.viscous_stress import ViscousStress, stress_of


@cache
def pairwise(discretisation: Discretisation) -> SimpleNamespace:
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    slope, slope_change, per_size = pair.slope, pair.slope_change, pair.per_size

    @wp.func
    def force(x: vector, v: vector, s: neighbourhood) -> vector:
        return (wp.dot(v, x) * per_size(x, s) * slope(x, s)) * x

    @wp.func
    def tangent(x: vector, v: vector, x_dot: vector, v_dot: vector, s: neighbourhood) -> vector:
        per_d = per_size(x, s)
        a = slope(x, s)
        b = wp.dot(v, x) * per_d
        b_dot = (wp.dot(v_dot, x) + wp.dot(v, x_dot) - real(2.0) * b * wp.dot(x, x_dot)) * per_d
        return (b_dot * a + b * slope_change(x, x_dot, s)) * x + (b * a) * x_dot

    @wp.func
    def adjoint_x(x: vector, v: vector, w: vector, s: neighbourhood) -> vector:
        a = slope(x, s)
        b = wp.dot(v, x) * per_size(x, s)
        t = a * per_size(x, s) * wp.dot(x, w)
        return (b * a) * w + t * v + (b * (slope_change(x, w, s) - real(2.0) * t)) * x

    @wp.func
    def adjoint_v(x: vector, v: vector, w: vector, s: neighbourhood) -> vector:
        return (slope(x, s) * per_size(x, s) * wp.dot(x, w)) * x

    return by_name(force, tangent, adjoint_x, adjoint_v)


@cache
def viscosity_kernels(discretisation: Discretisation, sticks: bool) -> Kernels:
    """The derivatives leave walls out; see `viscosity_term`."""
    real, vector, neighbourhood = discretisation.types
    phi = pairwise(discretisation)
    phi_force, phi_tangent, phi_adjoint_x, phi_adjoint_v = phi.force, phi.tangent, phi.adjoint_x, phi.adjoint_v
    reciprocal = arithmetic(discretisation.precision, discretisation.taped).reciprocal
    tiny = wp.constant(real(discretisation.precision.tiny))
    name = "pairwise" + "_no_slip" * sticks  # a module for each: their functions have the same names

    @wp.func
    def part(a: real, b: real) -> real:
        return wp.where(a + b > tiny, b * reciprocal(a + b), real(0.5))

    @wp.func
    def pair_viscosity(a: real, b: real) -> real:
        return real(2.0) * a * part(a, b)

    @wp.func
    def pair_viscosity_derivative(a: real, b: real) -> real:
        return real(2.0) * part(a, b) * part(a, b)

    @wp.func_grad(pair_viscosity)
    def adjoin_pair_viscosity(a: real, b: real, bar: real):
        wp.adjoint[a] += pair_viscosity_derivative(a, b) * bar
        wp.adjoint[b] += pair_viscosity_derivative(b, a) * bar

    typed = TypesByName(real, {vector: "x v bar", neighbourhood: "s"})

    @typed
    def wall_force(x_ij, v_ij, n_i, m_i, mu_i, k, s) -> vector:
        return (k * s.volume / (m_i * n_i) * mu_i) * phi_force(x_ij, v_ij, s)

    @rubbing_sum(discretisation, sticks, typed)(wall_force)
    def force(x_ij, v_ij, n_i, n_j, m_i, mu_i, mu_j, k, s) -> vector:
        weight = pair_viscosity(mu_i, mu_j) * reciprocal(n_j)
        return (k * s.volume / (m_i * n_i) * weight) * phi_force(x_ij, v_ij, s)

    @tangent_of(force)
    @fluid_sum(discretisation, typed, ahead=False)
    def force_tangent(
        x_ij, x_dot_ij, v_ij, v_dot_ij, n_i, n_j, n_dot_i, n_dot_j, m_i, m_dot_i, mu_i, mu_j, mu_dot_i, mu_dot_j, k, s
    ) -> vector:
        mu_ij = pair_viscosity(mu_i, mu_j)
        own = pair_viscosity_derivative(mu_i, mu_j) * mu_dot_i
        mu_dot_ij = own + pair_viscosity_derivative(mu_j, mu_i) * mu_dot_j
        change = mu_dot_ij - mu_ij * (m_dot_i / m_i + n_dot_i / n_i + n_dot_j / n_j)
        total = change * phi_force(x_ij, v_ij, s) + mu_ij * phi_tangent(x_ij, v_ij, x_dot_ij, v_dot_ij, s)
        return (k * s.volume / (m_i * n_i * n_j)) * total

    @adjoint_of(force)
    @fluid_sum(discretisation, typed)
    def force_adjoint(
        x_ij, v_ij, n_i, n_j, m_i, m_j, mu_i, mu_j, bar_i, bar_j, k, s
    ) -> tuple[vector, vector, real, real, real]:
        w_i = bar_i * reciprocal(m_i)
        w_ij = w_i - bar_j * reciprocal(m_j)
        per_volume = k * s.volume * reciprocal(n_i) * reciprocal(n_j)
        weight = per_volume * pair_viscosity(mu_i, mu_j)
        pushed = phi_force(x_ij, v_ij, s)
        work = wp.dot(pushed, w_ij)
        x_part = phi_adjoint_x(x_ij, v_ij, weight * w_ij, s)
        v_part = phi_adjoint_v(x_ij, v_ij, weight * w_ij, s)
        m_part = -weight * wp.dot(pushed, w_i) * reciprocal(m_i)
        mu_part = per_volume * pair_viscosity_derivative(mu_i, mu_j) * work
        return x_part, v_part, -weight * work * reciprocal(n_i), m_part, mu_part

    sums, modules = (force, force_tangent, force_adjoint), discretisation.modules(name)
    return sum_kernels("viscosity", modules, sums, "acceleration", before="acceleration_in", numbers=["k"])


@cache
def viscosity_term(discretisation: Discretisation) -> WallTerm:
    def made(d: Discretisation) -> Any:
        (real, vector, neighbourhood), phi = d.types, pairwise(d).force
        kinds = {vector: "x v acceleration", d.precision.pair: "constants", neighbourhood: "s"}

        @TypesByName(real, kinds)
        def viscosity_work(x_ij, v_ij, n_i, m_i, mu_i, acceleration_bar_i, constants, s) -> real:
            scale = constants[0] * s.volume / (m_i * n_i) * mu_i
            return scale * wp.dot(phi(x_ij, v_ij, s), acceleration_bar_i)

        return viscosity_work

    return WallTerm(discretisation, "pairwise", made, "acceleration_bar", rubs=True)


class Viscosity:
    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, setting: Setting):
        discretisation, self.sticks = setting.discretisation, setting.scene.sticks
        self._k = 2.0 * (setting.scene.dimension + 2)
        self._kernels = viscosity_kernels(discretisation, self.sticks)
        action = WallSums(viscosity_term(discretisation), setting.layout, (self._k, 0.0))
        self.wall_action = action if self.sticks else None

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._kernels.forward, k=self._k, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        step.launch(self._kernels.tangent, *dot.named, k=self._k, acceleration_in_dot=before, acceleration_dot=after)
        if self.wall_action is not None:
            add(self.wall_action.tangent(step, dot, ALL_WALLS), after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        step.launch(self._kernels.adjoint, *bar.named, k=self._k, acceleration_bar=acceleration_bar)
        if self.wall_action is not None:
            self.wall_action.adjoint(step, bar, ALL_WALLS, acceleration_bar, acceleration_bar)


def force(setting: Setting) -> Viscosity | ViscousStress | None:
    form = setting.scene.forces.viscosity
    if form == "stress":
        return stress_of(setting.scene)(setting)
    return Viscosity(setting) if form == "pairwise" else None
