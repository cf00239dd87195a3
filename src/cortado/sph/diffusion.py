"""Cahn-Hilliard diffusion between the phases of a mixture (after Yang et al. 2015):

    chi_k,i = alpha P f'(c_i)_k - (eps^2 / m_i) B(m; c_k)_i,         P u = u - (1 / phases) sum_l u_l
    c'_k,i  = c_k,i + (dt / m_i) B(m M; chi_k)_i,                    M_i = M_0 m(c_i)
    B(w; u)_i = V sum_j (w_i / n_j + w_j / n_i) (u_i - u_j) F_ij,    F = x . G / (|x|^2 + 0.01 h^2)

chi is the chemical potential. B is antisymmetric in i and j: each phase keeps its mass, sum_i m_i c_k,i, to round-off,
and sum_k c_k stays what it was, by P. The same B in both lines makes the discrete free energy

    E = V sum_i m_i alpha f(c_i) - (eps^2 V^2 / 4) sum_ij (m_i / n_j + m_j / n_i) F_ij |c_i - c_j|^2

fall along the flow on particles at rest (F <= 0). Nothing is clipped: that would break both.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.discretise.calibration import diffusion_limit
from cortado.discretise.smoothing import smoothing_kernel
from cortado.errors import OutOfRangeError
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.scene.scene import Scene
from cortado.sph.free_energy import MOBILITIES, FreeEnergy, Mobility


@dataclass(frozen=True)
class PairwiseLaplacian:
    """The pairwise Laplacian as a function of Warp, with its derivatives."""

    spread: Any
    spread_tangent: Any
    spread_adjoint: Any


@cache
def pairwise_laplacian_functions(discretisation: Discretisation, phases: int) -> PairwiseLaplacian:
    """Raw sums of B / V over the neighbours: ``spread``, ``spread_tangent``, ``spread_adjoint``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    fractions = discretisation.precision.fractions(phases)
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    factor, factor_gradient = pair.factor, pair.factor_gradient

    @fluid_sum(discretisation)
    def spread(
        x_ij: vector, n_i: real, n_j: real, w_i: real, w_j: real, u_ij: fractions, s: neighbourhood
    ) -> fractions:
        return ((w_i / n_j + w_j / n_i) * factor(x_ij, s)) * u_ij

    @tangent_of(spread)
    @fluid_sum(discretisation, ahead=False)
    def spread_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        n_i: real,
        n_j: real,
        n_dot_i: real,
        n_dot_j: real,
        w_i: real,
        w_j: real,
        w_dot_i: real,
        w_dot_j: real,
        u_ij: fractions,
        u_dot_ij: fractions,
        s: neighbourhood,
    ) -> fractions:
        weight = w_i / n_j + w_j / n_i
        weight_dot = (w_dot_i - w_i * n_dot_j / n_j) / n_j + (w_dot_j - w_j * n_dot_i / n_i) / n_i
        f = factor(x_ij, s)
        f_dot = wp.dot(factor_gradient(x_ij, s), x_dot_ij)
        return (weight_dot * f + weight * f_dot) * u_ij + (weight * f) * u_dot_ij

    @adjoint_of(spread)
    @fluid_sum(discretisation)
    def spread_adjoint(
        x_ij: vector,
        n_i: real,
        n_j: real,
        w_i: real,
        w_j: real,
        u_ij: fractions,
        y_i: fractions,
        y_ij: fractions,
        s: neighbourhood,
    ) -> tuple[vector, real, real, fractions, real]:
        """For an adjoint y of the sums: what it gives those of x_i, n_i, w_i and u_i, and y_i times the sum itself."""
        f = factor(x_ij, s)
        weight = w_i / n_j + w_j / n_i
        work = wp.dot(u_ij, y_ij)
        x_bar = (weight * work) * factor_gradient(x_ij, s)
        n_bar = -w_j * f * work / (n_i * n_i)
        return x_bar, n_bar, f * work / n_j, (weight * f) * y_ij, weight * f * wp.dot(u_ij, y_i)

    return PairwiseLaplacian(spread=spread, spread_tangent=spread_tangent, spread_adjoint=spread_adjoint)


MOST_SUBSTEPS = 10_000
"""Explicit steps of diffusion in a time step; beyond it the mobility is taken for a mistake."""


def stable_substeps(
    scene: Scene,
    free_energy: FreeEnergy,
    time_step: float,
    mobility: float,
    interface_width: float,
    rest_density: np.ndarray,
) -> int:
    """Those that are stable in a scene of several phases with a time step [s], a mobility [m2/s], an interface width
    [m] and rest densities (phases,) [kg/m3]; raises `OutOfRangeError` where there would be more than
    `MOST_SUBSTEPS`."""
    mixture, discretisation = scene.mixture, scene.discretisation
    limit = diffusion_limit(
        smoothing_kernel(discretisation.kernel),
        discretisation.spacing,
        discretisation.support_radius,
        scene.dimension,
        greatest_mobility=mobility * MOBILITIES[mixture.mobility_form].greatest(len(scene.phase)),
        interface_width=interface_width,
        curvature=mixture.strength * free_energy.curvature,
        density_ratio=float(np.max(rest_density) / np.min(rest_density)),
    )
    number = float(np.ceil(time_step / limit))
    if number > MOST_SUBSTEPS:
        raise OutOfRangeError(
            f"mobility is {mobility:g} m2/s, which takes {number:.3g} explicit steps of diffusion in a time step, but "
            f"must not take more than {MOST_SUBSTEPS}: lower it, interface_width or time_step."
        )
    return int(number)


@dataclass(frozen=True)
class Diffusion:
    """What the kernels of a mixture are made for."""

    discretisation: Discretisation
    phases: int
    energy: FreeEnergy
    mobility: Mobility

    def module(self, forward: bool) -> Any:
        """The Warp module of forward kernels, or of those of the adjoint."""
        return self.discretisation.module(forward, self._topic)

    def tangent_module(self) -> Any:
        """The Warp module of the kernels of forward mode."""
        return self.discretisation.tangent_module(self._topic)

    @property
    def _topic(self) -> str:
        return f"diffusion_{self.phases}_{self.energy.name}_{self.mobility.name}"


@dataclass(frozen=True)
class DiffusionKernels:
    """The kernels of one substep of diffusion."""

    potential: Kernels
    flux: Kernels
    scale_adjoint: Any


@cache
def diffusion_kernels(diffusion: Diffusion) -> DiffusionKernels:
    """Kernels of the potential, of the flux, and of the adjoint of the flux's scale."""
    discretisation, phases = diffusion.discretisation, diffusion.phases
    precision = discretisation.precision
    real, vector, fractions = precision.real, precision.vector, precision.fractions(phases)
    neighbourhood = neighbourhood_type(precision)
    sums = pairwise_laplacian_functions(discretisation, phases)
    spread, spread_tangent, spread_adjoint = sums.spread, sums.spread_tangent, sums.spread_adjoint
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    energy, form = diffusion.energy.functions(precision, phases), diffusion.mobility.functions(precision, phases)
    energy_gradient, energy_hessian_product = energy.gradient, energy.hessian_product
    mobile, mobile_gradient = form.value, form.gradient

    potential_changes = bundle(x=vector, n=real, m=real, c=fractions)
    flux_changes = bundle(x=vector, n=real, m=real, w=real, chi=fractions)
    flux_adjoints = bundle(x=vector, n=real, m=real, c=fractions, time_step=real, mobility=real)

    @wp.func
    def project(u: fractions) -> fractions:
        mean = real(0.0)
        for k in range(wp.static(phases)):
            mean += u[k]
        mean = mean / real(wp.static(phases))
        result = fractions()
        for k in range(wp.static(phases)):
            result[k] = u[k] - mean
        return result

    @wp.kernel(module=diffusion.module(True))
    def potential(
        s: neighbourhood,
        strength: real,
        interface_width: wp.array(dtype=real),
        mobility: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        c: wp.array(dtype=fractions),
        # out
        chi: wp.array(dtype=fractions),
        w: wp.array(dtype=real),
    ):
        """``w``: m M of a particle."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = spread(i, x, n, m, c, s)
        if lane() > 0:
            return
        stiffness = interface_width[member] * interface_width[member] * s.volume / m[i]
        chi[i] = strength * project(energy_gradient(c[i])) - stiffness * total
        w[i] = m[i] * mobility[member] * mobile(c[i])

    @wp.kernel(module=diffusion.module(True))
    def flux(
        s: neighbourhood,
        substeps: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        w: wp.array(dtype=real),
        chi: wp.array(dtype=fractions),
        c: wp.array(dtype=fractions),
        # out
        c_new: wp.array(dtype=fractions),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = spread(i, x, n, w, chi, s)
        if lane() > 0:
            return
        c_new[i] = c[i] + (time_step[member] / real(substeps) * s.volume / m[i]) * total

    @wp.kernel(module=diffusion.tangent_module(), enable_backward=False)
    def potential_tangent(
        s: neighbourhood,
        strength: real,
        interface_width: wp.array(dtype=real),
        interface_width_dot: wp.array(dtype=real),
        mobility: wp.array(dtype=real),
        mobility_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        c: wp.array(dtype=fractions),
        dot: potential_changes,
        # out
        chi_dot: wp.array(dtype=fractions),
        w_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = spread(i, x, n, m, c, s)
        total_dot = spread_tangent(i, x, dot.x, n, dot.n, m, dot.m, c, dot.c, s)
        if lane() > 0:
            return
        width = interface_width[member]
        scale = s.volume / m[i]
        stiffness = width * width * scale
        stiffness_dot = real(2.0) * width * interface_width_dot[member] * scale - stiffness * dot.m[i] / m[i]
        chi_dot[i] = (
            strength * project(energy_hessian_product(c[i], dot.c[i])) - stiffness * total_dot - stiffness_dot * total
        )
        m_0 = mobility[member]
        w_dot[i] = (dot.m[i] * m_0 + m[i] * mobility_dot[member]) * mobile(c[i]) + m[i] * m_0 * wp.dot(
            mobile_gradient(c[i]), dot.c[i]
        )

    @wp.kernel(module=diffusion.tangent_module(), enable_backward=False)
    def flux_tangent(
        s: neighbourhood,
        substeps: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        w: wp.array(dtype=real),
        chi: wp.array(dtype=fractions),
        dot: flux_changes,
        c_dot: wp.array(dtype=fractions),
        # out
        c_new_dot: wp.array(dtype=fractions),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        total = spread(i, x, n, w, chi, s)
        total_dot = spread_tangent(i, x, dot.x, n, dot.n, w, dot.w, chi, dot.chi, s)
        if lane() > 0:
            return
        scale = time_step[member] / real(substeps) * s.volume / m[i]
        change = time_step_dot[member] / time_step[member] - dot.m[i] / m[i]
        c_new_dot[i] = c_dot[i] + scale * (total_dot + change * total)

    @wp.kernel(module=diffusion.module(False), enable_backward=False)
    def scale_adjoint(
        s: neighbourhood,
        substeps: int,
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        c_bar: wp.array(dtype=fractions),
        # out
        y: wp.array(dtype=fractions),
    ):
        """``y``: the adjoint of the flux's raw sum."""
        i = s.first + wp.tid()
        member = i // s.particles
        y[i] = (time_step[member] / real(substeps) * s.volume / m[i]) * c_bar[i]

    @wp.kernel(module=diffusion.module(False), enable_backward=False)
    def flux_adjoint(
        s: neighbourhood,
        strength: real,
        time_step: wp.array(dtype=real),
        interface_width: wp.array(dtype=real),
        mobility: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        w: wp.array(dtype=real),
        chi: wp.array(dtype=fractions),
        c: wp.array(dtype=fractions),
        y: wp.array(dtype=fractions),
        # in and out
        bar: flux_adjoints,
        # out
        z: wp.array(dtype=fractions),
    ):
        """``z``: the adjoint of the potential's raw sum."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        x_sum, n_sum, w_bar, chi_bar, own = spread_adjoint(i, x, n, w, chi, y, s)
        if lane() > 0:
            return
        m_i = m[i]
        m_0 = mobility[member]
        mobile_i = mobile(c[i])
        bar.x[i] = bar.x[i] + x_sum
        bar.n[i] = bar.n[i] + n_sum
        bar.m[i] = bar.m[i] + w_bar * m_0 * mobile_i - own / m_i
        straight = project(chi_bar)
        bar.c[i] = (
            bar.c[i] + (w_bar * m_i * m_0) * mobile_gradient(c[i]) + strength * energy_hessian_product(c[i], straight)
        )
        bar.time_step[i] = bar.time_step[i] + own / time_step[member]
        bar.mobility[i] = bar.mobility[i] + w_bar * m_i * mobile_i
        z[i] = (-interface_width[member] * interface_width[member] * s.volume / m_i) * chi_bar

    @wp.kernel(module=diffusion.module(False), enable_backward=False)
    def potential_adjoint(
        s: neighbourhood,
        interface_width: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        c: wp.array(dtype=fractions),
        z: wp.array(dtype=fractions),
        # in and out
        x_bar: wp.array(dtype=vector),
        n_bar: wp.array(dtype=real),
        m_bar: wp.array(dtype=real),
        c_bar: wp.array(dtype=fractions),
        interface_width_bar: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        x_sum, n_sum, m_sum, c_sum, own = spread_adjoint(i, x, n, m, c, z, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        n_bar[i] = n_bar[i] + n_sum
        m_bar[i] = m_bar[i] + m_sum - own / m[i]
        c_bar[i] = c_bar[i] + c_sum
        interface_width_bar[i] = interface_width_bar[i] + real(2.0) * own / interface_width[member]

    return DiffusionKernels(
        Kernels(potential, potential_tangent, potential_adjoint),
        Kernels(flux, flux_tangent, flux_adjoint),
        scale_adjoint,
    )
