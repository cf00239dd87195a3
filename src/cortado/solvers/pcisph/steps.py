"""Steps of predictive-corrective incompressible SPH (Solenthaler and Pajarola 2009).

`PcisphSteps.step` goes on until the density error is small; `PcisphSteps.replay` repeats a step with a known number of
iterations and keeps every intermediate value, for `cortado.solvers.pcisph.derivatives`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp
from numpy.typing import NDArray

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import Parameters, State
from cortado.solvers.loop import IterationLog, Loop, LoopLimits
from cortado.solvers.particles import ParticleSolver, ParticleSystem
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels
from cortado.solvers.pcisph.relaxation import DensityRatioKernels, density_ratio_kernels, wall_kernels
from cortado.solvers.solver import Counts
from cortado.sph.integration import new_state_adjoint
from cortado.sph.parts import StepContext


@cache
def begin_adjoint_kernel(discretisation: Discretisation) -> Any:
    """Make the kernel that begins the adjoint of a step, with PCISPH's own (see `cortado.sph.begin_adjoint`)."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    adjoin_new_state, vectors = new_state_adjoint(discretisation.precision), wp.array(dtype=vector)

    @particle_kernel(
        discretisation.module(False, "pcisph"),
        "x_bar v_bar time_step_bar scaled_bar n_bar m_bar rho_0_bar mu_bar y_bar p_bar",
    )
    def begin_adjoint(
        order_i: wp.int32,
        time_step: real,
        m_i: real,
        v_i: vector,
        v_star_i: vector,
        x_scene_bar: vectors,
        v_scene_bar: vectors,
        time_step_bar_i: real,
    ) -> tuple[vector, vector, real, vector, real, real, real, real, real, real]:
        x_bar, v_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order_i], v_scene_bar[order_i], time_step_bar_i, v_i, v_star_i, time_step
        )
        no = real(0.0)
        return x_bar, v_bar, dt_bar, (time_step / m_i) * v_bar, no, no, no, no, no, no

    return begin_adjoint


@dataclass(frozen=True)
class PcisphKernels:
    """The kernels that only PCISPH needs, by topic, each with its forward, tangent and adjoint."""

    wall_relaxation: Kernels
    density_ratio: DensityRatioKernels | None
    """Only where there are several phases."""
    pressure: Kernels
    force: Kernels
    begin_adjoint: wp.Kernel
    """With which the way back through a step begins."""

    @classmethod
    def of(cls, discretisation: Discretisation, phases: int) -> "PcisphKernels":
        """Make the kernels of PCISPH for a smoothing kernel, a precision and a number of phases."""
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
        """Allocate one iteration by two functions, which make arrays (n,) of zero numbers and zero vectors."""
        self._numbers, self._vectors = numbers, vectors
        self.x_star: list[wp.array] = []
        self.v_star: list[wp.array] = []
        self.p: list[wp.array] = [numbers()]
        """``p[k]`` before iteration k; ``p[0]`` is 0 and never written."""
        self.c: list[wp.array] = []
        self.reserve(1)

    def reserve(self, iterations: int) -> None:
        """Make room for the values of ``iterations`` iterations."""
        while len(self.x_star) <= iterations:
            self.x_star.append(self._vectors())
            self.v_star.append(self._vectors())
            self.p.append(self._numbers())
            self.c.append(self._numbers())


class PcisphSteps(ParticleSolver):
    """The forward steps of PCISPH for one set of particles."""

    topic = "pcisph"

    def __init__(self, system: ParticleSystem, limits: LoopLimits | None, requires_grad: bool = False):
        """Prepare steps of a system; ``limits`` None leaves the pressure out."""
        super().__init__(system, requires_grad)
        self.limits, self.kernels = limits, PcisphKernels.of(self.discretisation, self.layout.phases)
        self.wall_relaxation, self.density_ratio = self.numbers(), self.numbers()
        self.pressure_relaxation = self.numbers() if self.layout.phases > 1 else self.wall_relaxation
        """(n,) what delta is multiplied with [-]: beside walls, and with several phases among lighter neighbours."""
        self.iterates = Iterates(self.numbers, self.vectors)
        self.pressure_loop = Loop(limits, self.layout, self.launch)
        self.loops = (self.pressure_loop,)

    def step(self, state: State, new_state: State, parameters: Parameters, log: IterationLog) -> None:
        context = self.predict(state, parameters)
        self.pressure_loop.run(lambda k: self.iterate(k, 0, context))
        self.write_state((0,), parameters, new_state)
        self.end_step(self.iterates.x_star[0], self.iterates.v_star[0], new_state, log)

    def reserve(self, counts: Counts) -> None:
        (iterations,) = counts
        self.iterates.reserve(iterations)

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        self.reserve(counts)
        context = self.predict(state, parameters)
        for k in range(*counts):
            self.iterate(k, k + 1, context)

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        """Write the last prediction as the new state."""
        (iterations,) = counts
        it = self.iterates
        self.unsort(self.context(parameters), it.x_star[iterations], it.v_star[iterations], new_state)

    def sorted_pressures(self) -> NDArray | None:
        return None if self.limits is None else self.iterates.p[1].numpy()

    def predict(self, state: State, parameters: Parameters) -> StepContext:
        """Do all of a step before the pressure iterations: sort and measure the density (`sort`), write the relaxation
        y, add up the explicit forces, gravity among them, and predict v* = v + dt a, x* = x + dt v*."""
        it, context = self.iterates, self.sort(state, parameters)
        with context.aside():
            self._relax(context)
        first = {"x_star": it.x_star[0], "v_star": it.v_star[0]}
        context.launch(self.integration.predict, acceleration=self.accelerate(context), **first)
        context.join()
        return context

    def _relax(self, context: StepContext) -> None:
        """Compute the relaxation of the pressure beside walls and among lighter neighbours."""
        kernels = self.kernels
        context.launch(kernels.wall_relaxation.forward, y=self.wall_relaxation)
        if kernels.density_ratio:
            context.launch(
                kernels.density_ratio.forward,
                wall_y=self.wall_relaxation,
                t=self.density_ratio,
                y=self.pressure_relaxation,
            )

    def iterate(self, k: int, slot: int, context: StepContext) -> None:
        """Take pressure iteration k, from the predicted state of the slot before to ``slot`` (0: the only one)."""
        it, kernels, before = self.iterates, self.kernels, max(slot - 1, 0)
        going = {"k": k, "rounds": self.pressure_loop.rounds}
        context.launch(
            kernels.pressure.forward,
            going,
            stiffness=self.lattice.stiffness,
            y=self.pressure_relaxation,
            x_star=it.x_star[before],
            p_in=it.p[0] if k == 0 else it.p[max(slot - 1, 1)],
            p_out=it.p[max(slot, 1)],
            c=it.c[before],
            error=self.pressure_loop.errors,
        )
        going |= {"x_before": it.x_star[before], "v_before": it.v_star[before]}
        new = {"x_star": it.x_star[slot], "v_star": it.v_star[slot]}
        context.launch(kernels.force.forward, going, acceleration=self.accelerations[-1], c=it.c[before], **new)
