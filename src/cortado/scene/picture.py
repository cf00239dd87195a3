"""How shaded pictures of a scene are made; it changes nothing of what is computed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import ValidationInfo, field_validator

from cortado.errors import Words
from cortado.scene.camera_paths import AnyCameraPath
from cortado.scene.fields import Colour, FieldPath, Flag, Length, OneOf, components, count, field_error, quantity
from cortado.scene.lights import LIGHTS, Light
from cortado.scene.quantities import NAMES
from cortado.scene.tables import Table

COLOURS = ("phase", *NAMES, "age")
"""What particles may be coloured by."""
SEARCHED_FRAMES = 121
"""Of films of a search whose scene does not say how many."""
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
    camera_path: AnyCameraPath | None = None
    """How the camera moves over a run, in films and in single pictures, in 3-D; if left out it stays where it is."""
    look_at: Place | None = None
    """(3,) the middle of the picture [m], in 3-D; that of the container if left out."""
    field_of_view: Annotated[float, quantity("degrees", gt=0.0, le=120.0)] = 28.0
    """The angle that the width of the picture spans [degrees], in 3-D."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """The part of the light, from 0 to 1, that goes through fluid a tenth as thick as the container is long; if left
    out 0.9 with one phase, and 0 with several or with another colour than theirs."""
    floor: Flag = True
    """Whether there is a floor, in 3-D."""
    light: Annotated[str, OneOf(LIGHTS)] = "studio"
    """Sun and sky, in 3-D: "studio", "noon", "evening" or "overcast"."""
    background: Colour | None = None
    """(3,) red, green and blue, linear, each from 0 to 1; that of the light if left out"""
    colour: Annotated[str, OneOf(COLOURS)] = "phase"
    """What colours particles: "phase", their own colours; a quantity, "density", "pressure", "speed", "vorticity" or
    "wall_force", or "age", the time since they left an emitter or since the start; of both with a scale beside it."""
    shaded: Flag = True
    """Whether light and shadow fall on the fluid; without them its colours are those of the scale."""
    film_frames: Annotated[int, count(0, 1_000_000)] | None = None
    """Frames of a film, evenly chosen from those that were recorded; 25 in each of its seconds if left out, and no film
    if 0. A search records as many for its films, 121 if left out."""
    film_speed: Annotated[float, quantity(gt=0.0)] | None = None
    """Seconds of the run in a second of its film: 1 is real time, 0.25 a quarter of it. If left out real time, or
    slower or faster where the film would be shorter than 4 s or longer than 10 s."""

    @property
    def sun_and_sky(self) -> Light:
        """The light by its numbers, with the background that is shown."""
        light = LIGHTS[self.light]
        return light if self.background is None else replace(light, background=self.background)

    @property
    def searched_frames(self) -> int:
        """How many states a search records for its films, at most."""
        return SEARCHED_FRAMES if self.film_frames is None else self.film_frames

    @field_validator("look_at")
    @classmethod
    def _check_place(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value == info.data.get("camera"):
            raise field_error((), value, "another place than camera")
        return value

    def in_scene(self, dimension: int, solids: Sequence[str], path: FieldPath = ()) -> "Picture":
        """This table, at a path, for 2 or 3 dimensions and solids of these names."""
        for name in ("camera", "look_at", "camera_path"):
            value = getattr(self, name)
            if value is not None and dimension == 2:
                found = Words("a table") if name == "camera_path" else value
                raise field_error((*path, name), found, "left out, as the scene has 2 dimensions")
        if self.camera_path is not None:
            self.camera_path.check_solids(solids, (*path, "camera_path"))
        return self
