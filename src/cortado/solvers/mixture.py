"""The mixture step of the report's Algorithm 3: phases diffuse, and each particle gets its material.

It comes first in a step, on the particles at rest at x(t); what it makes of a particle holds for the rest of the step.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from cortado.launching import Launcher, add, sum_of
from cortado.neighbours import NeighbourSearch
from cortado.particles import Fields, Parameters
from cortado.physics.diffusion import Diffusion, diffusion_kernels
from cortado.physics.mixture import mixture_kernels


@dataclass(frozen=True)
class Phases:
    """How many phases there are, and how they diffuse into one another."""

    count: int
    diffusion: Diffusion | None
    """None: not at all."""
    strength: float
    """alpha of the free energy [-]."""


class Mixture:
    """The composition of the particles of one solver; its arrays are reused by every step."""

    def __init__(
        self, phases: Phases, precision: Any, search: NeighbourSearch, launch: Launcher, requires_grad: bool = False
    ):
        self.phases, self.launch, self.search = phases, launch, search
        self.kernels = mixture_kernels(precision, phases.count)
        self.diffusion = diffusion_kernels(phases.diffusion) if phases.diffusion else None
        self.substeps = 0
        """Explicit steps of diffusion within a time step."""
        self._precision, self._requires_grad = precision, requires_grad
        self.c: list[wp.array] = [self.fractions()]
        """Sorted fractions (n,) before each substep, and after the last."""
        self.chi: list[wp.array] = []
        """Chemical potentials (n,) of each substep [-]."""
        self.w: list[wp.array] = []
        """m M (n,) of each substep [kg / (m s)]."""

    def fractions(self) -> wp.array:
        """(n,) of one number for each phase, all 0."""
        return self._zeros(self._precision.fractions(self.phases.count))

    def numbers(self) -> wp.array:
        """(n,) numbers, all 0."""
        return self._zeros(self._precision.real)

    def reserve(self, substeps: int) -> None:
        """Take so many substeps from now on, and make room for them."""
        self.substeps = substeps
        while len(self.chi) < substeps:
            self.c.append(self.fractions())
            self.chi.append(self.fractions())
            self.w.append(self.numbers())

    def step(self, surroundings: Any, fields: Fields, parameters: Parameters, mass_fractions: wp.array) -> None:
        """Diffuse, from ``mass_fractions`` in the scene's order, and write rest densities and viscosities."""
        f, p, s = fields, parameters, surroundings
        self.launch(self.kernels.sort, [self.search.order, mass_fractions], [self.c[0]])
        for k in range(self.substeps):
            assert self.diffusion is not None
            self.launch(
                self.diffusion.potential,
                [s, self.phases.strength, p.interface_width, p.mobility, f.x, f.n, f.m, self.c[k]],
                [self.chi[k], self.w[k]],
            )
            self.launch(
                self.diffusion.flux,
                [s, self.substeps, p.time_step, f.x, f.n, f.m, self.w[k], self.chi[k], self.c[k]],
                [self.c[k + 1]],
            )
        self.launch(self.kernels.blend, [self.c[self.substeps], p.rest_density, p.viscosity], [f.rho_0, f.mu])

    def result(self, mass_fractions: wp.array) -> None:
        """Write the fractions after the last step, in the scene's order."""
        self.launch(self.kernels.unsort, [self.search.order, self.c[self.substeps]], [mass_fractions])

    def _zeros(self, dtype: Any) -> wp.array:
        return wp.zeros(
            self.search.particles, dtype=dtype, device=self.search.device, requires_grad=self._requires_grad
        )


class MixtureAdjoint:
    """Reverse mode of a mixture step, by gathers."""

    def __init__(self, mixture: Mixture):
        self._mixture = mixture
        self._c_bar, self._y, self._z = (mixture.fractions() for _ in range(3))
        self._rest_density_bar, self._viscosity_bar = mixture.fractions(), mixture.fractions()
        self._sums = [sum_of(array.dtype, len(array), array.device) for array in self._phase_bars]

    @property
    def _phase_bars(self) -> tuple[wp.array, wp.array]:
        return self._rest_density_bar, self._viscosity_bar

    def clear(self) -> None:
        """Forget the phases' adjoints of the steps so far."""
        for array in self._phase_bars:
            array.zero_()

    def collect(self, bar: Parameters) -> None:
        """Add the adjoints of the phases' rest densities and viscosities, of all steps since `clear`."""
        for add_up, array, total in zip(self._sums, self._phase_bars, (bar.rest_density, bar.viscosity), strict=True):
            add(add_up(array).view(total.dtype).flatten(), total)

    def step(
        self,
        surroundings: Any,
        fields: Fields,
        fields_bar: Fields,
        parameters: Parameters,
        scalars_bar: wp.array,
        new_fractions_bar: wp.array,
        fractions_bar: wp.array,
    ) -> None:
        """From the adjoints of the materials and of the new fractions to that of the old ones, in scene order."""
        mixture, f, b, p, s = self._mixture, fields, fields_bar, parameters, surroundings
        launch, kernels, diffusion, order = mixture.launch, mixture.kernels, mixture.diffusion, mixture.search.order
        launch(
            kernels.blend_adjoint,
            [order, mixture.c[mixture.substeps], p.rest_density, p.viscosity, f.rho_0, f.mu, b.rho_0, b.mu]
            + [new_fractions_bar],
            [self._rest_density_bar, self._viscosity_bar, self._c_bar],
        )
        for k in reversed(range(mixture.substeps)):
            assert diffusion is not None
            launch(diffusion.scale_adjoint, [s, mixture.substeps, p.time_step, f.m, self._c_bar], [self._y])
            launch(
                diffusion.flux_adjoint,
                [s, mixture.phases.strength, p.time_step, p.interface_width, p.mobility, f.x, f.n, f.m]
                + [mixture.w[k], mixture.chi[k], mixture.c[k], self._y],
                [b.x, b.n, b.m, self._c_bar, scalars_bar, self._z],
            )
            launch(
                diffusion.potential_adjoint,
                [s, p.interface_width, f.x, f.n, f.m, mixture.c[k], self._z],
                [b.x, b.n, b.m, self._c_bar, scalars_bar],
            )
        launch(kernels.unsort, [order, self._c_bar], [fractions_bar])


class MixtureTangent:
    """Forward mode of a mixture step."""

    def __init__(self, mixture: Mixture):
        self._mixture = mixture
        self._c_dot = [mixture.fractions() for _ in range(2)]
        self._chi_dot = mixture.fractions()
        self._w_dot = mixture.numbers()

    def step(
        self,
        surroundings: Any,
        fields: Fields,
        fields_dot: Fields,
        parameters: Parameters,
        parameters_dot: Parameters,
        fractions_dot: wp.array,
    ) -> None:
        """From the tangent of the old fractions, in scene order, to those of the materials; `result` writes the new."""
        mixture, f, d, p, q, s = self._mixture, fields, fields_dot, parameters, parameters_dot, surroundings
        launch, kernels, diffusion = mixture.launch, mixture.kernels, mixture.diffusion
        launch(kernels.sort, [mixture.search.order, fractions_dot], [self._c_dot[0]])
        for k in range(mixture.substeps):
            assert diffusion is not None
            c_dot, c_new_dot = self._c_dot[k % 2], self._c_dot[(k + 1) % 2]
            launch(
                diffusion.potential_tangent,
                [s, mixture.phases.strength, p.interface_width, q.interface_width, p.mobility, q.mobility]
                + [f.x, d.x, f.n, d.n, f.m, d.m, mixture.c[k], c_dot],
                [self._chi_dot, self._w_dot],
            )
            launch(
                diffusion.flux_tangent,
                [s, mixture.substeps, p.time_step, q.time_step, f.x, d.x, f.n, d.n, f.m, d.m]
                + [mixture.w[k], self._w_dot, mixture.chi[k], self._chi_dot, c_dot],
                [c_new_dot],
            )
        self._last_dot = self._c_dot[mixture.substeps % 2]
        launch(
            kernels.blend_tangent,
            [mixture.c[mixture.substeps], self._last_dot, p.rest_density, q.rest_density, p.viscosity, q.viscosity]
            + [f.rho_0, f.mu],
            [d.rho_0, d.mu],
        )

    def result(self, new_fractions_dot: wp.array) -> None:
        """Write the tangent of the new fractions, in the scene's order."""
        self._mixture.launch(
            self._mixture.kernels.unsort, [self._mixture.search.order, self._last_dot], [new_fractions_dot]
        )
