"""Measurements of an experiment, for `cortado.fit`."""

from cortado.calls import face
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.observations import Direction, Observation, SensorSeries, Tracks, Video

__all__ = ["Direction", "Experiment", "Observation", "SensorSeries", "Tracks", "Video"]

__dir__ = face(globals())
