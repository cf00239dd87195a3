"""From a scene to its particles, in float64: fluid, walls, and the volumes of wall particles."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from cortado.scene import Scene
from cortado.scene_emitter import EmitterSample
from cortado.shapes import Points

CHUNK = 8192
"""How many wall particles look for their neighbours at a time: bounds the memory."""


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
    """The fluid of a scene. Raises `InputError` if a file with points is gone since the scene was read."""
    spacing, names = scene.discretisation.spacing, [phase.name for phase in scene.phase]
    positions = [fluid.particles(spacing) for fluid in scene.fluid]
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


def boundary_particles(scene: Scene, depth: float) -> Points:
    """(b, d) the wall particles of a scene's container [m], in one layer that lies ``depth`` [m] outside of it."""
    return scene.container.walls(scene.dimension, scene.discretisation.spacing, depth)


def period(scene: Scene) -> tuple[Points, Points]:
    """Where the period of a scene begins and how long it is, each (d,) [m]; the length is 0 for axes without one."""
    return scene.container.periods(scene.dimension)


def boundary_volumes(
    positions: Points,
    weight: Callable[[Points], Points],
    support_radius: float,
    lower: ArrayLike = 0.0,
    lengths: ArrayLike = 0.0,
) -> Points:
    """V_b = 1 / sum_b' W(|x_b - x_b'|), itself included: (b,) [m^d]. Akinci et al. (2012).

    Args:
        positions: (b, d) wall particles [m].
        weight: the smoothing kernel [1/m^d] of distances [m].
        support_radius: the distance [m] at which the kernel ends.
        lower: (d,) where the period begins [m].
        lengths: (d,) the lengths of the period [m], 0 for axes without one; the nearest image counts.
    """
    if not len(positions):
        return np.zeros(0)
    lengths = np.broadcast_to(np.asarray(lengths, dtype=np.float64), positions.shape[1:])
    wrapped = _wrapped(positions - np.asarray(lower, dtype=np.float64), lengths)
    everything = cKDTree(wrapped, boxsize=lengths)
    sums = [
        _kernel_sums(cKDTree(wrapped[start : start + CHUNK], boxsize=lengths), everything, weight, support_radius)
        for start in range(0, len(wrapped), CHUNK)
    ]
    return 1.0 / np.concatenate(sums)


def _kernel_sums(
    some: cKDTree, everything: cKDTree, weight: Callable[[Points], Points], support_radius: float
) -> Points:
    pairs = some.sparse_distance_matrix(everything, support_radius, output_type="ndarray")
    return np.asarray(np.bincount(pairs["i"], weights=weight(pairs["v"]), minlength=some.n), dtype=np.float64)


def _wrapped(positions: Points, lengths: Points) -> Points:
    """(b, d) positions within [0, length) on periodic axes; round-off may put a remainder on the length itself."""
    safe = np.where(lengths > 0.0, lengths, 1.0)
    remainder = np.mod(positions, safe)
    return np.where(lengths > 0.0, np.where(remainder >= safe, 0.0, remainder), positions)
