"""The mass fractions, rest density and viscosity of particles in a mixture. `docs/discretisation.md` has the equations.

The logarithm of the viscosity is a mean over the phases (Arrhenius 1887), so that the viscosity stays positive if mass
fractions leave the range from 0 to 1. Phases diffuse between fixed particles at the start of a step. Diffusion changes
the densities and viscosities of particles, but not the masses.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, kernel_module, kind_of
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import Entry, Layout, State, StateField
from cortado.sph.free_energy import FREE_ENERGIES, Diffusion, diffusion_kernels
from cortado.sph.parts import Adjoints, Part, PartAdjoint, PartTangent, StepContext, Tangents, order_kernels


def mixture_module(precision: Precision, phases: int, forward: bool, taped: bool = False) -> Any:
    return kernel_module(f"mixture_{kind_of(forward, taped)}_{phases}_{precision.name}", forward and taped)


@cache
def mixture_kernels(precision: Precision, phases: int, taped: bool) -> SimpleNamespace:
    """Properties of phases are arrays (members, phases)."""
    real, fractions = precision.real, precision.fractions(phases)
    tiny, numbers = wp.constant(real(precision.tiny)), wp.array2d(dtype=real)

    @wp.func
    def logarithm(viscosity: real) -> real:
        return wp.log(viscosity + tiny)

    materials = {numbers: "rest_density viscosity", wp.array(dtype=fractions): "c_scene"}
    typed = TypesByName(real, {fractions: "c", wp.int32: "order", **materials})

    @particle_kernel(mixture_module(precision, phases, True, taped), "rho_0 mu", typed=typed)
    def blend(member: int, c_i, rest_density, viscosity) -> tuple[real, real]:
        specific_volume = real(0.0)
        power = real(0.0)
        for k in range(wp.static(phases)):
            specific_volume += c_i[k] / rest_density[member, k]
            power += c_i[k] * logarithm(viscosity[member, k])
        return real(1.0) / specific_volume, wp.exp(power)

    @particle_kernel(mixture_module(precision, phases, False), "rho_0_dot mu_dot", typed=typed)
    def blend_tangent(
        member: int, c_i, c_dot_i, rest_density, rest_density_dot, viscosity, viscosity_dot, rho_0_i, mu_i
    ) -> tuple[real, real]:
        change = real(0.0)
        power_dot = real(0.0)
        for k in range(wp.static(phases)):
            rho_k = rest_density[member, k]
            mu_k = viscosity[member, k]
            change += (c_dot_i[k] - c_i[k] * rest_density_dot[member, k] / rho_k) / rho_k
            power_dot += c_dot_i[k] * logarithm(mu_k) + c_i[k] * viscosity_dot[member, k] / (mu_k + tiny)
        return -rho_0_i * rho_0_i * change, mu_i * power_dot

    @particle_kernel(mixture_module(precision, phases, False), "+rest_density_bar +viscosity_bar +c_bar", typed=typed)
    def blend_adjoint(
        member: int, order_i, c_i, rest_density, viscosity, rho_0_i, mu_i, rho_0_bar_i, mu_bar_i, c_scene_bar
    ) -> tuple[fractions, fractions, fractions]:
        c_bar = fractions(c_scene_bar[order_i])  # a copy: what follows writes to its components
        rest_density_bar, viscosity_bar = fractions(), fractions()
        power_bar = mu_bar_i * mu_i
        for k in range(wp.static(phases)):
            by_volume = rho_0_bar_i * rho_0_i * rho_0_i / rest_density[member, k]
            c_bar[k] = c_bar[k] - by_volume + power_bar * logarithm(viscosity[member, k])
            rest_density_bar[k] = by_volume * c_i[k] / rest_density[member, k]
            viscosity_bar[k] = power_bar * c_i[k] / (viscosity[member, k] + tiny)
        return rest_density_bar, viscosity_bar, c_bar

    order = order_kernels(fractions, mixture_module(precision, phases, True, taped))
    return SimpleNamespace(order=order, blend=Kernels(blend, blend_tangent, blend_adjoint))


MASS_FRACTIONS = StateField("mass_fractions", "", Entry.FRACTIONS, first="mass_fractions")
REFERENCE_DENSITY = StateField("reference_density", "kg/m³", Entry.NUMBER, is_constant=True)


@dataclass(frozen=True)
class Phases:
    count: int
    diffusion: Diffusion | None
    strength: float

    def part(self, layout: Layout, requires_grad: bool) -> "Mixture":
        return Mixture(self, layout, requires_grad)


class MixtureTangent(PartTangent):
    def __init__(self, part: Any):
        super().__init__(part)
        self._c_dot, self._chi_dot, self._w_dot = [part.fractions() for _ in range(2)], part.fractions(), part.numbers()

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        mixture, kernels, known = self.part, self.part.kernels, dot.named
        substeps, now = mixture.substeps, {"chi_dot": self._chi_dot, "w_dot": self._w_dot}
        course = [*(self._c_dot[k % 2] for k in range(substeps)), dot.fractions]
        if mixture.phases.count > 1:
            step.launch(kernels.order.sort, a_scene=state_dot.mass_fractions, a=course[0])
        for k in range(substeps):
            c_dot, c_new_dot = course[k : k + 2]
            given = {"strength": mixture.phases.strength, "c": mixture.c[k], "c_dot": c_dot}
            step.launch(mixture.diffusion.potential.tangent, *known, **given, **now)
            flux = {"chi": mixture.chi[k], "w": mixture.w[k], "c_dot": c_dot, "c_new_dot": c_new_dot}
            step.launch(mixture.diffusion.flux.tangent, *known, substeps=substeps, **flux, **now)
        step.launch(kernels.blend.tangent, *known, c=step.fractions, c_dot=dot.fractions)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        if self.part.phases.count > 1:
            step.launch(self.part.kernels.order.unsort, a=dot.fractions, a_scene=state_dot.mass_fractions)


class MixtureAdjoint(PartAdjoint):
    def __init__(self, part: Any):
        super().__init__(part)
        self._y, self._z = part.fractions(), part.fractions()

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        mixture, kernels, known, fractions_bar = self.part, self.part.kernels, bar.named, state_bar.mass_fractions
        substeps, c_bar, y, z = mixture.substeps, bar.fractions, self._y, self._z
        with nullcontext() if substeps else step.aside():
            step.launch(kernels.blend.adjoint, *known, c=step.fractions, c_scene_bar=fractions_bar, c_bar=c_bar)
            for k in reversed(range(substeps)):
                now = {"c": mixture.c[k], "c_bar": c_bar, "z": z}
                scale, flux = mixture.diffusion.flux.adjoint
                step.launch(scale, substeps=substeps, c_bar=c_bar, y=y)
                at = {"strength": mixture.phases.strength, "chi": mixture.chi[k], "w": mixture.w[k], "y": y}
                step.launch(flux, *known, at, now)
                step.launch(mixture.diffusion.potential.adjoint, *known, now)
            if mixture.phases.count > 1:
                step.launch(kernels.order.unsort, a=c_bar, a_scene=fractions_bar)
                c_bar.zero_()


class Mixture(Part):
    derivatives = MixtureTangent, MixtureAdjoint

    def __init__(self, phases: Phases, layout: Layout, requires_grad: bool = False):
        self.phases = phases
        self.fields = (replace(MASS_FRACTIONS, is_constant=phases.count == 1), REFERENCE_DENSITY)
        self.kernels = mixture_kernels(layout.precision, phases.count, requires_grad)
        if phases.diffusion and phases.diffusion.energy not in FREE_ENERGIES.values():
            phases.diffusion.energy.check(layout.precision, phases.count, layout.device)
        self.diffusion = diffusion_kernels(phases.diffusion) if phases.diffusion else None
        self.shares = ("rest_density", "viscosity", *(("mobility", "interface_width") if phases.diffusion else ()))
        self.substeps = 0
        self._layout = layout
        self._options = {"device": layout.device, "requires_grad": requires_grad}
        self.c: list[wp.array] = []
        """Arrays of shape (n,) with sorted particles' mass fractions before each diffusion substep."""
        self.chi: list[wp.array] = []
        """Arrays of shape (n,) with the chemical potentials of each substep [-]."""
        self.w: list[wp.array] = []
        """Arrays of shape (n,) with density times mobility of each substep [kg / (m s)]."""

    def fractions(self) -> wp.array:
        dtype = self._layout.precision.fractions(self.phases.count)
        return wp.zeros(self._layout.all_particles, dtype=dtype, **self._options)

    def numbers(self) -> wp.array:
        return wp.zeros(self._layout.all_particles, dtype=self._layout.precision.real, **self._options)

    def set_substeps(self, substeps: int) -> None:
        self.substeps = substeps
        while len(self.c) < substeps:
            self.c.append(self.fractions())
            self.chi.append(self.fractions())
            self.w.append(self.numbers())

    def course(self, step: StepContext) -> list[wp.array]:
        return [*self.c[: self.substeps], step.fractions]

    def sort(self, step: StepContext, state: State) -> None:
        with step.aside():
            if self.phases.count > 1:
                step.launch(self.kernels.order.sort, a_scene=state.mass_fractions, a=self.course(step)[0])
            if not self.substeps:
                step.launch(self.kernels.blend.forward, c=step.fractions)

    def settle(self, step: StepContext) -> None:
        course = self.course(step)
        for k in range(self.substeps):
            assert self.diffusion is not None
            now = {"c": course[k], "chi": self.chi[k], "w": self.w[k]}
            step.launch(self.diffusion.potential.forward, strength=self.phases.strength, **now)
            step.launch(self.diffusion.flux.forward, substeps=self.substeps, c_new=course[k + 1], **now)
        if self.substeps:
            step.launch(self.kernels.blend.forward, c=step.fractions)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        if self.phases.count > 1:
            step.launch(self.kernels.order.unsort, a=step.fractions, a_scene=state.mass_fractions)
