"""The tables of a scene together, and those that no other module has. SI units.

Vectors have as many components as the scene has dimensions. Whatever is wrong raises a `SceneError`, one sentence.
"""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationInfo, create_model, field_validator, model_validator

from cortado.scene.containers import AnyContainer, NoContainer
from cortado.scene.emitter import EmitterTable
from cortado.scene.fields import Colour, Flag, OneOf, Several, Text, Vector, count, field_error, quantity
from cortado.scene.filled_shapes import AnyFluid, turned
from cortado.scene.materials import LIQUIDS, Coloured
from cortado.scene.mixture import MixtureTable
from cortado.scene.package_tables import AnyForces
from cortado.scene.parameters.registry import PARAMETERS
from cortado.scene.picture import Picture
from cortado.scene.render import Render
from cortado.scene.rheology import AnyRheology
from cortado.scene.schedule import Schedule
from cortado.scene.sensors import AnySensor
from cortado.scene.solid_shapes import AnySolid
from cortado.scene.solvers import AnySolver, what_suits
from cortado.scene.tables import Table

OTHER_TABLES = ("problem", "optimise", "fit", "dataset")
"""Tables that a scene file may hold for other modules."""


class DiscretisationTable(Table):
    """How the fluid is cut into particles."""

    spacing: Annotated[float, quantity("m", gt=0.0)]
    """Distance between particles at rest [m]."""
    support: Annotated[float, quantity(ge=1.2, le=4.0)] = 2.0
    """Distance within which particles act on each other: support radius / spacing."""
    kernel: Literal["cubic_spline", "wendland_c2", "wendland_c4"] = "cubic_spline"
    """Name of the smoothing kernel. With the solver "projection" it is "wendland_c2", with a support of 2.6, if neither
    is given."""

    jitter: Annotated[float, quantity(ge=0.0, le=0.3)] = 0.0
    """How far a particle of a body is from its first place at most, along each axis and in spacings, at random but the
    same in every run: a fluid on a lattice is stiffer than one without order, and its derivatives at rest have corners.
    With the solver "projection" it is 0.05 if not given where all axes are periodic. Points of files stay where they
    are, and an emitter has a jitter of its own."""

    @property
    def support_radius(self) -> float:
        """The distance at which the smoothing kernel ends [m]."""
        return self.support * self.spacing


class Phase(Coloured):
    """A fluid."""

    materials: ClassVar = LIQUIDS
    plain: ClassVar = (0.1, 0.3, 0.8)

    name: Text
    """What bodies of fluid call it."""
    rest_density: Annotated[float, quantity("kg/m3", gt=0.0)]
    """Density of the fluid at rest [kg/m3]."""
    viscosity: Annotated[float, quantity("Pa s", ge=0.0)]
    """Dynamic viscosity [Pa s]."""
    rheology: AnyRheology | None = None
    """How the viscosity depends on the shear rate; not at all if left out."""
    material: Annotated[str, OneOf(tuple(LIQUIDS))] | None = None
    """What it looks like in pictures: its colour, and how far one sees into it. Nothing that is computed depends on
    it."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue, each from 0 to 1, in linear light: half as bright is 0.5. That of
    the material if left out, or [0.1, 0.3, 0.8] without one."""


class FixedForces(Table):
    """The forces that every scene has."""

    gravity: Vector[Annotated[float, quantity("m/s2")]] = (0.0, -9.81, 0.0)
    """(d,) Acceleration that acts on all fluid [m/s2]; with schedule.gravity, the first row there, if given."""
    viscosity: Literal["stress", "pairwise", "none"] = "stress"
    """Form of the viscous force. "stress": a stress that has the asked viscosity within 1 %, with 40 particles across a
    wave of shear, in every direction, and makes no force where fluid turns as a whole. "pairwise", with the
    solver "pcisph" alone: Monaghan's (2005), whose fluid is 0.6 to 1.4 times as viscous as asked for, by the direction
    of the shear, and flows 1.6 to 1.9 times as fast between plates as it should."""
    viscous_solve: Literal["automatic", "explicit", "implicit"] = "automatic"
    """When the viscous stress acts. "explicit": as velocities are at the start of a step, which limits the time step;
    "implicit": as they are at its end, for any time step, which takes a system of equations; "automatic": implicit
    where the time step is too long for the other."""
    pressure: Flag = True
    """Whether the fluid resists compression."""


_OPTIONAL: dict[str, Any] = {
    p.name: (Annotated[float, quantity(p.unit, ge=0.0)] | None, Field(None, description=p.meaning))
    for p in PARAMETERS
    if p.is_optional
}
Forces: Any = create_model("Forces", __base__=FixedForces, __module__=__name__, **_OPTIONAL)
"""Which forces act: `FixedForces`, and the optional ones of the registry of parameters."""


class SceneTables(Table):
    """Everything that a simulation starts from, each table right in itself."""

    beside: ClassVar = OTHER_TABLES
    name: Text = "scene"
    """Shown in titles."""
    dimension: Annotated[int, count(2, 3)]
    """2 for a plane, 3 for space: d, the number of components of vectors."""
    discretisation: DiscretisationTable
    """How the fluid is cut into particles."""
    phase: Several[Phase]
    """The materials: in this order the components of mass fractions."""
    fluid: tuple[AnyFluid, ...] = ()
    """The bodies of fluid; particles come in this order. With an emitter there may be none."""
    emitter: EmitterTable | None = None
    """An emitter, out of which fluid comes; its particles come after those of all fluids."""
    container: AnyContainer = Field(default=NoContainer(), validate_default=True)
    """What holds the fluid."""
    solid: tuple[AnySolid, ...] = ()
    """Solids, which fluid flows around or is held by, besides the container."""
    mixture: MixtureTable = MixtureTable()
    """How phases mix; the default if there is only one."""
    forces: Forces = Field(default=Forces(), validate_default=True)
    """Which forces act."""
    force: AnyForces = ()
    """Forces of installed packages, which act besides the scene's own."""
    solver: AnySolver
    """How a step is solved."""
    schedule: Schedule = Schedule()
    """What changes while the scene runs."""
    sensor: tuple[AnySensor, ...] = ()
    """What is read of the fluid in every step; it changes nothing of what is computed."""
    render: Render | None = None
    """How pictures are taken."""
    picture: Picture | None = None
    """How shaded pictures and films are made."""

    @property
    def sticks(self) -> bool:
        """Whether fluid has no slip along some walls."""
        return self.container.sticks or any(solid.sticks for solid in self.solid)

    @model_validator(mode="before")
    @classmethod
    def _choose_for_solver(cls, data: Any) -> Any:
        """The kernel with its support, and the jitters, that suit the solver, where they are not given."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        for name, chosen in what_suits(data.get("solver"), data.get("container")):
            given = data.get(name)
            if isinstance(given, Table) and not given.model_fields_set & set(chosen):
                data[name] = given.model_copy(update=chosen)
            elif isinstance(given, Mapping) and not set(given) & set(chosen):
                data[name] = {**given, **chosen}
        return data

    @field_validator("picture")
    @classmethod
    def _resolve_picture(cls, table: Any, info: ValidationInfo) -> Any:
        given = table is not None and {"dimension", "solid"} <= set(info.data)
        return table.in_scene(info.data["dimension"], [one.name for one in info.data["solid"]]) if given else table

    @field_validator("emitter", "container", "forces", "schedule", "render")
    @classmethod
    def _resolve(cls, table: Any, info: ValidationInfo) -> Any:
        given = table is not None and "dimension" in info.data
        return table.in_dimension(info.data["dimension"]) if given else table

    @field_validator("sensor", "solid")
    @classmethod
    def _resolve_named(cls, tables: Any, info: ValidationInfo) -> Any:
        for index, table in enumerate(tables):
            if table.name in [one.name for one in tables[:index]]:
                wanted = f"another name than those of the {info.field_name}s before"
                raise field_error((index, "name"), table.name, wanted)
        tables = cls._resolve_each(tables, info)
        if info.field_name != "solid" or not {"dimension", "container"} <= set(info.data):
            return tables
        return tuple(solid.in_container(info.data["container"], (index,)) for index, solid in enumerate(tables))

    @field_validator("fluid")
    @classmethod
    def _resolve_fluids(cls, fluids: Any, info: ValidationInfo) -> Any:
        return tuple(map(turned, cls._resolve_each(fluids, info)))

    @classmethod
    def _resolve_each(cls, tables: Any, info: ValidationInfo) -> Any:
        if "dimension" not in info.data:
            return tables
        return tuple(table.in_dimension(info.data["dimension"], (index,)) for index, table in enumerate(tables))
