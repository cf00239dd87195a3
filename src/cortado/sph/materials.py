"""What a particle of several phases is made of: its mass fractions c, and what follows from them.

    1 / rho_0i = sum_k c_k,i / rho_0k,    ln mu_i = sum_k c_k,i ln mu_k    (Arrhenius 1887)

Masses are constant (Yang et al. 2015 leave open whether mass or volume is; with mass
fractions it is the mass), so that a particle's rest volume follows its rest density. The logarithms keep the viscosity
positive where fractions stray out of [0, 1].
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, kernel_module, kind_of
from cortado.device.precision import Precision
from cortado.sph.order import OrderKernels, order_kernels


def mixture_module(precision: Precision, phases: int, forward: bool, taped: bool = False) -> Any:
    """The Warp module of kernels for a number of phases that need no smoothing kernel; ``taped`` forward kernels get
    Warp's own adjoint."""
    return kernel_module(f"mixture_{kind_of(forward, taped)}_{phases}_{precision.name}", forward and taped)


@dataclass(frozen=True)
class MixtureKernels:
    """The kernels that carry fractions into a step and out of it, and make materials of them."""

    order: OrderKernels
    blend: Kernels


@cache
def mixture_kernels(precision: Precision, phases: int, taped: bool) -> MixtureKernels:
    """The kernels for a number of phases; their materials are arrays (members, phases). A tape can differentiate
    ``taped`` ones."""
    real, fractions = precision.real, precision.fractions(phases)
    tiny = wp.constant(real(precision.tiny))

    @wp.func
    def logarithm(viscosity: real) -> real:
        """tiny stands in for a phase without viscosity, of which any amount makes a mixture thin."""
        return wp.log(viscosity + tiny)

    @wp.kernel(module=mixture_module(precision, phases, True, taped))
    def blend(
        particles: int,
        c: wp.array(dtype=fractions),
        rest_density: wp.array2d(dtype=real),
        viscosity: wp.array2d(dtype=real),
        # out
        rho_0: wp.array(dtype=real),
        mu: wp.array(dtype=real),
    ):
        i = wp.tid()
        member = i // particles
        specific_volume = real(0.0)
        power = real(0.0)
        for k in range(wp.static(phases)):
            specific_volume += c[i][k] / rest_density[member, k]
            power += c[i][k] * logarithm(viscosity[member, k])
        rho_0[i] = real(1.0) / specific_volume
        mu[i] = wp.exp(power)

    @wp.kernel(module=mixture_module(precision, phases, False), enable_backward=False)
    def blend_tangent(
        particles: int,
        c: wp.array(dtype=fractions),
        c_dot: wp.array(dtype=fractions),
        rest_density: wp.array2d(dtype=real),
        rest_density_dot: wp.array2d(dtype=real),
        viscosity: wp.array2d(dtype=real),
        viscosity_dot: wp.array2d(dtype=real),
        rho_0: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        # out
        rho_0_dot: wp.array(dtype=real),
        mu_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        member = i // particles
        change = real(0.0)
        power_dot = real(0.0)
        for k in range(wp.static(phases)):
            rho_k = rest_density[member, k]
            mu_k = viscosity[member, k]
            change += (c_dot[i][k] - c[i][k] * rest_density_dot[member, k] / rho_k) / rho_k
            power_dot += c_dot[i][k] * logarithm(mu_k) + c[i][k] * viscosity_dot[member, k] / (mu_k + tiny)
        rho_0_dot[i] = -rho_0[i] * rho_0[i] * change
        mu_dot[i] = mu[i] * power_dot

    @wp.kernel(module=mixture_module(precision, phases, False), enable_backward=False)
    def blend_adjoint(
        particles: int,
        order: wp.array(dtype=wp.int32),
        c: wp.array(dtype=fractions),
        rest_density: wp.array2d(dtype=real),
        viscosity: wp.array2d(dtype=real),
        rho_0: wp.array(dtype=real),
        mu: wp.array(dtype=real),
        rho_0_bar: wp.array(dtype=real),
        mu_bar: wp.array(dtype=real),
        c_scene_bar: wp.array(dtype=fractions),
        # in and out
        rest_density_bar: wp.array(dtype=fractions),
        viscosity_bar: wp.array(dtype=fractions),
        # out
        c_bar: wp.array(dtype=fractions),
    ):
        """``c_scene_bar``: the adjoint of the new state's fractions. Those of the phases add up by particle."""
        i = wp.tid()
        member = i // particles
        c_bar_i = c_scene_bar[order[i]]
        rest_density_bar_i = rest_density_bar[i]
        viscosity_bar_i = viscosity_bar[i]
        power_bar = mu_bar[i] * mu[i]
        for k in range(wp.static(phases)):
            by_volume = rho_0_bar[i] * rho_0[i] * rho_0[i] / rest_density[member, k]
            c_bar_i[k] = c_bar_i[k] - by_volume + power_bar * logarithm(viscosity[member, k])
            rest_density_bar_i[k] = rest_density_bar_i[k] + by_volume * c[i][k] / rest_density[member, k]
            viscosity_bar_i[k] = viscosity_bar_i[k] + power_bar * c[i][k] / (viscosity[member, k] + tiny)
        rest_density_bar[i] = rest_density_bar_i
        viscosity_bar[i] = viscosity_bar_i
        c_bar[i] = c_bar_i

    order = order_kernels(fractions, mixture_module(precision, phases, True, taped))
    return MixtureKernels(order, Kernels(blend, blend_tangent, blend_adjoint))
