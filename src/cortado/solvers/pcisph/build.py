"""The PCISPH solver of a scene."""

from collections.abc import Sequence
from math import inf
from typing import Any

from cortado.device.precision import Precision
from cortado.discretise.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene
from cortado.solvers.build import particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.solver import Solver
from cortado.sph.free_energy import FreeEnergy
from cortado.sph.makers import ForceMaker


def build(
    scene: Scene,
    discrete: DiscreteScene,
    free_energy: FreeEnergy,
    precision: Precision,
    device: Any,
    batch: int | None = None,
    makers: Sequence[ForceMaker] = (),
) -> Solver:
    """The solver of a scene that is cut into particles, on a device; ``batch`` of it in one launch, with the forces of
    ``makers`` besides the scene's."""
    system = particle_system(scene, discrete, free_energy, precision, device, batch, makers)
    return Pcisph(system, pressure_limits(scene))


def pressure_limits(scene: Scene) -> LoopLimits | None:
    """When the pressure loop may stop; None where no pressure acts."""
    solver = scene.solver
    if not scene.forces.pressure:
        return None
    greatest = solver.maximum_density_tolerance
    return LoopLimits(
        solver.minimum_iterations,
        solver.maximum_iterations,
        solver.density_tolerance,
        inf if greatest is None else greatest,
    )
