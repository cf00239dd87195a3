"""The sensors that a scene names."""

from collections.abc import Callable
from typing import Any

import numpy as np

from cortado.runs.sensors.flow_rate import FlowRate
from cortado.runs.sensors.pressure_probe import PressureProbe
from cortado.runs.sensors.sensor import Sensor
from cortado.runs.sensors.solid_load import SolidLoad
from cortado.runs.sensors.wall_force import WallForce
from cortado.runs.sensors.wave_gauge import WaveGauge
from cortado.scene.scene import Scene

SENSORS: dict[str, Callable[..., Sensor]] = {
    "pressure_probe": PressureProbe,
    "wave_gauge": WaveGauge,
    "flow_rate": FlowRate,
    "wall_force": WallForce,
    "solid_load": SolidLoad,
}
"""By their kinds."""


def sensors_of(scene: Scene) -> dict[str, Sensor]:
    """By their names. Up is against gravity."""
    gravity = np.asarray(scene.forces.gravity, dtype=np.float64)
    upwards: dict[str, Any] = {"wave_gauge": {"up": -gravity}} if gravity.any() else {}
    return {
        table.name: SENSORS[table.kind](**table.model_dump(exclude={"name", "kind"}), **upwards.get(table.kind, {}))
        for table in scene.sensor
    }
