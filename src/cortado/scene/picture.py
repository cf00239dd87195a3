"""How shaded pictures of a scene are made; it changes nothing of what is computed."""

from typing import Annotated, Any, Literal

from pydantic import ValidationInfo, field_validator

from cortado.scene.fields import Colour, FieldPath, Flag, Length, OneOf, components, count, field_error, quantity
from cortado.scene.quantities import NAMES
from cortado.scene.tables import Table

MOST_FRAMES = 120
"""Of a film whose scene does not say how many."""
Place = Annotated[tuple[Length, ...], components("x", "y", "z")]


class Picture(Table):
    """The stage for shaded pictures and films, which `cortado run`, `optimise` and `picture` write; what is left out
    fits the scene."""

    width: Annotated[int, count(64, 7680)] = 1280
    """Columns of pixels."""
    height: Annotated[int, count(64, 4320)] = 720
    """Rows of pixels."""
    surface: Literal["liquid", "spheres"] = "liquid"
    """"liquid": the surface of the fluid; "spheres": a sphere for each particle, in 3-D."""
    camera: Place | None = None
    """(3,) where the camera is [m], in 3-D; left out, it sees all of the container."""
    look_at: Place | None = None
    """(3,) the middle of the picture [m], in 3-D; that of the container if left out."""
    field_of_view: Annotated[float, quantity("degrees", gt=0.0, le=120.0)] = 28.0
    """The angle that the width of the picture spans [degrees], in 3-D."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """The part of the light, from 0 to 1, that goes through fluid a tenth as thick as the container is long; if left
    out 0.9 with one phase, and 0 with several or with colour_by."""
    floor: Flag = True
    """Whether there is a floor, in 3-D."""
    background: Colour = (0.74, 0.77, 0.80)
    """(3,) red, green and blue, linear, each from 0 to 1"""
    colour_by: Annotated[str, OneOf(NAMES)] | None = None
    """A quantity of the particles that they are coloured by, on a scale beside the picture: "density", "pressure",
    "speed", "vorticity" or "wall_force"; the colours of the phases if left out."""
    film_frames: Annotated[int, count(0, 100_000)] | None = None
    """Frames of a film, as far as there are so many; no film if 0. If left out as many as are drawn in about 40 s, at
    most 120."""

    @property
    def most_frames(self) -> int:
        """Of a film."""
        return MOST_FRAMES if self.film_frames is None else self.film_frames

    @field_validator("look_at")
    @classmethod
    def _check_place(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value == info.data.get("camera"):
            raise field_error((), value, "another place than camera")
        return value

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> "Picture":
        """This table, at a path, for 2 or 3 dimensions."""
        for name in ("camera", "look_at"):
            value = getattr(self, name)
            if value is not None and dimension == 2:
                raise field_error((*path, name), value, "left out, as the scene has 2 dimensions")
        return self
