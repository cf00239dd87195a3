"""What a gauge would read in the fluid: pressure at a point, the height of its surface, a flow, the load on a solid."""

from cortado.calls import face
from cortado.runs.sensors.probes import FlowRate, PressureProbe, SolidLoad, WallForce
from cortado.runs.sensors.readings import Readings
from cortado.runs.sensors.sensor import Sensor
from cortado.runs.sensors.wave_gauge import WaveGauge

__all__ = ["FlowRate", "PressureProbe", "Readings", "Sensor", "SolidLoad", "WallForce", "WaveGauge"]

__dir__ = face(globals())
