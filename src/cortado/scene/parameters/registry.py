"""The one list of parameters: what each is called, its unit, shape and range, what it is in a scene, and what a
meaningful change of it is. Without Warp.

Shapes on a device, checks of what users write, scales of the certificate and tables of the documents follow from it.
"""

from collections.abc import Callable, Mapping
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.scene.parameters.parameter import Axis, Limit, Parameter, Range, Role, Source


def _vector(dimension: int, phases: int) -> int:
    return dimension


def _spacing(source: Source, value: Any = None) -> float:
    return source.scene.discretisation.spacing


def _size_of_gravity(source: Source, value: Any = None) -> float:
    return float(np.linalg.norm(source.scene.forces.gravity)) or 1.0


def _speed_of_fall(source: Source, value: Any) -> float:
    height = float(np.ptp(source.positions, axis=0).max()) + _spacing(source)
    return float(np.sqrt(_size_of_gravity(source) * height))


def _has_several_phases(scene: Any) -> bool:
    return len(scene.phase) > 1


def _diffuses(source: Source, values: Mapping[str, NDArray]) -> bool:
    return bool(values["mobility"] > 0.0)


def _of_phases(name: str) -> Callable[[Source], list[Any]]:
    return lambda source: [getattr(phase, name) for phase in source.scene.phase]


def _has_emitter(scene: Any) -> bool:
    return scene.emitter is not None


def _capillary_step(scene: Any, values: Mapping[str, Any]) -> float:
    """C sqrt(rho s^3 / sigma) of the lightest phase, with the spacing s (the form is that of Brackbill et al. 1992). C
    is 0.08, as with PCISPH drops in space need many more iterations from 0.1 on; by curvature, 0.2."""
    tension = float(values.get("surface_tension", scene.forces.surface_tension))
    density = float(np.min(values.get("rest_density", [phase.rest_density for phase in scene.phase])))
    part = 0.08 if scene.solver.kind == "pcisph" else 0.2
    return part * float(np.sqrt(density * scene.discretisation.spacing**3 / tension)) if tension > 0.0 else inf


def _optional(
    name: str, unit: str, meaning: str, force: str, longest_step: Limit = lambda scene, values: inf
) -> Parameter:
    """A number of at least 0 that may stand in the table [forces] of a scene, and switches a force on: ``force`` is the
    module that makes it, ``longest_step`` the largest time step at which it is likely to be stable."""
    return Parameter(
        name,
        unit,
        meaning,
        Axis.SCALAR,
        lambda source: getattr(source.scene.forces, name),
        range=Range.NOT_NEGATIVE,
        present=lambda scene: getattr(scene.forces, name) is not None,
        absent=f"has no {name.replace('_', ' ')} in [forces]",
        force=force,
        is_optional=True,
        longest_step=longest_step,
    )


PARAMETERS = (
    Parameter(
        "gravity",
        "m/s²",
        "acceleration that acts on all fluid",
        Axis.STEP,
        lambda s: s.scene.forces.gravity,
        components=_vector,
        change=_size_of_gravity,
        force="cortado.sph.gravity",
    ),
    Parameter(
        "tilt",
        "°",
        "how far the scene's gravity leans, with its size kept, in the place of gravity: where it points along -y, "
        "towards x and, in 3-D, towards z",
        Axis.STEP,
        lambda s: np.zeros(s.scene.dimension - 1),
        components=lambda dimension, phases: dimension - 1,
        role=Role.VIEW,
        in_place_of="gravity",
        change=lambda source, value: np.degrees(1.0),
        present=lambda scene: any(scene.forces.gravity),
        absent="has no gravity to lean",
    ),
    Parameter(
        "initial_positions",
        "m",
        "where particles are at the start",
        Axis.PARTICLE,
        lambda s: s.positions,
        components=_vector,
        role=Role.STATE,
        change=_spacing,
    ),
    Parameter(
        "initial_velocities",
        "m/s",
        "how fast they are",
        Axis.PARTICLE,
        lambda s: s.velocities,
        components=_vector,
        role=Role.STATE,
        change=_speed_of_fall,
    ),
    Parameter(
        "mass_fractions",
        "",
        "what they are made of at the start, where there are several phases",
        Axis.PARTICLE,
        lambda s: s.mass_fractions,
        components=lambda dimension, phases: phases,
        role=Role.STATE,
        range=Range.FRACTIONS,
        change=lambda source, value: 0.02,
        acts=lambda source, values: _has_several_phases(source.scene),
    ),
    Parameter(
        "rest_density",
        "kg/m³",
        "density of the fluid at rest",
        Axis.PHASE,
        _of_phases("rest_density"),
        range=Range.POSITIVE,
    ),
    Parameter(
        "viscosity",
        "Pa s",
        "dynamic viscosity",
        Axis.PHASE,
        _of_phases("viscosity"),
        range=Range.NOT_NEGATIVE,
        present=lambda scene: scene.forces.viscosity != "none",
        absent='has viscosity = "none" in [forces]',
        force="cortado.sph.viscosity",
    ),
    _optional("surface_tension", "N/m", "tension of the free surface", "cortado.sph.surface_tension", _capillary_step),
    Parameter(
        "time_step",
        "s",
        "length of a step",
        Axis.SCALAR,
        lambda s: s.scene.solver.time_step,
        range=Range.POSITIVE,
        present=lambda scene: not scene.solver.chooses,
        absent='chooses its time steps, by solver.time_step = "auto", and derivatives hold them constant',
    ),
    Parameter(
        "mobility",
        "m²/s",
        "how fast phases diffuse into one another",
        Axis.SCALAR,
        lambda s: s.scene.mixture.mobility,
        range=Range.NOT_NEGATIVE,
        acts=_diffuses,
        present=_has_several_phases,
        absent="has only one phase",
    ),
    Parameter(
        "interface_width",
        "m",
        "width of the interface between phases",
        Axis.SCALAR,
        lambda s: s.scene.mixture.width(s.scene.discretisation.spacing),
        range=Range.POSITIVE,
        acts=_diffuses,
        present=_has_several_phases,
        absent="has only one phase",
    ),
    Parameter(
        "nozzle_path",
        "m",
        "where the opening of the emitter is after each step",
        Axis.STEP,
        lambda s: s.scene.emitter.outlet,
        components=_vector,
        change=_spacing,
        moment=1.0,
        present=_has_emitter,
        absent="has no emitter",
    ),
    Parameter(
        "flow_rate",
        "m³/s",
        "volume that the emitter gives in a second, in 2-D area",
        Axis.SCALAR,
        lambda s: s.scene.emitter.flow_rate,
        range=Range.POSITIVE,
        present=_has_emitter,
        absent="has no emitter",
    ),
    Parameter(
        "colours",
        "",
        "red, green and blue of the phases, linear, from 0 to 1; for losses of images",
        Axis.PHASE,
        _of_phases("colour"),
        components=lambda dimension, phases: 3,
        role=Role.LOSS,
        change=lambda source, value: 1.0,
    ),
)
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


def names(role: Role | None = None, axis: Axis | None = None) -> tuple[str, ...]:
    """The names of parameters of a role and with an axis, of any where none is given, in the order of the list."""
    return tuple(p.name for p in PARAMETERS if role in (None, p.role) and axis in (None, p.axis))


def offered(scene: Any) -> tuple[str, ...]:
    """The names of parameters that a scene has, without what its particles are made of where there is one phase."""
    one_phase = {"mass_fractions"} if len(scene.phase) == 1 else set()
    return tuple(p.name for p in PARAMETERS if p.present(scene) and p.name not in one_phase)
