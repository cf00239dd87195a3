"""Viscous forces between pairs and with walls at rest:

a_i = kappa / (m_i n_i) (sum_j (V / n_j) mu_ij phi(x_ij, v_ij) + friction mu_i sum_b V_b phi(x_ib, v_i))

pairwise:  phi = B G,  B = v . x / (|x|^2 + 0.01 h^2),  kappa = 2 (d + 2)     (Monaghan 2005)
laminar:   phi = F v,  F = x . G / (|x|^2 + 0.01 h^2),  kappa = 2             (Morris, Fox and Zhu 1997)

mu_ij = 2 mu_i mu_j / (mu_i + mu_j) is the dynamic viscosity of a pair [Pa s] (Cleary and Monaghan 1999: the harmonic
mean keeps the shear stress continuous between fluids); friction is 0 for a wall with free slip, else about 1
(`WallLayer.friction`). phi is odd in (x, v) together, so that momentum is kept; the pairwise form is central and keeps
angular momentum too, but carries no shear to a wall, which the laminar form does.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.arithmetic import arithmetic
from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.sph.pair_forces import PairForm, laminar, pairwise
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents


@cache
def viscosity_kernels(discretisation: Discretisation, form: PairForm) -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the viscous acceleration with a given pair force phi."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, vectors, numbers = pair.separation, pair.vectors, pair.numbers
    phi = form(discretisation)
    phi_force, phi_tangent, phi_adjoint_x, phi_adjoint_v = phi.force, phi.tangent, phi.adjoint_x, phi.adjoint_v
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up, add_up_vectors = lanes.lane, lanes.add_up, lanes.add_up_vectors
    reciprocal = arithmetic(discretisation.precision, discretisation.taped).reciprocal
    tiny = wp.constant(real(discretisation.precision.tiny))
    name = form.__name__  # a module for each form: their functions have the same names

    @wp.func
    def part(a: real, b: real) -> real:
        """b / (a + b), and half where both are 0."""
        return wp.where(a + b > tiny, b * reciprocal(a + b), real(0.5))

    @wp.func
    def pair_viscosity(a: real, b: real) -> real:
        """mu_ij, the harmonic mean of two viscosities; 0 where both are 0."""
        return real(2.0) * a * part(a, b)

    @wp.func
    def pair_viscosity_derivative(a: real, b: real) -> real:
        """d mu_ij / d mu_i; where both are 0, the derivative for both increasing together."""
        return real(2.0) * part(a, b) * part(a, b)

    @wp.func_grad(pair_viscosity)
    def adjoin_pair_viscosity(a: real, b: real, bar: real):
        wp.adjoint[a] += pair_viscosity_derivative(a, b) * bar
        wp.adjoint[b] += pair_viscosity_derivative(b, a) * bar

    @wp.func
    def force_sum(
        i: int,
        friction: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        s: neighbourhood,
    ) -> vector:
        x_i = x[i]
        v_i = v[i]
        mu_i = mu[i]
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            n_j = numbers(n, k, i, s)
            mu_j = numbers(mu, k, i, s)
            for u in range(UNROLL):
                weight = pair_viscosity(mu_i, mu_j[u]) * s.volume * reciprocal(n_j[u])
                total += weight * phi_force(separation(x_i, x_j[u], s), v_i - v_j[u], s)
        if friction != real(0.0):
            for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
                b = neighbour(k, i, s)
                x_ib = separation(x_i, wall_position(b, s), s)
                total += (mu_i * friction * s.volume * wall_weight(b, s)) * phi_force(x_ib, v_i, s)
        return add_up_vectors(total)

    @wp.func
    def force_sum_tangent(
        i: int,
        friction: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        mu_dot: wp.array(dtype=real),
        s: neighbourhood,
    ) -> vector:
        x_i = x[i]
        v_i = v[i]
        mu_i = mu[i]
        x_dot_i = x_dot[i]
        v_dot_i = v_dot[i]
        mu_dot_i = mu_dot[i]
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for u in range(UNROLL):
                j = neighbour(k + u, i, s)
                x_ij = separation(x_i, x[j], s)
                v_ij = v_i - v[j]
                volume_j = s.volume / n[j]
                mu_ij = pair_viscosity(mu_i, mu[j])
                own = pair_viscosity_derivative(mu_i, mu[j]) * mu_dot_i
                mu_dot_ij = own + pair_viscosity_derivative(mu[j], mu_i) * mu_dot[j]
                total += volume_j * (mu_dot_ij - mu_ij * n_dot[j] / n[j]) * phi_force(x_ij, v_ij, s)
                total += (volume_j * mu_ij) * phi_tangent(x_ij, v_ij, x_dot_i - x_dot[j], v_dot_i - v_dot[j], s)
        if friction != real(0.0):
            for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
                b = neighbour(k, i, s)
                x_ib = separation(x_i, wall_position(b, s), s)
                wall_volume = friction * s.volume * wall_weight(b, s)
                total += (wall_volume * mu_dot_i) * phi_force(x_ib, v_i, s)
                total += (wall_volume * mu_i) * phi_tangent(x_ib, v_i, x_dot_i, v_dot_i, s)
        return add_up_vectors(total)

    @wp.kernel(module=discretisation.module(True, name))
    def viscosity(
        s: neighbourhood,
        kappa: real,
        friction: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = force_sum(i, friction, x, v, n, mu, s)
        if lane() > 0:
            return
        acceleration[i] = acceleration_in[i] + (kappa / (m[i] * n[i])) * total

    @wp.kernel(module=discretisation.tangent_module(name), enable_backward=False)
    def viscosity_tangent(
        s: neighbourhood,
        kappa: real,
        friction: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        mu_dot: wp.array(dtype=real),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = force_sum(i, friction, x, v, n, mu, s)
        total_dot = force_sum_tangent(i, friction, x, x_dot, v, v_dot, n, n_dot, mu, mu_dot, s)
        if lane() > 0:
            return
        factor = kappa / (m[i] * n[i])
        change = m_dot[i] / m[i] + n_dot[i] / n[i]
        acceleration_dot[i] = acceleration_in_dot[i] + factor * (total_dot - change * total)

    @wp.kernel(module=discretisation.module(False, name), enable_backward=False)
    def viscosity_adjoint(
        s: neighbourhood,
        kappa: real,
        friction: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        n_bar: wp.array(dtype=real),
        m_bar: wp.array(dtype=real),
        mu_bar: wp.array(dtype=real),
    ):
        """Gathers alone: the pair (i, j) adds to i what it adds to j, seen from i."""
        i = s.first + wp.tid() // LANES
        x_i = x[i]
        v_i = v[i]
        mu_i = mu[i]
        w_i = acceleration_bar[i] / m[i]
        x_sum = vector()
        v_sum = vector()
        work = real(0.0)
        own_work = real(0.0)
        mu_work = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            n_j = numbers(n, k, i, s)
            m_j = numbers(m, k, i, s)
            mu_j = numbers(mu, k, i, s)
            w_j = vectors(acceleration_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                v_ij = v_i - v_j[u]
                w_ij = w_i - reciprocal(m_j[u]) * w_j[u]
                volume_j = s.volume * reciprocal(n_j[u])
                weight = volume_j * pair_viscosity(mu_i, mu_j[u])
                force = phi_force(x_ij, v_ij, s)
                force_work = wp.dot(force, w_ij)
                x_sum += phi_adjoint_x(x_ij, v_ij, weight * w_ij, s)
                v_sum += phi_adjoint_v(x_ij, v_ij, weight * w_ij, s)
                work += weight * force_work
                own_work += weight * wp.dot(force, w_i)
                mu_work += volume_j * pair_viscosity_derivative(mu_i, mu_j[u]) * force_work
        if friction != real(0.0):
            for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
                b = neighbour(k, i, s)
                x_ib = separation(x_i, wall_position(b, s), s)
                wall_volume = friction * s.volume * wall_weight(b, s)
                x_sum += (mu_i * wall_volume) * phi_adjoint_x(x_ib, v_i, w_i, s)
                v_sum += (mu_i * wall_volume) * phi_adjoint_v(x_ib, v_i, w_i, s)
                wall_work = wall_volume * wp.dot(phi_force(x_ib, v_i, s), w_i)
                work += mu_i * wall_work
                own_work += mu_i * wall_work
                mu_work += wall_work
        x_sum = add_up_vectors(x_sum)
        v_sum = add_up_vectors(v_sum)
        work = add_up(work)
        own_work = add_up(own_work)
        mu_work = add_up(mu_work)
        if lane() > 0:
            return
        factor = kappa / n[i]
        x_bar[i] = x_bar[i] + factor * x_sum
        v_bar[i] = v_bar[i] + factor * v_sum
        n_bar[i] = n_bar[i] - factor / n[i] * work
        m_bar[i] = m_bar[i] - factor / m[i] * own_work
        mu_bar[i] = mu_bar[i] + factor * mu_work

    return Kernels(viscosity, viscosity_tangent, viscosity_adjoint)


class Viscosity:
    """A viscous force between neighbours, and with walls."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, discretisation: Discretisation, form: PairForm, kappa: float, friction: float):
        """``friction`` 0 lets walls slip freely."""
        self._kernels, self.friction = viscosity_kernels(discretisation, form), friction
        self._constants: dict[str, Any] = {"kappa": kappa, "friction": friction}

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._kernels.forward, **self._constants, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        accelerations = {"acceleration_in_dot": before, "acceleration_dot": after}
        step.launch(self._kernels.tangent, *dot.named, **self._constants, **accelerations)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        step.launch(self._kernels.adjoint, *bar.named, **self._constants, acceleration_bar=acceleration_bar)


def force(setting: Setting) -> Viscosity | None:
    """The form that a scene names: that of Monaghan (2005), which keeps linear and angular momentum, or that of Morris,
    Fox and Zhu (1997), which carries shear to a wall. None for a scene without."""
    scene, walls = setting.scene, setting.walls
    sticks = getattr(scene.container, "slip", "free") == "no"
    if scene.forces.viscosity == "pairwise":
        return Viscosity(setting.discretisation, pairwise, 2.0 * (scene.dimension + 2), friction=float(sticks))
    if scene.forces.viscosity == "laminar":
        return Viscosity(setting.discretisation, laminar, 2.0, friction=walls.friction if sticks else 0.0)
    return None
