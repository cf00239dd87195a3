"""Contacts of free bodies with the container, solids and each other in a step; see `contact_kernels`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.reduction import add, sum_of
from cortado.particles.moving_walls import resting_pose
from cortado.particles.state import Layout, Parameters, padded, zeros
from cortado.scene.motions import RESTITUTION, friction_name, restitution_name
from cortado.solvers.contact_kernels import NUMBERS, OWN, SHARES, contact_kernels
from cortado.solvers.obstacles import Obstacle, middle_of, obstacle_mesh
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart, given_to
from cortado.sph.friction_kernels import lift_kernels
from cortado.sph.parts import Adjoints, StepContext, Tangents

Arrays = dict[str, wp.array]


@dataclass(frozen=True)
class Touching:
    """A free body and solids that it may touch: all solids at rest, or one moving solid."""

    body: int
    """Number of the body among the free bodies."""
    against: int
    """Number of the other solid among the moving solids; -1 for solids at rest."""
    other: int
    """Number of the other solid among the free bodies; -1 if it is not free."""
    obstacles: Sequence[Obstacle]
    points: NDArray[np.float64]
    """(n, d) points of the body's surface in the body's frame [m]"""
    slides: Sequence[float] = ()
    """(d,) velocity of the other solid's sliding surface, in the solid's frame [m/s]"""


class Contact:
    def __init__(self, touching: Touching, spacing: float, layout: Layout):
        self.touching, precision, device = touching, layout.precision, layout.device
        self.meshes = [obstacle_mesh(one, spacing, device) for one in touching.obstacles]
        self.places: list[dict[str, Any]] = []
        for one, mesh in zip(touching.obstacles, self.meshes, strict=True):
            middle, none = precision.vector(*padded(middle_of(one)[None])[0]), precision.vector()
            origin, inner = (middle, none) if touching.against < 0 else (none, middle)
            side = -1.0 if one.is_hollow else 1.0
            self.places.append({"mesh": mesh.id, "origin": origin, "inner": inner, "side": side})
        points, real, vector = padded(touching.points), precision.real, precision.vector
        self.slides = vector(*padded(np.array([touching.slides]))[0]) if len(touching.slides) else vector()
        self.count, self.layout = len(points), layout
        self.own = wp.array(np.tile(points, (layout.members, 1)), dtype=vector, device=device)
        self.all = layout.members * self.count
        self.found = self.arrays({"face": vector, "plane": real, "shift": vector, "depth": real})
        """The faces above points of the body, written by the kernel ``look``."""

    def arrays(self, kinds: Mapping[str, Any]) -> Arrays:
        return {name: wp.zeros(self.all, dtype=kind, device=self.layout.device) for name, kind in kinds.items()}

    def poses(self, each: Sequence[Named]) -> Named:
        """Return pose, scale and tangents of the other solid by the names of kernel arguments, given those of all
        moving solids."""
        against = self.touching.against
        other = resting_pose(self.layout) if against < 0 else each[against]
        return {f"other_{name}": array for name, array in other.items()}


class Totals:
    """Arrays of values of a body's points, and their sums over each scene."""

    def __init__(self, contact: Contact, kinds: Mapping[str, Any], suffix: str = "", end: str = "_sum"):
        layout = contact.layout
        self.each = contact.arrays({f"{name}{suffix}": kind for name, kind in kinds.items()})
        self._totals = {
            f"{name}{end}{suffix}": sum_of(kind, contact.count, layout.device, layout.members)
            for name, kind in kinds.items()
        }

    def sums(self) -> Arrays:
        """Sum the values over each scene, to arrays (members,) by name."""
        pairs = zip(self._totals.items(), self.each.values(), strict=True)
        return {name: total(array) for (name, total), array in pairs}


def share_kinds(layout: Layout) -> dict[str, Any]:
    matrix = layout.precision.matrix
    return dict(zip(SHARES, (matrix, matrix, layout.precision.six), strict=True))


class Contacts:
    """The contacts of a solver's free bodies; each step looks for contacts once poses are known."""

    def __init__(
        self,
        part: FreeSolidsPart,
        touching: Sequence[Touching],
        spacing: float,
        periods: NDArray[np.float64],
        layout: Layout,
    ):
        """Prepare contacts; ``periods`` (d,) [m] are 0 along axes without one."""
        self.part, self.layout, self.kernels = part, layout, contact_kernels(layout.precision)
        self.contacts = [Contact(one, spacing, layout) for one in touching if len(one.obstacles)]
        self._poses = [contact.poses(part.made_of.walls.each) for contact in self.contacts]
        vector = layout.precision.vector
        self._period, self._axes = (vector(*padded(one[None])[0]) for one in (periods, np.ones_like(periods)))
        self._shares = [Totals(contact, share_kinds(layout)) for contact in self.contacts]
        self._sums: list[Arrays] = [{} for _ in self.contacts]
        unsaid = {"friction": 0.0, "restitution": RESTITUTION}
        self._unsaid = {
            f"{label}{suffix}": wp.full(layout.members, 0.0 if suffix else value, layout.precision.real, layout.device)
            for label, value in unsaid.items()
            for suffix in ("", "_dot", "_bar")
        }
        """Default friction and restitution of bodies without these keys; nothing reads their tangents and adjoints."""
        self.lifts = lift_kernels(layout.precision)
        self.lift = {"lift": wp.zeros(layout.members, dtype=layout.precision.vector, device=layout.device)}

    def bodies(self, number: int) -> tuple[FreeBody, FreeBody]:
        """Return the body of a contact and the other free body; return the first body twice if the other solid is not
        free."""
        touching, bodies = self.contacts[number].touching, self.part.bodies
        own = bodies[touching.body]
        return own, own if touching.other < 0 else bodies[touching.other]

    def known(self, step: StepContext, number: int) -> tuple[Named, ...]:
        contact, (own, other), pair = self.contacts[number], self.bodies(number), self.layout.precision.pair
        constants: dict[str, Any] = {
            "particles": contact.count,
            "period": self._period,
            "axes": self._axes,
            "is_free": contact.touching.other >= 0,
            "volumes": pair(own.table.mass.volume, other.table.mass.volume),
            "greatest": pair(own.table.bounds["greatest"], other.table.bounds["greatest"]),
            "slides": contact.slides,
            "own": contact.own,
        }
        known = constants, self.numbers(step.parameters, number), contact.found, self._sums[number]
        return *known, self._poses[number], own.constants, self.lift

    def numbers(self, parameters: Parameters, number: int, suffix: str = "") -> Arrays:
        """Return the parameters of both solids, or their tangents or adjoints, by the names of kernel arguments."""
        found = {f"time_step{suffix}": parameters["time_step"]}
        for way, body in zip(("", "other_"), self.bodies(number), strict=True):
            name, weight = body.table.name, body.table.weight
            of = {"density": weight, "friction": friction_name(name), "restitution": restitution_name(name)}
            for label, one in of.items():
                value = parameters[one] if one in parameters.names else self._unsaid[f"{label}{suffix}"]
                found[f"{way}{label}{suffix}"] = value
        return found

    def given(self, number: int, each: Sequence[FreeBody | Changes]) -> Arrays:
        """Return the momenta of both solids, or their tangents or adjoints."""
        touching = self.contacts[number].touching
        return given_to(each, touching.body, touching.other)

    def look(self, step: StepContext) -> None:
        """Find the contacts of a step, and add their momenta to the bodies."""
        step.launch(self.lifts.forward, self.lift, threads=self.layout.members)
        for number, (contact, shares) in enumerate(zip(self.contacts, self._shares, strict=True)):
            for array in contact.found.values():
                array.zero_()
            for place in contact.places:
                step.launch(self.kernels.look, place, *self.known(step, number), threads=contact.all)
            step.launch(self.kernels.push.forward, shares.each, *self.known(step, number), threads=contact.all)
            self._sums[number], given = shares.sums(), self.given(number, self.part.bodies)
            step.launch(self.kernels.give.forward, given, *self.known(step, number), threads=self.layout.members)

    def tangent(self, changes: Sequence[Changes]) -> "ContactsTangent":
        return ContactsTangent(self, changes)

    def adjoint(self, changes: Sequence[Changes]) -> "ContactsAdjoint":
        return ContactsAdjoint(self, changes)


class ContactsTangent:
    def __init__(self, contacts: Contacts, changes: Sequence[Changes]):
        self._contacts, self._changes = contacts, changes
        self._shares = [Totals(contact, share_kinds(contacts.layout), "_dot") for contact in contacts.contacts]
        self._lift = {"lift_dot": wp.zeros_like(contacts.lift["lift"])}

    def look(self, step: StepContext, dot: Tangents) -> None:
        contacts, members = self._contacts, self._contacts.layout.members
        step.launch(contacts.lifts.tangent, self._lift, contacts.lift, lift_sizes(dot, "_dot"), threads=members)
        for number, shares in enumerate(self._shares):
            known = contacts.numbers(dot.parameters, number, "_dot"), *contacts.known(step, number)
            all_points = contacts.contacts[number].all
            step.launch(contacts.kernels.push.tangent, shares.each, self._lift, *known, threads=all_points)
            moved = contacts.given(number, self._changes), shares.sums()
            step.launch(contacts.kernels.give.tangent, *moved, *known, threads=members)


def lift_sizes(of: Tangents | Adjoints, suffix: str) -> Arrays:
    return {f"{name}{suffix}": of.parameters[name] for name in ("time_step", "gravity")}


class ContactsAdjoint:
    def __init__(self, contacts: Contacts, changes: Sequence[Changes]):
        self._contacts, self._changes, layout = contacts, changes, contacts.layout
        vectors = [*OWN, *(f"other_{name}" for name in OWN), "lift"]
        kinds = {**dict.fromkeys(vectors, layout.precision.vector)}
        kinds |= dict.fromkeys(("other_scales", *NUMBERS), layout.precision.real)
        self._moved = [Totals(contact, kinds, "_bar", end="") for contact in contacts.contacts]
        sums = {f"{name}_sum_bar": (layout.members, kind) for name, kind in share_kinds(layout).items()}
        self._sums = zeros(sums, layout.device)

    def look(self, step: StepContext, bar: Adjoints) -> None:
        """Turn adjoints of the bodies' momenta into adjoints of poses, densities and the time step."""
        contacts, members = self._contacts, self._contacts.layout.members
        for number, (contact, moved) in enumerate(zip(contacts.contacts, self._moved, strict=True)):
            numbers = contacts.numbers(bar.parameters, number, "_bar")
            known = (self._sums, *contacts.known(step, number))
            given = contacts.given(number, self._changes)
            step.launch(contacts.kernels.give.adjoint, given, numbers, *known, threads=members)
            step.launch(contacts.kernels.push.adjoint, moved.each, *known, threads=contact.all)
            bars = moved.sums()
            for name in NUMBERS:
                add(bars[f"{name}_bar"], numbers[f"{name}_bar"])
            step.launch(
                contacts.lifts.adjoint,
                {"lift_bar": bars["lift_bar"]},
                lift_sizes(bar, "_bar"),
                contacts.lift,
                threads=members,
            )
            own = [f"{name}_bar" for name in OWN]
            bar.solids.add_whole(contacts.bodies(number)[0].table.number, **{name: bars[name] for name in own})
            if contact.touching.against >= 0:
                others = {name: bars[f"other_{name}"] for name in (*own, "scales_bar")}
                bar.solids.add_whole(contact.touching.against, **others)
