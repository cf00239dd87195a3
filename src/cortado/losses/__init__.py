"""Losses of a rollout: objects that compute a value and an adjoint of its last state or of states in between."""

from cortado.calls import face
from cortado.losses.distances import (
    CentreOfMass,
    CentreOfMassAlong,
    FinalPositions,
    Image,
    SensorMatch,
    Series,
    SolidPose,
)
from cortado.losses.loss import Frames, Loss, Snapshot, SnapshotAdjoint, SnapshotBatch, fingerprint
from cortado.losses.run_losses import Recorded

__all__ = [
    "CentreOfMass",
    "CentreOfMassAlong",
    "FinalPositions",
    "Frames",
    "Image",
    "Loss",
    "Recorded",
    "SensorMatch",
    "Series",
    "Snapshot",
    "SnapshotAdjoint",
    "SnapshotBatch",
    "SolidPose",
    "fingerprint",
]

__dir__ = face(globals())
