"""Springs that pull free bodies: their tables and parameters, and the time step that they and hinges allow."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from cortado.discretise.shapes import Points
from cortado.errors import shown
from cortado.scene.hinges import HingeTable, Hold, hinge_parameters, in_frame, inertia_about, number_of
from cortado.scene.motions import mass_of_one, weight_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Parameter, Range
from cortado.scene.solids import SolidTable
from cortado.scene.tables import Flag, Length, Table, Text, Vector, field_error, quantity


class SpringTable(Table):
    """A spring with a damper, from a point of a free body to a point of another solid or to a place of the world."""

    name: Text
    """Name of the spring, with which those of its parameters begin."""
    solid: Text
    """Name of the free body that it pulls."""
    point: Vector[Length]
    """(d,) Where it holds the body at the start, in the scene [m]."""
    to: Text | None = None
    """Name of the solid at its other end; if left out that is a place of the world."""
    anchor: Vector[Length]
    """(d,) Where its other end is at the start, in the scene [m]."""
    stiffness: Annotated[float, quantity("N/m", gt=0.0)]
    """Force for each metre by which it is longer than at rest [N/m]; in 2-D that of a metre across."""
    rest_length: Annotated[float, quantity("m", ge=0.0)] | None = None
    """Length at which it pulls with no force [m]; as long as at the start if left out."""
    preload: Annotated[float, quantity("N")] | None = None
    """Force with which it pulls at the start [N], in place of a length at rest."""
    damping: Annotated[float, quantity("N s/m", ge=0.0)] = 0.0
    """Force for each metre a second by which it gets longer [N s/m]."""
    slack: Flag = False
    """Whether it only pulls, and is slack where it is shorter than at rest, as a mooring line is."""

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        if self.preload is not None and self.rest_length is not None:
            raise field_error(("preload",), self.preload, "left out, as there is a rest_length")
        if self.length_at_rest < 0.0:
            wanted = f"at most {self.stiffness * self.length:g}, with which it would have no length at rest"
            raise field_error(("preload",), self.preload, wanted)
        if self.slack and self.length_at_rest == 0.0:
            raise field_error(("slack",), True, "false, as the spring has no length at rest")
        return self

    @property
    def length(self) -> float:
        """Return its length at the start [m]."""
        return (
            float(np.linalg.norm(np.subtract(self.anchor, self.point))) if len(self.anchor) == len(self.point) else 0.0
        )

    @property
    def length_at_rest(self) -> float:
        """Return its length at rest [m]."""
        if self.rest_length is not None:
            return self.rest_length
        return self.length - (self.preload or 0.0) / self.stiffness


def check_springs(springs: Sequence[SpringTable], hinges: Sequence[HingeTable], solids: Sequence[SolidTable]) -> None:
    """Check that springs are between a free body and another solid, or the world, and have names of their own, as
    hinges have."""
    names = [solid.name for solid in solids]
    for index, hinge in enumerate(hinges):
        if hinge.name in names:
            raise field_error(("hinge", index, "name"), hinge.name, "another name than those of the solids")
    free = [solid.name for solid in solids if solid.motion == "free"]
    for index, spring in enumerate(springs):
        path = ("spring", index)
        if spring.name in [*names, *(hinge.name for hinge in hinges)]:
            raise field_error((*path, "name"), spring.name, "another name than those of the solids and hinges")
        if spring.solid not in free:
            wanted = f"the name of a free body, of {shown(free)}" if free else 'of a solid whose motion is "free"'
            raise field_error((*path, "solid"), spring.solid, wanted)
        if spring.to == spring.solid:
            raise field_error((*path, "to"), spring.to, "another solid than that of the other end")
        if spring.to is not None and spring.to not in names:
            raise field_error((*path, "to"), spring.to, f"the name of a solid, of {shown(names)}")


def spring_parameters(scene: Any) -> list[Parameter]:
    """Return the parameters of a scene's springs and hinges."""
    pull = "N/m" if scene.dimension == 3 else "N/m²"
    positive, not_negative, found = Range.POSITIVE, Range.NOT_NEGATIVE, list[Parameter]()
    for spring in scene.spring:
        of, k = (spring.name, f"of the spring {spring.name}"), spring.stiffness
        found += [
            number_of(*of, "stiffness", pull, "the stiffness", k, positive, 0.1 * k),
            number_of(*of, "rest_length", "m", "the length at rest", spring.length_at_rest, not_negative, 0.1),
            number_of(*of, "damping", f"{pull} s", "the damping", spring.damping, not_negative, 0.1 * k),
        ]
    for hinge in scene.hinge:
        found += hinge_parameters(hinge, scene.dimension)
    return found


@dataclass(frozen=True)
class _Yielding:
    """A free body as springs find it."""

    table: SolidTable
    mass: float
    """[kg]"""
    lightest: float
    """The greatest eigenvalue of the inverse of its inertia [1/(kg m2)]."""

    def at(self, point: Any) -> float:
        """Return the greatest inverse of the mass that a force at a point (d,) of it at the start sees [1/kg]."""
        arm = np.subtract(point, self.table.middle())
        return float(1.0 / self.mass + self.lightest * (arm @ arm))


NUMBERS = ("stiffness", "damping")
"""Keys of springs and hinges that bound the steps."""


def spring_limit(scene: Any, values: Arrays) -> float:
    """Return the longest step [s] that is stable with the scene's springs, 4 / (c + sqrt(c^2 + 4 w^2)). Their greatest
    frequency w and rate of damping c are both bounds, without the water that goes along with bodies."""
    bodies = {}
    for table in scene.solid:
        if table.motion == "free":
            one, weight = mass_of_one(table), float(values.get(weight_name(table), table.mass or table.density))
            inertia = inertia_about(Hold.of(table, scene.dimension, scene.hinge), one)
            lightest = np.linalg.eigvalsh(np.linalg.pinv(weight * inertia)).max()
            bodies[table.name] = _Yielding(table, weight * one.volume, float(lightest))
    ends: list[tuple[str, list[tuple[str, float]]]] = []
    for spring in scene.spring:
        both = ((spring.solid, spring.point), (spring.to, spring.anchor))
        ends.append((spring.name, [(name, bodies[name].at(place)) for name, place in both if name in bodies]))
    for hinge in scene.hinge:
        if hinge.turns:
            on = [name for name in (hinge.solid, hinge.to) if name in bodies]
            ends.append((hinge.name, [(str(name), bodies[str(name)].lightest) for name in on]))
    known = dict(values)
    for one in (*scene.spring, *scene.hinge):
        for end in NUMBERS:
            known.setdefault(f"{one.name}.{end}", np.array(getattr(one, end) or 0.0))
    square, rate = (_greatest(ends, known, end) for end in NUMBERS)
    fastest = rate + sqrt(rate * rate + 4.0 * square)
    return 4.0 / fastest if fastest > 0.0 else inf


def _greatest(ends: Sequence[tuple[str, list[tuple[str, float]]]], values: Arrays, key: str) -> float:
    """Return a bound of the greatest eigenvalue of J^T M^-1 J K: the sum over both bodies of a spring of the traces of
    all springs at them."""
    traces: dict[str, float] = {}
    for name, bodies in ends:
        for body, inverse in bodies:
            traces[body] = traces.get(body, 0.0) + float(values[f"{name}.{key}"]) * inverse
    return max((sum(traces[body] for body, _ in bodies) for _, bodies in ends), default=0.0)


@dataclass(frozen=True)
class Ends:
    """A spring between solids by their numbers."""

    name: str
    body: int
    """Number of its body among the free bodies."""
    against: int
    """Number of the other solid among the solids that move; -1 for one at rest and for the world."""
    other: int
    """Number of the other solid among the free bodies; -1 for one that is not free."""
    point: Points
    """(d,) of its body, in the body's frame [m]."""
    anchor: Points
    """(d,) of the other solid, in its frame [m]; of the world if that does not move."""
    slack: bool


def ends_of(springs: Sequence[SpringTable], moved: Sequence[SolidTable]) -> list[Ends]:
    """Return the ends of springs between solids that move, which are all ``moved``, and the world."""
    numbers = {table.name: number for number, table in enumerate(moved)}
    bodies = [table.name for table in moved if table.motion == "free"]
    found = []
    for spring in springs:
        own, against = moved[numbers[spring.solid]], numbers.get(spring.to or "", -1)
        other = bodies.index(spring.to) if spring.to in bodies else -1
        anchor = np.array(spring.anchor) if against < 0 else in_frame(moved[against], spring.anchor)
        point = in_frame(own, spring.point)
        found.append(Ends(spring.name, bodies.index(own.name), against, other, point, anchor, spring.slack))
    return found
