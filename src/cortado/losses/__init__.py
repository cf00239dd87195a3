"""What a rollout is judged by: objects with a value and an adjoint at the end of the trajectory, or on the way."""

from cortado.calls import face
from cortado.losses.batch import SnapshotBatch
from cortado.losses.centre_of_mass import CentreOfMass, CentreOfMassAlong
from cortado.losses.image import Image
from cortado.losses.loss import Frames, Loss, Snapshot, SnapshotAdjoint, fingerprint
from cortado.losses.positions import FinalPositions
from cortado.losses.recorded import Recorded
from cortado.losses.series import SensorMatch, Series
from cortado.losses.solid_pose import SolidPose

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
