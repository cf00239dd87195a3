"""How the camera of a film moves: the table ``camera_path`` of [picture], and objects in Python.

All begin at the camera that does not move, home, which fits the scene or is where the table [picture] says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from cortado.calls import public
from cortado.discretise.shapes import Points
from cortado.scene.fields import FieldPath, Length, Text, field_error, quantity
from cortado.scene.tables import Table

Place = tuple[Length, ...]


@dataclass(frozen=True)
class View:
    """Where a camera is and where it looks, in the scene's axes."""

    eye: Points
    """(3,) [m]"""
    look_at: Points
    """(3,) [m]"""


@dataclass(frozen=True)
class Moment:
    """When a picture of a film is taken."""

    share: float
    """The part of the film that is over, from 0 to 1."""
    time: float
    """[s] in the run"""
    up: Points
    """(3,) unit vector against gravity"""
    solids: Mapping[str, NDArray]
    """(3,) where the middles of solids are now, by their names [m]"""


class CameraPath(Table):
    """How a camera moves."""

    goes_around: ClassVar[bool] = False
    """Whether it looks from all sides, and home has to be far enough off for that."""
    kind: str
    """Name of the path."""

    def view(self, home: View, moment: Moment) -> View:
        """Where the camera is at a moment; ``home``: where it is if it does not move."""
        raise NotImplementedError

    def check_solids(self, names: Sequence[str], path: FieldPath = ()) -> None:
        """Raise the error of this table, at a path, if no solid of these names is the one that it names."""


@public
class Orbit(CameraPath):
    """Around what it looks at, at its height and its distance."""

    goes_around: ClassVar[bool] = True
    kind: Literal["orbit"] = "orbit"
    """Name of the path."""
    turns: Annotated[float, quantity(ge=-100.0, le=100.0)] = 1.0
    """How often it goes around during the film: counterclockwise seen from above, clockwise if negative."""

    def view(self, home: View, moment: Moment) -> View:
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(2.0 * np.pi * self.turns * moment.share * moment.up)
        return View(home.look_at + turn.apply(home.eye - home.look_at), home.look_at)


@public
class Dolly(CameraPath):
    """Straight towards what it looks at, or away from it, beginning and ending gently."""

    kind: Literal["dolly"] = "dolly"
    """Name of the path."""
    distance: Annotated[float, quantity(gt=0.0, le=100.0)] = 0.6
    """How far off it is at the end, in its distance at the start."""

    def view(self, home: View, moment: Moment) -> View:
        factor = self.distance ** _gently(moment.share)
        return View(home.look_at + factor * (home.eye - home.look_at), home.look_at)


@public
class Keyframes(CameraPath):
    """Through places at given times of the run, on a smooth curve."""

    kind: Literal["keyframes"] = "keyframes"
    """Name of the path."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...]
    """(k,) Times of the run, each greater than the one before [s]; before the first and after the last it rests."""
    cameras: tuple[Place, ...]
    """(k, 3) Where the camera is at these times [m]."""
    look_at: tuple[Place, ...] | None = None
    """(k, 3) Where it looks at these times [m]; where it looks at home, if left out."""

    @model_validator(mode="after")
    def _check_rows(self) -> Self:
        if len(self.times) < 2 or any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise field_error(("times",), self.times, "at least two times, each greater than the one before")
        for name in ("cameras", "look_at"):
            rows = getattr(self, name)
            if rows is not None and (len(rows) != len(self.times) or any(len(row) != 3 for row in rows)):
                wanted = f"{len(self.times)} places of 3 components, one for each of the times"
                raise field_error((name,), rows, wanted)
        return self

    def view(self, home: View, moment: Moment) -> View:
        look_at = home.look_at if self.look_at is None else self._at(moment.time, self.look_at)
        return View(self._at(moment.time, self.cameras), look_at)

    def _at(self, time: float, rows: Sequence[Place]) -> Points:
        from scipy.interpolate import PchipInterpolator

        return np.asarray(PchipInterpolator(self.times, rows)(np.clip(time, self.times[0], self.times[-1])))


@public
class Follow(CameraPath):
    """Beside a solid, in its middle the picture's, as far off as the camera is at home."""

    kind: Literal["follow"] = "follow"
    """Name of the path."""
    solid: Text
    """Name of the solid."""
    distance: Annotated[float, quantity(gt=0.0, le=100.0)] = 1.0
    """How far off it is, in its distance at home."""

    def view(self, home: View, moment: Moment) -> View:
        middle = np.asarray(moment.solids[self.solid])
        return View(middle + self.distance * (home.eye - home.look_at), middle)

    def check_solids(self, names: Sequence[str], path: FieldPath = ()) -> None:
        if self.solid not in names:
            wanted = f"the name of a solid: {', '.join(names)}" if names else "left out, as the scene has no solids"
            raise field_error((*path, "solid"), self.solid, wanted)


def _gently(share: float) -> float:
    return share * share * (3.0 - 2.0 * share)


AnyCameraPath = Annotated[Orbit | Dolly | Keyframes | Follow, Field(discriminator="kind")]
