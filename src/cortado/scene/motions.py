"""Parameters over time, motion of solids, and names of the fields and parameters of solids."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, create_model, model_validator

from cortado.discretise.solid import Mass
from cortado.errors import Words
from cortado.scene.courses import Columns, Interpolation, Knots, Ramp, Steady, path_of, values_in_file
from cortado.scene.parameters import PARAMETERS, Axis, Parameter, Range, Role, ending, of_part
from cortado.scene.shape_tables import File
from cortado.scene.solids import SolidTable
from cortado.scene.tables import MISSING, FieldPath, Several, Table, field_error, quantity, usable_file


class Course(Table):
    """Values of a parameter over time. Values are constant before the first and after the last time."""

    columns: ClassVar[Callable[[int], Columns]]
    """Function that returns the columns of the CSV file for a number of dimensions."""
    grows_from: ClassVar[float | None] = 0.0
    """Value from which a ramp starts, or None if the ramp starts from the first of the given values."""
    times: Several[Annotated[float, quantity("s", ge=0.0)]] | None = None
    """(k,) Times since the first state of the run, increasing [s]."""
    values: Any = None
    """(k, components) Values of the parameter at `times`, in the unit of the parameter."""
    file: File | None = None
    """A CSV file in place of `times` and `values`. The file has a column time [s], and columns x, y and z, or a column
    tilt, or columns tilt_x and tilt_z, with units. A relative path starts at the scene file's folder."""
    interpolation: Interpolation = "linear"
    """Interpolation between the times: linear, or by a cubic spline with zero slope at both ends."""
    ramp: Ramp | None = None
    """Duration of the ramp at the start [s]. During the ramp the values grow smoothly (twice differentiable)."""
    _dimension: int = PrivateAttr(0)

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        if self.file is not None:
            if given := [name for name in ("times", "values") if getattr(self, name) is not None]:
                raise field_error((given[0],), Words("given"), "left out, as there is a file")
            return self
        for name in ("times", "values"):
            if getattr(self, name) is None:
                raise field_error((name,), MISSING, "a list, or a file in its place")
        assert self.times is not None
        for index, (before, after) in enumerate(pairwise(self.times), 1):
            if after <= before:
                raise field_error(("times", index), after, f"greater than the time before, {before:g} s")
        if len(self.values) != len(self.times):
            wanted = f"a list of {len(self.times)}, one for each of the times"
            raise field_error(("values",), Words(f"a list of {len(self.values)}"), wanted)
        return self

    @property
    def knots(self) -> Knots:
        if self.file is None:
            times, values = np.array(self.times), np.array(self.values, dtype=np.float64)
        else:
            times, found = values_in_file(self.file, type(self).columns(self._dimension), True)
            values = np.stack([found[name] for name, _ in type(self).columns(self._dimension)], axis=1)
        begun = values[0] if self.grows_from is None else self.grows_from
        return Knots(times, values, self.interpolation, self.ramp or 0.0, begun)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        placed = self.model_copy()
        object.__setattr__(placed, "__pydantic_private__", {"_dimension": dimension})
        with usable_file((*path, "file"), self.file, "a table over time"):
            rows = placed.knots.values if self.values is None else self.values
        size = len(type(self).columns(dimension))
        for index, row in enumerate(rows):
            if len(row) != size:
                wanted = f"a list of {size}, as the scene has {dimension} dimensions"
                raise field_error((*path, "values", index), row, wanted)
        return placed


def course_table(parameter: Parameter) -> type[Course]:
    unit = parameter.unit.replace("²", "2").replace("°", "degrees")
    row = Annotated[tuple[Annotated[float, quantity(unit)], ...], Field(min_length=1, max_length=3, fail_fast=True)]
    values: Any = (Several[row] | None, Field(None, description="(k, components) one row for each of the times"))
    words = f"The parameter `{parameter.name}` over time: {parameter.meaning}."
    made = create_model(f"Course_{parameter.name}", __base__=Course, __module__=__name__, __doc__=words, values=values)

    def columns(dimension: int) -> Columns:
        size = 1 if parameter.components is None else parameter.components(dimension, 1)
        if size == dimension:
            return tuple((axis, unit) for axis in "xyz"[:size])
        return ((parameter.name, unit),) if size == 1 else tuple((f"{parameter.name}_{k}", unit) for k in "xz")

    made.columns, made.grows_from = columns, None if parameter.unit == "m" else 0.0
    return made


_COURSES: dict[str, Any] = {
    p.name: (course_table(p) | None, Field(None, description=p.meaning)) for p in PARAMETERS if p.axis is Axis.STEP
}


class _Schedule(Table):
    """The changes of parameters during a run."""

    @property
    def courses(self) -> dict[str, Knots]:
        return {name: course.knots for name, course in self._tables.items()}

    @property
    def _tables(self) -> dict[str, Course]:
        found = {name: getattr(self, name) for name in _COURSES}
        return {name: course for name, course in found.items() if course is not None}

    @property
    def leads_gravity(self) -> bool:
        return not self._tables.keys().isdisjoint(("gravity", "tilt"))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        placed = {name: course.in_dimension(dimension, (*path, name)) for name, course in self._tables.items()}
        return self.model_copy(update=placed)


Schedule: Any = create_model(
    "Schedule", __base__=_Schedule, __module__=__name__, __doc__=vars(_Schedule)["__doc__"], **_COURSES
)
AXES = ("turn_x", "turn_y", "turn_z")
"""Endings of the names of a free body's rotation fields."""
RESTITUTION = 0.6


def moving(solids: Sequence[SolidTable]) -> list[SolidTable]:
    return [solid for solid in solids if solid.moves]


def wall_numbers(solids: Sequence[SolidTable]) -> dict[str, int]:
    """Return the number by which wall particles refer to each solid, by name of the solid. Moving solids have the
    numbers 0, 1, ..., and solids at rest have -2, -3, ...."""
    resting = [solid for solid in solids if not solid.moves]
    numbers = {solid.name: number for number, solid in enumerate(moving(solids))}
    return numbers | {solid.name: -2 - number for number, solid in enumerate(resting)}


def told(solids: Sequence[SolidTable]) -> list[SolidTable]:
    """Return the solids with prescribed motion."""
    return [solid for solid in moving(solids) if solid.motion != "free"]


def free(solids: Sequence[SolidTable]) -> list[SolidTable]:
    return [solid for solid in solids if solid.motion == "free"]


def solid_frames(scene: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the initial middles (k, d) [m] and rotation matrices (k, d, d) of k moving solids."""
    tables, d = moving(scene.solid), scene.dimension
    middles = np.array([table.middle() for table in tables]).reshape(-1, d)
    return middles, np.array([table.turn(d) for table in tables]).reshape(-1, d, d)


def greatest_speed(solids: Sequence[SolidTable], values: Mapping[str, Any]) -> float:
    """Return the greatest speed of any point on the solids [m/s]. ``values`` replace the scene's parameters."""
    found = [0.0]
    for solid in moving(solids):
        shifts, turns = courses(solid)
        if (shift := values.get(velocity_name(solid.name))) is not None:
            shifts = Steady(shift)
        if (turn := values.get(angular_velocity_name(solid.name))) is not None:
            turns = Steady(turn)
        found.append(shifts.greatest() + reach(solid, values) * turns.greatest())
    return max(found)


def reach(solid: SolidTable, values: Mapping[str, Any]) -> float:
    """Return an upper bound on the distance of a solid's points from its middle [m]."""
    furthest = np.abs(solid.own_solid().extent()).max(axis=0)
    return float(np.linalg.norm(furthest) * values.get(scale_name(solid.name), 1.0))


position_name = ending("position")
"""Name of the parameter for the initial position [m] of a solid's middle, and of the field for the current position."""
rotation_name = ending("rotation")
scale_name = ending("scale")
displacement_name = ending("displacement")
turn_name = ending("turn")
velocity_name = ending("velocity")
angular_velocity_name = ending("angular_velocity")
density_name = ending("density")
mass_name = ending("mass")
friction_name = ending("friction")
restitution_name = ending("restitution")


def weight_name(solid: SolidTable) -> str:
    """Return the name of the parameter for density [kg/m3] or mass [kg], whichever the table of the body has."""
    return (density_name if solid.mass is None else mass_name)(solid.name)


def mass_of_one(solid: SolidTable) -> Mass:
    """Return the mass and inertia of a free body for the density 1, or for the mass 1 if its table has a mass."""
    even = Mass.of(solid.shape_about()[0])
    size = even.volume if solid.mass is None else 1.0
    if solid.inertia is not None:
        numbers, inertia = np.array(solid.inertia) / (solid.mass or solid.density or 1.0), np.zeros((3, 3))
        own = numbers.reshape(3, 3) if len(numbers) == 9 else np.diag(numbers)
        inertia[3 - len(own) :, 3 - len(own) :] = own
        return Mass(size, inertia)
    if solid.gyration_radius is None:
        return Mass(size, size / even.volume * even.inertia)
    return Mass(size, size * np.diag(np.square((0.0, 0.0, *solid.gyration_radius)[-3:])))


def solids_in(fields: Iterable[str]) -> list[str]:
    end = position_name("")
    return [field.removesuffix(end) for field in fields if field.endswith(end)]


def motion_parameters(solids: Sequence[SolidTable]) -> list[Parameter]:
    known = {parameter.name: parameter for solid in moving(solids) for parameter in _parameters(solid)}
    names = (position_name, rotation_name, scale_name, displacement_name, turn_name)
    found = [known[name(solid.name)] for solid in told(solids) for name in names]
    for solid in told(solids):
        for name, of in ((velocity_name, displacement_name), (angular_velocity_name, turn_name)):
            if solid.is_steady:
                found.append(replace(known[name(solid.name)], role=Role.VIEW, in_place_of=of(solid.name)))
    begun = (position_name, rotation_name, velocity_name, angular_velocity_name)
    found += [replace(known[name(solid.name)], role=Role.STATE) for solid in free(solids) for name in begun]
    found += [known[weight_name(solid)] for solid in free(solids)]
    said = [friction_name(solid.name) for solid in free(solids) if solid.friction is not None]
    said += [restitution_name(solid.name) for solid in free(solids) if solid.restitution is not None]
    return [*found, *(known[name] for name in said)]


def _parameters(solid: SolidTable) -> list[Parameter]:
    name, middle, still = solid.name, solid.middle(), np.zeros(len(solid.middle()))
    unturned = np.zeros(() if len(middle) == 2 else 3)
    when, (shifts, turns) = " at the start" if solid.motion == "free" else "", courses(solid)
    place = {"change": lambda source, value: np.full(np.shape(value), 10.0 * source.scene.discretisation.spacing)}
    turn = rate = {"change": lambda source, value: np.full(np.shape(value), 1.0)}
    size = {"role": Role.STATE, "range": Range.POSITIVE, "change": lambda source, value: 0.2 * np.abs(value)}
    steps: dict[str, Any] = {"axis": Axis.STEP, "moment": 1.0, "grows": True}

    def made(of: Callable[[str], str], *told: Any, **more: Any) -> Parameter:
        return of_part(of(name), *told, **more)

    rotation = unturned if solid.rotation is None else np.reshape(solid.rotation, unturned.shape)
    spin = unturned if solid.angular_velocity is None else np.reshape(solid.angular_velocity, unturned.shape)
    displaced = f"how far the middle of the solid {name} is from where it began, after each step"
    turned = f"how far the solid {name} is turned from how it began, after each step"
    heavy, unit = f"the mass of the body {name}", "kg" if len(middle) == 3 else "kg/m"
    bounce = RESTITUTION if solid.restitution is None else solid.restitution
    speed = f"how fast the middle of the solid {name} is{when}"
    number = {"range": Range.NOT_NEGATIVE, "change": lambda source, value: np.maximum(np.abs(value), 0.1)}
    stretched = f"how many times as large as in the scene the solid {name} is, about its middle"
    return [
        made(position_name, "m", f"where the middle of the solid {name} is at the start", middle, **place),
        made(rotation_name, "rad", f"how the solid {name} is turned about its middle at the start", rotation, **turn),
        made(scale_name, "", stretched, 1.0, **size),
        made(displacement_name, "m", displaced, still, **steps, **place, course=shifts),
        made(turn_name, "rad", turned, unturned, **steps, **turn, course=turns),
        made(velocity_name, "m/s", speed, solid.velocity or still, **rate),
        made(angular_velocity_name, "rad/s", f"how fast the solid {name} turns about its middle{when}", spin, **rate),
        made(density_name, "kg/m³", f"{heavy} over its volume", solid.density or 0.0, range=Range.POSITIVE),
        made(mass_name, unit, heavy, solid.mass or 0.0, range=Range.POSITIVE),
        made(friction_name, "", f"the friction of what the body {name} touches", solid.friction or 0.0, **number),
        made(restitution_name, "", f"with which part of its speed the body {name} leaves a wall", bounce, **number),
    ]


def courses(solid: SolidTable) -> tuple[Steady | Knots, Steady | Knots]:
    """Return the displacement [m] and the rotation [rad] of a solid with prescribed motion over time."""
    d = len(solid.middle())
    times, shifts, turns = path_of(solid, d) or (None, None, None)

    def course(rows: NDArray | None, steady: Any, components: int) -> Steady | Knots:
        shape = () if components == 1 else (components,)
        if rows is not None:
            assert times is not None
            return Knots(times, rows.reshape(len(rows), *shape), solid.interpolation, solid.ramp or 0.0)
        return Steady(np.zeros(shape) if steady is None else np.array(steady, dtype=np.float64).reshape(shape))

    return course(shifts, solid.velocity, d), course(turns, solid.angular_velocity, 2 * d - 3)


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of a moving solid. The rotation matrix (3, 3) of the solid is `turned` times the matrix of `begun`."""

    name: str
    is_free: bool
    position: NDArray[Any]
    """Position of the solid's middle (d,) [m]."""
    scale: float
    begun: NDArray[Any]
    """Rotation vector of the solid at the start (3,) [rad]."""
    turn: NDArray[Any]
    """Rotation vector of the rotation since the start (3,) [rad]; 0 for a free body."""
    turned: NDArray[Any]
    """Rotation matrix of the rotation since the start (3, 3)."""

    @classmethod
    def of(cls, name: str, is_free: bool, at: Any) -> Self:
        """Read a pose from state fields ``at``, which are arrays with a first axis of length 1."""
        position, begun, turn, scale = at[position_name(name)][0], at[rotation_name(name)][0], np.zeros(3), 1.0
        if is_free:
            turned = np.eye(3) + np.array([_in_space(at[f"{name}.{axis}"][0]) for axis in AXES]).T
        else:
            turn, scale = _in_space(at[turn_name(name)][0]), float(at[scale_name(name)][0])
            turned = matrix(turn)
        return cls(name, is_free, position, scale, _in_space(begun), turn, turned)

    @property
    def rotation(self) -> NDArray[Any]:
        return np.asarray(self.turned @ matrix(self.begun))

    @property
    def angles(self) -> NDArray[np.float64]:
        """Rotation vector of the pose (3,) [rad]. In 2-D, the angle of rotation (1,) from -pi to pi [rad]."""
        from scipy.spatial.transform import Rotation

        return np.asarray(_angles(Rotation.from_matrix(self.rotation).as_rotvec(), len(self.position)).ravel())

    def angle_bars(self, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the adjoints of state fields by name. ``bar`` is the adjoint of `angles`."""
        return self.turning_bars(np.linalg.solve(_jacobian(_in_space(self.angles)).T, _in_space(bar)))

    def turning_bars(self, t: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the adjoints of state fields by name. ``t`` (3,) is the adjoint of a small additional rotation."""
        name, dimension = self.name, len(self.position)
        bars = {rotation_name(name): _angles(_jacobian(self.begun).T @ self.turned.T @ t, dimension)}
        if not self.is_free:
            return bars | {turn_name(name): _angles(_jacobian(self.turn).T @ t, dimension)}
        columns = zip(AXES, self.turned.T, strict=True)
        return bars | {f"{name}.{axis}": 0.5 * np.cross(t, column)[None, :dimension] for axis, column in columns}


def matrix(rotation: NDArray[Any]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad], or of an angle (1,) [rad] in 2-D."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(_in_space(rotation)).as_matrix())


def _in_space(vector: NDArray[Any]) -> NDArray[np.float64]:
    given = np.atleast_1d(np.asarray(vector, dtype=np.float64))
    return np.pad(given, (2, 0) if len(given) == 1 else (0, 3 - len(given)))


def _angles(w: NDArray[Any], dimension: int) -> NDArray[np.float64]:
    return np.asarray(w[2:] if dimension == 2 else w[None])


def _jacobian(w: NDArray[Any]) -> NDArray[np.float64]:
    """Return the left Jacobian (3, 3) of the rotation group SO(3) at the rotation vector ``w`` (3,)."""
    size, cross = float(np.linalg.norm(w)), np.cross(np.eye(3), w)
    if size < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)
    a, b = (1.0 - np.cos(size)) / size**2, (size - np.sin(size)) / size**3
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)
