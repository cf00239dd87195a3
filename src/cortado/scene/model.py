"""The tables of a scene, and those tables that no other module defines, in SI units."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationInfo, create_model, field_validator, model_validator

from cortado.discretise.room import Domain, Region, Room
from cortado.discretise.shapes import Points
from cortado.scene.appearance import LIQUIDS, Coloured, Picture, Render
from cortado.scene.drain_tables import AnyDrain
from cortado.scene.emitter_table import EmitterTable
from cortado.scene.fluids import AnyFluid, turned
from cortado.scene.links import HingeTable, SpringTable
from cortado.scene.motions import Schedule
from cortado.scene.packages import AnyForces
from cortado.scene.parameters import PARAMETERS
from cortado.scene.sensor_tables import AnySensor
from cortado.scene.shape_tables import AnyContainer, NoContainer
from cortado.scene.solid_shapes import AnySolid
from cortado.scene.solids import solids_of, thick
from cortado.scene.solvers import AnySolver, what_suits
from cortado.scene.tables import Colour, Flag, OneOf, Several, Table, Text, Vector, count, field_error, quantity

SHORTEST = 40.0
"""Smallest default regularisation of a yield stress [s]: unyielded fluid creeps at most 2.5 % of its depth per second.
Longer ones are too sharp for 40 particles across a plug: the speed errs by 2.7 % with 100 s, 0.8 % with 40 s."""


class RheologyTable(Table):
    """A law of viscosity; its numbers are parameters, such as ``carreau.flow_index``."""

    kind: str
    """Name of the law."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        """Return the law's numbers by name, for a phase with this viscosity [Pa s]."""
        return {name: value for name, value in self.model_dump().items() if name != "kind"}

    def thickest(self, viscosity: float) -> float:
        """Return the greatest viscosity [Pa s], for a phase with this viscosity [Pa s]."""
        return viscosity


class Thinning(RheologyTable):
    """Base of the laws of viscosity with a power of the shear rate."""

    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """n [-]: with n < 1 the fluid is shear-thinning, with n > 1 shear-thickening."""
    least_shear_rate: Annotated[float, quantity("1/s", gt=0.0)] = 0.01
    """Regularisation at rest [1/s]: the law uses sqrt(shear_rate² + least_shear_rate²) as shear rate."""

    def thickest(self, viscosity: float) -> float:
        return viscosity * max(self.least_shear_rate ** (self.flow_index - 1.0), 1.0)


class PowerLaw(Thinning):
    """The power law of Ostwald and de Waele, eta = viscosity (shear rate)^(flow_index - 1). The key `viscosity` of the
    phase is the consistency: the viscosity at a shear rate of 1/s."""

    kind: Literal["power_law"] = "power_law"
    """Name of the law."""


class Carreau(RheologyTable):
    """The law of Carreau (1972), eta = infinite_viscosity + (viscosity - infinite_viscosity) (1 + (relaxation_time
    shear rate)^2)^((flow_index - 1) / 2). The key `viscosity` of the phase is the viscosity at rest."""

    kind: Literal["carreau"] = "carreau"
    """Name of the law."""
    relaxation_time: Annotated[float, quantity("s", ge=0.0)]
    """lambda [s]: the viscosity changes at shear rates beyond 1 / lambda."""
    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """n [-], the exponent: thinner under shear for n < 1."""
    infinite_viscosity: Annotated[float, quantity("Pa s", ge=0.0)] = 0.0
    """Viscosity at a large shear rate [Pa s]."""

    def thickest(self, viscosity: float) -> float:
        return max(viscosity, self.infinite_viscosity)


class Yielding(RheologyTable):
    """Base of the laws of viscosity with a yield stress."""

    yield_stress: Annotated[float, quantity("Pa", ge=0.0)]
    """Stress below which the fluid hardly flows [Pa]."""
    regularisation: Annotated[float, quantity("s", gt=0.0)] | None = None
    """m of Papanastasiou (1987) [s], which limits the viscosity at rest to viscosity + yield_stress m. Unyielded fluid
    creeps at a speed of at most its depth / m. If left out: the longer of 40 s and 100 viscosity / yield_stress."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        growth = self.regularisation
        if growth is None:
            growth = max(100.0 * viscosity / self.yield_stress if self.yield_stress > 0.0 else 0.0, SHORTEST)
        return {**super().numbers(viscosity), "regularisation": growth}

    def thickest(self, viscosity: float) -> float:
        return super().thickest(viscosity) + self.yield_stress * self.numbers(viscosity)["regularisation"]


class Bingham(Yielding):
    """The law of Bingham, smoothed as by Papanastasiou (1987): eta = viscosity + yield_stress (1 - exp(-m shear rate))
    / shear rate. The key `viscosity` of the phase is the plastic viscosity, of fluid that flows."""

    kind: Literal["bingham"] = "bingham"
    """Name of the law."""


class HerschelBulkley(Yielding, Thinning):
    """The law of Herschel and Bulkley, a power law with Bingham's yield stress: viscosity is the consistency."""

    kind: Literal["herschel_bulkley"] = "herschel_bulkley"
    """Name of the law."""


AnyRheology = Annotated[PowerLaw | Carreau | Bingham | HerschelBulkley, Field(discriminator="kind")]


class MixtureTable(Table):
    """The Cahn-Hilliard equation for the mass fractions (Yang et al. 2015), with the scene's phases in order."""

    free_energy: Literal["double_well", "miscible"] = "double_well"
    """"double_well": phases separate into pure ones; "miscible": phases mix by Fick's law."""
    strength: Annotated[float, quantity(gt=0.0)] = 1.0
    """Factor of the free energy, alpha."""
    mobility: Annotated[float, quantity("m2/s", ge=0.0)] = 0.0
    """Mobility M [m2/s]: how fast phases diffuse. With 0 there is no diffusion, and each particle keeps its phase."""
    mobility_form: Literal["degenerate", "constant"] = "degenerate"
    """"degenerate": phases diffuse only where they touch; "constant": everywhere equally."""
    interface_width: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Width epsilon of an interface [m]; one spacing if left out. The mass fraction changes from 10 % to 90 % over 4.39
    epsilon / sqrt(alpha)."""

    def width(self, spacing: float) -> float:
        return spacing if self.interface_width is None else self.interface_width


OTHER_TABLES = ("problem", "optimise", "fit", "dataset")
"""Tables of other modules that a scene file may contain."""


class DiscretisationTable(Table):
    """Spacing, kernel and lattice of the fluid's particles."""

    spacing: Annotated[float, quantity("m", gt=0.0)]
    """Distance between particles at rest [m]."""
    support: Annotated[float, quantity(ge=1.2, le=4.0)] = 2.0
    """Support radius / spacing: particles interact within the support radius. With the solver "projection" the default
    is 2.6 if the kernel is left out, too."""
    kernel: Literal["cubic_spline", "wendland_c2", "wendland_c4"] = "cubic_spline"
    """Name of the smoothing kernel. With the solver "projection" the default is "wendland_c2" if the support is left
    out, too."""

    jitter: Annotated[float, quantity(ge=0.0, le=0.3)] = 0.0
    """Largest offset of a particle from its initial position, along each axis, in spacings; equal in all runs. With the
    solver "projection" and all axes periodic the default is 0.05, because fluid on an exact lattice is too stiff.
    Points of files are not moved."""

    @property
    def support_radius(self) -> float:
        return self.support * self.spacing


class Phase(Coloured):
    """A phase of the fluid: a material with its density, viscosity and look."""

    materials: ClassVar = LIQUIDS
    plain: ClassVar = (0.1, 0.3, 0.8)

    name: Text
    """Name by which bodies of fluid refer to it."""
    rest_density: Annotated[float, quantity("kg/m3", gt=0.0)]
    """Density of the fluid at rest [kg/m3]."""
    viscosity: Annotated[float, quantity("Pa s", ge=0.0)]
    """Dynamic viscosity [Pa s]."""
    rheology: AnyRheology | None = None
    """Dependence of the viscosity on the shear rate; constant if left out."""
    material: Annotated[str, OneOf(tuple(LIQUIDS))] | None = None
    """Look of the phase in pictures: its colour and its transparency. Simulations do not depend on it."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue, each from 0 to 1, in linear light: half as bright is 0.5. If left
    out, the colour of the material, or [0.1, 0.3, 0.8] without a material."""


class FixedForces(Table):
    """The forces that every scene has."""

    gravity: Vector[Annotated[float, quantity("m/s2")]] = (0.0, -9.81, 0.0)
    """(d,) Acceleration of all fluid by gravity [m/s2]. With schedule.gravity, it must equal the first row there."""
    viscosity: Literal["stress", "pairwise", "none"] = "stress"
    """Form of the viscous force. "stress" matches the given viscosity within 1 %, with 40 particles across a shear
    wave, and exerts no force on fluid in rigid rotation. "pairwise" (Monaghan 2005), for the solver "pcisph" only, has
    0.6 to 1.4 times the given viscosity, depending on the direction of the shear."""
    viscous_solve: Literal["automatic", "explicit", "implicit"] = "automatic"
    """When the viscous stress is computed. "explicit": at the start of a step, which limits the time step. "implicit":
    at the end of a step, by a system of equations, for any time step. "automatic": implicit if the time step is too
    long for explicit."""
    pressure: Flag = True
    """Whether the fluid resists compression."""


_OPTIONAL: dict[str, Any] = {
    p.name: (Annotated[float, quantity(p.unit, ge=0.0)] | None, Field(None, description=p.meaning))
    for p in PARAMETERS
    if p.is_optional
}
Forces: Any = create_model("Forces", __base__=FixedForces, __module__=__name__, **_OPTIONAL)


def _with(given: Any, chosen: Mapping[str, Any]) -> Any:
    """Return a table with the chosen values, or unchanged if it sets any of their keys."""
    if isinstance(given, Table) and not given.model_fields_set & set(chosen):
        return given.model_copy(update=chosen)
    return {**given, **chosen} if isinstance(given, Mapping) and not set(given) & set(chosen) else given


class SceneTables(Table):
    """All tables of a scene, each valid without the others."""

    beside: ClassVar = OTHER_TABLES
    name: Text = "scene"
    """Name of the scene, shown in titles."""
    dimension: Annotated[int, count(2, 3)]
    """2 for a plane, 3 for space: d, the number of components of vectors."""
    discretisation: DiscretisationTable
    """How the fluid is divided into particles."""
    phase: Several[Phase]
    """The materials; mass fractions have one component for each phase, in this order."""
    fluid: tuple[AnyFluid, ...] = ()
    """The bodies of fluid, in the order of their particles. A scene with an emitter may have no body of fluid."""
    emitter: tuple[EmitterTable, ...] = ()
    """Emitters, from which fluid enters; their particles come after those of all fluids."""
    drain: tuple[AnyDrain, ...] = ()
    """Drains, which take particles out of the fluid."""
    container: AnyContainer = Field(default=NoContainer(), validate_default=True)
    """The container of the fluid."""
    solid: tuple[AnySolid, ...] = ()
    """Solids besides the container: obstacles in the fluid, and vessels."""
    hinge: tuple[HingeTable, ...] = ()
    """Hinges, about which free bodies turn."""
    spring: tuple[SpringTable, ...] = ()
    """Springs, which pull free bodies."""
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
    """Quantities of the fluid that are recorded in every step. Sensors do not influence the simulation."""
    render: Render | None = None
    """Settings of differentiable pictures."""
    picture: Picture | None = None
    """Settings of shaded pictures and films."""

    @property
    def sticks(self) -> bool:
        return self.container.sticks or any(solid.sticks for solid in self.solid)

    @property
    def periods(self) -> tuple[Points, Points]:
        """Return the start and the length of the period, each (d,) [m]; the length is 0 along other axes."""
        return self.container.periods(self.dimension)

    @property
    def domain(self) -> Domain:
        return self.container.domain(self.dimension)

    @property
    def region(self) -> Region:
        """Return the region inside the container, unbounded along periodic axes."""
        return self.container.region(self.dimension).opened(self.periods[1])

    @property
    def room(self) -> Room:
        """Return the initial room for fluid: inside the container and outside of solids."""
        return Room(self.region, solids_of(thick(self.solid)), self.periods[1])

    @property
    def resting_room(self) -> Room:
        """Return the room for fluid without the moving solids."""
        return replace(self.room, solids=solids_of(tuple(solid for solid in thick(self.solid) if not solid.moves)))

    @model_validator(mode="before")
    @classmethod
    def _choose_for_solver(cls, data: Any) -> Any:
        """Fill in the kernel, the support and the jitters that suit the solver, if they are not given."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        for name, chosen in what_suits(data.get("solver"), data.get("container")):
            if name in data:
                given = data[name]
                is_list = isinstance(given, (list, tuple))
                data[name] = [_with(one, chosen) for one in given] if is_list else _with(given, chosen)
        return data

    @field_validator("picture")
    @classmethod
    def _resolve_picture(cls, table: Any, info: ValidationInfo) -> Any:
        given = table is not None and {"dimension", "solid"} <= set(info.data)
        return table.in_scene(info.data["dimension"], [one.name for one in info.data["solid"]]) if given else table

    @field_validator("container", "forces", "schedule", "render")
    @classmethod
    def _resolve(cls, table: Any, info: ValidationInfo) -> Any:
        given = table is not None and "dimension" in info.data
        return table.in_dimension(info.data["dimension"]) if given else table

    @field_validator("sensor", "solid", "hinge", "spring", "emitter", "drain")
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
