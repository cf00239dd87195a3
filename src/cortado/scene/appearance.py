"""Materials, lights, cameras, and the tables [picture] and [render]. Colours are linear, from 0 to 1."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializationInfo, ValidationInfo, field_serializer, field_validator, model_validator

from cortado.calls import public
from cortado.discretise.shapes import Points
from cortado.errors import Words
from cortado.scene.parameters import NAMES
from cortado.scene.tables import (
    MISSING,
    Colour,
    FieldPath,
    Flag,
    Length,
    OneOf,
    Table,
    Text,
    components,
    count,
    field_error,
    quantity,
)

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Liquid:
    """Optical properties of a fluid in pictures. Light in fluid follows the Beer-Lambert law."""

    colour: Numbers
    """Colour of scattered light. Over the length 1 / absorption, absorption also gives white light this colour."""
    scattering: float
    """Scattering coefficient [1/m]. Over a length L the fraction exp(-scattering L) of the light is not scattered."""
    absorption: float
    """Absorption coefficient [1/m]. Over a length L the fraction colour^(absorption L) of the light is not absorbed."""


@dataclass(frozen=True)
class Finish:
    colour: Numbers
    transparency: float = 0.0
    reflectivity: float = 0.0
    """Fraction of light that the surface reflects like a coloured mirror."""


LIQUIDS = {
    "water": Liquid(colour=(0.10, 0.35, 0.65), scattering=0.02, absorption=0.15),
    "milk": Liquid(colour=(0.93, 0.90, 0.83), scattering=1500.0, absorption=100.0),
    "coffee": Liquid(colour=(0.12, 0.035, 0.008), scattering=30.0, absorption=50.0),
    "honey": Liquid(colour=(0.80, 0.36, 0.03), scattering=3.0, absorption=25.0),
    "oil": Liquid(colour=(0.80, 0.62, 0.08), scattering=1.0, absorption=15.0),
}
FINISHES = {
    "glass": Finish(colour=(0.72, 0.86, 0.82), transparency=0.92),
    "steel": Finish(colour=(0.62, 0.61, 0.59), reflectivity=0.75),
}


class Coloured(Table):
    """Base of tables with a colour. The default is the colour of the material, or ``plain`` without a material."""

    materials: ClassVar[Mapping[str, Any]]
    plain: ClassVar[Numbers]

    @model_validator(mode="after")
    def _take_colour(self) -> Self:
        own: Any = self
        if own.colour is None:
            self.__dict__["colour"] = self.plain if own.material is None else self.materials[own.material].colour
            self.model_fields_set.discard("colour")
        return self

    @field_serializer("colour", check_fields=False)
    def _given_colour(self, colour: Colour, info: SerializationInfo) -> Colour | None:
        return colour if "colour" in self.model_fields_set or info.context == "colours" else None


@dataclass(frozen=True)
class Light:
    """Light of a picture: the sun, the sky, and a weak strip of light opposite the sun."""

    azimuth: float
    """Horizontal angle of the sun to the right of the camera's initial viewing direction [degrees]."""
    elevation: float
    """Angle of the sun above the floor [degrees]."""
    lamp: Numbers
    strip: Numbers
    sunlight: Numbers
    """Brightness (3,) of sunlight on a white surface that faces the sun: red, green and blue."""
    shadow: float
    """Fraction of the light on the floor that comes from the sun."""
    background: Numbers
    zenith: Numbers
    """Colour of the sky overhead, divided by its colour at the horizon."""


LIGHTS = {  # in the order of the keys of `Light`
    "studio": Light(
        -62.0, 50.0, (7.0, 6.8, 6.4), (1.6, 1.7, 1.8), (0.62, 0.60, 0.57), 0.48, (0.74, 0.77, 0.80), (0.62, 0.72, 0.84)
    ),
    "noon": Light(
        -50.0, 68.0, (9.0, 8.7, 8.0), (0.0, 0.0, 0.0), (0.78, 0.75, 0.68), 0.58, (0.62, 0.73, 0.86), (0.36, 0.56, 0.86)
    ),
    "evening": Light(
        -78.0, 20.0, (9.0, 5.2, 2.4), (0.5, 0.6, 0.9), (0.90, 0.55, 0.28), 0.50, (0.76, 0.58, 0.46), (0.42, 0.60, 1.05)
    ),
    "overcast": Light(
        -62.0, 60.0, (0.0, 0.0, 0.0), (0.4, 0.4, 0.4), (0.12, 0.12, 0.12), 0.12, (0.62, 0.65, 0.68), (1.15, 1.15, 1.15)
    ),
}


@dataclass(frozen=True)
class View:
    eye: Points
    """Position of the camera (3,) [m]."""
    look_at: Points
    """Point in the middle of the picture (3,) [m]."""


@dataclass(frozen=True)
class Moment:
    share: float
    """Elapsed fraction of the film, from 0 to 1."""
    time: float
    """Time of the run [s]."""
    up: Points
    """Unit vector (3,) opposite to gravity."""
    solids: Mapping[str, NDArray]
    """Current centre (3,) [m] of each solid, by the solid's name."""


class CameraPath(Table):
    goes_around: ClassVar[bool] = False
    """True if the camera sees the scene from all sides along its path."""
    kind: str
    """Name of the kind of path."""

    def view(self, home: View, moment: Moment) -> View:
        """Return the view of the camera at a moment of the film. ``home`` is the view of a camera at rest."""
        raise NotImplementedError

    def check_solids(self, names: Sequence[str], path: FieldPath = ()) -> None: ...


@public
class Orbit(CameraPath):
    """A circular camera path around the middle of the picture, at constant height and distance."""

    goes_around: ClassVar[bool] = True
    kind: Literal["orbit"] = "orbit"
    turns: Annotated[float, quantity(ge=-100.0, le=100.0)] = 1.0
    """Number of turns during the film. Seen from above, positive turns are counterclockwise."""

    def view(self, home: View, moment: Moment) -> View:
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(2.0 * np.pi * self.turns * moment.share * moment.up)
        return View(home.look_at + turn.apply(home.eye - home.look_at), home.look_at)


@public
class Dolly(CameraPath):
    """A straight camera path towards the middle of the picture, or away from it. The camera starts and stops gently."""

    kind: Literal["dolly"] = "dolly"
    distance: Annotated[float, quantity(gt=0.0, le=100.0)] = 0.6
    """Final distance of the camera from the middle of the picture, as a multiple of the camera's initial distance."""

    def view(self, home: View, moment: Moment) -> View:
        factor = self.distance ** (moment.share * moment.share * (3.0 - 2.0 * moment.share))
        return View(home.look_at + factor * (home.eye - home.look_at), home.look_at)


@public
class Keyframes(CameraPath):
    """A smooth camera path through given positions at given times of the run."""

    kind: Literal["keyframes"] = "keyframes"
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...]
    """(k,) Times of the run, increasing [s]. The camera rests before the first and after the last time."""
    cameras: tuple[tuple[Length, ...], ...]
    """(k, 3) Positions of the camera at `times` [m]."""
    look_at: tuple[tuple[Length, ...], ...] | None = None
    """(k, 3) Points in the middle of the picture at `times` [m]; if left out, the camera looks at one fixed point."""

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

    def _at(self, time: float, rows: Sequence[tuple[float, ...]]) -> Points:
        from scipy.interpolate import PchipInterpolator

        return np.asarray(PchipInterpolator(self.times, rows)(np.clip(time, self.times[0], self.times[-1])))


@public
class Follow(CameraPath):
    """A camera path that moves with a solid and looks at its centre from a fixed direction and distance."""

    kind: Literal["follow"] = "follow"
    solid: Text
    """Name of the solid that the camera follows."""
    distance: Annotated[float, quantity(gt=0.0, le=100.0)] = 1.0
    """Distance of the camera from the solid, as a multiple of the viewing distance of a camera at rest."""

    def view(self, home: View, moment: Moment) -> View:
        middle = np.asarray(moment.solids[self.solid])
        return View(middle + self.distance * (home.eye - home.look_at), middle)

    def check_solids(self, names: Sequence[str], path: FieldPath = ()) -> None:
        if self.solid not in names:
            wanted = f"the name of a solid: {', '.join(names)}" if names else "left out, as the scene has no solids"
            raise field_error((*path, "solid"), self.solid, wanted)


AnyCameraPath = Annotated[Orbit | Dolly | Keyframes | Follow, Field(discriminator="kind")]
COLOURS = ("phase", *NAMES, "age")
Place = Annotated[tuple[Length, ...], components("x", "y", "z")]


class Picture(Table):
    """Settings for the shaded pictures and films of `cortado run`, `optimise` and `picture`. Missing keys get suitable
    values."""

    width: Annotated[int, count(64, 7680)] = 1280
    """Width of the picture in pixels."""
    height: Annotated[int, count(64, 4320)] = 720
    """Height of the picture in pixels."""
    surface: Literal["liquid", "spheres"] = "liquid"
    """"liquid" draws the surface of the fluid; "spheres" draws a sphere for each particle, in 3-D."""
    quality: Literal["traced", "quick"] | None = None
    """Quality of pictures in 3-D. "traced" follows light into the fluid and out again up to three times. "quick"
    follows light once, on a coarser surface, and takes about half the time. If left out, films of `cortado run` and
    `optimise` are quick, and all other pictures are traced."""
    camera: Place | None = None
    """(3,) Position of the camera [m], in 3-D; if left out, the camera sees the whole container."""
    camera_path: AnyCameraPath | None = None
    """Path of the camera during a run, for films and single pictures in 3-D. If left out, the camera stays in place."""
    look_at: Place | None = None
    """(3,) Point in the middle of the picture [m], in 3-D; if left out, the middle of the container."""
    field_of_view: Annotated[float, quantity("degrees", gt=0.0, le=120.0)] = 28.0
    """Horizontal angle of view [degrees], in 3-D."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Fraction of light that passes through a layer of fluid, from 0 to 1, in 3-D. The layer is a tenth as thick as the
    container is long. The default is 0.9 for a single phase in its own colour, and otherwise 0."""
    floor: Flag = True
    """Whether the picture shows a floor, in 3-D."""
    light: Annotated[str, OneOf(LIGHTS)] = "studio"
    """Sun and sky, in 3-D: "studio", "noon", "evening" or "overcast"."""
    background: Colour | None = None
    """(3,) Colour behind the scene: red, green and blue, linear, each from 0 to 1; if left out, the colour of the
    light."""
    colour: Annotated[str, OneOf(COLOURS)] = "phase"
    """Colours of particles: "phase" for the colours of the phases, or the name of a quantity on a colour scale. "age"
    is the time since a particle left an emitter, or since the start of the run."""
    shaded: Flag = True
    """Whether the fluid is drawn with light and shadow. If false, fluid has exactly the colours of the colour scale."""
    film_frames: Annotated[int, count(0, 1_000_000)] | None = None
    """Number of frames of a film, evenly chosen from the recorded states. If left out, a film has 25 frames per second.
    With 0 no film is made. A search records `film_frames` states for its films, by default 121."""
    film_speed: Annotated[float, quantity(gt=0.0)] | None = None
    """Simulated seconds per second of the film; 1 is real time. If left out, the film runs in real time, or at a speed
    for a length of 4 to 10 s."""

    @property
    def sun_and_sky(self) -> Light:
        light = LIGHTS[self.light]
        return light if self.background is None else replace(light, background=self.background)

    @property
    def for_films(self) -> "Picture":
        return self.model_copy(update={"quality": self.quality or "quick"})

    @property
    def searched_frames(self) -> int:
        return 121 if self.film_frames is None else self.film_frames

    @field_validator("look_at")
    @classmethod
    def _check_place(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value == info.data.get("camera"):
            raise field_error((), value, "another place than camera")
        return value

    def in_scene(self, dimension: int, solids: Sequence[str], path: FieldPath = ()) -> "Picture":
        for name in ("camera", "look_at", "camera_path"):
            value = getattr(self, name)
            if value is not None and dimension == 2:
                found = Words("a table") if name == "camera_path" else value
                raise field_error((*path, name), found, "left out, as the scene has 2 dimensions")
        if self.camera_path is not None:
            self.camera_path.check_solids(solids, (*path, "camera_path"))
        return self


Pixels = Annotated[tuple[Annotated[int, count(8, 4096)], ...], components("columns", "rows")]


class Render(Table):
    """The view and the camera of a differentiable picture."""

    view: Literal["top", "volume", "plane"] = "top"
    """"top" looks from above, "volume" looks through a camera, and "plane" shows a plane (default in 2-D)."""
    resolution: Pixels = (128, 128)
    """(2,) Width and height of the picture in pixels."""
    background: Colour = (1.0, 1.0, 1.0)
    """(3,) Background colour: red, green and blue, each from 0 to 1."""
    extinction: Annotated[float, quantity("1/m", gt=0.0)] | None = None
    """Extinction coefficient of the fluid [1/m]; if left out, the renderer chooses a value."""
    position: Place | None = Field(default=None, validate_default=True)
    """(3,) Position of the camera [m]; required for the view "volume"."""
    look_at: Place | None = Field(default=None, validate_default=True)
    """(3,) Point in the middle of the picture [m]; required for the view "volume"."""
    field_of_view: Annotated[float, quantity("degrees", gt=0.0, le=170.0)] | None = Field(
        default=None, validate_default=True
    )
    """Horizontal angle of view [degrees], for the view "volume"; 40 if left out."""

    @field_validator("position", "look_at", "field_of_view")
    @classmethod
    def _check_camera(cls, value: Any, info: ValidationInfo) -> Any:
        view = info.data.get("view")
        if value is not None and view in ("top", "plane"):
            raise field_error((), value, f'left out, as the view is "{view}": only the view "volume" has a camera')
        if value is None and view == "volume":
            if info.field_name == "field_of_view":
                return 40.0
            raise field_error((), MISSING, 'a list of 3 components: x, y and z, as the view is "volume"')
        if value is not None and info.field_name == "look_at" and value == info.data.get("position"):
            raise field_error((), value, "another place than position")
        return value

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2 and "view" not in self.model_fields_set:
            return self.model_copy(update={"view": "plane"})
        if (self.view == "plane") != (dimension == 2):
            wanted = '"plane", as the scene has 2 dimensions' if dimension == 2 else '"top" or "volume" in 3-D'
            raise field_error((*path, "view"), self.view, wanted)
        return self
