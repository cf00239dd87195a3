"""Cameras and views. A view consists of a camera, the extinction of the fluid and the background.

A `Calibration` makes unknown properties of a view, such as the camera's position, into parameters.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from cortado.arrays import as_numbers, as_one_number, is_whole
from cortado.calls import keep_own, public
from cortado.errors import InputError, shown

Vector = tuple[float, ...]


def vector(name: str, values: Sequence[float] | np.ndarray, length: int = 3) -> Vector:
    """Return ``values`` as a tuple. Raises `InputError` if ``values`` are not ``length`` finite numbers."""
    found = as_numbers(name, values)
    if found.shape != (length,) or not np.isfinite(found).all():
        raise InputError(f"{name} is {shown(values)}, but must be {length} finite numbers.")
    return tuple(found.tolist())


def positive(name: str, value: float) -> None:
    if not 0 < as_one_number(name, value) < np.inf:
        raise InputError(f"{name} is {shown(value)}, but must be a positive number.")


@dataclass(frozen=True)
class Camera:
    """Base class of cameras. A renderer samples the fluid at evenly spaced points on each ray, between ``near`` and
    ``far``."""

    position: Vector
    """Position of the camera [m], (3,)."""
    look_at: Vector
    """Point in the middle of the picture [m], (3,)."""
    up: Vector
    """Direction (3,) that points upwards in the picture, not parallel to the viewing direction."""
    resolution: tuple[int, int] = field(default=(256, 256), kw_only=True)
    """Numbers of columns and rows; pixels are square."""
    near: float = field(default=0.0, kw_only=True)
    """Distance from the camera to the first sample on a ray [m]."""
    far: float | None = field(default=None, kw_only=True)
    """Distance from the camera to the last sample on a ray [m], by default twice the distance to ``look_at``."""

    def __post_init__(self) -> None:
        for name in ("position", "look_at", "up"):
            object.__setattr__(self, name, vector(name, getattr(self, name)))
        sight = np.subtract(self.look_at, self.position)
        if not sight.any():
            raise InputError(f"look_at is {shown(self.look_at)}, but must not be the position of the camera.")
        if np.linalg.norm(np.cross(sight, self.up)) <= 1e-9 * np.linalg.norm(sight) * np.linalg.norm(self.up):
            raise InputError(f"up is {shown(self.up)}, but must not be zero or parallel to the view.")
        check_resolution(self.resolution)
        keep_own(self, "resolution")
        if self.far is None:
            object.__setattr__(self, "far", 2.0 * float(np.linalg.norm(sight)))
        near, far = as_one_number("near", self.near), as_one_number("far", self.far)
        if not 0 <= near < far < np.inf:
            raise InputError(f"near is {shown(self.near)} and far is {shown(self.far)}, but 0 <= near < far must hold.")

    @property
    def reach(self) -> float:
        """Distance from the camera to the last sample on a ray [m]: ``far``, or its default."""
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
        """Half the visible width at the camera [m], and the growth of the half width with depth [-]."""
        raise NotImplementedError

    def moved(self, translation: Sequence[float] | np.ndarray, rotation: Sequence[float] | np.ndarray) -> "Camera":
        """Return the camera after a ``translation`` (3,) [m] and a ``rotation`` about its position. The rotation of the
        camera is a rotation vector (3,) [rad].

        The renderer returns derivatives with respect to the translation and rotation at zero.
        """
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(vector("rotation", rotation)).as_matrix()
        position = np.add(self.position, vector("translation", translation))
        look_at = position + turn @ np.subtract(self.look_at, self.position)
        return replace(self, position=tuple(position), look_at=tuple(look_at), up=tuple(turn @ self.up))


@public
@dataclass(frozen=True)
class Orthographic(Camera):
    """A camera with parallel rays.

    The camera is at ``position`` (3,) [m] and looks at ``look_at`` [m], with ``up`` upwards. The picture is ``width``
    [m] wide, shows depths from ``near`` to ``far`` [m], and has ``resolution`` (columns, rows).

    Example::

        camera = cortado.render.Orthographic((0.0, 1.0, 3.0), (0.0, 0.2, 0.0), (0.0, 1.0, 0.0), width=1.5)
        renderer = simulation.renderer(view="volume", camera=camera)
    """

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
    """A camera with rays from one point.

    The camera is at ``position`` (3,) [m] and looks at ``look_at`` [m], with ``up`` upwards. The horizontal angle of
    view is ``field_of_view`` [degrees]. The picture shows depths from ``near`` to ``far`` [m] and has ``resolution``
    (columns, rows).

    Example::

        camera = cortado.render.Perspective((0.0, 1.0, 3.0), (0.0, 0.2, 0.0), (0.0, 1.0, 0.0), 40.0)
        renderer = simulation.renderer(view="volume", camera=camera)
    """

    field_of_view: float
    """Horizontal angle of view [degree]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < as_one_number("field_of_view", self.field_of_view) < 180:
            raise InputError(f"field_of_view is {shown(self.field_of_view)}, but must be between 0 and 180 degrees.")

    @property
    def half_width(self) -> tuple[float, float]:
        return 0.0, float(np.tan(np.radians(0.5 * self.field_of_view)))


def check_resolution(resolution: tuple[int, int]) -> None:
    """Raise `InputError` if ``resolution`` is not a pair of positive whole numbers."""
    whole = isinstance(resolution, Sequence) and all(is_whole(n) and n > 0 for n in resolution)
    if not whole or len(resolution) != 2:
        wanted = "two positive whole numbers, columns and rows"
        raise InputError(f"resolution is {shown(resolution)}, but must be {wanted}.")


WHITE = (1.0, 1.0, 1.0)
ZERO = (0.0, 0.0, 0.0)
NUDGE = 1e-6
"""Step for finite differences with respect to a rotation vector [rad]."""


class View(Protocol):
    """Protocol of views: a camera, the extinction of fluid and the background."""

    @property
    def camera(self) -> Camera: ...

    @property
    def extinction(self) -> float:
        """Extinction coefficient of fluid with coverage 1 [1 / m]."""

    @property
    def background(self) -> Vector:
        """Background colour (3,), in linear RGB."""


@public
@dataclass(frozen=True)
class Volume:
    """A view of translucent fluid through any camera."""

    camera: Camera
    extinction: float
    """Extinction of fluid with coverage 1 [1 / m]. Light is reduced to 1 / e over the length 1 / extinction."""
    background: Vector = WHITE
    """Background colour (3,), in linear RGB."""

    def __post_init__(self) -> None:
        positive("extinction", self.extinction)
        object.__setattr__(self, "background", vector("background", self.background))


@public
@dataclass(frozen=True)
class TopView:
    """A view of the free surface from above, as a barista sees latte art.

    The picture shows the whole container, seen along the up axis and not mirrored. With y upwards, columns run along x
    and rows along z, with the lowest z in row 0. With z upwards, columns run along x and rows against y, as in a plot.
    With x upwards, columns run along y and rows against z.
    """

    lower: Vector
    """Lower corner of the container [m], (2,) or (3,). In 2-D the camera looks at the plane, and ``up_axis`` is 2."""
    upper: Vector
    spacing: float
    """Particle spacing [m]."""
    resolution: tuple[int, int] = (256, 256)
    """Numbers of columns and rows."""
    up_axis: int = 1
    opacity: float = 4.0
    """Extinction times particle spacing [-]. A large value hides the fluid below the first layer of particles."""
    background: Vector = WHITE
    """Background colour (3,), in linear RGB."""

    def __post_init__(self) -> None:
        length = 2 if np.shape(self.lower) == (2,) else 3
        for name in ("lower", "upper"):
            object.__setattr__(self, name, (*vector(name, getattr(self, name), length), 0.0)[:3])
        object.__setattr__(self, "background", vector("background", self.background))
        check_resolution(self.resolution)
        keep_own(self, "resolution")
        positive("spacing", self.spacing)
        positive("opacity", self.opacity)
        if not is_whole(self.up_axis) or self.up_axis not in (0, 1, 2):
            raise InputError(f"up_axis is {shown(self.up_axis)}, but must be 0, 1 or 2.")
        if not (np.delete(np.subtract(self.upper, self.lower), self.up_axis) > 0).all():
            raise InputError(f"upper is {shown(self.upper)}, but must be above lower, {shown(self.lower)}.")

    @cached_property
    def camera(self) -> Camera:
        lower, upper = np.array(self.lower), np.array(self.upper)
        back, right = np.eye(3)[self.up_axis], np.eye(3)[1 if self.up_axis == 0 else 0]
        up, extent, (columns, rows) = np.cross(back, right), upper - lower, self.resolution
        width = max(extent @ right, abs(extent @ up) * columns / rows)
        top, margin = np.where(back, upper, 0.5 * (lower + upper)), 8 * self.spacing
        sight = tuple(top + margin * back), tuple(top), tuple(up)
        return Orthographic(*sight, width, resolution=self.resolution, far=2 * margin + extent @ back)

    @property
    def extinction(self) -> float:
        return self.opacity / self.spacing


@dataclass(frozen=True)
class ViewTangent:
    """Rates of change of a view's properties, for a directional derivative."""

    translation: Vector = ZERO
    """Translation of the camera (3,) [m]."""
    rotation: Vector = ZERO
    """Rotation vector (3,) of the camera about its position [rad]."""
    half_width: tuple[float, float] = (0.0, 0.0)
    """Change of the two numbers in `Camera.half_width`: half width at the camera [m], and growth with depth [-]."""
    extinction: float = 0.0
    """Change of the extinction coefficient [1 / m]."""


@dataclass(frozen=True)
class Calibration:
    """Unknown properties of a view as parameters. The view ``aimed`` has approximate values of the unknown properties.

    The possible parameters are "translation" (3,) [m] and "rotation" (3,) [rad] of the camera, and the "extinction" of
    the fluid [1/m]. A perspective camera also has the "field_of_view" [degrees], and a camera with parallel rays has
    the "width" [m].
    """

    aimed: View
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in self._values:
                raise InputError(f"calibrate has {shown(name)}, but must have names among {', '.join(self._values)}.")

    @property
    def start(self) -> dict[str, np.ndarray]:
        """Values of the unknown parameters in the view ``aimed``."""
        return {name: self._values[name] for name in self.names}

    @property
    def unseen(self) -> dict[str, np.ndarray]:
        """Masks by parameter name, True for components without effect on pictures."""
        camera = self.aimed.camera
        if "translation" not in self.names or not isinstance(camera, Orthographic):
            return {}
        sight = np.subtract(camera.look_at, camera.position)
        return {"translation": np.isclose(np.abs(sight), np.linalg.norm(sight))}

    def view(self, values: Mapping[str, np.ndarray]) -> View:
        """Return the view with the given parameter ``values``. Raises `InputError` for invalid values."""
        if not self.names:
            return self.aimed
        all_values = {**self._values, **values}
        camera = self.aimed.camera.moved(all_values["translation"], all_values["rotation"])
        if isinstance(camera, Perspective):
            camera = replace(camera, field_of_view=float(all_values["field_of_view"]))
        elif isinstance(camera, Orthographic):
            camera = replace(camera, width=float(all_values["width"]))
        return Volume(camera, float(all_values["extinction"]), self.aimed.background)

    def tangent(self, values: Mapping[str, np.ndarray], directions: Mapping[str, np.ndarray]) -> ViewTangent:
        """Return the rate of change of the view along ``directions``. Directions that are left out are 0."""
        from scipy.spatial.transform import Rotation

        rotation: Vector = ZERO
        if "rotation" in directions:
            at = np.asarray(values["rotation"])
            further = Rotation.from_rotvec(at + NUDGE * directions["rotation"])
            rotation = tuple((further * Rotation.from_rotvec(at).inv()).as_rotvec() / NUDGE)
        half_width = (0.5 * float(directions.get("width", 0.0)), 0.0)
        if "field_of_view" in directions:
            half_angle = np.radians(0.5 * float(values["field_of_view"]))
            half_width = (0.0, float(np.radians(0.5 * directions["field_of_view"]) / np.cos(half_angle) ** 2))
        translation = tuple(directions.get("translation", ZERO))
        return ViewTangent(translation, rotation, half_width, float(directions.get("extinction", 0.0)))

    @property
    def _values(self) -> dict[str, np.ndarray]:
        camera = self.aimed.camera
        found = {"translation": np.zeros(3), "rotation": np.zeros(3), "extinction": np.array(self.aimed.extinction)}
        if isinstance(camera, Perspective):
            found["field_of_view"] = np.array(camera.field_of_view)
        elif isinstance(camera, Orthographic):
            found["width"] = np.array(camera.width)
        return found
