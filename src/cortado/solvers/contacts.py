"""Bodies that touch the container, solids and each other: see `cortado.solvers.contact_kernels`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.reduction import sum_of
from cortado.particles.state import Layout, padded
from cortado.particles.wall_terms import WHOLE
from cortado.scene.motions import density_name
from cortado.solvers.contact_kernels import contact_kernels, strength_kernels
from cortado.solvers.obstacles import Obstacle, middle_of, obstacle_mesh
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart
from cortado.sph.parts import Adjoints, StepContext, Tangents

Arrays = dict[str, wp.array]
SHARES = ("push", "twist", "other")


@dataclass(frozen=True)
class Touching:
    """A free body and what it may touch: all solids at rest, or one solid that moves."""

    body: int
    """Number of the body among the free bodies."""
    against: int
    """Number of the other solid among the solids that move; -1 for solids at rest."""
    other: int
    """Number of the other solid among the free bodies; -1 for a solid that is not free."""
    obstacles: Sequence[Obstacle]
    points: NDArray[np.float64]
    """(n, d) of the surface of the body, in its frame [m]"""


class Contact:
    """One contact between a body and other solids, with its arrays on the device, in the steps of a solver."""

    def __init__(self, touching: Touching, spacing: float, layout: Layout):
        self.touching, precision, device = touching, layout.precision, layout.device
        self.meshes = [obstacle_mesh(one, spacing, device) for one in touching.obstacles]
        self.places: list[dict[str, Any]] = [
            {
                "mesh": mesh.id,
                "middle": precision.vector(*padded(middle_of(one)[None])[0]),
                "side": -1.0 if one.is_hollow else 1.0,
            }
            for one, mesh in zip(touching.obstacles, self.meshes, strict=True)
        ]
        points = padded(touching.points)
        self.count, self._layout = len(points), layout
        self.own = wp.array(points, dtype=precision.vector, device=device)
        self.all = layout.members * self.count

    def arrays(self, names: Sequence[str], dtype: Any) -> Arrays:
        """Make arrays (members points,) of zeros, by name, all of one type."""
        return self.arrays_of(dict.fromkeys(names, dtype))

    def arrays_of(self, kinds: Mapping[str, Any]) -> Arrays:
        """Make arrays (members points,) of zeros, by name, each of its own type."""
        return {name: wp.zeros(self.all, dtype=kind, device=self._layout.device) for name, kind in kinds.items()}

    def total(self, dtype: Any) -> Any:
        """Make a function that adds up the values of a body's points, scene by scene."""
        return sum_of(dtype, self.count, self._layout.device, self._layout.members)


class Seen:
    """The depths of a body's points within another body, with normals and shares of the force; or their tangents."""

    def __init__(self, contact: Contact, layout: Layout, suffix: str = ""):
        real, vector = layout.precision.real, layout.precision.vector
        self._suffix = suffix
        self.numbers = contact.arrays([f"depth{suffix}", f"square{suffix}"], real)
        self.normals = contact.arrays([f"normal{suffix}"], vector)
        self.shares = contact.arrays([f"{name}{suffix}" for name in SHARES], vector)
        self._whole, self._sums = contact.total(real), [contact.total(vector) for _ in SHARES]

    def clear(self) -> None:
        """Forget what points of the body found in the last step."""
        for array in (*self.numbers.values(), *self.normals.values()):
            array.zero_()

    def whole(self) -> Arrays:
        """Sum up S = sum d^4 over the points of a contact, (members,), by the name that kernels have for it."""
        return {f"whole{self._suffix}": self._whole(self.numbers[f"square{self._suffix}"])}

    def sums(self) -> Arrays:
        """Return the sums over the points of a body of each share of the contact force, (members,) vectors each."""
        shares = zip(self.shares.items(), self._sums, strict=True)
        names = [f"{name}_sum{self._suffix}" for name in SHARES]
        return dict(zip(names, (total(share) for (_, share), total in shares), strict=True))


class Contacts:
    """The contacts of the free bodies of one solver with solids, the container and each other; each step looks for them
    once poses are known."""

    def __init__(
        self,
        part: FreeSolidsPart,
        touching: Sequence[Touching],
        spacing: float,
        periods: NDArray[np.float64],
        layout: Layout,
    ):
        """Prepare contacts of a solver's bodies; ``periods`` (d,) [m] are 0 along axes without one."""
        self.part, self.layout, self.kernels = part, layout, contact_kernels(layout.precision)
        self.strength = strength_kernels(layout.precision)
        self.contacts = [Contact(one, spacing, layout) for one in touching if len(one.obstacles)]
        self.seen = [Seen(contact, layout) for contact in self.contacts]
        self._period = layout.precision.vector(*padded(periods[None])[0])
        self._whole: list[Arrays] = [{} for _ in self.contacts]
        self._sums: list[Arrays] = [{} for _ in self.contacts]

    def bodies(self, number: int) -> tuple[FreeBody, FreeBody]:
        """Return the body of a contact and the other free body; the first one twice where the other is not free."""
        touching, bodies = self.contacts[number].touching, self.part.bodies
        own = bodies[touching.body]
        return own, own if touching.other < 0 else bodies[touching.other]

    def known(self, step: StepContext, number: int) -> tuple[Named, ...]:
        """Return the arrays and constants of a contact by the names that kernels have for them."""
        contact, seen, (own, other) = self.contacts[number], self.seen[number], self.bodies(number)
        volumes = self.layout.precision.pair(own.table.mass.volume, other.table.mass.volume)
        constants: dict[str, Any] = {
            "points": contact.count,
            "number": own.table.number,
            "against": contact.touching.against,
            "period": self._period,
            "is_free": contact.touching.other >= 0,
            "volumes": volumes,
            "own": contact.own,
            "density": step.parameters[density_name(own.table.name)],
            "other_density": step.parameters[density_name(other.table.name)],
        }
        found = seen.numbers, seen.normals, seen.shares, self._whole[number], self._sums[number]
        return constants, *found, self.part.poses

    def look(self, step: StepContext) -> None:
        """Find the contacts of a step, and write the momenta that bodies get from them."""
        for body in self.part.bodies:
            for array in body.given.values():
                array.zero_()
        for number, (contact, seen) in enumerate(zip(self.contacts, self.seen, strict=True)):
            seen.clear()
            known = self.known(step, number)
            for place in contact.places:
                step.launch(self.kernels.look.forward, place, *known, threads=contact.all)
            self._whole[number] = seen.whole()
            step.launch(self.kernels.push.forward, *self.known(step, number), threads=contact.all)
            self._sums[number] = seen.sums()
            own, other = self.bodies(number)
            given = {**own.given, **{f"{name}_other": array for name, array in other.given.items()}}
            step.launch(self.strength.forward, given, *self.known(step, number), threads=self.layout.members)

    def tangent(self, changes: Sequence[Changes]) -> "ContactsTangent":
        """Return forward mode of `look`: from ``changes`` of the bodies' poses to those of what contacts push with."""
        return ContactsTangent(self, changes)

    def adjoint(self, changes: Sequence[Changes]) -> "ContactsAdjoint":
        """Return reverse mode of `look`: from the adjoints in ``changes`` of what contacts push with to those of poses,
        densities and the time step."""
        return ContactsAdjoint(self, changes)


class ContactsTangent:
    """The tangent of the contacts between bodies, for forward mode."""

    def __init__(self, contacts: Contacts, changes: Sequence[Changes]):
        self._contacts, self._changes = contacts, changes
        self._seen = [Seen(contact, contacts.layout, "_dot") for contact in contacts.contacts]

    def look(self, step: StepContext, dot: Tangents) -> None:
        """Write the tangents of the depths and normals that `Contacts.look` finds."""
        contacts, kernels = self._contacts, self._contacts.kernels
        for own in self._changes:
            for array in own.given.values():
                array.zero_()
        for number, (contact, seen) in enumerate(zip(contacts.contacts, self._seen, strict=True)):
            known = (seen.numbers, seen.normals, seen.shares, *contacts.known(step, number))
            step.launch(kernels.look.tangent, *known, threads=contact.all)
            step.launch(kernels.push.tangent, seen.whole(), *known, threads=contact.all)
            bodies, (own, other) = contacts.bodies(number), _both(contact, self._changes)
            rates = {"time_step_dot": dot.parameters["time_step"]}
            for name, body in zip(("density_dot", "other_density_dot"), bodies, strict=True):
                rates[name] = dot.parameters[density_name(body.table.name)]
            given = {**own.given, **_of_other(other.given)}
            members = contacts.layout.members
            step.launch(contacts.strength.tangent, given, rates, seen.sums(), *known, threads=members)


class ContactsAdjoint:
    """The adjoint of the contacts between bodies, for reverse mode."""

    def __init__(self, contacts: Contacts, changes: Sequence[Changes]):
        self._contacts, self._changes = contacts, changes
        layout = contacts.layout
        real, vector = layout.precision.real, layout.precision.vector
        kinds = dict.fromkeys(("own_force", "own_torque", "other_force", "other_torque"), vector)
        kinds["other_growth"] = real
        self._work = [contact.arrays(["work", "weighed"], real) for contact in contacts.contacts]
        self._moved = [contact.arrays_of(kinds) for contact in contacts.contacts]
        self._weighed = [contact.total(real) for contact in contacts.contacts]
        self._sums = [{name: contact.total(kind) for name, kind in kinds.items()} for contact in contacts.contacts]
        self._shares = {f"{name}_bar": wp.zeros(layout.members, dtype=vector, device=layout.device) for name in SHARES}

    def look(self, step: StepContext, bar: Adjoints) -> None:
        """Apply the adjoint of `Contacts.look`: from adjoints of the bodies' momenta to adjoints of their poses."""
        contacts, kernels = self._contacts, self._contacts.kernels
        for number, contact in enumerate(contacts.contacts):
            bodies, (own, other) = contacts.bodies(number), _both(contact, self._changes)
            rates = {"time_step_bar": bar.parameters["time_step"]}
            for name, body in zip(("density_bar", "other_density_bar"), bodies, strict=True):
                rates[name] = bar.parameters[density_name(body.table.name)]
            given = {**own.given, **_of_other(other.given)}
            work, moved, known = self._work[number], self._moved[number], contacts.known(step, number)
            step.launch(contacts.strength.adjoint, given, rates, self._shares, *known, threads=contacts.layout.members)
            step.launch(kernels.push.adjoint, self._shares, work, *known, threads=contact.all)
            weighed = {"weighed_sum": self._weighed[number](work["weighed"])}
            step.launch(kernels.look.adjoint, self._shares, work, moved, weighed, *known, threads=contact.all)
            sums = {name: total(moved[name]) for name, total in self._sums[number].items()}
            bar.solids.add_whole(bodies[0].table.number, sums["own_force"], sums["own_torque"])
            if contact.touching.against >= 0:
                bar.solids.add_whole(contact.touching.against, *(sums[f"other_{name}"] for name in WHOLE))


def _both(contact: Contact, changes: Sequence[Changes]) -> tuple[Changes, Changes]:
    own = changes[contact.touching.body]
    return own, own if contact.touching.other < 0 else changes[contact.touching.other]


def _of_other(given: Arrays) -> Arrays:
    """Rename a body's adjoints for kernels that take it as the other one: ``pushed_bar``, ``pushed_other_bar``."""
    return {f"{name.split('_')[0]}_other_{name.split('_')[1]}": array for name, array in given.items()}
