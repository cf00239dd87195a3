"""What a PCISPH solver is made of: when to stop, kernels, and room for its iterates."""

from dataclasses import dataclass
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.neighbourhood import Discretisation
from cortado.solvers.pcisph.convergence import ConvergenceKernels, convergence_kernels
from cortado.solvers.pcisph.density_ratio_relaxation import DensityRatioKernels, density_ratio_kernels
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels
from cortado.solvers.pcisph.wall_relaxation import wall_kernels
from cortado.sph.density import density_kernels
from cortado.sph.integration import IntegrationKernels, integration_kernels


@dataclass(frozen=True)
class PressureSolve:
    """When the pressure loop may stop."""

    minimum_iterations: int
    maximum_iterations: int
    tolerance: float
    """Bound on the average of (rho* - rho_0)+ / rho_0."""
    greatest_tolerance: float
    """Bound on the maximum of the same; infinite where none is asked for."""


@dataclass(frozen=True)
class PcisphKernels:
    """The kernels of a step, each topic with its forward, tangent and adjoint."""

    density: Kernels
    walls: Kernels
    contrast: DensityRatioKernels
    pressure: Kernels
    force: Kernels
    integration: IntegrationKernels
    convergence: ConvergenceKernels

    @classmethod
    def of(cls, discretisation: Discretisation) -> "PcisphKernels":
        """Those for a smoothing kernel and a precision."""
        return cls(
            density_kernels(discretisation),
            wall_kernels(discretisation),
            density_ratio_kernels(discretisation),
            pressure_kernels(discretisation),
            pressure_force_kernels(discretisation),
            integration_kernels(discretisation.precision),
            convergence_kernels(discretisation.precision),
        )


class Iterates:
    """Predicted states and pressures of the iterations of one step; a single slot is overwritten each time."""

    def __init__(self, particles: int, precision: Any, device: Any, requires_grad: bool):
        self._make = lambda dtype: wp.zeros(particles, dtype=dtype, device=device, requires_grad=requires_grad)
        self._real, self._vector = precision.real, precision.vector
        self.x_star: list[wp.array] = []
        self.v_star: list[wp.array] = []
        self.p: list[wp.array] = [self._make(self._real)]
        """``p[k]`` before iteration k; ``p[0]`` is 0 and never written."""
        self.c: list[wp.array] = []
        self.reserve(1)

    def reserve(self, iterations: int) -> None:
        """Room for every value of so many iterations."""
        while len(self.x_star) <= iterations:
            self.x_star.append(self._make(self._vector))
            self.v_star.append(self._make(self._vector))
            self.p.append(self._make(self._real))
            self.c.append(self._make(self._real))
