"""What a gauge would read in the fluid: pressure at a point, the height of its surface, a flow, a force on walls."""

from cortado.sensors.flow_rate import FlowRate
from cortado.sensors.log import Readings
from cortado.sensors.pressure_probe import PressureProbe
from cortado.sensors.sensor import Sensor
from cortado.sensors.wall_force import WallForce
from cortado.sensors.wave_gauge import WaveGauge

__all__ = ["FlowRate", "PressureProbe", "Readings", "Sensor", "WallForce", "WaveGauge"]


def __dir__() -> list[str]:
    return __all__
