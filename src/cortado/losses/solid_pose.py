"""How far a solid is from where it should be."""

from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import read_only
from cortado.errors import InputError, shown
from cortado.fixed import fixed
from cortado.losses.loss import Adjoint, Snapshot
from cortado.scene.motions import AXES, position_name, rotation_name, solids_in, turn_name


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
        """The part of the rotation R = Q R(w), and its adjoint; t is that of a further turn of R."""
        name, flat, weight = self.name, end.dimension == 2, self.length**2
        assert self.rotation is not None
        w, wanted = end[rotation_name(name)][0], _matrix(self.rotation)
        begun, is_free = _matrix(w), f"{name}.{AXES[0]}" in end.state.names
        if is_free:
            columns = np.array([_in_space(end[f"{name}.{axis}"][0]) for axis in AXES]).T
            Q = np.eye(3) + columns
        else:
            turn = end[turn_name(name)][0]
            Q = _matrix(turn)
        R = Q @ begun
        t = -weight * np.cross(R, wanted, axis=0).sum(axis=1)
        bars = {rotation_name(name): _angles(_jacobian(w).T @ Q.T @ t, flat)}
        if is_free:
            bars |= {f"{name}.{axis}": 0.5 * np.cross(t, Q[:, k])[None, : end.dimension] for k, axis in enumerate(AXES)}
        else:
            bars[turn_name(name)] = _angles(_jacobian(turn).T @ t, flat)
        return weight * float(3.0 - np.trace(wanted.T @ R)), bars


def _in_space(vector: NDArray) -> NDArray[np.float64]:
    """(3,) of a vector, or the rotation vector of an angle."""
    found = np.zeros(3)
    if np.ndim(vector) == 0 or len(vector) == 1:
        found[2] = np.reshape(vector, ())
    else:
        found[: len(vector)] = vector
    return found


def _angles(w: NDArray, flat: bool) -> NDArray[np.float64]:
    """As a field of a state has it."""
    return w[2:] if flat else w[None]


def _matrix(w: NDArray) -> NDArray[np.float64]:
    """(3, 3) of a rotation vector, or an angle."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(_in_space(w)).as_matrix())


def _jacobian(w: NDArray) -> NDArray[np.float64]:
    """J of `cortado.sph.rotations`."""
    w = _in_space(w)
    size, cross = float(np.linalg.norm(w)), np.cross(np.eye(3), w)
    if size < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)
    a, b = (1.0 - np.cos(size)) / size**2, (size - np.sin(size)) / size**3
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)
