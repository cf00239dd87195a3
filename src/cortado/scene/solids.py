"""Keys that every solid of a scene has."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Hollow, Placed, Solid, rotation_matrix
from cortado.scene.appearance import FINISHES, Coloured, Finish
from cortado.scene.courses import WAYS, Interpolation, Ramp, check_motion
from cortado.scene.shape_tables import Container, File, surface_cells
from cortado.scene.tables import Angle, Colour, Few, FieldPath, Inertia, Length, OnAxes, OneOf, Text, Turns, quantity


class SolidTable(Coloured):
    """A solid of any shape. Fluid cannot enter a solid."""

    measures: ClassVar[tuple[str, ...]] = ()
    least_thickness: ClassVar = 1.0
    is_sheet: ClassVar = False
    materials: ClassVar = FINISHES
    plain: ClassVar = (0.55, 0.55, 0.58)

    name: Text
    """Name of the solid."""
    position: OnAxes[Length] = None
    """(d,) Position of the centroid [m]; if left out, the shape's corners, centre or mesh determine it."""
    rotation: Turns[Angle] = None
    """Initial rotation about the centroid [rad]; no rotation if left out. The value is a rotation vector in 3-D, and a
    counterclockwise angle in 2-D."""
    motion: Literal["fixed", "path", "free"] = "fixed"
    """Motion of the solid. A "fixed" solid does not move. A "path" solid moves as `positions`, `rotations`, the file
    `path`, `velocity` or `angular_velocity` prescribe. A "free" solid is a rigid body that fluid and gravity move."""
    density: Annotated[float, quantity("kg/m3", gt=0.0)] | None = None
    """Density of a free body [kg/m³]: its mass divided by its volume."""
    mass: Annotated[float, quantity("kg", gt=0.0)] | None = None
    """Mass of a free body, in place of its density [kg]; in 2-D the mass per metre of depth."""
    centre_of_mass: OnAxes[Length] = None
    """(d,) Vector from the centroid of a free body to its centre of mass, in the body's frame [m]; 0 if left out."""
    gyration_radius: Turns[Annotated[float, quantity("m", gt=0.0)]] = None
    """(3,) Radii of gyration of a free body about the axes of its frame [m], in 2-D one number. A radius of gyration is
    the square root of moment of inertia divided by mass. If left out, the body is homogeneous."""
    inertia: Inertia | None = None
    """Moments of inertia of a free body about its centre of mass [kg m²], in place of `gyration_radius`. In 2-D the
    value is one moment of inertia per metre of depth. In 3-D the value contains three moments about the axes of the
    body's frame, or the nine components of the inertia matrix, row by row."""
    freedom: tuple[Annotated[str, OneOf(sorted({*WAYS[2], *WAYS[3]}))], ...] | None = None
    """Directions in which a free body can move, along the axes of space; all directions if left out. In 2-D the names
    are "x", "y" and "rotation". In 3-D the names are "x", "y", "z", "rotation_x", "rotation_y" and "rotation_z"."""
    friction: Annotated[float, quantity(ge=0.0)] | None = None
    """Coefficient of Coulomb friction of a free body at contacts; 0 if left out. Two free bodies in contact use the
    mean of their coefficients."""
    restitution: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Coefficient of restitution of a free body: its speed after an impact divided by its speed before; 0.6 if left
    out. Two free bodies in contact use the mean of their coefficients."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of the path, increasing from 0 [s]. After the last time the solid is at rest."""
    positions: tuple[tuple[Length, ...], ...] | None = None
    """(k, d) Positions of the centroid at `times` [m]. The first position is the initial position."""
    rotations: tuple[Few[Angle], ...] | None = None
    """Rotations since the start of the run at `times` [rad]: rotation vectors (k, 3) in 3-D, angles (k,) in 2-D. The
    first rotation is 0."""
    path: File | None = None
    """A CSV file in place of `times`, with columns such as time [s], x [mm], y [mm] and rotation [deg]. In 3-D the
    rotations are rotation_x [deg], rotation_y [deg] and rotation_z [deg]. Only differences from the file's first line
    matter. A missing column counts as a column of zeros. A relative path starts at the scene file's folder."""
    interpolation: Interpolation = "linear"
    """Interpolation between `times`: linear, or a cubic spline. The spline has continuous velocity and acceleration,
    and velocity 0 at both ends."""
    ramp: Ramp | None = None
    """Duration of the ramp [s]. During the ramp, the displacement is multiplied by a factor that grows smoothly (C2)
    from 0 to 1."""
    velocity: OnAxes[Annotated[float, quantity("m/s")]] = None
    """(d,) Constant velocity of the solid's middle [m/s]; for a free body, the initial velocity of its centre
    of mass."""
    angular_velocity: Turns[Annotated[float, quantity("rad/s")]] = None
    """Constant angular velocity about the solid's middle [rad/s]; for a free body, the initial angular velocity. The
    value is a vector in 3-D. In 2-D the value is one number, positive for a counterclockwise rotation."""
    surface_velocity: OnAxes[Annotated[float, quantity("m/s")]] = None
    """(d,) Velocity of the sliding surface of a solid at rest, such as a conveyor belt, in the solid's frame [m/s]."""
    side: Literal["outside", "inside"] = "outside"
    """Side of the solid's surface with the fluid: "outside", or "inside" for a tank."""
    slip: Literal["free", "no"] = "free"
    """"no" for a no-slip surface; "free" for a surface without viscous force."""
    material: Annotated[str, OneOf(tuple(FINISHES))] | None = None
    """Material of the solid in pictures, which sets its colour, transparency and reflections."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue, each from 0 to 1, in linear light. The default is the colour of the
    material, or [0.55, 0.55, 0.58] without a material."""
    transparency: Annotated[float, quantity(ge=0.0, le=1.0)] | None = None
    """Fraction of the light that passes through the solid in pictures, from 0 to 1. The default is the transparency of
    the material. Without a material, the default is 1 for a solid with fluid inside, and otherwise 0."""

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
        """True if the solid is at rest, is free, or moves at a constant velocity."""
        return self.times is None and self.path is None

    @property
    def moves(self) -> bool:
        return self.motion != "fixed" or self.surface_velocity is not None

    def centroid(self) -> Points:
        """Return the initial centroid of the solid's volume (d,) [m]."""
        return self.shape_about()[1] if self.position is None else np.array(self.position)

    def middle(self) -> Points:
        """Return the solid's initial middle (d,) [m]: its centre of mass if given, else its centroid."""
        return self.centroid() + self._arm()

    def moved(self, middle: Points, rotation: tuple[float, ...]) -> Self:
        """Return the solid with its middle at ``middle`` (d,) [m] and with a ``rotation`` [rad]."""
        turned = self.model_copy(update={"rotation": rotation})
        return turned.model_copy(update={"position": tuple((middle - turned._arm()).tolist())})

    def _arm(self) -> Points:
        """Return the vector from the centroid to the centre of mass (d,) [m], or zero (1,) if both points coincide."""
        arm = self.centre_of_mass
        return np.zeros(1) if arm is None else np.asarray(self.turn(len(arm)) @ np.array(arm))

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """Return the unrotated shape with its centroid at the origin, and the centroid's position (d,) [m]."""

    def shown_shape(self, spacing: float) -> Solid:
        return self.shape_about()[0]

    def stretched(self, scale: float) -> Self:
        if scale == 1.0:
            return self
        grown = {name: _times(scale, getattr(self, name)) for name in self.measures}
        return self.model_copy(update={**grown, "position": tuple(self.centroid().tolist())})

    def thinnest(self, spacing: float) -> float:
        """Return the thickness of the thinnest part [m]; infinite for planes, sheets and thick meshes."""
        return np.inf

    def in_container(self, container: Container, path: FieldPath) -> Self:
        """Return the table with an unbounded shape cut at the container."""
        return self

    def wall_count(self, spacing: float) -> float:
        return surface_cells(*self.shape_about()[0].extent(), spacing)

    def solid(self) -> Solid:
        """Return the region that fluid cannot enter: the body of a solid, or the outside of a tank."""
        return Hollow(self.body()) if self.side == "inside" else self.body()

    def own_solid(self) -> Solid:
        """Return the region that fluid cannot enter, for an unrotated solid with its middle at the origin."""
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
        placed = super().in_dimension(dimension, path)
        check_motion(placed, dimension, path)
        return placed


def thick(tables: Sequence[SolidTable]) -> tuple[SolidTable, ...]:
    return tuple(table for table in tables if not table.is_sheet)


def solids_of(tables: tuple[SolidTable, ...]) -> tuple[Solid, ...]:
    return tuple(table.solid() for table in tables)


def _times(scale: float, value: Any) -> Any:
    return tuple(_times(scale, part) for part in value) if isinstance(value, tuple) else scale * value
