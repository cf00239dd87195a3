"""From a scene to its fluid particles, in float64."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.scene.bodies import CutBody, is_packed
from cortado.scene.emitter import EmitterSample
from cortado.scene.fluids import PointsFluid
from cortado.scene.room import room_of
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class FluidSample:
    """Fluid particles, in the order in which the scene lists their fluids; those of the emitter come last."""

    positions: Points
    """(n, d) [m]"""
    velocities: Points
    """(n, d) [m/s]"""
    phase: NDArray[np.int64]
    """(n,) index into the scene's phases"""
    sizes: tuple[int, ...]
    """How many particles each body of fluid has, without those of the emitter."""
    asked: tuple[float, ...]
    """What each of these is to hold, without what walls take of it [m^d]; of points what they hold."""
    bodies: tuple[CutBody, ...]
    """Those whose particles are to be packed, in the order of the particles."""
    is_packed: NDArray[np.bool_]
    """(n,) whether a particle is of one of these."""
    is_placed: NDArray[np.bool_]
    """(n,) whether somebody has said where a particle is: a point of a file, or one in a nozzle."""
    emitter: EmitterSample | None
    """The last of the particles once more, in the same order, as they are along the emitter; None without one."""

    def jittered(self, most: float) -> Points:
        """(n, d) [m] positions, with each coordinate of what nobody has placed changed by up to ``most`` [m]."""
        moves = np.random.default_rng(0).uniform(-most, most, self.positions.shape)
        return np.where(self.is_placed[:, None], self.positions, self.positions + moves)

    def some(self, kept: NDArray[np.int64]) -> "FluidSample":
        """The same without particles but those of the given numbers (m,), in rising order; all of the emitter stay."""
        names = "positions", "velocities", "phase", "is_packed", "is_placed"
        arrays = {name: getattr(self, name)[kept] for name in names}
        ends = np.searchsorted(kept, np.cumsum(self.sizes))
        return replace(self, sizes=tuple(np.diff(ends, prepend=0).tolist()), **arrays)

    @property
    def emitted(self) -> slice:
        """Which particles are the emitter's."""
        count = len(self.positions)
        return slice(count if self.emitter is None else count - len(self.emitter.upstream), count)


def fluid_particles(scene: Scene) -> FluidSample:
    """The fluid of a scene, before particles of round bodies are packed. Raises `InputError` if a file with points is
    gone since the scene was read, or if walls leave no room for any particle of a fluid."""
    spacing, names = scene.discretisation.spacing, [phase.name for phase in scene.phase]
    room, bodies = room_of(scene), _cut_bodies(scene)
    positions = [
        fluid.particles_in(room, spacing) if body is None else body.particles()
        for fluid, body in zip(scene.fluid, bodies, strict=True)
    ]
    for index, (particles, body) in enumerate(zip(positions, bodies, strict=True)):
        if not len(particles):
            raise InputError(f"fluid.{index} has no particle{_why_none(body, spacing)}.")
    velocities = [fluid.velocities(x) for fluid, x in zip(scene.fluid, positions, strict=True)]
    phases = [names.index(fluid.phase) for fluid in scene.fluid]
    asked = [
        fluid.volume(spacing) if body is None else body.asked for fluid, body in zip(scene.fluid, bodies, strict=True)
    ]
    emitted = None
    if scene.emitter is not None:
        emitted = scene.emitter.sample(spacing)
        emitted.positions[emitted.upstream > emitted.column] += reserve_offset(scene)
        positions.append(emitted.positions)
        velocities.append(emitted.velocities)
        phases.append(names.index(scene.emitter.phase))
        bodies.append(None)
    sizes, nozzles = [len(x) for x in positions], len(positions) - len(scene.fluid)
    return FluidSample(
        positions=np.concatenate(positions),
        velocities=np.concatenate(velocities),
        phase=np.repeat(phases, sizes),
        sizes=tuple(sizes[: len(scene.fluid)]),
        asked=tuple(asked),
        bodies=tuple(body for body in bodies if body is not None),
        is_packed=np.repeat([body is not None for body in bodies], sizes),
        is_placed=np.repeat([*(isinstance(fluid, PointsFluid) for fluid in scene.fluid), *[True] * nozzles], sizes),
        emitter=emitted,
    )


def reserve_offset(scene: Scene) -> Points:
    """(d,) [m] how far from their place in line particles wait that are in reserve: along every axis without a period
    beyond all else, upstream of the opening."""
    assert scene.emitter is not None
    spacing, direction = scene.discretisation.spacing, np.array(scene.emitter.direction)
    boxes = [fluid.extent(spacing) for fluid in scene.fluid] + [solid.body().extent() for solid in scene.solid]
    ends = np.array([[scene.emitter.outlet] * 2, scene.container.extent() or [scene.emitter.outlet] * 2, *boxes])
    size = float(np.ptp(ends.reshape(-1, scene.dimension), axis=0).max())
    aside = np.where(direction > 0.0, -1.0, 1.0) * (period(scene)[1] == 0.0)
    return 2.0 * (size + scene.discretisation.support_radius) * aside


def _cut_bodies(scene: Scene) -> list[CutBody | None]:
    """Of each body of fluid the part that walls leave room for, where its particles may be packed; None of others."""
    spacing, reach, room = scene.discretisation.spacing, scene.discretisation.support_radius, room_of(scene)
    return [CutBody(fluid, room, spacing) if is_packed(fluid, room, reach, spacing) else None for fluid in scene.fluid]


def _why_none(body: CutBody | None, spacing: float) -> str:
    """Why a body of fluid has no particles, and what to do, as the end of a sentence."""
    if body is None:
        return (
            f" that is half a spacing, {0.5 * spacing:g} m, or more from all walls: it must be larger, or further "
            "from them"
        )
    cells = body.volume() / spacing**body.room.dimension
    return f", as the volume that walls leave it is {cells:.2g} of that of a particle: it must be larger"


def period(scene: Scene) -> tuple[Points, Points]:
    """Where the period of a scene begins and how long it is, each (d,) [m]; the length is 0 for axes without one."""
    return scene.container.periods(scene.dimension)
