"""What was measured of an experiment, for `cortado.fit`."""

from cortado.calls import face
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.observation import Direction, Observation
from cortado.optimisation.fitting.sensor_series import SensorSeries
from cortado.optimisation.fitting.tracks import Tracks
from cortado.optimisation.fitting.video import Video

__all__ = ["Direction", "Experiment", "Observation", "SensorSeries", "Tracks", "Video"]

__dir__ = face(globals())
