"""The tables of sensors, which read numbers of a run in every step."""

import unicodedata
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from cortado.scene.shape_tables import check_order
from cortado.scene.tables import FieldPath, Length, Table, Text, Vector, field_error, quantity

Reach = Annotated[float, quantity("m", gt=0.0)] | None
Corner = tuple[Length, ...] | None
Axes = Literal["world", "body"]


class SensorTable(Table):
    """A sensor that reads numbers of the fluid in every step."""

    name: Text
    """Beginning of the names of its columns in sensors.csv."""

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        """Refuse a name that begins with a sign, wide ones too, by which a spreadsheet would run a formula."""
        plain = unicodedata.normalize("NFKC", name).strip()
        if plain[:1] in tuple("=+-@") or not name.isprintable():
            wanted = "one line of text that begins with none of = + - @, as it heads a column of a table"
            raise field_error((), name, wanted)
        return name

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("lower", "upper", "about"), dimension, path)
        return super().in_dimension(dimension, path)


class PressureProbeTable(SensorTable):
    """A sensor of the mean pressure of the particles around a point."""

    kind: Literal["pressure_probe"]
    """Which sensor it is."""
    position: Vector[Length]
    """(d,) the point [m]."""
    radius: Reach = None
    """How far away particles count [m]; the support radius if left out."""
    on: Text | None = None
    """The name of a solid that moves, which carries the point from where it is as the scene begins."""


class WaveGaugeTable(SensorTable):
    """A sensor of the height of the fluid's surface at a place: the level to which its volume in a column fills the
    room that solids leave there."""

    kind: Literal["wave_gauge"]
    """Which sensor it is."""
    position: Vector[Length]
    """(d,) a point of the middle of the column [m]; its height does not matter."""
    floor: Length = 0.0
    """From where on the column is filled [m], against gravity: the bottom of the container as a rule."""
    radius: Reach = None
    """Radius of the column [m]; two support radii, but at least five spacings, if left out."""
    on: Text | None = None
    """The name of a solid that moves, which carries the column from where it is as the scene begins."""
    axes: Axes = "world"
    """Along which axes a column on a solid stands. "body": it turns with the solid, and its height is that in the
    solid, as that begins. "world": it stands upright, and its height is that in the scene."""


class FlowRateTable(SensorTable):
    """A sensor of the volume of fluid that goes through a plane in a second."""

    kind: Literal["flow_rate"]
    """Which sensor it is."""
    position: Vector[Length]
    """(d,) a point of the plane [m]."""
    normal: Vector[Annotated[float, quantity()]]
    """(d,) the direction in which the flow is positive."""
    reach: Reach = None
    """Half of the thickness of the layer that counts [m]; two support radii, but at least five spacings, if left
    out."""

    @field_validator("normal")
    @classmethod
    def _check_normal(cls, normal: tuple[float, ...]) -> tuple[float, ...]:
        if not any(normal):
            raise field_error((), normal, "a vector that is not zero")
        return normal


class WallForceTable(SensorTable):
    """A sensor of the force, and its torque, with which the fluid in a region pushes the walls."""

    kind: Literal["wall_force"]
    """Which sensor it is."""
    lower: Corner = None
    """(d,) lower corner of the region [m]; without an end there if left out."""
    upper: Corner = None
    """(d,) upper corner of the region [m]; without an end there if left out."""
    about: Corner = None
    """(d,) the point of the torque [m]; the origin if left out."""
    on: Text | None = None
    """The name of a solid that moves, which carries and turns the region and the point from where they are as the scene
    begins."""
    axes: Axes = "world"
    """The axes of force and torque of a region on a solid: "world", or "body", those that turn with the solid."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.lower is not None and self.upper is not None:
            check_order(self.lower, self.upper)
        return self


class SolidLoadTable(SensorTable):
    """A sensor of the force of the fluid on a solid, and its torque about the solid's position."""

    kind: Literal["solid_load"]
    """Which sensor it is."""
    solid: Text
    """The name of the solid."""
    axes: Axes = "world"
    """The axes of force and torque: "world", or "body", those that turn with the solid."""


class SpringForceTable(SensorTable):
    """A sensor of the force with which a spring pulls, and of its length."""

    kind: Literal["spring_force"]
    """Which sensor it is."""
    spring: Text
    """The name of the spring."""


class BodyMotionTable(SensorTable):
    """A sensor of where a free body is, how it is turned, and how fast it goes and turns."""

    kind: Literal["body_motion"]
    """Which sensor it is."""
    solid: Text
    """The name of the body."""


AnySensor = Annotated[
    PressureProbeTable
    | WaveGaugeTable
    | FlowRateTable
    | WallForceTable
    | SolidLoadTable
    | SpringForceTable
    | BodyMotionTable,
    Field(discriminator="kind"),
]
