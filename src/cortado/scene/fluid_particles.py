"""Initial fluid particles of a scene, in float64."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.room import Region, Room
from cortado.discretise.shapes import EXCESS, Points, Which, apart, grid, pairs_within
from cortado.errors import InputError
from cortado.scene.emitter_table import EmitterSample, samples
from cortado.scene.fluids import ALIGNED, PointsFluid, RegionFluid
from cortado.scene.scene import Scene

FINER = 4
"""Number of equal parts of a lattice cell along each axis, for measuring the volume of a body of fluid."""
LOOSENESS, MOST_LOOSENESS = 0.05, 0.008
"""Greatest missing fraction of the particles of a packed body: near the body's surface, and in the whole body."""
BESIDE = 2
"""Greatest distance between the surface and a particle that may be left out, along each axis [cells]."""
FAR = 4.0
"""Greatest distance from the surface that is computed [spacings]."""
DIGITS = 6
"""Number of decimals to which depths [spacings] are rounded before sorting."""


@dataclass(frozen=True)
class CutBody:
    fluid: RegionFluid
    room: Room
    spacing: float

    def distance(self, points: Points, reach: float) -> Points:
        """Return the signed distances (n,) [m] of points (n, d) [m] from the body, negative inside."""
        return np.maximum(self.fluid.distance(points, self.spacing, reach), self.room.distance(points, reach))

    def shares(self, points: Points) -> Points:
        """Return the fraction (n,) of lattice cells inside the body. ``points`` (n, d) [m] are the centres of cells."""
        return np.clip(0.5 - self.distance(points, 0.5 * self.spacing) / self.spacing, 0.0, 1.0)

    def volume(self, depth: float = 0.0, beside_cuts: bool = False) -> float:
        """Return the volume of the part of the body more than ``depth`` [m] below its surface [m^d]. If ``beside_cuts``
        is true, count only cells near the cells that the surface cuts."""
        dimension, fine = self.room.dimension, self.spacing / FINER
        cells, reach = self.fluid.block(self.spacing).grown(1).points(), depth + self.spacing
        cells = cells[self._beside_cuts(cells)] if beside_cuts else cells
        distances = self.distance(cells, reach) + depth
        cut = cells[np.abs(distances) < 0.5 * self.spacing * np.sqrt(dimension)]
        whole = np.count_nonzero(distances < 0.0) - np.count_nonzero(self.distance(cut, reach) + depth < 0.0)
        parts = grid([np.asarray(fine * (np.arange(FINER) + 0.5) - 0.5 * self.spacing)] * dimension)
        reach = depth + fine
        shares = sum(np.clip(0.5 - (self.distance(cut + part, reach) + depth) / fine, 0.0, 1.0).sum() for part in parts)
        return float(whole * self.spacing**dimension + shares * fine**dimension)

    @cached_property
    def asked(self) -> float:
        """Prescribed volume of the body, without its parts inside walls [m^d]."""
        everywhere = Room(Region.everywhere(self.room.dimension), (), self.room.periods)
        return self.fluid.volume(self.spacing) * self._held / replace(self, room=everywhere)._held

    @cached_property
    def _held(self) -> float:
        return self.volume()

    @cached_property
    def count(self) -> int:
        volume, outermost = self._held, self.volume(0.0, True) - self.volume(self.spacing, True)
        lacking = min(LOOSENESS * outermost, MOST_LOOSENESS * volume)
        return round((volume - lacking) / self.spacing**self.room.dimension)

    def particles(self) -> Points:
        if not self.fluid.cuts_cells(self.spacing):
            from_solids = self.room.from_solids(self.fluid.particles(self.spacing), self.spacing)
            if (np.abs(from_solids) >= (0.5 - ALIGNED) * self.fluid.block(self.spacing).spacings.min()).all():
                return self.fluid.particles_in(self.room, self.spacing)
        points = self.fluid.lattice(self.spacing, self.spacing)
        depths = np.round(self.distance(points, FAR * self.spacing) / self.spacing, DIGITS)
        depths = np.where(self._beside_cuts(points), depths, np.copysign(np.inf, depths))
        return points[np.sort(np.argsort(depths, kind="stable")[: self.count])]

    def _beside_cuts(self, points: Points) -> Which:
        reach = (BESIDE + 0.5) * self.fluid.block(self.spacing).spacings.max()
        return np.asarray(self._cut.query(points, p=np.inf, distance_upper_bound=reach)[0] < reach)

    @cached_property
    def _cut(self) -> Any:
        from scipy.spatial import cKDTree

        lattice = self.fluid.block(self.spacing)
        cells = lattice.grown(1).points()
        return cKDTree(cells[np.abs(self.distance(cells, self.spacing)) < (0.5 - ALIGNED) * lattice.spacings.min()])


def air_around(
    bodies: tuple[CutBody, ...], staying: Points, lower: Points, lengths: Points, reach: float
) -> tuple[Points, Points]:
    """Return lattice points (m, d) [m] in the air within ``reach`` [m] of the surfaces of bodies of fluid. Also return
    the fraction of air in the lattice cell around each point (m,).

    ``staying`` (k, d) [m] are the particles that packing does not move. ``lower`` and ``lengths`` (d,) [m] are the
    lower corner and the lengths of the periodic box. The length is 0 along an axis that is not periodic.
    """
    found = []
    for number, body in enumerate(bodies):
        spacing, furthest = body.spacing, reach + body.spacing
        points = body.fluid.lattice(spacing, furthest)
        middle = 0.5 * np.sum(body.fluid.extent(spacing), axis=0)
        within = ((lengths == 0.0) | (np.abs(points - middle) < 0.5 * lengths)).all(axis=1)
        points = points[within & (np.abs(body.distance(points, furthest)) < furthest)]
        distances = [
            np.min([other.distance(points + shift, furthest) for shift in other.room.shifts()], axis=0)
            for other in bodies
        ]
        points = points[np.argmin(distances, axis=0) == number]
        fluid: Any = sum(other.shares(points + shift) for other in bodies for shift in other.room.shifts())
        point, particle, _ = pairs_within(points, staying, spacing * np.sqrt(points.shape[1]), lower, lengths)
        separations = np.abs(apart(points[point] - staying[particle], lengths))
        common = np.clip(1.0 - separations / spacing, 0.0, None).prod(axis=1)
        fluid += np.bincount(point, common, minlength=len(points))
        walls = np.clip(0.5 + body.room.distance(points, spacing) / spacing, 0.0, 1.0)
        found.append((points, np.clip(1.0 - fluid - walls, 0.0, 1.0)))
    points, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return points[shares > 0.0], shares[shares > 0.0]


@dataclass(frozen=True)
class FluidSample:
    positions: Points
    velocities: Points
    phase: NDArray[np.int64]
    sizes: tuple[int, ...]
    """Number of particles of each body of fluid, without emitters."""
    asked: tuple[float, ...]
    """Prescribed volume of each body, without its parts inside walls [m^d]."""
    bodies: tuple[CutBody, ...]
    is_packed: NDArray[np.bool_]
    is_placed: NDArray[np.bool_]
    """True for particles from a file of positions or from an emitter (n,)."""
    emitters: tuple[tuple[str, int, EmitterSample], ...]
    """For each emitter, its name, the index of its first particle, and its particles."""
    places: Points
    """Positions (n, d) [m] where particles rest while they are outside the simulation."""

    def some(self, kept: NDArray[np.int64]) -> "FluidSample":
        """Return only the particles at the sorted indices ``kept`` (m,), which contain all particles of emitters."""
        names = "positions", "velocities", "phase", "is_packed", "is_placed", "places"
        arrays = {name: getattr(self, name)[kept] for name in names}
        ends = np.searchsorted(kept, np.cumsum(self.sizes))
        gone = len(self.positions) - len(kept)
        emitters = tuple((name, first - gone, sample) for name, first, sample in self.emitters)
        return replace(self, sizes=tuple(np.diff(ends, prepend=0).tolist()), emitters=emitters, **arrays)

    @property
    def names(self) -> NDArray[np.str_]:
        """Return the name of the body of each particle (n,), such as "fluid[1]"."""
        named = *(f"fluid[{k}]" for k in range(len(self.sizes))), *(f"emitter {name}" for name, _, _ in self.emitters)
        ends = *np.cumsum(self.sizes), *(first for _, first, _ in self.emitters[1:]), len(self.positions)
        return np.repeat(named, np.diff(ends[: len(named)], prepend=0))

    @property
    def emitted(self) -> slice:
        count = len(self.positions)
        return slice(self.emitters[0][1] if self.emitters else count, count)


def fluid_particles(scene: Scene) -> FluidSample:
    """Build the fluid particles of a scene before packing."""
    spacing, names = scene.discretisation.spacing, [phase.name for phase in scene.phase]
    room, reach = scene.room, scene.discretisation.support_radius
    bodies, positions, velocities, asked = list[CutBody | None](), list[Points](), list[Points](), list[float]()
    for index, fluid in enumerate(scene.fluid):
        body = CutBody(fluid, room, spacing) if isinstance(fluid, RegionFluid) else None
        if body is not None and not body.fluid.cuts_cells(spacing):  # it is packed only beside solids
            is_near = room.solids and (room.from_solids(fluid.particles(spacing), reach) < reach).any()
            body = body if is_near else None
        particles = fluid.particles_in(room, spacing) if body is None else body.particles()
        if not len(particles):
            why = f" that is half a spacing, {0.5 * spacing:g} m, or more from all walls"
            if body is not None:
                cells = body.volume() / spacing**scene.dimension
                why = f", as the volume that walls leave it is {cells:.2g} of that of a particle"
            larger = "it must be larger, or further from them" if body is None else "it must be larger"
            raise InputError(f"fluid.{index} has no particle{why}: {larger}.")
        bodies.append(body)
        positions.append(particles)
        velocities.append(fluid.velocities(particles))
        asked.append(fluid.volume(spacing) if body is None else body.asked)
    phases = [names.index(body.phase) for body in (*scene.fluid, *scene.emitter)]
    count = sum(map(len, positions)) + sum(len(e.sample(spacing).upstream) for e in scene.emitter)
    emitters, places = samples(scene, count), resting_places(scene, count)
    for _, first, sample in emitters:
        waits = sample.upstream > sample.column
        sample.positions[waits], sample.velocities[waits] = places[first:][: len(waits)][waits], 0.0
        positions.append(sample.positions)
        velocities.append(sample.velocities)
        bodies.append(None)
    sizes, nozzles = [len(x) for x in positions], len(scene.emitter)
    return FluidSample(
        positions=np.concatenate(positions),
        velocities=np.concatenate(velocities),
        phase=np.repeat(phases, sizes),
        sizes=tuple(sizes[: len(scene.fluid)]),
        asked=tuple(asked),
        bodies=tuple(body for body in bodies if body is not None),
        is_packed=np.repeat([body is not None for body in bodies], sizes),
        is_placed=np.repeat([*(isinstance(fluid, PointsFluid) for fluid in scene.fluid), *[True] * nozzles], sizes),
        emitters=tuple(emitters),
        places=places,
    )


def resting_places(scene: Scene, count: int) -> Points:
    """Return positions (count, d) [m] for reserves of emitters and for particles that drains have removed.

    The positions are far from the scene and from each other. If all axes are periodic, the positions are NaN.
    """
    spacing, support = scene.discretisation.spacing, scene.discretisation.support_radius
    boxes = [body.extent(spacing) for body in (*scene.fluid, *scene.emitter)]
    boxes += [solid.body().extent() for solid in scene.solid]
    boxes += [ends] if (ends := scene.container.extent()) is not None else []
    corners, (begin, lengths), pitch = np.array(boxes).reshape(-1, scene.dimension), scene.periods, 2.0 * support
    lower, upper, free = corners.min(axis=0), corners.max(axis=0), lengths == 0.0
    if not free.any():
        return np.full((count, scene.dimension), np.nan)
    slots = np.maximum(np.floor(lengths / pitch), 1.0)
    slots[free] = np.ceil((count / slots[~free].prod()) ** (1.0 / free.sum()))
    number = np.stack(np.unravel_index(np.arange(count), slots.astype(int)), axis=1)
    start = upper + 2.0 * (float((upper - lower).max()) + support)
    return np.where(free, start + pitch * number, begin + pitch * (number + 0.5))


@dataclass(frozen=True)
class FluidMasses:
    """Actual and prescribed mass of each phase [kg], in 2-D per metre of depth."""

    given: Mapping[str, float]
    """Actual initial mass of all particles, including the particles in emitters, by phase name."""
    asked: Mapping[str, float]
    """Prescribed mass of the bodies of fluid and of the fluid in emitters, by phase name."""

    @classmethod
    def of(cls, scene: Scene, fluid: FluidSample) -> Self:
        names, cell = [phase.name for phase in scene.phase], scene.discretisation.spacing**scene.dimension
        densities = np.array([phase.rest_density for phase in scene.phase])
        held = cell * np.bincount(fluid.phase, minlength=len(names))
        waiting = cell * np.bincount(fluid.phase[fluid.emitted], minlength=len(names))
        bodies = [names.index(body.phase) for body in scene.fluid]
        wanted = waiting + np.bincount(bodies, fluid.asked, minlength=len(names))
        given, asked = ((densities * volumes).tolist() for volumes in (held, wanted))
        return cls(dict(zip(names, given, strict=True)), dict(zip(names, asked, strict=True)))

    @property
    def off(self) -> dict[str, str]:
        """Return messages about masses that differ from the prescribed mass by more than `EXCESS`, by phase name."""
        return {
            name: f"{given:.4g} kg of {name}, where {self.asked[name]:.4g} kg were asked for"
            for name, given in self.given.items()
            if abs(given - self.asked[name]) > EXCESS * self.asked[name]
        }
