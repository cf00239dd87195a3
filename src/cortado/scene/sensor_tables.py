"""Tables of sensors. A sensor records measured values in every time step."""

import unicodedata
from typing import Annotated, Literal

from pydantic import Field, field_validator

from cortado.scene.shape_tables import Ordered
from cortado.scene.tables import Direction, Length, OnAxes, Table, Text, Vector, field_error, quantity

Reach = Annotated[float, quantity("m", gt=0.0)] | None
Axes = Literal["world", "body"]


class SensorTable(Table):
    """A sensor that records measured values in every time step."""

    name: Text
    """Name of the sensor. Column names in sensors.csv begin with the name of the sensor."""
    kind: str
    """Kind of the sensor."""

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        plain = unicodedata.normalize("NFKC", name).strip()
        if plain[:1] in tuple("=+-@") or not name.isprintable():
            wanted = "one line of text that begins with none of = + - @, as it heads a column of a table"
            raise field_error((), name, wanted)
        return name


class PressureProbeTable(SensorTable):
    """A sensor of the mean pressure of the particles around a point."""

    kind: Literal["pressure_probe"]
    position: Vector[Length]
    """(d,) Position of the point [m]."""
    radius: Reach = None
    """Radius around the point [m]; the support radius of the smoothing kernel if left out."""
    on: Text | None = None
    """Name of a moving solid that carries the point along."""


class WaveGaugeTable(SensorTable):
    """A sensor of the height of the free surface in a vertical column."""

    kind: Literal["wave_gauge"]
    position: Vector[Length]
    """(d,) A point on the axis of the column [m]; its height has no effect."""
    floor: Length = 0.0
    """Height of the column's lower end [m], measured upwards against gravity; usually the height of the container's
    bottom."""
    radius: Reach = None
    """Radius of the column [m]. The default is two support radii, but at least five spacings."""
    on: Text | None = None
    """Name of a moving solid that carries the column along."""
    axes: Axes = "world"
    """Axes of a column that a solid carries. With "body", the column rotates with the solid, and heights are measured
    along the solid's axes. With "world", the column stays upright, and heights are measured along the scene's axes."""


class FlowRateTable(SensorTable):
    """A sensor of the volume of fluid that flows through a plane per second."""

    kind: Literal["flow_rate"]
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    normal: Direction
    """(d,) Direction of positive flow."""
    reach: Reach = None
    """Half the thickness of the measured layer of fluid [m]. The default is two support radii, but at least five
    spacings."""


class WallForceTable(SensorTable, Ordered):
    """A sensor of the force and torque of the fluid on walls in a region."""

    kind: Literal["wall_force"]
    lower: OnAxes[Length] = None
    """(d,) Lower corner of the region [m]; if left out, the region has no lower end."""
    upper: OnAxes[Length] = None
    """(d,) Upper corner of the region [m]; if left out, the region has no upper end."""
    about: OnAxes[Length] = None
    """(d,) Reference point of the torque [m]; the origin if left out."""
    on: Text | None = None
    """Name of a moving solid that carries the region and the reference point along."""
    axes: Axes = "world"
    """Axes of force and torque: "world", or "body" for axes that rotate with the solid named by `on`."""


class SolidLoadTable(SensorTable):
    """A sensor of the force and torque of the fluid on a solid. The torque is about the solid's middle."""

    kind: Literal["solid_load"]
    solid: Text
    """Name of the solid."""
    axes: Axes = "world"
    """Axes of force and torque: "world", or "body" for axes that rotate with the solid."""


class SpringForceTable(SensorTable):
    """A sensor of the tension and the length of a spring."""

    kind: Literal["spring_force"]
    spring: Text
    """Name of the spring."""


class BodyMotionTable(SensorTable):
    """A sensor of the position, rotation, velocity and angular velocity of a free body."""

    kind: Literal["body_motion"]
    solid: Text
    """Name of the free body."""


_OfFluid = PressureProbeTable | WaveGaugeTable | FlowRateTable | WallForceTable | SolidLoadTable
AnySensor = Annotated[_OfFluid | SpringForceTable | BodyMotionTable, Field(discriminator="kind")]
