"""Scenes as the extension module wants them, and which ones it knows."""

from typing import Any

import numpy as np

from cortado.discretise.smoothing import SKIN, stress_control
from cortado.errors import InputError, shown
from cortado.scene.discrete_scene import DiscreteScene, mirrors_of
from cortado.scene.parameters import BY_NAME
from cortado.scene.scene import Scene
from cortado.scene.solvers import PcisphSolver, ProjectionSolver
from cortado.scene.stability import is_implicit
from cortado.solvers.projection.lattice import coarse_grid, endless, lattice_constants
from cortado_reference.engine import extension

CLOSEST = 0.25
"""In spacings: from where on a wall without slip pulls no harder, with the stress."""


def check_scene(scene: Scene) -> None:
    """Refuse what the engine does not know."""
    if not isinstance(scene.solver, PcisphSolver | ProjectionSolver):
        kind = shown(scene.solver.kind)
        raise InputError(f"solver.kind is {kind}, but must be pcisph or projection for the reference engine.")
    if getattr(scene.solver, "velocities_follow", False):
        raise InputError("solver.velocities_follow is true, but must be left out for the reference engine.")
    if getattr(scene.solver, "tolerance", None) is not None:
        raise InputError("solver.tolerance is given, but must be left out for the reference engine.")
    if len(scene.phase) > 1 or scene.emitter:
        raise InputError("scene has several phases or an emitter, but must have neither for the reference engine.")
    unknown = [p.name for p in BY_NAME.values() if p.is_optional and p.present(scene)]
    if unknown:
        raise InputError(f"scene has forces.{unknown[0]}, but must leave it out for the reference engine.")
    if scene.phase[0].rheology is not None:
        raise InputError("scene has phase[0].rheology, but must leave it out for the reference engine.")
    if scene.force:
        raise InputError("scene has [[force]], but must leave it out for the reference engine.")
    moving = [k for k, solid in enumerate(scene.solid) if solid.moves]
    if moving:
        raise InputError(
            f"scene has solid[{moving[0]}], which moves, but must have solids at rest alone for the reference engine."
        )
    sheets = [k for k, solid in enumerate(scene.solid) if solid.is_sheet]
    if sheets:
        raise InputError(f"scene has solid[{sheets[0]}], a sheet, but must have none for the reference engine.")
    walls = [*scene.solid, *([scene.container] if scene.container.extent() is not None else [])]
    if len({wall.sticks for wall in walls}) > 1:
        raise InputError("scene has walls with and without slip, but must have one kind for the reference engine.")
    if scene.schedule.courses:
        raise InputError(
            "scene has a schedule, but must leave it out for the reference engine, which takes a gravity for each "
            "step by controls."
        )
    scene.solver.fixed_time_step("the reference engine")
    if is_implicit(scene):
        raise InputError(
            'scene has viscosity at the end of a step, but must have viscous_solve = "explicit" in [forces], or a '
            "shorter time step, for the reference engine."
        )


def engine_scene(scene: Scene, discrete: DiscreteScene) -> Any:
    """What the extension module is told of a scene and of its particles."""
    lattice, solver, form = discrete.lattice, scene.solver, scene.forces.viscosity
    spacing = scene.discretisation.spacing
    values = {
        "dimension": scene.dimension,
        "kernel": discrete.kernel.name,
        "support": lattice.support,
        "reach": (1.0 + SKIN) * lattice.support,
        "normalisation": lattice.normalisation,
        "volume": lattice.volume,
        "stiffness": lattice.stiffness,
        "response": lattice.response,
        "wall_positions": discrete.walls.positions.ravel().tolist(),
        "wall_weights": discrete.walls.weights.tolist(),
        "wall_feet": discrete.walls.feet.ravel().tolist(),
        **_of_mirrors(scene, discrete),
        "periods": [*map(float, discrete.periods), *[0.0] * (3 - scene.dimension)],
        "rest_density": scene.phase[0].rest_density,
        "time_step": solver.time_step,
        "viscosity": form,
        "friction": 1.0 if scene.sticks else 0.0,
        "control": stress_control(discrete.kernel, spacing, lattice.support, scene.dimension),
        "closest": CLOSEST * spacing,
        "pressure": scene.forces.pressure,
        "spacing": spacing,
        **_of_solver(scene, discrete),
    }
    made = extension().Scene()
    for name, value in values.items():
        setattr(made, name, value)
    return made


def _of_mirrors(scene: Scene, discrete: DiscreteScene) -> dict[str, Any]:
    """The flat walls that mirror the fluid, and which wall particles are theirs."""
    lower, upper = mirrors_of(scene)
    mirrors = (discrete.walls.solid == -1) & np.isfinite([lower, upper]).any()
    return {
        "mirror_lower": lower.tolist(),
        "mirror_upper": upper.tolist(),
        "wall_mirrors": mirrors.astype(int).tolist(),
    }


def _of_solver(scene: Scene, discrete: DiscreteScene) -> dict[str, Any]:
    """What the engine is told of the solver; without pressure both take the same step."""
    solver = scene.solver
    if isinstance(solver, ProjectionSolver):
        spacing, support = scene.discretisation.spacing, discrete.lattice.support
        constants = lattice_constants(discrete.kernel, spacing, support, scene.dimension)
        return {
            "projection": scene.forces.pressure,
            "maximum_iterations": solver.iterations,
            "relaxation": constants.relaxation,
            "repair_relaxations": constants.repair_relaxations(solver.repairs),
            "least_diagonal": constants.least_diagonal,
            "nearest_weight": constants.nearest_weight,
            **({} if endless(discrete) else _of_nodes(scene, discrete)),
        }
    assert isinstance(solver, PcisphSolver)
    greatest = solver.maximum_density_tolerance
    return {
        "minimum_iterations": solver.minimum_iterations,
        "maximum_iterations": solver.maximum_iterations,
        "density_tolerance": solver.density_tolerance,
        "maximum_density_tolerance": float("inf") if greatest is None else greatest,
    }


def _of_nodes(scene: Scene, discrete: DiscreteScene) -> dict[str, Any]:
    """What the engine is told of the coarse correction."""
    grid = coarse_grid(scene, discrete, len(discrete.fluid.positions))
    frequency = (1.0 / grid.cell).tolist()
    return {"nodes": list(grid.shape), "first_node": grid.origin.tolist(), "node_frequency": frequency}
