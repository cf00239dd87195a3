"""Makers of forces and solvers, for the arguments ``forces`` and ``solver`` of `Simulation` and for scenes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from cortado.device.grid import Grid
from cortado.device.precision import Precision, lanes_for
from cortado.discretise.smoothing import SKIN
from cortado.discretise.solid import Hollow, Solid
from cortado.errors import InputError, shown
from cortado.particles.mirrors import MOST_FACES, most_imaged
from cortado.particles.moving_walls import WallArrays
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.sheets import Sheets
from cortado.particles.state import Layout, padded
from cortado.scene.discrete_scene import DiscreteScene, mirrors_of
from cortado.scene.drain_tables import drain_parameters
from cortado.scene.emitter_table import emitter_parameters
from cortado.scene.links import Hold, ends_of, joints_of, spring_parameters
from cortado.scene.motions import mass_of_one, motion_parameters, moving, solid_frames, wall_numbers, weight_name
from cortado.scene.parameter_values import REGISTRY, Known, checked_value
from cortado.scene.parameters import PARAMETERS, Parameter, Source
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import NoContainer
from cortado.scene.solids import SolidTable
from cortado.scene.solvers import PackageSolver, SolverTable
from cortado.solvers import obstacles
from cortado.solvers.contacts import Contacts, Touching
from cortado.solvers.particles import ParticleSystem
from cortado.solvers.solver import Solver
from cortado.sph.drains import Drains
from cortado.sph.free_energy import MOBILITIES, Diffusion, FreeEnergy
from cortado.sph.free_solids import FreeSolids, FreeSolidsPart, FreeTable, Push
from cortado.sph.function_text import code_words
from cortado.sph.mixture import Phases
from cortado.sph.moving_solids import MovingSolids
from cortado.sph.own_force import Rheology
from cortado.sph.parts import Force, Part, PartMaker, Setting
from cortado.sph.springs import Springs
from cortado.sph.stress_forces import LAWS


class ForceMaker(Protocol):
    """Protocol of a maker of forces. A maker lists the parameters of the force, and makes the force for each solver of
    a simulation.

    The maker is pickled with the simulation. An optional text ``fingerprint`` identifies the maker when a search
    resumes. An optional method ``check(values, simulation)`` gets parameter values by name, and raises `InputError` for
    impossible values.
    """

    parameters: Sequence[Parameter]
    """Parameters of the force, with unique names. Kernels read the parameter ``drag.k`` as their argument ``drag_k``.
    If kernels read ``time``, `known.TIME` must be among the parameters."""

    def force(self, setting: Setting) -> Force | None:
        """Make the force for one precision and one device, or return None without a force."""


def checked_makers(forces: Any) -> tuple[ForceMaker, ...]:
    if not isinstance(forces, (list, tuple)):
        wanted = "a list of forces, such as [cortado.forces.Body(function, k=2.0)]"
        raise InputError(f"forces is {shown(forces)}, but must be {wanted}.")
    for k, maker in enumerate(forces):
        if isinstance(maker, type) or not callable(getattr(maker, "force", None)):
            wanted = (
                "but each force must be an object with a method force(setting), such as cortado.forces.Body(f, k=2.0)"
            )
            raise InputError(f"forces has {shown(maker)} at place {k}, {wanted}.")
        check_parameters("force", maker, getattr(maker, "parameters", None))
    return tuple(forces)


def check_parameters(what: str, maker: Any, parameters: Any) -> None:
    if not isinstance(parameters, (list, tuple)) or not all(isinstance(p, Parameter) for p in parameters):
        wanted = "a list of cortado.scene.parameters.Parameter, which may be empty"
        raise InputError(f"the {what} {shown(maker)} has parameters {shown(parameters)}, but must have {wanted}.")


def known_of(forces: Sequence[ForceMaker], solver: Any, scene: Scene) -> Known:
    taken: dict[str, ForceMaker] = {}
    for maker in forces:
        if (place := getattr(maker, "replaces", None)) is not None and taken.setdefault(place, maker) is not maker:
            what = place.rpartition(".")[2].replace("_", " ")
            found = f"{shown(taken[place])} and {shown(maker)} both replace the scene's force of {what}"
            raise InputError(f"{found}, but only one can: remove one from forces or from the phase's rheology.")
    own = [(parameter, "a solver") for parameter in getattr(solver, "parameters", ())]
    own += [(parameter, "a force") for maker in forces for parameter in maker.parameters]
    own += [(parameter, "a solid") for parameter in motion_parameters(scene.solid)]
    own += [(parameter, "an emitter") for parameter in emitter_parameters(scene)]
    own += [(parameter, "a drain") for parameter in drain_parameters(scene)]
    return Known([*own, *((parameter, "a spring") for parameter in spring_parameters(scene))])


def check_own(known: Known, source: Source) -> None:
    """Raise `InputError` if the shape of a user-defined parameter does not fit the scene."""
    for parameter in known.own:
        shapes = parameter.shapes(0, len(source.scene.phase), source.positions.shape)
        checked_value(parameter.name, parameter.value(source), shapes, known=known)


def fingerprint(makers: Sequence[Any], source: Source) -> str:
    """Return a hash of makers and their parameter values, or an empty text if no makers are given."""
    words = []
    for maker in makers:
        parameters = getattr(maker, "parameters", ())
        values = [(p.name, np.asarray(p.value(source), dtype=np.float64).tolist()) for p in parameters]
        words.append(f"{getattr(maker, 'fingerprint', None) or code_words(maker)} {values}")
    return sha256("\n".join(words).encode()).hexdigest()[:16] if words else ""


@dataclass(frozen=True)
class SolverSetting:
    """The arguments for making a solver."""

    scene: Scene
    discrete: DiscreteScene
    free_energy: FreeEnergy
    precision: Precision
    device: Any
    batch: int | None
    forces: Sequence[ForceMaker]
    known: Known
    called: str
    lanes: int | None = None
    """Number of GPU threads for each particle; None for an automatic choice."""


class SolverMaker(Protocol):
    """Protocol of a maker of a solver. A simulation and all simulations derived from it use the same maker.

    The maker is pickled with the simulation. Kernels may read the optional ``parameters`` of a maker by name. The
    optional text ``fingerprint`` of a maker identifies the maker. ``batches = True`` declares that the solver supports
    batches.
    """

    def build(self, setting: SolverSetting) -> Solver:
        """Make the solver for one precision and one device."""


def checked_solver(solver: Any) -> SolverMaker:
    if isinstance(solver, type) or not callable(getattr(solver, "build", None)):
        wanted = "an object with a method build(setting), which returns a solver: see docs/own_parts.md"
        raise InputError(f"solver is {shown(solver)}, but must be {wanted}.")
    check_parameters("solver", solver, getattr(solver, "parameters", ()))
    return solver


def called(table: SolverTable, given: SolverMaker | None) -> str:
    return f'solver.kind "{table.kind}"' if given is None else f"the solver {type(given).__name__}"


NEEDED = ("new_parameters", "new_log", "set_substeps", "reset", "make_room", "step")


def built(maker: SolverMaker, setting: SolverSetting) -> Solver:
    if setting.batch is not None and not getattr(maker, "batches", False):
        raise InputError(f"batch is {setting.batch}, but must be left out, as {setting.called} supports no batches.")
    solver = maker.build(setting)
    if not callable(getattr(solver, "new_state", None)):
        raise InputError(f"build of {setting.called} returned {shown(solver)}, but must return a solver.")
    lacking = [name for name in NEEDED if not callable(getattr(solver, name, None))]
    if lacking:
        found = f"build of {setting.called} returned {shown(solver)}, which has no method {lacking[0]}"
        raise InputError(f"{found}, but must have all methods of cortado.solvers.solver.Solver.")
    if setting.forces and not hasattr(solver, "forces"):
        raise InputError(f"forces is given, but must be left out, as {setting.called} takes no user-defined forces.")
    return solver


def solver_named(table: SolverTable) -> SolverMaker:
    if isinstance(table, PackageSolver):
        return checked_solver(table.make())
    made: SolverMaker = import_module(f"cortado.solvers.{table.kind}.solver").Maker(table)
    return made


def forces_named(scene: Scene) -> tuple[ForceMaker, ...]:
    """Return the makers of a scene's viscosity laws and of its forces from installed packages."""
    laws = [
        Rheology(LAWS[phase.rheology.kind], None, **phase.rheology.numbers(phase.viscosity))
        for phase in scene.phase
        if phase.rheology is not None
    ]
    return checked_makers([*laws, *(table.make() for table in scene.force)])


def known_in(scene: Scene) -> Known:
    own = scene.force or any(phase.rheology for phase in scene.phase) or isinstance(scene.solver, PackageSolver)
    if not (own or scene.emitter or scene.drain or moving(scene.solid)):
        return REGISTRY
    return known_of(forces_named(scene), solver_named(scene.solver), scene)


FORCE_ATTRIBUTES = ("shares", "accelerate", "tangent", "adjoint")
PART_METHODS = ("begin", "sort", "settle", "target", "end", "new_tangent", "new_adjoint")
"""Methods of a `Part` that a `Force` lacks."""


def first_capacity(support: float, dimension: int) -> int:
    """Return the initial capacity of neighbour lists. ``support`` is the support radius [spacings]."""
    filled = np.pi * support**2 if dimension == 2 else 4.0 / 3.0 * np.pi * support**3
    return int(1.5 * filled) + 6


def particle_system(setting: SolverSetting) -> ParticleSystem:
    """Discretise a scene into particles on a device, with all forces."""
    scene, discrete, precision, device = setting.scene, setting.discrete, setting.precision, setting.device
    layout = Layout(len(discrete.fluid.positions), len(scene.phase), precision, device, setting.batch, setting.known)
    lanes, numbers = lanes_for(layout.particles, device, setting.lanes), wall_numbers(scene.solid)
    drains, spacing = obstacles.drained_of(scene, discrete, precision), scene.discretisation.spacing
    shared = Discretisation(discrete.kernel, precision, lanes, any(discrete.periods), bool(moving(scene.solid)))
    mirrors, placed = mirrors_of(scene), obstacles.placed_sheets(scene)
    most = MOST_FACES if layout.all_particles <= most_imaged(moving=True) else 0
    faces = obstacles.flat_faces(scene, discrete.lattice.support, most)
    search = _search(setting, shared, layout, bool(np.isfinite(mirrors).any()), faces)
    sheets = Sheets(placed, spacing, layout) if placed else None

    def obstacle(table: SolidTable, solid: Solid) -> obstacles.Obstacle:
        return obstacles.Obstacle(table.name, solid, table.side == "inside", table.thinnest(spacing))

    still = [obstacle(table, table.solid()) for table in scene.solid if not table.moves]
    moved = [obstacle(table, table.own_solid()) for table in moving(scene.solid)]
    # Without pressure, walls do not stop particles and are left out.
    holds, solids = (scene.container, (still, moved)) if scene.forces.pressure else (NoContainer(), ([], []))
    region = holds.region(scene.dimension).opened(discrete.periods)
    free = _free_solids(setting, search, layout, still, moved)
    walled = obstacles.Walled(region, discrete.near, spacing, tuple(solids[0]), tuple(solids[1]), discrete.periods)
    named = {one.name: obstacles.NamedSolid(numbers[one.name], padded(one.middle()[None])[0]) for one in scene.solid}
    around = 0 if drains else discrete.fluid.emitted.start, walled, mirrors, faces, named, sheets

    def system(own: Discretisation) -> ParticleSystem:
        made = Setting(scene, own, discrete.lattice, discrete.wall_layers, layout)
        forces = [*_forces(made, setting.forces), *([Drains(drains, layout, own.taped)] if drains else [])]
        fluid = own, layout, discrete.lattice, search, forces, _parts(setting, own, search, free)
        return ParticleSystem(setting.called, *fluid, *around, lambda: system(replace(own, lanes=1, taped=True)))

    return system(shared)


def _search(
    setting: SolverSetting, discretisation: Discretisation, layout: Layout, mirrored: bool, faces: obstacles.FlatFaces
) -> NeighbourSearch:
    scene, discrete, spacing = setting.scene, setting.discrete, setting.scene.discretisation.spacing
    near, support, walls = discrete.near, discrete.lattice.support, discrete.walls
    most = max(4 * layout.particles, 512)
    grid = Grid.around(near.lower, near.upper, discrete.periods, (1.0 + SKIN) * support, most)
    positions, feet, (middles, turns) = walls.positions.copy(), walls.feet.copy(), solid_frames(scene)
    for number, (middle, turn) in enumerate(zip(middles, turns, strict=True)):
        own = walls.solid == number
        positions[own], feet[own] = (positions[own] - middle) @ turn, feet[own] @ turn
    free = [number for number, table in enumerate(moving(scene.solid)) if table.motion == "free"]
    grips = walls.weights * (walls.sticks & ~np.isin(walls.solid, free))  # `FreeFriction` has that of free bodies
    positions, feet = padded(positions), padded(feet)
    behind = faces.behind(walls.solid, positions, feet, obstacles.ON * spacing)
    arrays = WallArrays(positions, walls.weights, grips, feet, padded(walls.slides), walls.solid, behind)
    room, imaged = first_capacity(support / spacing, scene.dimension), mirrored or len(faces.solids) > 0
    return NeighbourSearch(discretisation, grid, arrays, layout, room, len(middles), scene.dimension, imaged)


def _forces(setting: Setting, makers: Sequence[ForceMaker]) -> list[Force]:
    replaced, scene = {getattr(maker, "replaces", None) for maker in makers}, setting.scene
    modules = [p.force for p in PARAMETERS if p.force is not None and p.present(scene) and p.force not in replaced]
    forces: list[Force] = []
    for maker in (*map(import_module, modules), *makers):
        if (force := maker.force(setting)) is None:
            continue
        forces.append(force)
        name, batch = type(force).__name__, setting.layout.batch
        if missing := [one for one in FORCE_ATTRIBUTES if not hasattr(force, one)]:
            made = f"the force {name}, which {shown(maker)} made, has no {missing[0]}"
            raise InputError(f"{made}, but must have {', '.join(FORCE_ATTRIBUTES)}.")
        of_part = [method for method in PART_METHODS if hasattr(force, method)]
        if of_part and not isinstance(force, Part):
            raise InputError(
                f"the force {name} has the methods {', '.join(of_part)} of a part, but is no Part: derive its class "
                "from cortado.sph.parts.Part."
            )
        if isinstance(force, Part) and type(force).end is Part.end and not all(f.is_constant for f in force.fields):
            raise InputError(f"the force {name} has fields, but no method `end` that writes them after a step.")
        if batch is not None and not getattr(force, "batches", False):
            raise InputError(
                f"batch is {batch}, but must be left out, as the force {name} has no `batches = True`, by which "
                "a force declares that its kernels read the parameters of each particle's scene."
            )
    return sorted(forces, key=lambda one: bool(getattr(one, "is_last", False)))


def _parts(
    setting: SolverSetting, discretisation: Discretisation, search: NeighbourSearch, free: FreeSolids | None
) -> list[PartMaker]:
    scene, count, phases = setting.scene, len(setting.scene.phase), Phases(1, None, 0.0)
    if count > 1:
        mobility = MOBILITIES[scene.mixture.mobility_form]
        diffusion = Diffusion(discretisation, count, setting.free_energy, mobility)
        phases = Phases(count, diffusion, scene.mixture.strength)
    found: list[PartMaker] = [phases, *obstacles.nozzles_of(scene, setting.discrete), *([free] if free else [])]
    if tables := moving(scene.solid):  # this also writes the walls of free bodies
        numbers = {table.name: number for number, table in enumerate(tables) if table.motion != "free"}
        found.append(MovingSolids(numbers, scene.dimension, search))
    return found


def _free_solids(
    setting: SolverSetting,
    search: NeighbourSearch,
    layout: Layout,
    still: list[obstacles.Obstacle],
    moved: list[obstacles.Obstacle],
) -> FreeSolids | None:
    scene, discrete, spacing = setting.scene, setting.discrete, setting.scene.discretisation.spacing
    walls, solids = discrete.walls, moving(scene.solid)
    bodies = [number for number, table in enumerate(solids) if table.motion == "free"]
    if not bodies:
        return None
    sides = scene.container.solids(scene.dimension, discrete.lattice.support)
    fixed = [*(obstacles.Obstacle("container", side, isinstance(side, Hollow), np.inf) for side in sides), *still]
    tables, touching = [], []
    for body, number in enumerate(bodies):
        table, own = solids[number], walls.solid == number
        mass = mass_of_one(table).in_volumes(spacing**scene.dimension)
        hold = Hold.of(table, scene.dimension, scene.hinge)
        tables.append(FreeTable(table.name, number, weight_name(table), mass, hold, table.sticks))
        feet = walls.positions[own] - table.middle() + walls.feet[own]
        near = feet[np.linalg.norm(walls.feet[own], axis=1) < spacing] @ table.turn(scene.dimension)
        points = np.concatenate([near, table.own_solid().faces(obstacles.FINE * spacing).vertices])
        touching.append(Touching(body, -1, -1, fixed, points))
        for against, one in enumerate(solids):
            if against != number:
                other = bodies.index(against) if against in bodies else -1
                touching.append(Touching(body, against, other, [moved[against]], points, one.surface_velocity or ()))
    springs, joints = ends_of(scene.spring, solids), joints_of(scene.hinge, solids)
    turned, joined = ([one for one in joints if one.turns], [one for one in joints if one.against >= 0])
    pushes: list[Callable[[FreeSolidsPart], Push]] = []
    pushes.append(lambda part: Contacts(part, touching, spacing, discrete.periods))
    if springs or turned:
        pushes.append(lambda part: Springs(part, springs, turned, layout))
    assert search.moving is not None
    return FreeSolids(tables, scene.dimension, search.moving, pushes, joined)
