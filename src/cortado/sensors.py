"""Sensors of pressure, wave height, flow rate, loads on solids, spring forces and motions of rigid bodies."""

from cortado.calls import face
from cortado.runs.body_sensors import BodyMotion, SpringForce
from cortado.runs.probes import FlowRate, PressureProbe, SolidLoad, WallForce
from cortado.runs.sensor import Readings, Sensor
from cortado.runs.wave_gauge import WaveGauge

__all__ = ["BodyMotion", "FlowRate", "PressureProbe", "Readings", "Sensor", "SolidLoad", "SpringForce", "WallForce"]
__all__ += ["WaveGauge"]

__dir__ = face(globals())
