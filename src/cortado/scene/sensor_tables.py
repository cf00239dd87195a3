"""Tables of sensors, which record numbers of a run in every step."""

import unicodedata
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from cortado.scene.shape_tables import check_order
from cortado.scene.tables import FieldPath, Length, Table, Text, Vector, field_error, quantity

Reach = Annotated[float, quantity("m", gt=0.0)] | None
Corner = tuple[Length, ...] | None
Axes = Literal["world", "body"]


class SensorTable(Table):
    """A sensor that records numbers of the fluid in every step."""

    name: Text
    """Name of the sensor; the names of its columns in sensors.csv begin with it."""

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        """Refuse a name that a spreadsheet takes for a formula, also with a full-width sign."""
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
    """Kind of the sensor."""
    position: Vector[Length]
    """(d,) Position of the point [m]."""
    radius: Reach = None
    """Radius within which particles contribute [m]; the support radius if left out."""
    on: Text | None = None
    """Name of a moving solid that carries the point along, from its position at the start of the scene."""


class WaveGaugeTable(SensorTable):
    """A sensor of the height of the fluid's surface: the level to which the fluid in a vertical column would fill the
    space that solids leave free."""

    kind: Literal["wave_gauge"]
    """Kind of the sensor."""
    position: Vector[Length]
    """(d,) A point on the axis of the column [m]; its height has no effect."""
    floor: Length = 0.0
    """Height at which the column begins [m], measured against gravity; usually the bottom of the container."""
    radius: Reach = None
    """Radius of the column [m]; two support radii, but at least five spacings, if left out."""
    on: Text | None = None
    """Name of a moving solid that carries the column along, from its position at the start of the scene."""
    axes: Axes = "world"
    """Axes of a column carried by a solid. "body": the column turns with the solid, and heights are heights in the
    solid at the start. "world": the column stays upright, and heights are heights in the scene."""


class FlowRateTable(SensorTable):
    """A sensor of the volume of fluid that flows through a plane per second."""

    kind: Literal["flow_rate"]
    """Kind of the sensor."""
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    normal: Vector[Annotated[float, quantity()]]
    """(d,) Direction in which the flow counts as positive."""
    reach: Reach = None
    """Half the thickness of the measured layer of fluid [m]; two support radii, but at least five spacings, if left
    out."""

    @field_validator("normal")
    @classmethod
    def _check_normal(cls, normal: tuple[float, ...]) -> tuple[float, ...]:
        if not any(normal):
            raise field_error((), normal, "a vector that is not zero")
        return normal


class WallForceTable(SensorTable):
    """A sensor of the force, and its torque, that the fluid in a region exerts on the walls."""

    kind: Literal["wall_force"]
    """Kind of the sensor."""
    lower: Corner = None
    """(d,) Lower corner of the region [m]; if left out, the region has no lower end."""
    upper: Corner = None
    """(d,) Upper corner of the region [m]; if left out, the region has no upper end."""
    about: Corner = None
    """(d,) Reference point of the torque [m]; the origin if left out."""
    on: Text | None = None
    """Name of a moving solid that carries and turns the region and the reference point from their initial positions."""
    axes: Axes = "world"
    """Axes of force and torque for a region on a solid: "world", or "body" for axes that turn with the solid."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.lower is not None and self.upper is not None:
            check_order(self.lower, self.upper)
        return self


class SolidLoadTable(SensorTable):
    """A sensor of the fluid's force on a solid, and of its torque about the solid's middle."""

    kind: Literal["solid_load"]
    """Kind of the sensor."""
    solid: Text
    """Name of the solid."""
    axes: Axes = "world"
    """Axes of force and torque: "world", or "body" for axes that turn with the solid."""


class SpringForceTable(SensorTable):
    """A sensor of the force with which a spring pulls, and of the spring's length."""

    kind: Literal["spring_force"]
    """Kind of the sensor."""
    spring: Text
    """Name of the spring."""


class BodyMotionTable(SensorTable):
    """A sensor of a free body's position, rotation, velocity and angular velocity."""

    kind: Literal["body_motion"]
    """Kind of the sensor."""
    solid: Text
    """Name of the body."""


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
