"""What a gauge would read in the fluid: pressure at a point, the height of its surface, a flow, the load on a solid."""

from cortado.calls import face
from cortado.runs.sensors.flow_rate import FlowRate
from cortado.runs.sensors.log import Readings
from cortado.runs.sensors.pressure_probe import PressureProbe
from cortado.runs.sensors.sensor import Sensor
from cortado.runs.sensors.solid_load import SolidLoad
from cortado.runs.sensors.wall_force import WallForce
from cortado.runs.sensors.wave_gauge import WaveGauge

__all__ = ["FlowRate", "PressureProbe", "Readings", "Sensor", "SolidLoad", "WallForce", "WaveGauge"]

__dir__ = face(globals())
