"""What a picture shows: a camera, how opaque the fluid is, and what stands behind it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from cortado.arrays import is_whole
from cortado.calls import public
from cortado.errors import InputError, shown
from cortado.fixed import keep_own
from cortado.render.cameras import Camera, Orthographic, Vector, check_resolution, positive, vector

WHITE = (1.0, 1.0, 1.0)


class View(Protocol):
    """What the renderer asks of a view."""

    @property
    def camera(self) -> Camera: ...

    @property
    def extinction(self) -> float:
        """Of filled fluid [1 / m]."""
        ...

    @property
    def background(self) -> Vector:
        """Linear RGB, (3,)."""
        ...


@public
@dataclass(frozen=True)
class Volume:
    """Fluid that one can look into, from any camera."""

    camera: Camera
    extinction: float
    """Of filled fluid [1 / m]: after 1 / extinction, 1 / e of the light is left."""
    background: Vector = WHITE
    """Linear RGB, (3,)."""

    def __post_init__(self) -> None:
        positive("extinction", self.extinction)
        object.__setattr__(self, "background", vector("background", self.background))


@public
@dataclass(frozen=True)
class TopView:
    """The colour at the free surface from above, as who pours latte art sees it.

    The picture shows the whole container, seen along the axis downwards; it is not mirrored. Columns run along the
    first of the other two axes, left to right. Then, with y upwards, rows run along z: row 0 has the lowest z, and the
    viewer stands at the side of the greatest z. With z upwards rows run against y, as in a plot; with x upwards
    (columns along y) against z.
    """

    lower: Vector
    """Corner of the container [m], (2,) or (3,); in 2-D, where one looks at the plane, ``up_axis`` is 2."""
    upper: Vector
    spacing: float
    """Of the particles [m]."""
    resolution: tuple[int, int] = (256, 256)
    """Columns and rows."""
    up_axis: int = 1
    opacity: float = 4.0
    """Extinction times spacing [-]: how well the first layer of particles hides the second."""
    background: Vector = WHITE
    """Linear RGB, (3,)."""

    def __post_init__(self) -> None:
        length = 2 if np.shape(self.lower) == (2,) else 3
        for name in ("lower", "upper"):
            corner = vector(name, getattr(self, name), length)
            object.__setattr__(self, name, (*corner, 0.0)[:3])
        object.__setattr__(self, "background", vector("background", self.background))
        check_resolution(self.resolution)
        keep_own(self, "resolution")
        positive("spacing", self.spacing)
        positive("opacity", self.opacity)
        if not is_whole(self.up_axis) or self.up_axis not in (0, 1, 2):
            raise InputError(f"up_axis is {shown(self.up_axis)}, but must be 0, 1 or 2.")
        extent = np.delete(np.subtract(self.upper, self.lower), self.up_axis)
        if not (extent > 0).all():
            raise InputError(f"upper is {shown(self.upper)}, but must be above lower, {shown(self.lower)}.")

    @cached_property
    def camera(self) -> Camera:
        """High enough that all of the field lies below it."""
        lower, upper = np.array(self.lower), np.array(self.upper)
        back = np.eye(3)[self.up_axis]
        right = np.eye(3)[1 if self.up_axis == 0 else 0]
        up = np.cross(back, right)
        extent = upper - lower
        columns, rows = self.resolution
        width = max(extent @ right, abs(extent @ up) * columns / rows)
        top = np.where(back, upper, 0.5 * (lower + upper))
        margin = 8 * self.spacing
        return Orthographic(
            tuple(top + margin * back),
            tuple(top),
            tuple(up),
            width,
            resolution=self.resolution,
            far=2 * margin + extent @ back,
        )

    @property
    def extinction(self) -> float:
        return self.opacity / self.spacing
