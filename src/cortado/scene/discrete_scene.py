"""Discretisation of a scene with NumPy in float64: initial fluid particles and wall particles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cortado.discretise import smoothing
from cortado.discretise.packing import Packing
from cortado.discretise.room import Domain, Region, Room
from cortado.discretise.shapes import Points, Rows, check_crowding
from cortado.discretise.sheet import Sheet, sheet_points, sheet_weights
from cortado.discretise.smoothing import SmoothingKernel, smoothing_kernel
from cortado.discretise.solid import Placed
from cortado.discretise.solid_walls import ContainerWalls, ExposedSurface, WallPoints, solid_places
from cortado.discretise.walls import Places, RestLattice, WallLayers, wall_weights
from cortado.errors import InputError, MassWarning, warn
from cortado.scene.fluid_particles import FluidMasses, FluidSample, air_around, fluid_particles
from cortado.scene.fluids import PointsFluid
from cortado.scene.motions import moving, wall_numbers
from cortado.scene.scene import Scene
from cortado.scene.scene_warnings import standing_sentences, thin_sentences
from cortado.scene.shape_tables import Container, NoContainer
from cortado.scene.solids import SolidTable, thick
from cortado.scene.solvers import ProjectionSolver

if TYPE_CHECKING:
    from cortado.device.precision import Precision

WHOLE = 1e-6
"""Greatest relative gap between a solid and its periodic image that counts as closed."""
OFF_SHEETS = 0.25
"""Smallest initial distance between fluid particles and a sheet [spacings]."""
NEAREST_PLACE = 0.4
"""Smallest distance from surfaces of the points at which weights of wall particles are fitted [spacings]."""


@dataclass(frozen=True)
class Walls(Rows):
    positions: Points
    """Initial positions of the wall particles (b, d) [m]."""
    weights: Points
    """Weights of the wall particles in density sums (b,). A fluid particle has the weight 1."""
    feet: Points
    """Vectors from the wall particles to the nearest points on the wall's surface (b, d) [m]."""
    sticks: NDArray[np.bool_]
    slides: Points
    """Velocity of a surface that slides like a conveyor belt (b, d) [m/s], relative to its solid."""
    solid: NDArray[np.int64]
    """Number of each wall particle's solid (b,), from `wall_numbers`. The number of the container is -1."""

    @classmethod
    def of(cls, points: WallPoints, weights: Points, sticks: bool | NDArray[np.bool_]) -> "Walls":
        grips, solid = np.full(len(points), sticks), np.full(len(points), -1)
        return cls(points.positions, weights, points.feet, grips, 0.0 * points.feet, solid)


def walls_of(scene: Scene, lattice: RestLattice) -> Walls:
    """Build the wall particles of a scene. Raise `InputError` for a solid that cannot touch fluid."""
    even = _even_points(scene.container, lattice)
    solids = scene.container.solids(scene.dimension, lattice.support)
    container = ContainerWalls(even, solids, scene.resting_room, lattice.spacing, lattice.support)
    still = [_kept(scene, container, lattice)]
    if container.room.solids:
        still.append(_around(scene, container, still[0], lattice))
    periods, tables = scene.periods[1], moving(scene.solid)
    sheets = [table for table in scene.solid if table.is_sheet and not table.moves]
    still += _beside_sheets(scene, sheets, container.room, still, lattice)
    empty = Room(Region.everywhere(scene.dimension), (), 0.0 * periods)
    for k, table in enumerate(tables):
        if table.is_sheet:
            still += _beside_sheets(scene, [table], empty, [], lattice)
        else:
            still.append(_alone(table, k, periods, lattice))
    return Walls.joined(still)


def _kept(scene: Scene, container: ContainerWalls, lattice: RestLattice) -> Walls:
    from scipy.spatial import cKDTree

    points, dimension = container.points.some(container.stay), scene.dimension
    if not len(points):
        return Walls.of(points, points.flat, scene.container.sticks)
    short, folded = scene.container.shortened(lattice.spacing, lattice.support)
    sought = _even_points(short, lattice)
    lower, lengths = short.periods(dimension)
    room = Room(short.region(dimension).opened(lengths), (), lengths)
    places = short.places(dimension, lattice.spacing, lattice.support)
    weights = wall_weights(sought.positions, sought.flat, places, lattice, room, lower, are_even=True)
    same = cKDTree(sought.positions).query(folded(points.positions))[1]
    return Walls.of(points, weights[same], scene.container.sticks)


def _even_points(container: Container, lattice: RestLattice) -> WallPoints:
    dimension, layers = lattice.dimension, lattice.layers
    particles = [container.walls(dimension, lattice.spacing, depth) for depth in layers.depths]
    positions, flat = np.concatenate(particles), np.repeat(layers.weights, [len(layer) for layer in particles])
    region = container.region(dimension).opened(container.periods(dimension)[1])
    return WallPoints(positions, flat, region.nearest(positions) - positions)


def _around(scene: Scene, container: ContainerWalls, kept: Walls, lattice: RestLattice) -> Walls:
    """Build the wall particles of solids at rest, and of the nearby container walls."""
    room, (lower, _) = container.room, scene.periods
    resting = [solid for solid in thick(scene.solid) if not solid.moves]
    images = [room.images(solid) for solid in room.solids]
    tables: list[Container | SolidTable] = [scene.container for _ in container.solids]
    tables += [table for table, several in zip(resting, images, strict=True) for _ in several]
    solids = [image for several in images for image in several]
    surface = ExposedSurface.of(container, solids, lower)
    for table in resting:
        if not any(tables[number] is table for number in np.unique(surface.owner)):
            raise InputError(f"solid {table.name!r} has no surface that fluid in the container can touch.")
    beside = scene.container.places(scene.dimension, lattice.spacing, lattice.support)
    beside = beside.some(container.is_near(beside.points, lattice.support))
    points, weights = _weighed(surface, beside, kept, lattice)
    owners, numbers = surface.owners(points), wall_numbers(scene.solid)
    found = Walls.of(points, weights, np.array([table.sticks for table in tables])[owners])
    of_tables = [-1 if isinstance(table, Container) else numbers[table.name] for table in tables]
    return replace(found, solid=np.array(of_tables)[owners])


def _alone(table: SolidTable, number: int, periods: Points, lattice: RestLattice) -> Walls:
    dimension, turn = len(periods), table.turn(len(periods))
    lower, upper = table.solid().extent()
    filled = np.where(upper - lower > periods * (1.0 - WHOLE), periods, 0.0)
    solid = Placed(table.own_solid(), np.zeros(dimension), turn) if filled.any() else table.own_solid()
    room, begins = Room(Region.everywhere(dimension), (solid,), filled), solid.extent()[0]
    nothing = _even_points(NoContainer(), lattice)
    container = ContainerWalls(nothing, (), room, lattice.spacing, lattice.support)
    surface = ExposedSurface.of(container, room.images(solid), begins)
    beside, kept = Places.upright(nothing.positions), Walls.of(nothing, nothing.flat, False)
    points, weights = _weighed(surface, beside, kept, lattice)
    frame = np.eye(dimension) if filled.any() else turn
    placed = replace(points, positions=table.middle() + points.positions @ frame.T, feet=points.feet @ frame.T)
    found = Walls.of(placed, weights, table.sticks)
    slides = np.tile(table.surface_velocity or (0.0,) * dimension, (len(points), 1))
    return replace(found, slides=slides, solid=np.full(len(points), number))


def _beside_sheets(
    scene: Scene, tables: Sequence[SolidTable], room: Room, others: Sequence[Walls], lattice: RestLattice
) -> list[Walls]:
    if not tables:
        return []
    sheets, found, numbers = list[Sheet](), list[Walls](), wall_numbers(scene.solid)
    for table in tables:
        about, middle, turn = table.own_solid(), table.middle(), table.turn(lattice.dimension)
        assert isinstance(about, Sheet)
        sheets.append(about.placed(middle, turn))
        points = sheet_points(about, lattice)
        placed = replace(points, positions=middle + points.positions @ turn.T, feet=points.feet @ turn.T)
        walls = Walls.of(placed, points.flat, table.sticks)
        found.append(replace(walls, solid=np.full(len(points), numbers[table.name])))
    own, every = Walls.joined(found), Walls.joined([*found, *others])
    known = every.some(slice(len(own), None))
    both = (own.positions, known.positions), (own.weights, known.weights)
    weights = sheet_weights(Sheet.joined(sheets), *both, room, lattice, NEAREST_PLACE * lattice.spacing)
    return [replace(own, weights=weights)]


def _weighed(surface: ExposedSurface, beside: Places, kept: Walls, lattice: RestLattice) -> tuple[WallPoints, Points]:
    room, spacing, reach = surface.container.room, lattice.spacing, lattice.support
    points = surface.walls(lattice)
    about = Places.joined([beside, *(solid_places(solid, spacing, reach) for solid in room.solids)])
    places = about.some(room.contains(about.points, -NEAREST_PLACE * spacing))
    walls, flat = np.concatenate([points.positions, kept.positions]), np.append(points.flat, kept.weights)
    found = wall_weights(walls, flat, places, lattice, room, surface.lower, False, len(kept.weights))
    return points, found[: len(points)]


def mirrors_of(scene: Scene) -> tuple[Points, Points]:
    """Return the positions (3,) [m] of lower and upper walls that mirror the fluid; infinite without such a wall."""
    nowhere = np.full(3, np.inf)
    if not isinstance(scene.solver, ProjectionSolver):
        return -nowhere, nowhere
    lower, upper = scene.container.mirrors(scene.dimension, scene.discretisation.support_radius)
    flat = (0, 3 - scene.dimension)
    return np.pad(lower, flat, constant_values=-np.inf), np.pad(upper, flat, constant_values=np.inf)


@dataclass(frozen=True)
class Lattice:
    support: float
    """Support radius h of the smoothing kernel [m]."""
    normalisation: float
    """Normalisation sigma of the smoothing kernel [1 / m^d]."""
    self_weight: float
    """Value W(0) of the smoothing kernel [1 / m^d]."""
    volume: float
    """Volume of one particle [m^d]. With this volume, fluid on the lattice has the rest density."""
    cell: float
    """Volume of a lattice cell [m^d]."""
    stiffness: float
    """Stiffness of the solver PCISPH times the square of the time step [m2] (Solenthaler and Pajarola 2009)."""
    response: float
    """Sum of the squared kernel gradients from all neighbours of a particle [1 / m^(2 d + 2)]."""
    laplacian_correction: float
    domain: Domain

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int, domain: Domain) -> "Lattice":
        return cls(
            support=support,
            normalisation=kernel.normalisation(dimension, support),
            self_weight=float(kernel.weight(np.zeros(1), dimension, support)[0]),
            volume=smoothing.rest_volume(kernel, spacing, support, dimension),
            cell=spacing**dimension,
            stiffness=smoothing.pressure_stiffness(kernel, spacing, support, dimension),
            response=smoothing.wall_response(kernel, spacing, support, dimension),
            laplacian_correction=smoothing.lattice_laplacian_correction(kernel, spacing, support, dimension),
            domain=domain,
        )


@dataclass(frozen=True)
class DiscreteScene:
    kernel: SmoothingKernel
    lattice: Lattice
    fluid: FluidSample
    masses: FluidMasses
    wall_layers: WallLayers
    walls: Walls
    periods: Points
    """Lengths of the periodic box (d,) [m]; 0 along an axis that is not periodic."""

    @cached_property
    def near(self) -> Region:
        everything = np.concatenate([self.fluid.positions, self.walls.positions])
        return Region.between(everything.min(axis=0), everything.max(axis=0))


def discretise(scene: Scene) -> DiscreteScene:
    """Discretise a scene into particles. Warns if the mass of the fluid differs from the prescribed mass.

    Raises `InputError` if a file of particle positions no longer exists, or if its positions are too close together.
    """
    kernel, dimension = smoothing_kernel(scene.discretisation.kernel), scene.dimension
    spacing, support = scene.discretisation.spacing, scene.discretisation.support_radius
    at_rest = RestLattice(kernel, spacing, support, dimension)
    lattice = Lattice.of(kernel, spacing, support, dimension, scene.domain)
    fluid, walls = fluid_particles(scene), walls_of(scene, at_rest)
    own = wall_numbers(scene.solid)
    beside = ~np.isin(walls.solid, [own[table.name] for table in scene.solid if table.is_sheet])
    fluid = _settled(scene, fluid, walls.some(beside), at_rest)  # packing would see the walls on both sides of a sheet
    masses = FluidMasses.of(scene, fluid)
    for sentence in (*thin_sentences(scene), *standing_sentences(scene)):
        warn(sentence)
    if masses.off:
        warn(
            f"the fluid begins with {' and '.join(masses.off.values())}: boxes whose sides are whole multiples of the "
            "spacing have exactly the prescribed mass, and a smaller spacing reduces the error of other shapes.",
            MassWarning,
        )
    if most := scene.discretisation.jitter * spacing:
        moved = fluid.positions + np.random.default_rng(0).uniform(-most, most, fluid.positions.shape)
        fluid = replace(fluid, positions=np.where(fluid.is_placed[:, None], fluid.positions, moved))
    velocities = fluid.velocities.copy()
    for body, end, size in zip(scene.fluid, np.cumsum(fluid.sizes), fluid.sizes, strict=True):
        velocities[end - size : end] = body.velocities(fluid.positions[end - size : end])
    fluid = replace(fluid, velocities=velocities)
    if any(isinstance(body, PointsFluid) for body in scene.fluid):
        of_lattice = kernel, support, lattice.volume, spacing
        told = check_crowding("the points of the fluid", fluid.positions, *of_lattice, scene.periods, fluid.names)
        if told is not None:
            warn(told)
    return DiscreteScene(kernel, lattice, fluid, masses, at_rest.layers, walls, scene.periods[1])


def _settled(scene: Scene, fluid: FluidSample, walls: Walls, lattice: RestLattice) -> FluidSample:
    """Pack the fluid, and keep each particle at least `OFF_SHEETS` spacings from sheets."""
    if fluid.bodies:
        stays, (lower, lengths) = ~fluid.is_packed, scene.periods
        air, shares = air_around(fluid.bodies, fluid.positions[stays], lower, lengths, lattice.support)
        fixed, weights = np.concatenate([air, walls.positions]), np.append(shares, walls.weights)
        moved, kept = Packing(lattice, fixed, weights, len(air), lengths).packed(fluid.positions, stays)
        fluid = replace(fluid.some(kept), positions=moved)
    found, least = fluid.positions.copy(), OFF_SHEETS * lattice.spacing
    for table in scene.solid:
        about = table.own_solid()
        if isinstance(about, Sheet):
            sheet = about.placed(table.middle(), table.turn(scene.dimension))
            near = np.flatnonzero(~fluid.is_placed & (sheet.distance(found) < least))
            found[near] = sheet.aside(found[near], least)
    return replace(fluid, positions=found)


def check_distance(scene: Scene, discrete: DiscreteScene, precision: "Precision") -> None:
    spacing = scene.discretisation.spacing
    furthest = max(np.abs(discrete.near.lower).max(), np.abs(discrete.near.upper).max()) / spacing
    if furthest > precision.furthest:
        raise InputError(
            f"The scene reaches {furthest:.3g} spacings of {spacing:g} m from the origin, but must be within "
            f"{precision.furthest:g} in {precision.name}, which rounds positions there to steps of "
            f"{furthest * np.finfo(precision.numpy).eps:.1g} spacings: move it to the origin, or use another precision."
        )
