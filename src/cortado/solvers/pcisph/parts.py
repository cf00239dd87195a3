"""What a PCISPH solver is made of: kernels, and room for its iterates."""

from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.solvers.pcisph.begin_adjoint import begin_adjoint_kernel
from cortado.solvers.pcisph.density_ratio_relaxation import DensityRatioKernels, density_ratio_kernels
from cortado.solvers.pcisph.pressure import pressure_kernels
from cortado.solvers.pcisph.pressure_force import pressure_force_kernels
from cortado.solvers.pcisph.wall_relaxation import wall_kernels


@dataclass(frozen=True)
class PcisphKernels:
    """The kernels that only PCISPH needs, each topic with its forward, tangent and adjoint."""

    wall_relaxation: Kernels
    density_ratio: DensityRatioKernels | None
    """Only where there are several phases."""
    pressure: Kernels
    force: Kernels
    begin_adjoint: wp.Kernel
    """With which the way back through a step begins."""

    @classmethod
    def of(cls, discretisation: Discretisation, phases: int) -> "PcisphKernels":
        """Those for a smoothing kernel, a precision and a number of phases."""
        return cls(
            wall_kernels(discretisation),
            density_ratio_kernels(discretisation) if phases > 1 else None,
            pressure_kernels(discretisation),
            pressure_force_kernels(discretisation),
            begin_adjoint_kernel(discretisation),
        )


class Iterates:
    """Predicted states and pressures of the iterations of one step; a single slot is overwritten each time."""

    def __init__(self, numbers: Callable[[], wp.array], vectors: Callable[[], wp.array]):
        """Both make arrays (n,) of zeros."""
        self._numbers, self._vectors = numbers, vectors
        self.x_star: list[wp.array] = []
        self.v_star: list[wp.array] = []
        self.p: list[wp.array] = [numbers()]
        """``p[k]`` before iteration k; ``p[0]`` is 0 and never written."""
        self.c: list[wp.array] = []
        self.reserve(1)

    def reserve(self, iterations: int) -> None:
        """Room for every value of so many iterations."""
        while len(self.x_star) <= iterations:
            self.x_star.append(self._vectors())
            self.v_star.append(self._vectors())
            self.p.append(self._numbers())
            self.c.append(self._numbers())
