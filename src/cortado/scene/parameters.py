"""Registry of parameters and registry of particle quantities, with units, shapes and valid ranges."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from math import inf
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown


class Axis(Enum):
    """The axis along which a parameter's values differ: phases, steps, particles or none."""

    SCALAR = "one number"
    PHASE = "each phase"
    STEP = "each step, or all of them"
    PARTICLE = "each particle"
    ARRAY = "each entry of an array"


class Role(Enum):
    RUN = "what steps depend on"
    STATE = "part of the first state"
    VIEW = "another way to write a parameter"
    LOSS = "what only losses depend on"
    CLOCK = "when steps are, which nobody gives"


class Range(Enum):
    ANY = "any"
    POSITIVE = "greater than 0"
    NOT_NEGATIVE = "at least 0"
    FRACTIONS = "adding up to 1 for each particle"


class Source(Protocol):
    scene: Any
    positions: NDArray
    velocities: NDArray
    mass_fractions: NDArray


class Changing(Protocol):
    def at(self, times: NDArray) -> NDArray:
        """Return values (n,) or (n, components) at times (n,) [s]."""

    def rates(self, times: NDArray) -> NDArray: ...


Limit = Callable[[Any, Mapping[str, Any]], float]
"""Function from a scene and parameter values to the longest time step [s]."""


@dataclass(frozen=True)
class Parameter:
    """An input of a run or of a loss, with its unit, shape and valid range."""

    name: str
    unit: str
    meaning: str
    axis: Axis
    value: Callable[[Source], Any]
    components: Callable[[int, int], int] | None = None
    """Function that returns the number of components, given the numbers of dimensions and phases; None for a scalar."""
    role: Role = Role.RUN
    range: Range = Range.ANY
    change: Callable[[Source, NDArray], Any] = lambda source, value: np.abs(value)
    """Function that returns the size of a typical change of the parameter, given a scene and the parameter's value."""
    acts: Callable[[Source, Mapping[str, NDArray]], bool] = lambda source, values: True
    """Function that returns True if the parameter has an effect, given a scene and all parameter values by name."""
    present: Callable[[Any], bool] = lambda scene: True
    absent: str = ""
    """Reason why a scene may lack the parameter, such as "has only one phase"."""
    force: str | None = None
    """Module of the force that uses the parameter."""
    is_optional: bool = False
    """True for a parameter of an optional force."""
    longest_step: Limit = lambda scene, values: inf
    moment: float = 0.5
    """Instant in a time step at which the solver reads a time-dependent value: 0 at the start, 1 at the end."""
    grows: bool = False
    """True if the parameter is a displacement since the start of a run."""
    in_place_of: str | None = None
    """Name of the parameter that this alternative parameter replaces."""
    course: Changing | None = None
    """Default values of the parameter as a function of time."""
    shape: tuple[int, ...] = ()

    @property
    def rank(self) -> int:
        """Number of array axes of one value: 0 for a scalar, 1 for a vector."""
        return 0 if self.components is None else 1

    def shapes(self, steps: int, phases: int, positions: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Return the allowed shapes of a value. ``positions`` is the shape (n, d) of positions."""
        if self.axis is Axis.ARRAY:
            return [self.shape]
        particles, dimension = positions
        own = () if self.components is None else (self.components(dimension, phases),)
        if self.axis is Axis.STEP:
            return [own, (steps, *own)] if steps > 0 else [own]
        if self.axis is Axis.PARTICLE:
            return [(particles, *own)]
        return [(phases, *own) if self.axis is Axis.PHASE and (phases > 1 or own) else own]


def _vector(dimension: int, phases: int) -> int:
    return dimension


def of_part(name: str, unit: str, meaning: str, value: Any, axis: Axis = Axis.SCALAR, **more: Any) -> Parameter:
    own = np.asarray(value, dtype=np.float64)
    return Parameter(name, unit, meaning, axis, lambda source: own, components=_vector if own.ndim else None, **more)


def spacing_of(source: Source, value: Any = None) -> float:
    return source.scene.discretisation.spacing


def _size_of_gravity(source: Source, value: Any = None) -> float:
    return float(np.linalg.norm(source.scene.forces.gravity)) or 1.0


def _speed_of_fall(source: Source, value: Any) -> float:
    height = float(np.ptp(source.positions, axis=0).max()) + spacing_of(source)
    return float(np.sqrt(_size_of_gravity(source) * height))


def _has_several_phases(scene: Any) -> bool:
    return len(scene.phase) > 1


def _of_particles(name: str, unit: str, meaning: str, value: Callable[[Source], Any], **more: Any) -> Parameter:
    more = {"components": _vector, "role": Role.STATE, **more}
    return Parameter(name, unit, meaning, Axis.PARTICLE, value, **more)


def _of_phases(name: str, unit: str, meaning: str, key: str = "", **more: Any) -> Parameter:
    of_each = attrgetter(key or name)
    return Parameter(name, unit, meaning, Axis.PHASE, lambda s: list(map(of_each, s.scene.phase)), **more)


def _of_mixture(name: str, unit: str, meaning: str, allowed: Range) -> Parameter:
    def value(source: Source) -> float:
        mixture = source.scene.mixture
        return mixture.mobility if name == "mobility" else mixture.width(spacing_of(source))

    own: Any = {"acts": lambda source, values: bool(values["mobility"] > 0.0), "present": _has_several_phases}
    return Parameter(name, unit, meaning, Axis.SCALAR, value, range=allowed, absent="has only one phase", **own)


def _capillary_step(scene: Any, values: Mapping[str, Any]) -> float:
    """Return the longest stable time step with surface tension [s] (Brackbill et al. 1992)."""
    tension = float(values.get("surface_tension", scene.forces.surface_tension))
    density = float(np.min(values.get("rest_density", [phase.rest_density for phase in scene.phase])))
    part = 0.08 if scene.solver.kind == "pcisph" else 0.2
    return part * float(np.sqrt(density * scene.discretisation.spacing**3 / tension)) if tension > 0.0 else inf


PARAMETERS = (
    Parameter(
        *("gravity", "m/s²", "acceleration that acts on all fluid", Axis.STEP, lambda s: s.scene.forces.gravity),
        components=_vector,
        change=_size_of_gravity,
        force="cortado.sph.gravity",
    ),
    Parameter(
        "tilt",
        "°",
        "angles by which gravity turns, at constant strength, instead of `gravity`. The first angle turns gravity along"
        " -y towards x; in 3-D, the second angle turns gravity towards z",
        Axis.STEP,
        lambda s: np.zeros(s.scene.dimension - 1),
        components=lambda dimension, phases: dimension - 1,
        role=Role.VIEW,
        in_place_of="gravity",
        change=lambda source, value: np.degrees(1.0),
        present=lambda scene: any(scene.forces.gravity),
        absent="has no gravity to lean",
    ),
    _of_particles(
        "initial_positions", "m", "positions of particles at the start", lambda s: s.positions, change=spacing_of
    ),
    _of_particles(
        "initial_velocities",
        "m/s",
        "velocities of particles at the start",
        lambda s: s.velocities,
        change=_speed_of_fall,
    ),
    _of_particles(
        "mass_fractions",
        "",
        "shares of the phases in the mass of each particle at the start",
        lambda s: s.mass_fractions,
        components=lambda dimension, phases: phases,
        range=Range.FRACTIONS,
        change=lambda source, value: 0.02,
        acts=lambda source, values: _has_several_phases(source.scene),
    ),
    _of_phases("rest_density", "kg/m³", "density of the fluid at rest", range=Range.POSITIVE),
    _of_phases(
        *("viscosity", "Pa s", "dynamic viscosity"),
        range=Range.NOT_NEGATIVE,
        present=lambda scene: scene.forces.viscosity != "none",
        absent='has viscosity = "none" in [forces]',
        force="cortado.sph.viscosity",
    ),
    Parameter(
        *("surface_tension", "N/m", "tension of the free surface"),
        *(Axis.SCALAR, lambda s: s.scene.forces.surface_tension),
        range=Range.NOT_NEGATIVE,
        present=lambda scene: scene.forces.surface_tension is not None,
        absent="has no surface tension in [forces]",
        force="cortado.sph.surface_tension",
        is_optional=True,
        longest_step=_capillary_step,
    ),
    Parameter(
        *("time_step", "s", "length of a step", Axis.SCALAR, lambda s: s.scene.solver.time_step),
        range=Range.POSITIVE,
        present=lambda scene: not scene.solver.chooses,
        absent='chooses its time steps, by solver.time_step = "auto", and derivatives hold them constant',
    ),
    _of_mixture("mobility", "m²/s", "how fast phases diffuse into one another", Range.NOT_NEGATIVE),
    _of_mixture("interface_width", "m", "width of the interface between phases", Range.POSITIVE),
    _of_phases(
        "colours",
        "",
        "red, green and blue of the phases, linear, from 0 to 1; for losses of images",
        "colour",
        components=lambda dimension, phases: 3,
        role=Role.LOSS,
        change=lambda source, value: 1.0,
    ),
)
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


def names(role: Role | None = None, axis: Axis | None = None) -> tuple[str, ...]:
    return tuple(p.name for p in PARAMETERS if role in (None, p.role) and axis in (None, p.axis))


def offered(scene: Any) -> tuple[str, ...]:
    one_phase = {"mass_fractions"} if len(scene.phase) == 1 else set()
    return tuple(p.name for p in PARAMETERS if p.present(scene) and p.name not in one_phase)


class Kind(Enum):
    NUMBER = "a number"
    VECTOR = "a vector"
    TURNING = "in the plane a number, which is positive counter-clockwise, in space a vector"


@dataclass(frozen=True)
class Quantity:
    """A particle quantity that is computed from a state and parameters."""

    name: str
    unit: str
    meaning: str
    kind: Kind = Kind.NUMBER

    def shape(self, particles: int, dimension: int) -> tuple[int, ...]:
        is_vector = self.kind is Kind.VECTOR or (self.kind is Kind.TURNING and dimension == 3)
        return (particles, dimension) if is_vector else (particles,)


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity("density", "kg/m3", "The sum of smoothing kernels around a particle, walls included, times its mass."),
        Quantity("pressure", "Pa", "What a gauge would read in the step that begins at the state."),
        Quantity("speed", "m/s", "The length of the velocity."),
        Quantity("vorticity", "1/s", "The curl of the velocity, from the fluid around a particle.", Kind.TURNING),
        Quantity("wall_force", "N", "What a particle pushes the walls with; in the plane N/m.", Kind.VECTOR),
    )
}
NAMES = tuple(QUANTITIES)


def sizes(name: str, values: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return scalars (..., n) unchanged, or norms of vectors (..., n, k). ``name`` is a quantity or a state field."""
    known = QUANTITIES.get(name)
    is_vector = values.ndim == 2 if known is None else len(known.shape(1, dimension)) == 2
    return np.linalg.norm(values, axis=-1) if is_vector else values


def ending(end: str) -> Callable[[str], str]:
    return lambda name: f"{name}.{end}"


LOAD = ".load"
load_name = ending("load")
"""Name of the fluid load on a solid, such as "rotor.load": force [N] and torque [N m], in 2-D [N/m] and [N]."""


def is_load(name: object) -> bool:
    return isinstance(name, str) and name.endswith(LOAD)


def check_readable(name: object, what: str, fields: tuple[str, ...]) -> str:
    """Return ``name`` if it names a quantity, a load or one of ``fields``; else raise `InputError`."""
    return str(name) if is_load(name) else check_quantity(name, what, fields)


def check_quantity(name: object, what: str = "quantity", others: tuple[str, ...] = ()) -> str:
    """Return ``name`` if it names a quantity or is one of ``others``; else raise `InputError`."""
    if not isinstance(name, str) or name not in (*others, *NAMES):
        raise InputError(f"{what} is {shown(name)}, but must be one of {', '.join((*others, *NAMES))}.")
    return name
