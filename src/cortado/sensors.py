"""What a gauge would read in the fluid: pressure at a point, the height of its surface, a flow, the load on a solid,
how a body moves."""

from cortado.calls import face
from cortado.runs.body_sensors import BodyMotion, SpringForce
from cortado.runs.probes import FlowRate, PressureProbe, SolidLoad, WallForce
from cortado.runs.sensor import Readings, Sensor
from cortado.runs.wave_gauge import WaveGauge

__all__ = [
    "BodyMotion",
    "FlowRate",
    "PressureProbe",
    "Readings",
    "Sensor",
    "SolidLoad",
    "SpringForce",
    "WallForce",
    "WaveGauge",
]

__dir__ = face(globals())
