"""Springs between free bodies, other solids and space, and the time step that springs and hinges allow."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from cortado.discretise.shapes import Points
from cortado.scene.hinges import HingeTable, Hold, Link, hinge_parameters, in_frame, inertia_about, linked, number_of
from cortado.scene.motions import mass_of_one, weight_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Parameter, Range
from cortado.scene.solids import SolidTable, check_free_body
from cortado.scene.tables import Flag, Length, Table, Text, Vector, check_name, field_error, quantity


class SpringTable(Table):
    """A spring with a damper between a point of a free body and a point of another solid or of space."""

    name: Text
    """Name of the spring; the names of its parameters begin with it."""
    solid: Text
    """Name of the free body."""
    point: Vector[Length]
    """(d,) Position of the spring's end on the free body at the start [m]."""
    to: Text | None = None
    """Name of the solid at the other end; if left out, the other end is fixed in space."""
    anchor: Vector[Length]
    """(d,) Position of the other end at the start [m]."""
    stiffness: Annotated[float, quantity("N/m", gt=0.0)]
    """Force per metre of extension [N/m]; in 2-D per metre of depth."""
    rest_length: Annotated[float, quantity("m", ge=0.0)] | None = None
    """Length without force [m]; if left out, the length at the start."""
    preload: Annotated[float, quantity("N")] | None = None
    """Tension of the spring at the start [N], in place of `rest_length`."""
    damping: Annotated[float, quantity("N s/m", ge=0.0)] = 0.0
    """Force per rate of extension [N s/m]."""
    slack: Flag = False
    """If true, the spring has no force while shorter than its rest length, like a mooring line."""

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
        """Return the length at the start [m]; 0 if the two ends have different dimensions."""
        fits = len(self.anchor) == len(self.point)
        return float(np.linalg.norm(np.subtract(self.anchor, self.point))) if fits else 0.0

    @property
    def length_at_rest(self) -> float:
        if self.rest_length is not None:
            return self.rest_length
        return self.length - (self.preload or 0.0) / self.stiffness


def check_springs(springs: Sequence[SpringTable], hinges: Sequence[HingeTable], solids: Sequence[SolidTable]) -> None:
    """Check the solids that springs name, and that no two solids, hinges or springs have the same name."""
    names = [solid.name for solid in solids]
    for index, hinge in enumerate(hinges):
        if hinge.name in names:
            raise field_error(("hinge", index, "name"), hinge.name, "another name than those of the solids")
    for index, spring in enumerate(springs):
        path = ("spring", index)
        if spring.name in [*names, *(hinge.name for hinge in hinges)]:
            raise field_error((*path, "name"), spring.name, "another name than those of the solids and hinges")
        check_free_body((*path, "solid"), spring.solid, solids)
        if spring.to == spring.solid:
            raise field_error((*path, "to"), spring.to, "another solid than that of the other end")
        if spring.to is not None:
            check_name((*path, "to"), spring.to, names, "a solid")


def spring_parameters(scene: Any) -> list[Parameter]:
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
    table: SolidTable
    mass: float
    """[kg]"""
    lightest: float
    """Greatest eigenvalue of the inverse inertia [1/(kg m2)]."""

    def at(self, point: Any) -> float:
        """Return a bound of the inverse effective mass for a force at a point (d,) of the body [1/kg]."""
        arm = np.subtract(point, self.table.middle())
        return float(1.0 / self.mass + self.lightest * (arm @ arm))


def spring_limit(scene: Any, values: Arrays) -> float:
    """Return the longest stable time step [s] with the scene's springs, 4 / (c + sqrt(c² + 4 w²)). The frequency w and
    the damping rate c are upper bounds, without the added mass of water."""
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
        for end in ("stiffness", "damping"):
            known.setdefault(f"{one.name}.{end}", np.array(getattr(one, end) or 0.0))
    square, rate = (_greatest(ends, known, end) for end in ("stiffness", "damping"))
    fastest = rate + sqrt(rate * rate + 4.0 * square)
    return 4.0 / fastest if fastest > 0.0 else inf


def _greatest(ends: Sequence[tuple[str, list[tuple[str, float]]]], values: Arrays, key: str) -> float:
    """Return a bound of the greatest eigenvalue of Jᵀ M⁻¹ J K: for a spring, the sum over its bodies of the traces of
    all springs at the body; the greatest over all springs."""
    traces: dict[str, float] = {}
    for name, bodies in ends:
        for body, inverse in bodies:
            traces[body] = traces.get(body, 0.0) + float(values[f"{name}.{key}"]) * inverse
    return max((sum(traces[body] for body, _ in bodies) for _, bodies in ends), default=0.0)


@dataclass(frozen=True)
class Ends(Link):
    point: Points
    """(d,) position of the end on the body, in the body's frame [m]."""
    anchor: Points
    """(d,) position of the other end [m], in the other solid's frame, or in space if that solid does not move."""
    slack: bool


def ends_of(springs: Sequence[SpringTable], moved: Sequence[SolidTable]) -> list[Ends]:
    found = []
    for spring in springs:
        body, solid, fields = linked(spring, moved)
        anchor = np.array(spring.anchor) if solid is None else in_frame(solid, spring.anchor)
        found.append(Ends(*fields, in_frame(body, spring.point), anchor, spring.slack))
    return found
