"""Losses of a rollout. A loss computes a value and an adjoint from one or several states."""

from cortado.calls import face
from cortado.losses.distances import CentreOfMass, CentreOfMassAlong, FinalPositions, Image, SensorMatch, Series
from cortado.losses.distances import SolidPose as SolidPose
from cortado.losses.loss import Frames, Loss, Snapshot, SnapshotAdjoint, SnapshotBatch, fingerprint
from cortado.losses.run_losses import Recorded

__all__ = ["CentreOfMass", "CentreOfMassAlong", "FinalPositions", "Frames", "Image", "Loss", "Recorded"]
__all__ += ["SensorMatch", "Series", "Snapshot", "SnapshotAdjoint", "SnapshotBatch", "SolidPose", "fingerprint"]

__dir__ = face(globals())
