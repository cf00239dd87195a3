"""What any solver of a scene is made of: neighbours, forces, phases, nozzle, and where particles may go."""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from cortado.device.grid import Grid
from cortado.device.lanes import lanes_for
from cortado.discretise.calibration import SKIN
from cortado.discretise.solid import Hollow, Mass, Solid
from cortado.errors import InputError, shown
from cortado.particles.moving_walls import WallArrays
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Layout, padded
from cortado.scene.discrete_scene import DiscreteScene, mirrors_of
from cortado.scene.fluid_particles import reserve_offset
from cortado.scene.motions import moving, solid_frames, wall_numbers
from cortado.scene.parameters import PARAMETERS
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import NoContainer
from cortado.scene.solids import SolidTable
from cortado.solvers.contacts import Contacts, Touching
from cortado.solvers.makers import ForceMaker, SolverSetting
from cortado.solvers.obstacles import FINE, NamedSolid, Obstacle, Walled
from cortado.solvers.particles import ParticleSystem
from cortado.sph.diffusion import Diffusion
from cortado.sph.emitter import Nozzle
from cortado.sph.free_energy import MOBILITIES, FreeEnergy
from cortado.sph.free_solids import FreeSolids, FreeTable
from cortado.sph.mixture import Phases
from cortado.sph.moving_solids import MovingSolids
from cortado.sph.parts import Force, Part, PartMaker, Setting

FORCE_ATTRIBUTES = ("shares", "accelerate", "tangent", "adjoint")
"""Attributes that every `Force` must have."""
PART_METHODS = ("begin", "sort", "settle", "target", "end", "new_tangent", "new_adjoint")
"""Methods of a `Part` that a `Force` alone does not have."""


def first_capacity(support: float, dimension: int) -> int:
    """Room for neighbours to begin with: half again as many as the lattice has, for a support in spacings."""
    filled = np.pi * support**2 if dimension == 2 else 4.0 / 3.0 * np.pi * support**3
    return int(1.5 * filled) + 6


def particle_system(setting: SolverSetting) -> ParticleSystem:
    """Cut the scene of a setting into particles on a device, with the scene's forces and those of the setting."""
    scene, discrete, precision, device = setting.scene, setting.discrete, setting.precision, setting.device
    layout = Layout(len(discrete.fluid.positions), len(scene.phase), precision, device, setting.batch, setting.known)
    lanes, moves = lanes_for(layout.particles, device, setting.lanes), bool(moving(scene.solid))
    shared = Discretisation(discrete.kernel, precision, lanes, any(discrete.periods), moves)
    mirrors = mirrors_of(scene)
    search = _search(scene, discrete, shared, layout, bool(np.isfinite(mirrors).any()))

    def system(discretisation: Discretisation) -> ParticleSystem:
        return ParticleSystem(
            setting.called,
            discretisation,
            layout,
            discrete.lattice,
            search,
            _forces(scene, discrete, discretisation, layout, setting.forces),
            [*discrete.periods, *[0.0] * (3 - scene.dimension)],
            _parts(scene, discrete, discretisation, setting.free_energy, search, layout),
            discrete.fluid.emitted.start,
            _walled(scene, discrete),
            mirrors,
            _named_solids(scene),
            of_one_lane=lambda: system(replace(discretisation, lanes=1, taped=True)),
        )

    return system(shared)


def _search(
    scene: Scene, discrete: DiscreteScene, discretisation: Discretisation, layout: Layout, mirrored: bool
) -> NeighbourSearch:
    """Make the search for neighbours of particles within the support radius, and a little beyond."""
    support = discrete.lattice.support
    grid = Grid.around(
        discrete.near.lower,
        discrete.near.upper,
        discrete.periods,
        reach=(1.0 + SKIN) * support,
        most=max(4 * layout.particles, 512),
    )
    room = first_capacity(support / scene.discretisation.spacing, scene.dimension)
    walls, (middles, turns) = discrete.walls, solid_frames(scene)
    positions, feet = walls.positions.copy(), walls.feet.copy()
    for number, (middle, turn) in enumerate(zip(middles, turns, strict=True)):
        own = walls.solid == number
        positions[own], feet[own] = (positions[own] - middle) @ turn, feet[own] @ turn
    grips = walls.weights * walls.sticks
    arrays = WallArrays(padded(positions), walls.weights, grips, padded(feet), padded(walls.slides), walls.solid)
    return NeighbourSearch(discretisation, grid, arrays, layout, room, len(middles), scene.dimension, mirrored)


def _forces(
    scene: Scene, discrete: DiscreteScene, discretisation: Discretisation, layout: Layout, makers: Sequence[ForceMaker]
) -> list[Force]:
    """Make the forces of a scene's parameters, in the order of the registry, and after them those of the makers."""
    setting = Setting(scene, discretisation, discrete.lattice, discrete.wall_layers, layout)
    replaced = {getattr(maker, "replaces", None) for maker in makers}
    modules = [p.force for p in PARAMETERS if p.force is not None and p.present(scene) and p.force not in replaced]
    made = [(maker, maker.force(setting)) for maker in (*map(import_module, modules), *makers)]
    forces = [force for _, force in made if force is not None]
    for maker, force in made:
        if force is not None:
            _check_force(force, maker)
    for force in forces:
        if layout.batch is not None and not getattr(force, "batches", False):
            raise InputError(
                f"batch is {layout.batch}, but must be left out, as the force {type(force).__name__} has no "
                "`batches = True`, which says that its kernels read the parameters of a particle's own scene."
            )
    return sorted(forces, key=lambda one: bool(getattr(one, "is_last", False)))


def _check_force(force: Force, maker: Any) -> None:
    """Raise `InputError` for a maker's result that lacks an attribute of a `Force`, or for a part that would leave its
    fields unwritten. So it does for an object with methods of a part that is no force, as no step would call them."""
    name = type(force).__name__
    if missing := [one for one in FORCE_ATTRIBUTES if not hasattr(force, one)]:
        made = f"the force {name}, which {shown(maker)} made, has no {missing[0]}"
        raise InputError(f"{made}, but must have {', '.join(FORCE_ATTRIBUTES)}.")
    if not isinstance(force, Part):
        found = [method for method in PART_METHODS if hasattr(force, method)]
        if found:
            raise InputError(
                f"the force {name} has the methods {', '.join(found)} of a part, but is none: let its class be a "
                "cortado.sph.parts.Part too."
            )
    elif type(force).end is Part.end and not all(field.is_constant for field in force.fields):
        raise InputError(f"the force {name} has fields, but no method `end` that writes them after a step.")


def _parts(
    scene: Scene,
    discrete: DiscreteScene,
    discretisation: Discretisation,
    free_energy: FreeEnergy,
    search: NeighbourSearch,
    layout: Layout,
) -> list[PartMaker]:
    """Make the parts of a solver that are no forces, in the order in which they end a step."""
    found: list[PartMaker | None] = [_phases(scene, discretisation, free_energy), _nozzle(scene, discrete)]
    found += [_free_solids(scene, discrete, search, layout), _moving_solids(scene, search)]
    return [part for part in found if part is not None]


def _free_solids(scene: Scene, discrete: DiscreteScene, search: NeighbourSearch, layout: Layout) -> FreeSolids | None:
    """Make the part that moves free bodies with the fluid; None for a scene without free bodies."""
    tables = [
        FreeTable(
            table.name, number, Mass.of(table.own_solid()).in_volumes(scene.discretisation.spacing**scene.dimension)
        )
        for number, table in enumerate(moving(scene.solid))
        if table.motion == "free"
    ]
    if not tables:
        return None
    spacing, touching, periods = scene.discretisation.spacing, _touching(scene, discrete), discrete.periods
    return FreeSolids(tables, scene.dimension, search, lambda part: Contacts(part, touching, spacing, periods, layout))


def _touching(scene: Scene, discrete: DiscreteScene) -> list[Touching]:
    """List for each free body the solids that it may touch: container and solids at rest, and each other moving
    solid."""
    moved, spacing, walls = moving(scene.solid), scene.discretisation.spacing, discrete.walls
    bodies = [number for number, table in enumerate(moved) if table.motion == "free"]
    sides = scene.container.solids(scene.dimension, discrete.lattice.support)
    still = [Obstacle("container", side, isinstance(side, Hollow), np.inf) for side in sides]
    still += [_obstacle(table, table.solid(), spacing) for table in scene.solid if not table.moves]
    found = []
    for body, number in enumerate(bodies):
        table, own = moved[number], walls.solid == number
        feet = walls.positions[own] - table.middle() + walls.feet[own]
        near = feet[np.linalg.norm(walls.feet[own], axis=1) < spacing] @ table.turn(scene.dimension)
        points = np.concatenate([near, table.own_solid().faces(FINE * spacing).vertices])
        found.append(Touching(body, -1, -1, still, points))
        for against, one in enumerate(moved):
            if against != number:
                other = bodies.index(against) if against in bodies else -1
                found.append(Touching(body, against, other, [_obstacle(one, one.own_solid(), spacing)], points))
    return found


def _moving_solids(scene: Scene, search: NeighbourSearch) -> MovingSolids | None:
    """Make the part that moves solids and writes the walls of all moving solids; None where no solid moves."""
    tables = moving(scene.solid)
    numbers = {table.name: number for number, table in enumerate(tables) if table.motion != "free"}
    return MovingSolids(numbers, scene.dimension, search) if tables else None


def _phases(scene: Scene, discretisation: Discretisation, free_energy: FreeEnergy) -> Phases:
    """Make the part for the phases of a mixture, with their diffusion into one another where there are several."""
    mixture, count = scene.mixture, len(scene.phase)
    if count == 1:
        return Phases(1, None, 0.0)
    diffusion = Diffusion(discretisation, count, free_energy, MOBILITIES[mixture.mobility_form])
    return Phases(count, diffusion, mixture.strength)


def _nozzle(scene: Scene, discrete: DiscreteScene) -> Nozzle | None:
    """Make the part for the particles that wait in a nozzle; None for a scene without an emitter."""
    fluid, sample = discrete.fluid, discrete.fluid.emitter
    if scene.emitter is None or sample is None:
        return None
    return Nozzle(
        first=fluid.emitted.start,
        upstream=sample.upstream,
        offsets=sample.offsets,
        direction=np.array(scene.emitter.direction),
        area=scene.emitter.flow_rate / sample.speed,
        column=sample.column,
        reserve=reserve_offset(scene),
    )


def _walled(scene: Scene, discrete: DiscreteScene) -> Walled:
    """Describe where particles may go: container and solids. Without pressure walls hold nothing and are left out."""
    holds = scene.container if scene.forces.pressure else NoContainer()
    region = holds.region(scene.dimension).opened(discrete.periods)
    spacing = scene.discretisation.spacing
    still = [_obstacle(table, table.solid(), spacing) for table in scene.solid if not table.moves]
    moved = [_obstacle(table, table.own_solid(), spacing) for table in moving(scene.solid)]
    solids = (tuple(still), tuple(moved)) if scene.forces.pressure else ((), ())
    return Walled(region, discrete.near, spacing, *solids, discrete.periods)


def _named_solids(scene: Scene) -> dict[str, NamedSolid]:
    """Return the solids of a scene by name, each with the number of its wall particles and its middle."""
    numbers = wall_numbers(scene.solid)
    return {table.name: NamedSolid(numbers[table.name], padded(table.middle()[None])[0]) for table in scene.solid}


def _obstacle(table: SolidTable, solid: Solid, spacing: float) -> Obstacle:
    return Obstacle(table.name, solid, table.side == "inside", table.thinnest(spacing))
