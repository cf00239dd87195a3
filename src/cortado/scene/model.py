"""The tables of a scene file: phases, mixtures, forces and discretisation, and `SceneTables` with all tables."""

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
"""Smallest default of the regularisation time for fluids with a yield stress [s]."""


class RheologyTable(Table):
    """Base of the laws for a viscosity that depends on the shear rate. The coefficients of a law are parameters, such
    as ``carreau.flow_index``."""

    kind: str
    """Name of the law of viscosity."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        """Return the coefficients of the law by name. ``viscosity`` is the dynamic viscosity of the phase [Pa s]."""
        return {name: value for name, value in self.model_dump().items() if name != "kind"}

    def thickest(self, viscosity: float) -> float:
        """Return the greatest viscosity at any shear rate [Pa s]."""
        return viscosity


class Thinning(RheologyTable):
    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """Exponent n of the law [-]. Fluid with n < 1 is shear-thinning, and fluid with n > 1 is shear-thickening."""
    least_shear_rate: Annotated[float, quantity("1/s", gt=0.0)] = 0.01
    """Shear rate that keeps the viscosity finite at rest [1/s]. The law uses sqrt(shear_rate² + least_shear_rate²)."""

    def thickest(self, viscosity: float) -> float:
        return viscosity * max(self.least_shear_rate ** (self.flow_index - 1.0), 1.0)


class PowerLaw(Thinning):
    """The power law of Ostwald and de Waele: the viscosity is viscosity (shear rate)^(flow_index - 1). The key
    `viscosity` of the phase is the viscosity at a shear rate of 1/s."""

    kind: Literal["power_law"] = "power_law"


class Carreau(RheologyTable):
    """The law of Carreau (1972). The viscosity is infinite_viscosity + (viscosity - infinite_viscosity) (1 +
    (relaxation_time shear_rate)^2)^((flow_index - 1) / 2). The key `viscosity` of the phase is the viscosity at rest.
    """

    kind: Literal["carreau"] = "carreau"
    relaxation_time: Annotated[float, quantity("s", ge=0.0)]
    """Relaxation time [s]. The viscosity begins to change at the shear rate 1 / relaxation_time."""
    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """Exponent n of the law [-]. Fluid with n < 1 is shear-thinning."""
    infinite_viscosity: Annotated[float, quantity("Pa s", ge=0.0)] = 0.0
    """Viscosity in the limit of large shear rates [Pa s]."""

    def thickest(self, viscosity: float) -> float:
        return max(viscosity, self.infinite_viscosity)


class Yielding(RheologyTable):
    yield_stress: Annotated[float, quantity("Pa", ge=0.0)]
    """Yield stress [Pa]. At lower stress the fluid hardly flows."""
    regularisation: Annotated[float, quantity("s", gt=0.0)] | None = None
    """Regularisation time of Papanastasiou (1987) [s]. The viscosity at rest is viscosity + yield_stress
    regularisation. If left out, the regularisation time is 100 viscosity / yield_stress, but at least 40 s."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        growth = self.regularisation
        if growth is None:
            growth = max(100.0 * viscosity / self.yield_stress if self.yield_stress > 0.0 else 0.0, SHORTEST)
        return {**super().numbers(viscosity), "regularisation": growth}

    def thickest(self, viscosity: float) -> float:
        return super().thickest(viscosity) + self.yield_stress * self.numbers(viscosity)["regularisation"]


class Bingham(Yielding):
    """The law of Bingham, smoothed as by Papanastasiou (1987). The viscosity is viscosity + yield_stress (1 -
    exp(-regularisation shear_rate)) / shear_rate. The key `viscosity` of the phase is the viscosity of fast flow."""

    kind: Literal["bingham"] = "bingham"


class HerschelBulkley(Yielding, Thinning):
    """The law of Herschel and Bulkley: a power law with a yield stress. The key `viscosity` of the phase is the
    consistency."""

    kind: Literal["herschel_bulkley"] = "herschel_bulkley"


AnyRheology = Annotated[PowerLaw | Carreau | Bingham | HerschelBulkley, Field(discriminator="kind")]


class MixtureTable(Table):
    """The Cahn-Hilliard equation for the mass fractions of the phases (Yang et al. 2015)."""

    free_energy: Literal["double_well", "miscible"] = "double_well"
    """"double_well" separates the phases; "miscible" mixes the phases by Fick's law."""
    strength: Annotated[float, quantity(gt=0.0)] = 1.0
    """Dimensionless factor of the free energy [-]."""
    mobility: Annotated[float, quantity("m2/s", ge=0.0)] = 0.0
    """Mobility of the Cahn-Hilliard equation [m2/s]. With 0 there is no diffusion between phases."""
    mobility_form: Literal["degenerate", "constant"] = "degenerate"
    """With "degenerate", phases diffuse only at interfaces; with "constant", phases diffuse everywhere."""
    interface_width: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Width parameter of an interface [m]; one spacing if left out. Across an interface, the mass fraction changes from
    10 % to 90 % over the distance 4.39 interface_width / sqrt(strength)."""

    def width(self, spacing: float) -> float:
        return spacing if self.interface_width is None else self.interface_width


OTHER_TABLES = ("problem", "optimise", "fit", "dataset")
"""Tables that a scene file may have besides the tables of the scene."""


class DiscretisationTable(Table):
    """Particle spacing, smoothing kernel and initial lattice of the fluid particles."""

    spacing: Annotated[float, quantity("m", gt=0.0)]
    """Distance between particles at rest [m]."""
    support: Annotated[float, quantity(ge=1.2, le=4.0)] = 2.0
    """Support radius divided by the spacing. Particles closer than the support radius interact. With the solver
    "projection", the default support is 2.6, unless the key `kernel` is given."""
    kernel: Literal["cubic_spline", "wendland_c2", "wendland_c4"] = "cubic_spline"
    """Name of the smoothing kernel. The default in "projection" is "wendland_c2", unless `support` is given."""
    jitter: Annotated[float, quantity(ge=0.0, le=0.3)] = 0.0
    """Largest random offset of a particle from its initial position, along each axis, in spacings. The offsets are
    equal in all runs. With the solver "projection" and all axes periodic the default is 0.05, because fluid on an exact
    lattice is too stiff. Particles from files are not moved."""

    @property
    def support_radius(self) -> float:
        return self.support * self.spacing


class Phase(Coloured):
    """A phase of the fluid: a material with its density, viscosity and appearance."""

    materials: ClassVar = LIQUIDS
    plain: ClassVar = (0.1, 0.3, 0.8)

    name: Text
    """Name of the phase. Bodies of fluid refer to this name."""
    rest_density: Annotated[float, quantity("kg/m3", gt=0.0)]
    """Density of the fluid at rest [kg/m3]."""
    viscosity: Annotated[float, quantity("Pa s", ge=0.0)]
    """Dynamic viscosity [Pa s]."""
    rheology: AnyRheology | None = None
    """Law for a viscosity that depends on the shear rate; if left out, the viscosity is constant."""
    material: Annotated[str, OneOf(tuple(LIQUIDS))] | None = None
    """Material that sets the colour and transparency of the phase in pictures. Simulations ignore the material."""
    colour: Colour | None = None
    """(3,) Colour in pictures: red, green and blue from 0 to 1, in linear light. If left out, the colour of the
    material, or [0.1, 0.3, 0.8] without a material."""


class FixedForces(Table):
    """Forces that exist in every scene."""

    gravity: Vector[Annotated[float, quantity("m/s2")]] = (0.0, -9.81, 0.0)
    """(d,) Gravitational acceleration [m/s2]. If schedule.gravity is given, it must begin with this vector."""
    viscosity: Literal["stress", "pairwise", "none"] = "stress"
    """Form of the viscous force: "stress" or "pairwise", or "none" for no force. The form "stress" is accurate within 1
    % for a shear wave with 40 particles per wavelength. The form "stress" exerts no force on fluid in rigid rotation.
    The form "pairwise" (Monaghan 2005) exists only for the solver "pcisph". The effective viscosity of "pairwise" is
    0.6 to 1.4 times the given viscosity, depending on the direction of the shear."""
    viscous_solve: Literal["automatic", "explicit", "implicit"] = "automatic"
    """Time integration of the viscous stress. Explicit integration limits the time step. Implicit integration solves a
    system of equations in each step, and works with any time step. The value "automatic" means implicit if the time
    step is too long for explicit integration."""
    pressure: Flag = True
    """Whether the fluid resists compression."""


_OPTIONAL: dict[str, Any] = {
    p.name: (Annotated[float, quantity(p.unit, ge=0.0)] | None, Field(None, description=p.meaning))
    for p in PARAMETERS
    if p.is_optional
}
Forces: Any = create_model("Forces", __base__=FixedForces, __module__=__name__, **_OPTIONAL)


def _with(given: Any, chosen: Mapping[str, Any]) -> Any:
    if isinstance(given, Table) and not given.model_fields_set & set(chosen):
        return given.model_copy(update=chosen)
    return {**given, **chosen} if isinstance(given, Mapping) and not set(given) & set(chosen) else given


class SceneTables(Table):
    """All tables of a scene. `Scene` also checks that the tables fit together."""

    beside: ClassVar = OTHER_TABLES
    name: Text = "scene"
    """Name of the scene, shown in titles."""
    dimension: Annotated[int, count(2, 3)]
    """Number d of dimensions, and of components of vectors: 2 for a plane, 3 for space."""
    discretisation: DiscretisationTable
    """How the fluid is divided into particles."""
    phase: Several[Phase]
    """The phases of the fluid. Mass fractions have one component for each phase, in this order."""
    fluid: tuple[AnyFluid, ...] = ()
    """The bodies of fluid, in the order of their particles. A scene with an emitter may have no body of fluid."""
    emitter: tuple[EmitterTable, ...] = ()
    """Emitters, through which fluid enters the scene."""
    drain: tuple[AnyDrain, ...] = ()
    """Drains, which remove particles from the fluid."""
    container: AnyContainer = Field(default=NoContainer(), validate_default=True)
    """The container of the fluid."""
    solid: tuple[AnySolid, ...] = ()
    """Solids besides the container, such as obstacles and vessels."""
    hinge: tuple[HingeTable, ...] = ()
    """Hinges of free bodies."""
    spring: tuple[SpringTable, ...] = ()
    """Springs of free bodies."""
    mixture: MixtureTable = MixtureTable()
    """Diffusion and separation of phases."""
    forces: Forces = Field(default=Forces(), validate_default=True)
    """Gravity, viscosity, pressure and Cortado's optional forces."""
    force: AnyForces = ()
    """Additional forces that installed packages provide."""
    solver: AnySolver
    """Solver and time step."""
    schedule: Schedule = Schedule()
    """Parameters that change during a run."""
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
        """Return the region where fluid may be at the start: inside the container and outside all solids."""
        return Room(self.region, solids_of(thick(self.solid)), self.periods[1])

    @property
    def resting_room(self) -> Room:
        """Return the region inside the container and outside the solids at rest."""
        return replace(self.room, solids=solids_of(tuple(solid for solid in thick(self.solid) if not solid.moves)))

    @model_validator(mode="before")
    @classmethod
    def _choose_for_solver(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        for name, chosen in what_suits(data.get("solver"), data.get("container")):
            if (given := data.get(name)) is not None:
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
