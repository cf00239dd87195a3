"""Keys that all solids of a scene have."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Hollow, Placed, Solid
from cortado.scene.appearance import FINISHES, Coloured, Finish
from cortado.scene.courses import WAYS, Interpolation, Ramp, check_motion
from cortado.scene.shape_tables import Container, File, surface_cells
from cortado.scene.tables import (
    Colour,
    FieldPath,
    Inertia,
    Length,
    OneOf,
    Radii,
    Rotation,
    Text,
    Turning,
    check_name,
    quantity,
    rotation_matrix,
)


class SolidTable(Coloured):
    """A solid of any shape, which fluid cannot enter."""

    measures: ClassVar[tuple[str, ...]] = ()
    least_thickness: ClassVar = 1.0
    is_sheet: ClassVar = False
    materials: ClassVar = FINISHES
    plain: ClassVar = (0.55, 0.55, 0.58)

    name: Text
    """Name by which other tables refer to the solid."""
    position: tuple[Length, ...] | None = None
    """(d,) Position of the centroid of its volume [m]; if left out, the other keys of the shape determine it."""
    rotation: Rotation | None = None
    """Initial rotation about the centroid [rad]; not rotated if left out. In 3-D a rotation vector, in 2-D one number,
    counterclockwise."""
    motion: Literal["fixed", "path", "free"] = "fixed"
    """How the solid moves. "fixed": not at all. "path": along `times` with `positions` or `rotations`, along the file
    `path`, or at a steady `velocity` or `angular_velocity`. "free": as a rigid body moved by fluid and gravity."""
    density: Annotated[float, quantity("kg/m3", gt=0.0)] | None = None
    """Density of a free body: its mass divided by its volume [kg/m³]."""
    mass: Annotated[float, quantity("kg", gt=0.0)] | None = None
    """Mass of a free body, in place of its density [kg]; in 2-D the mass per metre of depth."""
    centre_of_mass: tuple[Length, ...] | None = None
    """(d,) Vector from the centroid of a free body's volume to its centre of mass, in the body's frame [m]; 0 if left
    out."""
    gyration_radius: Radii | None = None
    """(3,) Radii of gyration of a free body about the axes of its frame through its centre of mass, in 2-D one number
    [m]: square roots of moment of inertia over mass. If left out, those of a homogeneous body."""
    inertia: Inertia | None = None
    """Moments of inertia of a free body about its centre of mass [kg m²], in place of its radii of gyration. In 2-D one
    number, per metre of depth. In 3-D three numbers, about the axes of its frame, or the nine of a matrix, row by
    row."""
    freedom: tuple[Annotated[str, OneOf(sorted({*WAYS[2], *WAYS[3]}))], ...] | None = None
    """Directions in which a free body can move, along the axes of space; all if left out. The names are "x", "y" and
    "rotation", in 3-D "x", "y", "z", "rotation_x", "rotation_y" and "rotation_z"."""
    friction: Annotated[float, quantity(ge=0.0)] | None = None
    """Coefficient of Coulomb friction of a free body where it touches something; 0 if left out. Between two free bodies
    the mean of both coefficients acts."""
    restitution: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Coefficient of restitution of a free body: its speed after a hit over its speed before; 0.6 if left out. Between
    two free bodies the mean of both coefficients acts."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of the path, increasing from 0 on [s]; after the last time the solid rests."""
    positions: tuple[tuple[Length, ...], ...] | None = None
    """(k, d) Positions of the middle (the centroid) at these times [m]; the first is the position at the start."""
    rotations: tuple[Rotation, ...] | None = None
    """(k, 3) Rotation vectors since the start at these times, in 2-D (k,) angles [rad]; the first is 0."""
    path: File | None = None
    """A CSV file in place of `times`, with columns such as time [s], x [mm], y [mm] and rotation [deg], in 3-D
    rotation_x [deg] and so on. Only differences from its first line matter; a missing column means 0. A relative path
    starts at the scene file's folder."""
    interpolation: Interpolation = "linear"
    """Curve between the times: straight lines, or a cubic spline. The spline has continuous velocity and acceleration,
    and zero velocity at both ends."""
    ramp: Ramp | None = None
    """Duration of the ramp [s]: from 0 to this time, the path is multiplied by a factor that grows smoothly (C2) from 0
    to 1."""
    velocity: tuple[Annotated[float, quantity("m/s")], ...] | None = None
    """(d,) Velocity of the middle [m/s], constant; for a free body, the velocity of its centre of mass at the start."""
    angular_velocity: Turning | None = None
    """Angular velocity about the middle [rad/s], constant; for a free body, the angular velocity at the start. In 3-D a
    vector, in 2-D one number, counterclockwise."""
    surface_velocity: tuple[Annotated[float, quantity("m/s")], ...] | None = None
    """(d,) Velocity of a surface that slides along a shape at rest, such as a conveyor belt, in the solid's frame
    [m/s]."""
    side: Literal["outside", "inside"] = "outside"
    """Side on which fluid may be: outside of the shape, or inside, as in a tank."""
    slip: Literal["free", "no"] = "free"
    """"no": the viscous force acts between fluid and solid; "free": it does not."""
    material: Annotated[str, OneOf(tuple(FINISHES))] | None = None
    """Look of the solid in pictures: its colour, its transparency and its reflections."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue, each from 0 to 1, in linear light. If left out, the colour of the
    material, or [0.55, 0.55, 0.58] without a material."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Fraction of the light that passes through the solid in pictures, from 0 to 1. If left out, the transparency of
    the material; without a material 0, or 1 if fluid is inside."""

    @property
    def finish(self) -> Finish:
        plain = Finish(self.plain, transparency=float(self.side == "inside"))
        own = plain if self.material is None else FINISHES[self.material]
        clear = own.transparency if self.transparency is None else self.transparency
        return replace(own, colour=self.colour or own.colour, transparency=clear)

    @property
    def sticks(self) -> bool:
        return self.slip == "no"

    @property
    def is_steady(self) -> bool:
        """Return True if the solid's position is not a table over time."""
        return self.times is None and self.path is None

    @property
    def moves(self) -> bool:
        return self.motion != "fixed" or self.surface_velocity is not None

    def centroid(self) -> Points:
        """Return the centroid (d,) of the solid's volume at the start [m]."""
        return self.shape_about()[1] if self.position is None else np.array(self.position)

    def middle(self) -> Points:
        """Return the middle (d,) of the solid at the start [m]: its centre of mass if given, else its centroid."""
        return self.centroid() + self._arm()

    def moved(self, middle: Points, rotation: tuple[float, ...]) -> Self:
        """Return the solid with its middle (d,) at a position [m] and a rotation [rad] as in `rotation`."""
        turned = self.model_copy(update={"rotation": rotation})
        return turned.model_copy(update={"position": tuple((middle - turned._arm()).tolist())})

    def _arm(self) -> Points:
        """Return the vector (d,) from the centroid to the middle at the start [m]; zero (1,) if they are equal."""
        arm = self.centre_of_mass
        return np.zeros(1) if arm is None else np.asarray(self.turn(len(arm)) @ np.array(arm))

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """Return the unrotated shape with its centroid at the origin, and the centroid (d,) that its keys imply [m]."""

    def shown_shape(self, spacing: float) -> Solid:
        return self.shape_about()[0]

    def stretched(self, scale: float) -> Self:
        if scale == 1.0:
            return self
        grown = {name: _times(scale, getattr(self, name)) for name in self.measures}
        return self.model_copy(update={**grown, "position": tuple(self.centroid().tolist())})

    def thinnest(self, spacing: float) -> float:
        """Return the thickness of the thinnest part [m]; infinite for planes and sheets, and for a mesh without sheets
        thinner than a few spacings."""
        return np.inf

    def in_container(self, container: Container, path: FieldPath) -> Self:
        """Return the table, found at ``path``, with unbounded shapes cut to the container."""
        return self

    def wall_count(self, spacing: float) -> float:
        return surface_cells(*self.shape_about()[0].extent(), spacing)

    def solid(self) -> Solid:
        """Return the region without fluid: the body, or for a tank the outside of the body."""
        return Hollow(self.body()) if self.side == "inside" else self.body()

    def own_solid(self) -> Solid:
        """Return the region without fluid, unrotated with the middle at the origin."""
        shape = self.shape_about()[0]
        if self.centre_of_mass is not None:
            return Placed(shape, -np.array(self.centre_of_mass), np.eye(len(self.centre_of_mass)))
        return Hollow(shape) if self.side == "inside" else shape

    def body(self) -> Solid:
        centroid = self.centroid()
        return Placed(self.shape_about()[0], centroid, self.turn(len(centroid)))

    def turn(self, dimension: int) -> NDArray[np.float64]:
        return rotation_matrix(self.rotation or (0.0,) * (2 * dimension - 3))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("position", "velocity", "surface_velocity", "centre_of_mass"), dimension, path)
        self._check_turns(("rotation", "angular_velocity", "gyration_radius"), dimension, path)
        check_motion(self, dimension, path)
        return super().in_dimension(dimension, path)


def thick(tables: Sequence[SolidTable]) -> tuple[SolidTable, ...]:
    return tuple(table for table in tables if not table.is_sheet)


def check_free_body(path: FieldPath, name: str, tables: Sequence[SolidTable]) -> None:
    free = [table.name for table in tables if table.motion == "free"]
    check_name(path, name, free, "a free body", 'of a solid whose motion is "free"')


def solids_of(tables: tuple[SolidTable, ...]) -> tuple[Solid, ...]:
    return tuple(table.solid() for table in tables)


def _times(scale: float, value: Any) -> Any:
    return tuple(_times(scale, part) for part in value) if isinstance(value, tuple) else scale * value
