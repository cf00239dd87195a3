"""Slow twins of simulations."""

import numpy as np

import reference
from cortado.sph.emitter import Nozzle
from cortado.sph.surface_tension import SurfaceTension, tension_constants
from cortado.sph.viscosity import Viscosity


def twin(simulation):
    """The slow twin of a simulation's solver, in the simulation's own dimension."""
    lattice, search, d = simulation.solver.lattice, simulation.solver.search, simulation.dimension
    viscous = [force for force in simulation.solver.forces if isinstance(force, Viscosity)]
    return reference.Pcisph(
        simulation.solver.discretisation.smoothing,
        d,
        lattice.support,
        lattice.volume,
        lattice.stiffness,
        search.wall_positions.numpy()[:, :d].astype(np.float64),
        search.wall_weights.numpy().astype(np.float64),
        viscosity=simulation.scene.forces.viscosity,
        friction=viscous[0].friction if viscous else 0.0,
        reach=1.03 * lattice.support,
        response=lattice.response,
        laplacian_correction=lattice.laplacian_correction,
    )


def tension_twin(simulation):
    """The slow twin of its surface tension; None without."""
    solver, scene = simulation.solver, simulation.scene
    if not any(isinstance(force, SurfaceTension) for force in solver.forces):
        return None
    lattice = solver.lattice
    constants = tension_constants(scene.discretisation.spacing, lattice.support, lattice.volume, scene.dimension)
    return reference.SurfaceTension(lattice.support, *constants)


def emitter_twin(simulation, path):
    """The slow twin of its emitter, whose opening goes along a path (steps, d); None without."""
    nozzle = nozzle_of(simulation)
    return nozzle and reference.Emitter(nozzle.upstream, nozzle.offsets, nozzle.direction, nozzle.area, path)


def nozzle_of(simulation):
    """Of its emitter; None without."""
    return next((part for part in simulation.solver.system.parts if isinstance(part, Nozzle)), None)
