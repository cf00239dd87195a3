"""Viscous forces between pairs and with walls at rest:

a_i = (kappa mu / rho_i) (sum_j (m / rho_j) phi(x_ij, v_ij) + friction sum_b V_b phi(x_ib, v_i))

pairwise:  phi = B G,  B = v . x / (|x|^2 + 0.01 h^2),  kappa = 2 (d + 2)     (report eq. 10; Monaghan 2005)
laminar:   phi = F v,  F = x . G / (|x|^2 + 0.01 h^2),  kappa = 2             (Morris, Fox and Zhu 1997)

mu is the dynamic viscosity [Pa s]; friction is 0 for a wall with free slip, else about 1 (`WallLayer.friction`). phi is
odd in (x, v) together, so that momentum is kept; the pairwise form is central and keeps angular momentum too, but
carries no shear to a wall, which the laminar form does. The 0.01 h^2 covers coincident particles.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.physics.surroundings import UNROLL, Discretisation, pair_functions, surroundings_type


@cache
def pairwise_functions(discretisation: Discretisation) -> SimpleNamespace:
    """phi of the pairwise form: ``force``, ``tangent``, and the transposed derivatives ``adjoint_x``, ``adjoint_v``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    surroundings = surroundings_type(discretisation.precision)
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @wp.func
    def size(x: vector, s: surroundings) -> real:
        return wp.dot(x, x) + real(0.01) * s.support * s.support

    @wp.func
    def force(x: vector, v: vector, s: surroundings) -> vector:
        return (wp.dot(v, x) / size(x, s)) * gradient(x, s)

    @wp.func
    def tangent(x: vector, v: vector, x_dot: vector, v_dot: vector, s: surroundings) -> vector:
        d = size(x, s)
        b = wp.dot(v, x) / d
        b_dot = (wp.dot(v_dot, x) + wp.dot(v, x_dot) - real(2.0) * b * wp.dot(x, x_dot)) / d
        return b_dot * gradient(x, s) + b * hessian_product(x, x_dot, s)

    @wp.func
    def adjoint_x(x: vector, v: vector, w: vector, s: surroundings) -> vector:
        d = size(x, s)
        b = wp.dot(v, x) / d
        return b * hessian_product(x, w, s) + (wp.dot(gradient(x, s), w) / d) * (v - real(2.0) * b * x)

    @wp.func
    def adjoint_v(x: vector, v: vector, w: vector, s: surroundings) -> vector:
        return (wp.dot(gradient(x, s), w) / size(x, s)) * x

    return SimpleNamespace(force=force, tangent=tangent, adjoint_x=adjoint_x, adjoint_v=adjoint_v)


@cache
def laminar_functions(discretisation: Discretisation) -> SimpleNamespace:
    """phi of the laminar form, as `pairwise_functions`."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    surroundings = surroundings_type(discretisation.precision)
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @wp.func
    def size(x: vector, s: surroundings) -> real:
        return wp.dot(x, x) + real(0.01) * s.support * s.support

    @wp.func
    def factor_gradient(x: vector, s: surroundings) -> vector:
        d = size(x, s)
        g = gradient(x, s)
        return (g + hessian_product(x, x, s) - (real(2.0) * wp.dot(x, g) / d) * x) / d

    @wp.func
    def force(x: vector, v: vector, s: surroundings) -> vector:
        return (wp.dot(x, gradient(x, s)) / size(x, s)) * v

    @wp.func
    def tangent(x: vector, v: vector, x_dot: vector, v_dot: vector, s: surroundings) -> vector:
        factor = wp.dot(x, gradient(x, s)) / size(x, s)
        return factor * v_dot + wp.dot(factor_gradient(x, s), x_dot) * v

    @wp.func
    def adjoint_x(x: vector, v: vector, w: vector, s: surroundings) -> vector:
        return wp.dot(v, w) * factor_gradient(x, s)

    @wp.func
    def adjoint_v(x: vector, v: vector, w: vector, s: surroundings) -> vector:
        return (wp.dot(x, gradient(x, s)) / size(x, s)) * w

    return SimpleNamespace(force=force, tangent=tangent, adjoint_x=adjoint_x, adjoint_v=adjoint_v)


PairFunctions = Callable[[Discretisation], SimpleNamespace]


@cache
def viscosity_kernels(discretisation: Discretisation, form: PairFunctions) -> SimpleNamespace:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the viscous acceleration with a given pair force phi."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    surroundings = surroundings_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, vectors, numbers = pair.separation, pair.vectors, pair.numbers
    phi = form(discretisation)
    phi_force, phi_tangent, phi_adjoint_x, phi_adjoint_v = phi.force, phi.tangent, phi.adjoint_x, phi.adjoint_v
    name = form.__name__.removesuffix("_functions")  # a module for each form: their functions share names

    @wp.func
    def force_sum(
        i: int,
        mass: real,
        friction: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        rho: wp.array(dtype=real),
        s: surroundings,
    ) -> vector:
        x_i = x[i]
        v_i = v[i]
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            rho_j = numbers(rho, k, i, s)
            for u in range(UNROLL):
                total += (mass / rho_j[u]) * phi_force(separation(x_i, x_j[u], s), v_i - v_j[u], s)
        if friction != real(0.0):
            for k in range(s.fluid_count[i], s.count[i]):
                b = s.neighbours[k, i]
                x_ib = separation(x_i, s.wall_positions[b], s)
                total += (friction * s.volume * s.wall_weights[b]) * phi_force(x_ib, v_i, s)
        return total

    @wp.func
    def force_sum_tangent(
        i: int,
        mass: real,
        mass_dot: real,
        friction: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        rho: wp.array(dtype=real),
        rho_dot: wp.array(dtype=real),
        s: surroundings,
    ) -> vector:
        x_i = x[i]
        v_i = v[i]
        x_dot_i = x_dot[i]
        v_dot_i = v_dot[i]
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            for u in range(UNROLL):
                j = s.neighbours[k + u, i]
                x_ij = separation(x_i, x[j], s)
                v_ij = v_i - v[j]
                volume_j = mass / rho[j]
                volume_dot_j = (mass_dot - volume_j * rho_dot[j]) / rho[j]
                total += volume_dot_j * phi_force(x_ij, v_ij, s)
                total += volume_j * phi_tangent(x_ij, v_ij, x_dot_i - x_dot[j], v_dot_i - v_dot[j], s)
        if friction != real(0.0):
            for k in range(s.fluid_count[i], s.count[i]):
                b = s.neighbours[k, i]
                x_ib = separation(x_i, s.wall_positions[b], s)
                wall_volume = friction * s.volume * s.wall_weights[b]
                total += wall_volume * phi_tangent(x_ib, v_i, x_dot_i, v_dot_i, s)
        return total

    @wp.kernel(module=discretisation.module(True, name))
    def viscosity(
        s: surroundings,
        kappa: real,
        friction: real,
        rest_density: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        rho: wp.array(dtype=real),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total = force_sum(i, rest_density[0] * s.volume, friction, x, v, rho, s)
        acceleration[i] = acceleration_in[i] + (kappa * mu[0] / rho[i]) * total

    @wp.kernel(module=discretisation.module(False, name), enable_backward=False)
    def viscosity_tangent(
        s: surroundings,
        kappa: real,
        friction: real,
        rest_density: wp.array(dtype=real),
        rest_density_dot: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        mu_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        rho: wp.array(dtype=real),
        rho_dot: wp.array(dtype=real),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        mass = rest_density[0] * s.volume
        mass_dot = rest_density_dot[0] * s.volume
        total = force_sum(i, mass, friction, x, v, rho, s)
        total_dot = force_sum_tangent(i, mass, mass_dot, friction, x, x_dot, v, v_dot, rho, rho_dot, s)
        factor = kappa * mu[0] / rho[i]
        factor_dot = kappa * mu_dot[0] / rho[i] - factor * rho_dot[i] / rho[i]
        acceleration_dot[i] = acceleration_in_dot[i] + factor_dot * total + factor * total_dot

    @wp.kernel(module=discretisation.module(False, name), enable_backward=False)
    def viscosity_adjoint(
        s: surroundings,
        kappa: real,
        friction: real,
        rest_density: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        rho: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        rho_bar: wp.array(dtype=real),
        scalars_bar: wp.array(dtype=vector),
    ):
        """Gathers alone: the pair (i, j) adds to i what it adds to j, seen from i."""
        i = s.first + wp.tid()
        x_i = x[i]
        v_i = v[i]
        rho_i = rho[i]
        w_i = acceleration_bar[i]
        mass = rest_density[0] * s.volume
        x_sum = vector()
        v_sum = vector()
        fluid_work = real(0.0)
        wall_work = real(0.0)
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            v_j = vectors(v, k, i, s)
            rho_j = numbers(rho, k, i, s)
            w_j = vectors(acceleration_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                v_ij = v_i - v_j[u]
                volume_j = mass / rho_j[u]
                w_ij = w_i - w_j[u]
                x_sum += volume_j * phi_adjoint_x(x_ij, v_ij, w_ij, s)
                v_sum += volume_j * phi_adjoint_v(x_ij, v_ij, w_ij, s)
                fluid_work += volume_j * wp.dot(phi_force(x_ij, v_ij, s), w_ij)
        if friction != real(0.0):
            for k in range(s.fluid_count[i], s.count[i]):
                b = s.neighbours[k, i]
                x_ib = separation(x_i, s.wall_positions[b], s)
                wall_volume = friction * s.volume * s.wall_weights[b]
                x_sum += wall_volume * phi_adjoint_x(x_ib, v_i, w_i, s)
                v_sum += wall_volume * phi_adjoint_v(x_ib, v_i, w_i, s)
                wall_work += wall_volume * wp.dot(phi_force(x_ib, v_i, s), w_i)
        factor = kappa * mu[0] / rho_i
        # Each fluid pair is met twice, each wall pair once.
        own_work = real(0.5) * fluid_work
        x_bar[i] = x_bar[i] + factor * x_sum
        v_bar[i] = v_bar[i] + factor * v_sum
        rho_bar[i] = rho_bar[i] - factor / rho_i * (fluid_work + wall_work)
        scalars_bar[i] = scalars_bar[i] + vector(
            factor * own_work / rest_density[0], kappa / rho_i * (own_work + wall_work), real(0.0)
        )

    return SimpleNamespace(forward=viscosity, tangent=viscosity_tangent, adjoint=viscosity_adjoint)
