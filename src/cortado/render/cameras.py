"""Cameras: where they stand, where they look, and what they see of the depth."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cortado.arrays import as_numbers, as_one_number, is_whole
from cortado.calls import keep_own, public
from cortado.errors import InputError, shown

Vector = tuple[float, ...]


def vector(name: str, values: Sequence[float] | np.ndarray, length: int = 3) -> Vector:
    """Return finite numbers as a tuple of a length; raises an `InputError` that calls them ``name``."""
    found = as_numbers(name, values)
    if found.shape != (length,) or not np.isfinite(found).all():
        raise InputError(f"{name} is {shown(values)}, but must be {length} finite numbers.")
    return tuple(found.tolist())


def positive(name: str, value: float) -> None:
    """Raise `InputError` for a number that is not positive and finite."""
    if not 0 < as_one_number(name, value) < np.inf:
        raise InputError(f"{name} is {shown(value)}, but must be a positive number.")


@dataclass(frozen=True)
class Camera:
    """The base of all cameras. Samples along a ray stand at fixed distances between ``near`` and ``far``."""

    position: Vector
    """Position of the camera [m], (3,)."""
    look_at: Vector
    """Point in the middle of the picture [m], (3,)."""
    up: Vector
    """Direction (3,) that points upwards in the picture, not along the view."""
    resolution: tuple[int, int] = field(default=(256, 256), kw_only=True)
    """Numbers of columns and rows; pixels are square."""
    near: float = field(default=0.0, kw_only=True)
    """Distance of the first sample's layer [m]."""
    far: float | None = field(default=None, kw_only=True)
    """Distance at which samples end [m]; by default twice that of ``look_at``."""

    def __post_init__(self) -> None:
        for name in ("position", "look_at", "up"):
            object.__setattr__(self, name, vector(name, getattr(self, name)))
        sight = np.subtract(self.look_at, self.position)
        if not sight.any():
            raise InputError(f"look_at is {shown(self.look_at)}, but must not be the position of the camera.")
        if np.linalg.norm(np.cross(sight, self.up)) <= 1e-9 * np.linalg.norm(sight) * np.linalg.norm(self.up):
            raise InputError(f"up is {shown(self.up)}, but must not be zero or along the view.")
        check_resolution(self.resolution)
        keep_own(self, "resolution")
        if self.far is None:
            object.__setattr__(self, "far", 2.0 * float(np.linalg.norm(sight)))
        near, far = as_one_number("near", self.near), as_one_number("far", self.far)
        if not 0 <= near < far < np.inf:
            raise InputError(f"near is {shown(self.near)} and far {shown(self.far)}, but must be 0 <= near < far.")

    @property
    def reach(self) -> float:
        """Distance at which samples end [m]: ``far``, which is a number once the camera is made."""
        assert self.far is not None
        return self.far

    @property
    def orientation(self) -> np.ndarray:
        """Rotation matrix (3, 3) whose columns point to the right, upwards and backwards in the picture."""
        back = np.subtract(self.position, self.look_at)
        back /= np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back], axis=1)

    @property
    def half_width(self) -> tuple[float, float]:
        """Half of the width seen at the camera [m], and its growth per depth [-]."""
        raise NotImplementedError

    def moved(self, translation: Sequence[float] | np.ndarray, rotation: Sequence[float] | np.ndarray) -> "Camera":
        """Return the camera shifted by a vector (3,) [m] and turned about its own position by a rotation vector (3,)
        [rad].

        These are the coordinates, at zero, in which the renderer gives the derivative with respect to the pose.
        """
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(vector("rotation", rotation)).as_matrix()
        position = np.add(self.position, vector("translation", translation))
        look_at = position + turn @ np.subtract(self.look_at, self.position)
        return replace(self, position=tuple(position), look_at=tuple(look_at), up=tuple(turn @ self.up))


@public
@dataclass(frozen=True)
class Orthographic(Camera):
    """A camera with parallel rays."""

    width: float
    """Width of the region that the picture shows [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("width", self.width)

    @property
    def half_width(self) -> tuple[float, float]:
        return 0.5 * self.width, 0.0


@public
@dataclass(frozen=True)
class Perspective(Camera):
    """A camera with rays from one point."""

    field_of_view: float
    """Angle that the width of the picture spans [degree]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < as_one_number("field_of_view", self.field_of_view) < 180:
            raise InputError(f"field_of_view is {shown(self.field_of_view)}, but must be between 0 and 180 degrees.")

    @property
    def half_width(self) -> tuple[float, float]:
        return 0.0, float(np.tan(np.radians(0.5 * self.field_of_view)))


def check_resolution(resolution: tuple[int, int]) -> None:
    """Raise `InputError` unless ``resolution`` is two positive whole numbers, columns and rows."""
    whole = isinstance(resolution, Sequence) and all(is_whole(n) and n > 0 for n in resolution)
    if not whole or len(resolution) != 2:
        raise InputError(
            f"resolution is {shown(resolution)}, but must be two positive whole numbers, columns and rows."
        )
