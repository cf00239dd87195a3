"""From a scene to its particles, in float64: fluid and walls."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.lattice.shapes import Points
from cortado.scene.emitter import EmitterSample
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
    emitter: EmitterSample | None
    """The last of the particles once more, in the same order, as they are along the emitter; None without one."""

    @property
    def emitted(self) -> slice:
        """Which particles are the emitter's."""
        count = len(self.positions)
        return slice(count if self.emitter is None else count - len(self.emitter.upstream), count)


def fluid_particles(scene: Scene) -> FluidSample:
    """The fluid of a scene. Raises `InputError` if a file with points is gone since the scene was read, or if walls
    leave no room for any particle of a fluid."""
    spacing, names = scene.discretisation.spacing, [phase.name for phase in scene.phase]
    room = scene.container.region(scene.dimension).opened(period(scene)[1])
    positions = [fluid.particles_in(room, spacing) for fluid in scene.fluid]
    for index, particles in enumerate(positions):
        if not len(particles):
            raise InputError(
                f"fluid.{index} has no particle that is half a spacing, {0.5 * spacing:g} m, or more from all walls: "
                f"it must be larger, or further from them."
            )
    velocities = [np.tile(fluid.velocity, (len(x), 1)) for fluid, x in zip(scene.fluid, positions, strict=True)]
    phases = [names.index(fluid.phase) for fluid in scene.fluid]
    emitted = None
    if scene.emitter is not None:
        emitted = scene.emitter.sample(spacing)
        positions.append(emitted.positions)
        velocities.append(emitted.velocities)
        phases.append(names.index(scene.emitter.phase))
    return FluidSample(
        positions=np.concatenate(positions),
        velocities=np.concatenate(velocities),
        phase=np.repeat(phases, [len(x) for x in positions]),
        emitter=emitted,
    )


def wall_particles(scene: Scene, depths: Sequence[float]) -> list[Points]:
    """The wall particles of a scene's container: a layer (b, d) [m] for each depth [m] behind its surface."""
    return [scene.container.walls(scene.dimension, scene.discretisation.spacing, depth) for depth in depths]


def period(scene: Scene) -> tuple[Points, Points]:
    """Where the period of a scene begins and how long it is, each (d,) [m]; the length is 0 for axes without one."""
    return scene.container.periods(scene.dimension)
