"""The numbers that a picture of a run colours its particles by."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.runs.curl import vorticity
from cortado.runs.emitted import ages
from cortado.runs.measuring import Measuring
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.quantities import sizes
from cortado.scene.scene import Scene


def coloured_by(
    scene: Scene, trajectory: Trajectory, simulation: Callable[[], Measuring] | None = None
) -> NDArray | None:
    """(frames, n) what the pictures of a scene colour particles by: recorded, computed from what was recorded, or else
    by a simulation of it. None where they have the colours of phases.

    Raises:
        InputError: it was not recorded and cannot be computed.
    """
    name = (scene.picture or Picture()).colour
    if name == "phase":
        return None
    if name == "age":
        return ages(scene, trajectory)
    if name == "speed" or name in (*trajectory.quantities, *trajectory.others):
        return np.array([sizes(name, frame[name], scene.dimension) for frame in trajectory])
    if simulation is not None:
        return sizes(name, simulation().quantity(name, trajectory), scene.dimension)
    if name == "vorticity":
        each = [vorticity(scene, frame.positions, frame.velocities) for frame in trajectory]
        return sizes(name, np.array(each), scene.dimension)
    advice = f'record it, as in simulation.run(steps, record=["{name}"]), or use simulation.film(trajectory, path)'
    raise InputError(f"{name} was not recorded, and does not follow from positions and velocities: {advice}.")
