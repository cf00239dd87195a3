"""A view that is not known exactly: the numbers of its camera as parameters, and how the view changes with them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cortado.errors import InputError, shown
from cortado.render.cameras import Orthographic, Perspective, Vector
from cortado.render.views import View, Volume

ZERO = (0.0, 0.0, 0.0)
NUDGE = 1e-6
"""Of a rotation vector [rad], for the direction in which a turned camera turns further."""


@dataclass(frozen=True)
class ViewTangent:
    """How a view changes: the direction of a derivative."""

    translation: Vector = ZERO
    """Of the camera (3,) [m]."""
    rotation: Vector = ZERO
    """Of the camera about its position, a rotation vector (3,) [rad]."""
    half_width: tuple[float, float] = (0.0, 0.0)
    """Of `Camera.half_width`: at the camera [m], and its growth with depth [-]."""
    extinction: float = 0.0
    """Of filled fluid [1 / m]."""


@dataclass(frozen=True)
class Calibration:
    """The view that was aimed at, and which of its numbers are searched: "translation" (3,) [m] and "rotation" (3,)
    [rad] of the camera from where it was aimed at, its "field_of_view" [degrees] or, of parallel rays, its "width" [m],
    and the "extinction" of the fluid [1/m]."""

    aimed: View
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in self._values:
                wanted = ", ".join(self._values)
                raise InputError(f"calibrate has {shown(name)}, but must be made of {wanted}.")

    @property
    def start(self) -> dict[str, np.ndarray]:
        """The values as the view was aimed."""
        return {name: self._values[name] for name in self.names}

    @property
    def unseen(self) -> dict[str, np.ndarray]:
        """By name, true for the numbers that no picture shows: how far a camera of parallel rays, which look along an
        axis, is moved along them."""
        camera = self.aimed.camera
        if "translation" not in self.names or not isinstance(camera, Orthographic):
            return {}
        sight = np.subtract(camera.look_at, camera.position)
        return {"translation": np.isclose(np.abs(sight), np.linalg.norm(sight))}

    def view(self, values: Mapping[str, np.ndarray]) -> View:
        """The view with these values; raises `InputError` where there is none."""
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
        """How the view with these values changes along directions of some of them."""
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
        """All numbers of the view that was aimed at."""
        camera = self.aimed.camera
        found = {"translation": np.zeros(3), "rotation": np.zeros(3), "extinction": np.array(self.aimed.extinction)}
        if isinstance(camera, Perspective):
            found["field_of_view"] = np.array(camera.field_of_view)
        elif isinstance(camera, Orthographic):
            found["width"] = np.array(camera.width)
        return found
