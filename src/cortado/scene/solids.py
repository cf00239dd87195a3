"""Solids, which fluid flows around or is held by: what all have."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Hollow, Placed, Solid
from cortado.scene.appearance import FINISHES, Coloured, Finish
from cortado.scene.courses import WAYS, Interpolation, Ramp, check_motion
from cortado.scene.shape_tables import Container, File
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
    check_turn,
    quantity,
    rotation_matrix,
)


class SolidTable(Coloured):
    """A solid, which fluid cannot enter, of any shape."""

    measures: ClassVar[tuple[str, ...]] = ()
    """Fields with which its shape grows."""
    least_thickness: ClassVar = 1.0
    """Least thickness, in spacings."""
    is_sheet: ClassVar = False
    """True for a wall of no thickness."""
    materials: ClassVar = FINISHES
    plain: ClassVar = (0.55, 0.55, 0.58)

    name: Text
    """Name by which other tables refer to it."""
    position: tuple[Length, ...] | None = None
    """(d,) Where the centroid of its volume is [m]; left out, it is where its measures put it."""
    rotation: Rotation | None = None
    """How it is turned about its middle [rad], not at all if left out: in 3-D a rotation vector, in 2-D one number,
    counterclockwise."""
    motion: Literal["fixed", "path", "free"] = "fixed"
    """How it moves. "fixed": not at all. "path": by `times` with `positions` or `rotations`, by the file `path`, or
    with a steady `velocity` or `angular_velocity`. "free": as a rigid body, which fluid and gravity move."""
    density: Annotated[float, quantity("kg/m3", gt=0.0)] | None = None
    """Density of a free body: its mass over its volume [kg/m³]."""
    mass: Annotated[float, quantity("kg", gt=0.0)] | None = None
    """Mass of a free body, in place of its density; in 2-D that of a metre of it [kg]."""
    centre_of_mass: tuple[Length, ...] | None = None
    """(d,) Where the centre of mass of a free body is, from the centroid of its volume and along its own axes [m]; 0 if
    left out."""
    gyration_radius: Radii | None = None
    """(3,) Radii of gyration of a free body about its own axes through its centre of mass, in 2-D one number: roots of
    its moments of inertia over its mass [m]. If left out they are those of its shape."""
    inertia: Inertia | None = None
    """Moments of inertia of a free body about its centre of mass [kg m²], in place of its radii of gyration. In 2-D
    one number, that of a metre of it. In 3-D three, about its own axes, or the nine of a matrix, row by row."""
    freedom: tuple[Annotated[str, OneOf(sorted({*WAYS[2], *WAYS[3]}))], ...] | None = None
    """Ways in which a free body can move, all if left out: of "x", "y" and "rotation", in 3-D of "x", "y", "z",
    "rotation_x", "rotation_y" and "rotation_z", along the axes of space."""
    friction: Annotated[float, quantity(ge=0.0)] | None = None
    """Coefficient of Coulomb's friction of a free body with what it touches; 0 if left out. Two free bodies that touch
    have the mean of both."""
    restitution: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Part of the speed of a hit with which a free body leaves what it touches; 0.6 if left out. Two free bodies that
    touch have the mean of both."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of the path, from 0 on, each greater than the one before [s]; after the last it rests."""
    positions: tuple[tuple[Length, ...], ...] | None = None
    """(k, d) Where the middle is at these times [m]; the first is where it begins."""
    rotations: tuple[Rotation, ...] | None = None
    """(k, 3) Rotation vectors by which it is turned from how it begins at these times, in 2-D (k,) angles; the first is
    0 [rad]."""
    path: File | None = None
    """A CSV file in the place of `times`, with columns such as time [s], x [mm], y [mm] and rotation [deg], in 3-D
    rotation_x [deg] and so on. Only differences from the first line count, and a column that is not there stays 0. A
    relative name begins at the scene file."""
    interpolation: Interpolation = "linear"
    """How it gets from one of the times to the next: in straight lines, or along a cubic spline, whose velocity and
    acceleration are continuous, and which is at rest at both ends."""
    ramp: Ramp | None = None
    """Time after which the path is whole [s]; until then it is multiplied by a number that grows smoothly (C2) from 0
    to 1."""
    velocity: tuple[Annotated[float, quantity("m/s")], ...] | None = None
    """(d,) Velocity of the middle, if it is steady; of a free body at the start [m/s]."""
    angular_velocity: Turning | None = None
    """Angular velocity about the middle, if it is steady; of a free body at the start: in 3-D a vector, in 2-D one
    number, counterclockwise [rad/s]."""
    surface_velocity: tuple[Annotated[float, quantity("m/s")], ...] | None = None
    """(d,) How fast its surface slides while its shape stays, as that of a belt does, in the frame of the solid
    [m/s]."""
    side: Literal["outside", "inside"] = "outside"
    """Where fluid may be: outside of the shape, or inside of it, as in a tank."""
    slip: Literal["free", "no"] = "free"
    """"no": the viscous force acts between fluid and solid; "free": it does not."""
    material: Annotated[str, OneOf(tuple(FINISHES))] | None = None
    """What it looks like in pictures: its colour, how clear it is, and how much it is a mirror."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue, each from 0 to 1, in linear light. That of the material if left
    out, or [0.55, 0.55, 0.58] without one."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """The part of the light that goes through it in pictures, from 0 to 1; if left out that of the material, and
    without one 0, or 1 if fluid is inside."""

    @property
    def finish(self) -> Finish:
        """Return the finish of its surface in pictures."""
        plain = Finish(self.plain, transparency=float(self.side == "inside"))
        own = plain if self.material is None else FINISHES[self.material]
        clear = own.transparency if self.transparency is None else self.transparency
        return replace(own, colour=self.colour or own.colour, transparency=clear)

    @property
    def sticks(self) -> bool:
        """Return True where fluid has no slip along it."""
        return self.slip == "no"

    @property
    def is_steady(self) -> bool:
        """Return True where no table says where it is over time."""
        return self.times is None and self.path is None

    @property
    def moves(self) -> bool:
        """Return True where it or its surface moves."""
        return self.motion != "fixed" or self.surface_velocity is not None

    def centroid(self) -> Points:
        """Return the centroid (d,) of the solid's volume at the start [m]."""
        return self.shape_about()[1] if self.position is None else np.array(self.position)

    def middle(self) -> Points:
        """Return the middle (d,) of the solid at the start [m]: its centroid, or the centre of mass that it has."""
        return self.centroid() + self._arm()

    def moved(self, middle: Points, rotation: tuple[float, ...]) -> Self:
        """Return the solid with its middle (d,) at a place [m], turned by a rotation."""
        turned = self.model_copy(update={"rotation": rotation})
        return turned.model_copy(update={"position": tuple((middle - turned._arm()).tolist())})

    def _arm(self) -> Points:
        """Return the way (d,) from the centroid to the middle at the start [m], (1,) zero without a centre of mass."""
        arm = self.centre_of_mass
        return np.zeros(1) if arm is None else np.asarray(self.turn(len(arm)) @ np.array(arm))

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """Return the shape about its centroid, not turned, and the centroid by its measures, (d,) [m]."""

    def shown_shape(self, spacing: float) -> Solid:
        """Return the shape about its centroid, not turned, as pictures show it beside particles of a spacing [m]."""
        return self.shape_about()[0]

    def stretched(self, scale: float) -> Self:
        """Return the solid ``scale`` times as large about its middle."""
        if scale == 1.0:
            return self
        grown = {name: _times(scale, getattr(self, name)) for name in self.measures}
        return self.model_copy(update={**grown, "position": tuple(self.centroid().tolist())})

    @abstractmethod
    def thinnest(self, spacing: float) -> float:
        """Return the thickness of the solid's thinnest part [m]; infinite where that is not known, as of a mesh whose
        sheets are all thicker than a few spacings [m]."""

    def in_container(self, container: Container, path: FieldPath) -> Self:
        """Return this table, at a path, as it is in a container, which shapes without an end need to know."""
        return self

    def wall_count(self, spacing: float) -> float:
        """Estimate how many wall particles one layer has, without making any."""
        lower, upper = self.shape_about()[0].extent()
        cells = np.maximum((upper - lower) / spacing, 1.0)
        return float(2.0 * np.sum(np.prod(cells) / cells))

    def solid(self) -> Solid:
        """Return the solid where fluid may not be: the shape, or all outside of it for a tank."""
        return Hollow(self.body()) if self.side == "inside" else self.body()

    def own_solid(self) -> Solid:
        """Return the solid where fluid may not be, about its middle and not turned."""
        shape = self.shape_about()[0]
        if self.centre_of_mass is not None:
            return Placed(shape, -np.array(self.centre_of_mass), np.eye(len(self.centre_of_mass)))
        return Hollow(shape) if self.side == "inside" else shape

    def body(self) -> Solid:
        """Return the shape in its place."""
        centroid = self.centroid()
        return Placed(self.shape_about()[0], centroid, self.turn(len(centroid)))

    def turn(self, dimension: int) -> NDArray[np.float64]:
        """Return the rotation matrix (d, d) at the start."""
        return rotation_matrix(self.rotation or (0.0,) * (2 * dimension - 3))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("position", "velocity", "surface_velocity", "centre_of_mass"), dimension, path)
        for name in ("rotation", "angular_velocity", "gyration_radius"):
            check_turn((*path, name), getattr(self, name), dimension)
        check_motion(self, dimension, path)
        return super().in_dimension(dimension, path)


def thick(tables: Sequence[SolidTable]) -> tuple[SolidTable, ...]:
    """Return the solids that are no sheets."""
    return tuple(table for table in tables if not table.is_sheet)


@lru_cache(maxsize=8)
def solids_of(tables: tuple[SolidTable, ...]) -> tuple[Solid, ...]:
    """Return the solids that tables describe, in their order."""
    return tuple(table.solid() for table in tables)


def _times(scale: float, value: Any) -> Any:
    """Multiply a number by a scale, or one by one those of a tuple."""
    return tuple(_times(scale, part) for part in value) if isinstance(value, tuple) else scale * value
