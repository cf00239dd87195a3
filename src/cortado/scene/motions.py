"""How solids that move are displaced and turned from where they begin, over time, and how large they are."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.scene.parameters import Axis, Parameter, Range, Role, Source
from cortado.scene.schedule import along_lines
from cortado.scene.solids import SolidTable

AXES = ("turn_x", "turn_y", "turn_z")
"""How fields of states end that keep how a free body is turned: how far the ends of its unit axes have moved [-]."""
RADIAN = 1.0
"""What an optimiser would take for a large turn [rad]."""
STRETCH = 0.2
"""What it would take for a large change of a scale, in parts of it."""


@dataclass(frozen=True, eq=False)
class Steady:
    """Something that grows by the same in every second."""

    rate: NDArray[np.float64]
    """() or (components,)"""

    def at(self, times: NDArray) -> NDArray:
        """(n,) or (n, components) at times (n,) [s]"""
        return np.multiply.outer(times, self.rate)

    def greatest(self) -> float:
        """Size of the rate."""
        return float(np.linalg.norm(self.rate))

    def rates(self, times: NDArray) -> NDArray:
        """(n,) or (n, components) the derivatives with respect to time."""
        return np.broadcast_to(self.rate, (*np.shape(times), *self.rate.shape))


@dataclass(frozen=True, eq=False)
class Knots:
    """Straight lines between values at some times, constant after the last."""

    times: NDArray[np.float64]
    """(k,) [s]"""
    values: NDArray[np.float64]
    """(k,) or (k, components)"""

    def at(self, times: NDArray) -> NDArray:
        """(n,) or (n, components) at times (n,) [s]"""
        found = along_lines(times, self.times, self.values.reshape(len(self.times), -1))
        return found.reshape(len(times), *self.values.shape[1:])

    def greatest(self) -> float:
        """Size of the greatest rate."""
        return float(np.linalg.norm(self._slopes.reshape(len(self.times), -1), axis=1).max())

    def rates(self, times: NDArray) -> NDArray:
        """(n,) or (n, components) the derivatives with respect to time, at a knot that of what comes after."""
        return self._slopes[np.searchsorted(self.times, times, side="right") - 1]

    @property
    def _slopes(self) -> NDArray[np.float64]:
        """(k,) or (k, components) after each of the times."""
        lengths = np.diff(self.times).reshape(-1, *(1,) * (self.values.ndim - 1))
        return np.concatenate([np.diff(self.values, axis=0) / lengths, 0.0 * self.values[:1]])


def moving(solids: Sequence[SolidTable]) -> list[SolidTable]:
    """Those that move, in their order."""
    return [solid for solid in solids if solid.moves]


def wall_numbers(solids: Sequence[SolidTable]) -> dict[str, int]:
    """What their wall particles are numbered with, by their names: those that move from 0 on, and those at rest from
    -2 on downwards, as -1 is the container."""
    resting = [solid for solid in solids if not solid.moves]
    numbers = {solid.name: number for number, solid in enumerate(moving(solids))}
    return numbers | {solid.name: -2 - number for number, solid in enumerate(resting)}


def told(solids: Sequence[SolidTable]) -> list[SolidTable]:
    """Those that move as they are told."""
    return [solid for solid in moving(solids) if solid.motion != "free"]


def free(solids: Sequence[SolidTable]) -> list[SolidTable]:
    """Those that fluid moves."""
    return [solid for solid in solids if solid.motion == "free"]


def solid_frames(scene: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of the solids of a scene that move: where their middles are at the start, (k, d) [m], and how they are turned,
    (k, d, d)."""
    tables, d = moving(scene.solid), scene.dimension
    middles = np.array([table.middle() for table in tables]).reshape(-1, d)
    return middles, np.array([table.turn(d) for table in tables]).reshape(-1, d, d)


def greatest_speed(solids: Sequence[SolidTable], values: Mapping[str, Any]) -> float:
    """How fast the fastest point of a solid moves at most [m/s], with values of parameters that replace the scene's."""
    found = [0.0]
    for solid in moving(solids):
        shifts, turns = courses(solid)
        shift = values.get(velocity_name(solid.name))
        turn = values.get(angular_velocity_name(solid.name))
        shifts = shifts if shift is None else Steady(shift)
        turns = turns if turn is None else Steady(turn)
        found.append(shifts.greatest() + reach(solid, values) * turns.greatest())
    return max(found)


def reach(solid: SolidTable, values: Mapping[str, Any]) -> float:
    """How far from its middle its furthest point is at most [m], with values of parameters that replace the scene's."""
    shape, _ = solid.shape_about()
    return float(np.linalg.norm(np.abs(shape.extent()).max(axis=0)) * values.get(scale_name(solid.name), 1.0))


def motion_parameters(solids: Sequence[SolidTable]) -> list[Parameter]:
    """Of solids that move: where they begin, and where they are at the end of each step, as from there, or, if their
    motion is steady, how fast they go, and how large they are; of free bodies how they begin, and their density."""
    found = [make(solid) for solid in told(solids) for make in (_position, _rotation, _scale, _displacement, _turn)]
    steady = [
        replace(make(solid), role=Role.VIEW, in_place_of=name(solid.name))
        for solid in told(solids)
        if solid.times is None
        for make, name in ((_velocity, displacement_name), (_angular_velocity, turn_name))
    ]
    makers = (_position, _rotation, _velocity, _angular_velocity)
    begun = [replace(make(solid), role=Role.STATE) for solid in free(solids) for make in makers]
    return [*found, *steady, *begun, *map(_density, free(solids))]


def position_name(solid: str) -> str:
    """Of the parameter that says where its middle begins, and of the field of a state that says where it is."""
    return f"{solid}.position"


def solids_in(fields: Iterable[str]) -> list[str]:
    """The names of the solids that fields of a state tell of."""
    end = position_name("")
    return [field.removesuffix(end) for field in fields if field.endswith(end)]


def rotation_name(solid: str) -> str:
    """Of the parameter that says how it begins, and of the field that keeps it."""
    return f"{solid}.rotation"


def scale_name(solid: str) -> str:
    """Of the parameter that says how many times as large it is, and of the field that keeps it."""
    return f"{solid}.scale"


def displacement_name(solid: str) -> str:
    """Of the parameter."""
    return f"{solid}.displacement"


def turn_name(solid: str) -> str:
    """Of the parameter, and of the field of a state."""
    return f"{solid}.turn"


def velocity_name(solid: str) -> str:
    """Of the parameter that says how fast the middle of a solid is, of a free body at the start, and of the field of a
    state."""
    return f"{solid}.velocity"


def angular_velocity_name(solid: str) -> str:
    """Of the parameter that says how fast a solid turns, a free body at the start, and of the field of a state."""
    return f"{solid}.angular_velocity"


def density_name(solid: str) -> str:
    """Of the parameter of a free body."""
    return f"{solid}.density"


def courses(solid: SolidTable) -> tuple[Steady | Knots, Steady | Knots]:
    """How a solid that is told where to go is displaced [m], and turned [rad], over time from where it begins."""
    d = len(solid.middle())
    return _course(solid, "positions", "velocity", d), _course(solid, "rotations", "angular_velocity", 2 * d - 3)


def _position(solid: SolidTable) -> Parameter:
    middle = solid.middle()
    return Parameter(
        position_name(solid.name),
        "m",
        f"where the middle of the solid {solid.name} is at the start",
        Axis.SCALAR,
        lambda source: middle,
        components=lambda dimension, phases: dimension,
        change=_change_of_place,
    )


def _rotation(solid: SolidTable) -> Parameter:
    angles = 2 * len(solid.middle()) - 3
    begun = np.array(solid.rotation or (0.0,) * angles, dtype=np.float64)
    return Parameter(
        rotation_name(solid.name),
        "rad",
        f"how the solid {solid.name} is turned about its middle at the start",
        Axis.SCALAR,
        lambda source: begun.reshape(_shape_of(angles)),
        components=None if angles == 1 else lambda dimension, phases: dimension,
        change=lambda source, value: np.full(np.shape(value), RADIAN),
    )


def _scale(solid: SolidTable) -> Parameter:
    return Parameter(
        scale_name(solid.name),
        "",
        f"how many times as large as in the scene the solid {solid.name} is, about its middle",
        Axis.SCALAR,
        lambda source: np.float64(1.0),
        role=Role.STATE,
        range=Range.POSITIVE,
        change=lambda source, value: STRETCH * np.abs(value),
    )


def _velocity(solid: SolidTable) -> Parameter:
    begun = np.array(solid.velocity or np.zeros(len(solid.middle())), dtype=np.float64)
    return Parameter(
        velocity_name(solid.name),
        "m/s",
        f"how fast the middle of the solid {solid.name} is{_when(solid)}",
        Axis.SCALAR,
        lambda source: begun,
        components=lambda dimension, phases: dimension,
        change=lambda source, value: np.ones(np.shape(value)),
    )


def _angular_velocity(solid: SolidTable) -> Parameter:
    angles = 2 * len(solid.middle()) - 3
    begun = np.array(solid.angular_velocity or np.zeros(angles), dtype=np.float64)
    return Parameter(
        angular_velocity_name(solid.name),
        "rad/s",
        f"how fast the solid {solid.name} turns about its middle{_when(solid)}",
        Axis.SCALAR,
        lambda source: begun.reshape(_shape_of(angles)),
        components=None if angles == 1 else lambda dimension, phases: dimension,
        change=lambda source, value: np.ones(np.shape(value)),
    )


def _when(solid: SolidTable) -> str:
    return " at the start" if solid.motion == "free" else ""


def _density(solid: SolidTable) -> Parameter:
    return Parameter(
        density_name(solid.name),
        "kg/m³",
        f"the mass of the body {solid.name} over its volume",
        Axis.SCALAR,
        lambda source: np.float64(solid.density or 0.0),
        range=Range.POSITIVE,
    )


def _displacement(solid: SolidTable) -> Parameter:
    return Parameter(
        displacement_name(solid.name),
        "m",
        f"how far the middle of the solid {solid.name} is from where it began, after each step",
        Axis.STEP,
        lambda source: np.zeros(source.scene.dimension),
        components=lambda dimension, phases: dimension,
        change=_change_of_place,
        moment=1.0,
        grows=True,
        course=courses(solid)[0],
    )


def _turn(solid: SolidTable) -> Parameter:
    angles = 2 * len(solid.middle()) - 3
    return Parameter(
        turn_name(solid.name),
        "rad",
        f"how far the solid {solid.name} is turned from how it began, after each step",
        Axis.STEP,
        lambda source: np.zeros(_shape_of(angles)),
        components=None if angles == 1 else lambda dimension, phases: dimension,
        change=lambda source, value: np.full(np.shape(value), RADIAN),
        moment=1.0,
        grows=True,
        course=courses(solid)[1],
    )


def _change_of_place(source: Source, value: NDArray) -> NDArray[np.float64]:
    return np.full(np.shape(value), 10.0 * source.scene.discretisation.spacing)


def _shape_of(components: int) -> tuple[int, ...]:
    return () if components == 1 else (components,)


def _course(solid: SolidTable, values: str, rate: str, components: int) -> Steady | Knots:
    shape = _shape_of(components)
    known: Any = getattr(solid, values)
    if known is not None:
        table = np.array(known, dtype=np.float64).reshape(len(known), *shape)
        return Knots(np.array(solid.times), table - table[0])
    steady: Any = getattr(solid, rate)
    return Steady(np.zeros(shape) if steady is None else np.array(steady, dtype=np.float64).reshape(shape))
