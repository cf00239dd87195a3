"""How a solid that moves lies in a state, and from turns of it to the fields that keep them."""

from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from cortado.scene.motions import AXES, position_name, rotation_name, scale_name, turn_name


class Fields(Protocol):
    """A state of one scene."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A field by its name, with an axis of one entry."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the middle of a solid is, and how the solid is turned about it: R = Q R(w), in space, also of one in the
    plane."""

    name: str
    """Of the solid."""
    is_free: bool
    """Whether it is a body that fluid moves: states keep Q of these by its columns, and of others by its vector."""
    position: NDArray[Any]
    """(d,) [m]"""
    scale: float
    """How many times as large as in the scene it is."""
    begun: NDArray[Any]
    """w, (3,), by which it was turned at first [rad]"""
    turn: NDArray[Any]
    """(3,) by which it was turned since [rad]; 0 of a body that is free"""
    turned: NDArray[Any]
    """Q, (3, 3)"""

    @classmethod
    def of(cls, name: str, is_free: bool, at: Fields) -> Self:
        """As a state has it."""
        position, begun, turn, scale = at[position_name(name)][0], at[rotation_name(name)][0], np.zeros(3), 1.0
        if is_free:
            turned = np.eye(3) + np.array([_in_space(at[f"{name}.{axis}"][0]) for axis in AXES]).T
        else:
            turn, scale = _in_space(at[turn_name(name)][0]), float(at[scale_name(name)][0])
            turned = matrix(turn)
        return cls(name, is_free, position, scale, _in_space(begun), turn, turned)

    @property
    def rotation(self) -> NDArray[Any]:
        """R, (3, 3)"""
        return np.asarray(self.turned @ matrix(self.begun))

    def turning_bars(self, t: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """From ``t`` (3,), the derivative with respect to a further turn of R, to those of fields, by their names."""
        name, dimension = self.name, len(self.position)
        bars = {rotation_name(name): _angles(_jacobian(self.begun).T @ self.turned.T @ t, dimension)}
        if not self.is_free:
            return bars | {turn_name(name): _angles(_jacobian(self.turn).T @ t, dimension)}
        columns = zip(AXES, self.turned.T, strict=True)
        return bars | {f"{name}.{axis}": 0.5 * np.cross(t, column)[None, :dimension] for axis, column in columns}


def matrix(rotation: NDArray[Any]) -> NDArray[np.float64]:
    """(3, 3) of a rotation vector (3,), or of an angle (1,) in the plane [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(_in_space(rotation)).as_matrix())


def _in_space(vector: NDArray[Any]) -> NDArray[np.float64]:
    """(3,) of a vector, or the rotation vector of an angle."""
    found = np.zeros(3)
    if np.ndim(vector) == 0 or len(vector) == 1:
        found[2] = np.reshape(vector, ())
    else:
        found[: len(vector)] = vector
    return found


def _angles(w: NDArray[Any], dimension: int) -> NDArray[np.float64]:
    """As a field of a state has it."""
    return np.asarray(w[2:] if dimension == 2 else w[None])


def _jacobian(w: NDArray[Any]) -> NDArray[np.float64]:
    """J of `cortado.sph.rotations`."""
    size, cross = float(np.linalg.norm(w)), np.cross(np.eye(3), w)
    if size < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)
    a, b = (1.0 - np.cos(size)) / size**2, (size - np.sin(size)) / size**3
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)
