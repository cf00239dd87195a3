"""The velocity projection as the solver of a scene: its steps, forward, and their derivatives."""

from math import inf

from cortado.errors import InputError
from cortado.particles.state import Parameters
from cortado.scene.solvers import ProjectionSolver
from cortado.solvers.build import SolverSetting, particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.projection.derivatives import ProjectionAdjoint, ProjectionTangent
from cortado.solvers.projection.lattice import coarse_grid, endless, lattice_constants
from cortado.solvers.projection.steps import ProjectionSteps
from cortado.solvers.solver import Solver, StepAdjoint, StepTangent


class Projection(ProjectionSteps):
    """The solver by a projection that pushes and pulls incompressible SPH fluid, with derivatives; see `Solver`."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return ProjectionTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return ProjectionAdjoint(self, steps)


class ProjectionMaker:
    """A maker of the projection solver that the table [solver] of a scene describes."""

    batches = True

    def __init__(self, table: ProjectionSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Make the projection solver of a scene that is cut into particles, on a device. Without pressure nothing is
        projected, and all solvers take the same step."""
        system, table = particle_system(setting), self._table
        if not setting.scene.forces.pressure:
            return Pcisph(system, None)
        if setting.batch is not None and table.tolerance is not None:
            raise InputError(
                f"batch is {setting.batch}, but must be left out, as solver.tolerance is that of one scene."
            )
        grid = coarse_grid(setting.scene, setting.discrete, system.layout.particles)
        constants = lattice_constants(setting.scene, setting.discrete)
        own = table.repairs, table.velocities_follow, grid, endless(setting.discrete)
        return Projection(system, constants, pressure_limits(table), *own)


maker = ProjectionMaker


def pressure_limits(table: ProjectionSolver) -> LoopLimits:
    """Return the bounds on iterations and errors at which the projection's pressure loop stops."""
    if table.tolerance is None:
        return LoopLimits(table.iterations, table.iterations, 0.0, 0.0)
    return LoopLimits(table.iterations, table.maximum_iterations, table.tolerance, inf)
