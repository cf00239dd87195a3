"""What sensors read of all scenes, and the quantities of particles that they read it of."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown
from cortado.losses.loss import SnapshotBatch
from cortado.particles.state import State
from cortado.rollout.rollout import Rollout
from cortado.runs.quantities.moment import Moment, row_of
from cortado.runs.sensors.sensor import Sensor, checked_sensor, value_of
from cortado.simulation import Simulation


def checked_sensors(given: Mapping[str, Sensor] | None, taken: set[str]) -> dict[str, Sensor]:
    """Sensors by names that are not ``taken``; raises `InputError` for anything else."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"sensors is {shown(given)}, but must be a table of sensors by name, {{'gauge': sensor}}.")
    for name in given:
        if not isinstance(name, str) or name in taken:
            raise InputError(
                f"sensors has the name {shown(name)}, but must have texts other than {', '.join(sorted(taken))}."
            )
    return {name: checked_sensor(sensor) for name, sensor in given.items()}


def readings(
    sensors: Mapping[str, Sensor], simulation: Simulation, rollout: Rollout, state: State, driven: Mapping[str, NDArray]
) -> dict[str, NDArray]:
    """(scenes, k) by name, of states of all scenes. Parameters are those of the last step of the rollout, but for those
    that are ``driven`` (scenes, 1, ...)."""
    if not sensors:
        return {}
    row = rollout.steps - 1
    parameters = {**row_of(rollout, rollout.parameters.written, row), **driven}
    moment = Moment(state, parameters, rollout.substeps, row, simulation.evaluator)
    scenes = simulation.batch or 1
    end = SnapshotBatch(state, simulation.dimension, np.zeros((scenes, len(simulation.scene.phase), 3)), moment)
    return {name: np.array([value_of(sensor, end[b]) for b in range(scenes)]) for name, sensor in sensors.items()}
