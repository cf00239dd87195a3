"""PCISPH as the solver of a scene: its steps, forward, and their derivatives."""

from math import inf
from typing import Self

from cortado.particles.state import Parameters
from cortado.scene.solvers import PcisphSolver
from cortado.solvers.build import particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.makers import SolverSetting
from cortado.solvers.pcisph.derivatives import PcisphAdjoint, PcisphTangent
from cortado.solvers.pcisph.steps import PcisphSteps
from cortado.solvers.solver import Solver, StepAdjoint, StepTangent


class Pcisph(PcisphSteps):
    """The solver by predictive-corrective incompressible SPH, with its derivatives; see `Solver`."""

    def differentiable(self) -> Self:
        """Return a solver over this neighbour search with arrays of its own that Warp's tape can differentiate."""
        return type(self)(self.system.of_one_lane(), self.limits, requires_grad=True)

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return PcisphAdjoint(self, steps)


class PcisphMaker:
    """A maker of the PCISPH solver that the table [solver] of a scene describes."""

    batches = True

    def __init__(self, table: PcisphSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Make the PCISPH solver of a scene that is cut into particles, on a device."""
        limits = pressure_limits(self._table) if setting.scene.forces.pressure else None
        return Pcisph(particle_system(setting), limits)


maker = PcisphMaker


def pressure_limits(table: PcisphSolver) -> LoopLimits:
    """Return the bounds on iterations and density errors at which PCISPH's pressure loop stops."""
    greatest = table.maximum_density_tolerance
    return LoopLimits(
        table.minimum_iterations,
        table.maximum_iterations,
        table.density_tolerance,
        inf if greatest is None else greatest,
    )
