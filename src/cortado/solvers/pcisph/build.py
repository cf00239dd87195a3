"""The PCISPH solver of a scene."""

from math import inf
from typing import Any

from cortado.device.neighbourhood import Discretisation
from cortado.device.precision import Precision
from cortado.discretise.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene
from cortado.solvers.build import forces_of, nozzle_of, phases_of, search_of, walled_of
from cortado.solvers.pcisph.parts import PressureSolve
from cortado.solvers.pcisph.solver import Pcisph
from cortado.sph.free_energy import FreeEnergy


def build_pcisph(
    scene: Scene, discrete: DiscreteScene, free_energy: FreeEnergy, precision: Precision, device: Any
) -> Pcisph:
    """The solver of a scene that is cut into particles, on a device."""
    discretisation = Discretisation(discrete.kernel, precision)
    return Pcisph(
        discretisation,
        discrete.lattice,
        search_of(scene, discrete, discretisation, device),
        forces_of(scene, discrete, discretisation, device),
        _pressure(scene),
        [*discrete.periods, *[0.0] * (3 - scene.dimension)],
        phases_of(scene, discretisation, free_energy),
        nozzle_of(scene, discrete),
        walled_of(scene, discrete),
    )


def _pressure(scene: Scene) -> PressureSolve | None:
    """When the pressure loop may stop; None where no pressure acts."""
    solver = scene.solver
    if not scene.forces.pressure:
        return None
    greatest = solver.maximum_density_tolerance
    return PressureSolve(
        solver.minimum_iterations,
        solver.maximum_iterations,
        solver.density_tolerance,
        inf if greatest is None else greatest,
    )
