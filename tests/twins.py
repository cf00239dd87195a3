"""Slow twins of simulations."""

import numpy as np

import reference
from cortado.discretise.smoothing import stress_control
from cortado.sph.curvature import CurvatureConstants
from cortado.sph.emitter import Nozzle
from cortado.sph.surface_tension import CurvatureTension, SurfaceTension, tension_constants
from cortado.sph.viscosity import Viscosity
from reference_terms import Curvature, Stress


def twin(simulation):
    """The slow twin of a simulation's solver, in the simulation's own dimension."""
    lattice, search, d = simulation.solver.lattice, simulation.solver.search, simulation.dimension
    walls = (
        search.walls["wall_positions"].numpy()[:, :d].astype(np.float64),
        search.walls["wall_weights"].numpy().astype(np.float64),
    )
    viscous = [force for force in simulation.solver.forces if isinstance(force, Viscosity)]
    options = {"viscosity": simulation.scene.forces.viscosity, "sticks": bool(viscous) and viscous[0].sticks}
    options |= {"reach": 1.03 * lattice.support, "response": lattice.response}
    kernel, options["stress"] = simulation.solver.discretisation.smoothing, stress_twin(simulation, *walls)
    return reference.Pcisph(kernel, d, lattice.support, lattice.volume, lattice.stiffness, *walls, **options)


def stress_twin(simulation, walls, wall_weights, sticks=None):
    """The slow twin of its viscosity as a stress, given its walls (b, d) and their weights, all of which ``sticks`` may
    be told of."""
    solver, scene, d = simulation.solver, simulation.scene, simulation.dimension
    lattice, spacing = solver.lattice, scene.discretisation.spacing
    feet = solver.search.walls["wall_feet"].numpy()[:, :d].astype(np.float64)
    control = stress_control(solver.discretisation.smoothing, spacing, lattice.support, d)
    held = sticks or (sticks is None and getattr(scene.container, "slip", "free") == "no")
    return Stress(lattice.volume, control, 0.25 * spacing, walls, wall_weights, feet if held else None)


def tension_twin(simulation):
    """The slow twin of its surface tension; None without."""
    solver, scene = simulation.solver, simulation.scene
    if any(isinstance(force, CurvatureTension) for force in solver.forces):
        lattice, kernel, spacing = solver.lattice, solver.discretisation.smoothing, scene.discretisation.spacing
        made = CurvatureConstants.of(kernel, spacing, lattice.support, scene.dimension)
        return Curvature(kernel, lattice.support, lattice.volume, spacing, made.width, made.depth)
    if not any(isinstance(force, SurfaceTension) for force in solver.forces):
        return None
    lattice = solver.lattice
    constants = tension_constants(scene.discretisation.spacing, lattice.support, scene.dimension)
    return reference.SurfaceTension(lattice.support, *constants)


def emitter_twin(simulation, path):
    """The slow twin of its emitter, whose opening goes along a path (steps, d); None without."""
    nozzle = nozzle_of(simulation)
    return nozzle and reference.Emitter(nozzle.sample, nozzle.direction, nozzle.area, path)


def nozzle_of(simulation):
    """Of its emitter; None without."""
    return next((part for part in simulation.solver.system.parts if isinstance(part, Nozzle)), None)
