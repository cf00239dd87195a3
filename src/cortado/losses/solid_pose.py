"""How far a solid is from where it should be."""

from hashlib import sha256
from typing import Any

import numpy as np

from cortado.arrays import read_only
from cortado.errors import InputError, shown
from cortado.fixed import fixed
from cortado.losses.loss import Adjoint, Snapshot
from cortado.scene.motions import AXES, position_name, solids_in
from cortado.scene.poses import Pose, matrix


@fixed
class SolidPose:
    """Of a solid that moves, |x - x*|^2 + l^2 (3 - tr R*^T R) [m2]: the squared distance of its middle to where it
    should be, and, for a rotation that is off by a small angle, the squared angle times that of a length l."""

    def __init__(self, name: str, position: Any = None, rotation: Any = None, length: float = 1.0):
        """``name`` of the solid; ``position`` (d,) of its middle [m] and ``rotation``, in 3-D a rotation vector (3,),
        in 2-D a number, [rad], either or both; ``length`` l [m], greater than 0."""
        if not isinstance(name, str):
            raise InputError(f"name is {shown(name)}, but must be the name of a solid.")
        if position is None and rotation is None:
            raise InputError("position and rotation are left out, but one of them must be given.")
        if not np.isfinite(length) or length <= 0.0:
            raise InputError(f"length is {shown(length)}, but must be greater than 0.")
        self.name, self.length = name, float(length)
        self.position = None if position is None else read_only("position", position)
        self.rotation = None if rotation is None else read_only("rotation", np.atleast_1d(rotation))
        given = (np.zeros(0) if one is None else one for one in (self.position, self.rotation))
        words = b" ".join([name.encode(), *(one.tobytes() for one in given), np.float64(length).tobytes()])
        self.fingerprint = sha256(words).hexdigest()
        """Tells one target from another, for checkpoints."""

    def value(self, end: Snapshot) -> float:
        return self.value_and_adjoint(end)[0]

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        name, names = self.name, end.state.names
        if position_name(name) not in names:
            moving = ", ".join(solids_in(names)) or "none does"
            raise InputError(f"name is {name!r}, but must be that of a solid that moves: {moving}.")
        value, bars = 0.0, {}
        if self.position is not None:
            position = end[position_name(name)]
            if self.position.shape != position.shape[1:]:
                raise InputError(f"position has shape {self.position.shape}, but must be {position.shape[1:]}.")
            value += float(((position - self.position) ** 2).sum())
            bars[position_name(name)] = 2.0 * (position - self.position)
        if self.rotation is not None:
            if self.rotation.shape != (2 * end.dimension - 3,):
                raise InputError(f"rotation has shape {self.rotation.shape}, but must be {(2 * end.dimension - 3,)}.")
            more, of_fields = self._turned(end)
            value, bars = value + more, {**bars, **of_fields}
        return value, bars

    def _turned(self, end: Snapshot) -> tuple[float, dict[str, np.ndarray]]:
        """The part of the rotation, and its adjoint; t is that of a further turn of R."""
        assert self.rotation is not None
        pose = Pose.of(self.name, f"{self.name}.{AXES[0]}" in end.state.names, end)
        R, wanted, weight = pose.rotation, matrix(self.rotation), self.length**2
        t = -weight * np.cross(R, wanted, axis=0).sum(axis=1)
        return weight * float(3.0 - np.trace(wanted.T @ R)), pose.turning_bars(t)
