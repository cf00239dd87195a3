"""Bodies that touch the container, solids and each other: the force between a body and a solid is a smooth penalty.

Points of a body's surface that are in the other solid, d_j > 0 deep, give it the momentum

    P = (q / dt) M sum_j f_j n_j,   f_j = d_j^3 / sqrt(S),   S = sum_j d_j^4,

along the normals n_j of the faces above them, and the other one -P. This force has the potential
q M sqrt(S) / (2 dt^2), for a depth S^(1/4) that is near the greatest one whatever the number of points. It is the
potential of a spring in which the lighter of two bodies, with M m / (M + m), would swing with sqrt(q) / dt. As d_j is
where the body would go, a swing shrinks by sqrt(1 - q) in a step: a body leaves what it falls on with 0.6 of its speed,
whatever the time step. At a depth of 0 f_j has two derivatives, both 0; where the face above a point changes, there is
a corner.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named, bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import sum_of
from cortado.particles.moving_walls import matrix_of, resting_pose
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Layout, Parameters, padded, zeros
from cortado.solvers.obstacles import Obstacle, middle_of, obstacle_mesh
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart, given_to
from cortado.sph.moving_solids import free_module
from cortado.sph.parts import Adjoints, StepContext, Tangents

STIFFNESS = 0.04
"""The stiffness q of contacts [-]."""
FAR = 1e6
"""[m] beyond which no face is looked for."""
SHARES = ("push", "twist", "other", "square")
"""What a point adds: d^3 n, its moments about the middles of both solids, and d^4."""


@dataclass(frozen=True)
class ContactKernels:
    """Kernels of contact between a body and a solid; the first two have a thread for each surface point in each
    scene."""

    look: Any
    """This finds the face that a point is deepest behind, and goes on from the deepest so far: the normal in the frame
    of the other solid, how far the plane is from the middle of that along it, for a scale of 1, and the shift to the
    image that is near."""
    push: Kernels
    """These compute `SHARES` from both poses and the scale of the other solid; adjoints of these are written, point by
    point."""
    give: Kernels
    """These turn the sums of shares into the momenta of both, with a thread for each scene; a solid that is not free
    gets none."""


@cache
def contact_kernels(precision: Precision) -> ContactKernels:
    """Make the kernels of contacts between bodies and solids in a precision."""
    real, vector, matrix, pair = precision.real, precision.vector, matrix_of(precision), precision.pair
    modules, stiffness = [free_module(precision)] * 3, wp.constant(real(STIFFNESS))

    @wp.func
    def vec(a: wp.vec3f) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def along(way: real, length: real) -> real:
        """Shorten a separation along one axis [m] to that of the nearest periodic image."""
        found = way
        if length > real(0.0):
            found = way - length * wp.round(way / length)
        return found

    vectors = "after other_after own face shift push twist other_sum"
    typed = TypesByName(real, {vector: vectors, matrix: "turns other_turns", pair: "volumes", bool: "is_free"})

    @wp.kernel(module=modules[0], enable_backward=False)
    @typed.arrays
    def look(
        particles: int,
        period: vector,
        mesh: wp.uint64,
        origin: vector,
        inner: vector,
        side: real,
        own,
        after,
        turns,
        other_after,
        other_turns,
        other_scales,
        of: bundle(face=vector, plane=real, shift=vector, depth=real),
    ):
        """Find the face. The mesh is about ``origin`` of a solid at rest, and about ``inner`` in the frame of one that
        moves; ``period`` is 0 along an axis without one."""
        j = wp.tid()
        b = j // particles
        way = after[b] + turns[b] * own[j] - other_after[b] - origin
        x = vector(along(way[0], period[0]), along(way[1], period[1]), along(way[2], period[2]))
        y = wp.transpose(other_turns[b]) * x / other_scales[b] - inner
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(mesh, place, wp.float32(FAR))
        if not found.result or real(found.sign) * side > real(0.0):
            return
        corners = wp.mesh_get(mesh)
        first = vec(corners.points[corners.indices[3 * found.face]])
        second = vec(corners.points[corners.indices[3 * found.face + 1]])
        third = vec(corners.points[corners.indices[3 * found.face + 2]])
        n = side * wp.normalize(wp.cross(second - first, third - first))
        d = other_scales[b] * wp.dot(n, first - y)
        if d > of.depth[j]:
            of.face[j] = n
            of.plane[j] = wp.dot(n, first + inner)
            of.shift[j] = way - x + origin
            of.depth[j] = d

    @typed
    def push(
        after, turns, other_after, other_turns, other_scales, own_i, face_i, plane_i, shift_i
    ) -> tuple[vector, vector, vector, real]:
        r = turns * own_i
        x, n = after + r - other_after - shift_i, other_turns * face_i
        d = other_scales * plane_i - wp.dot(n, x)
        f = (d * d * d) * n
        return f, wp.cross(r, f), wp.cross(x, f), d * d * d * d

    @typed
    def give(
        time_step_i, density_i, other_density_i, is_free, volumes, push_sum_i, twist_sum_i, other_sum_i, square_sum_i
    ) -> tuple[vector, vector, vector, vector]:
        mass, other, strength = density_i * volumes[0], other_density_i * volumes[1], real(0.0)
        both = wp.where(is_free, mass * other / (mass + other), mass)
        if square_sum_i > real(0.0):
            strength = stiffness * both / (time_step_i * wp.sqrt(square_sum_i))
        against = wp.where(is_free, -strength, real(0.0))
        return strength * push_sum_i, strength * twist_sum_i, against * push_sum_i, against * other_sum_i

    moved = ["after", "turns", "other_after", "other_turns", "other_scales"]
    pushes = pointwise_kernels(
        precision,
        modules,
        lambda _: push,
        SHARES,
        written=moved,
        known=["own", "face", "plane", "shift"],
        where="depth",
        summed=SHARES,
        turned={"turns": "turned", "other_turns": "other_turned"},
    )
    gives = pointwise_kernels(
        precision,
        modules,
        lambda _: give,
        [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")],
        numbers=["is_free", "volumes"],
        written=[f"{name}_sum" for name in SHARES],
    )
    return ContactKernels(look, pushes, gives)


Arrays = dict[str, wp.array]


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
        self.places: list[dict[str, Any]] = []
        for one, mesh in zip(touching.obstacles, self.meshes, strict=True):
            middle, none = precision.vector(*padded(middle_of(one)[None])[0]), precision.vector()
            origin, inner = (middle, none) if touching.against < 0 else (none, middle)
            side = -1.0 if one.is_hollow else 1.0
            self.places.append({"mesh": mesh.id, "origin": origin, "inner": inner, "side": side})
        points, real, vector = padded(touching.points), precision.real, precision.vector
        self.count, self.layout = len(points), layout
        self.own = wp.array(np.tile(points, (layout.members, 1)), dtype=vector, device=device)
        self.all = layout.members * self.count
        self.found = self.arrays({"face": vector, "plane": real, "shift": vector, "depth": real})
        """The faces that points are behind, as the kernel ``look`` writes them."""

    def arrays(self, kinds: Mapping[str, Any]) -> Arrays:
        """Make arrays (members points,) of zeros, by name, each of its own type."""
        return {name: wp.zeros(self.all, dtype=kind, device=self.layout.device) for name, kind in kinds.items()}

    def poses(self, each: Sequence[Named]) -> Named:
        """Return pose, scale and tangents of the other solid under the names of kernel arguments, out of those of all
        moving solids, ``each``."""
        against = self.touching.against
        other = resting_pose(self.layout) if against < 0 else each[against]
        return {f"other_{name}": array for name, array in other.items()}


class Totals:
    """Arrays of values of a body's points, such as ``push_dot``, and their sums of each scene, ``push_sum_dot``."""

    def __init__(self, contact: Contact, kinds: Mapping[str, Any], suffix: str = "", end: str = "_sum"):
        layout = contact.layout
        self.each = contact.arrays({f"{name}{suffix}": kind for name, kind in kinds.items()})
        self._totals = {
            f"{name}{end}{suffix}": sum_of(kind, contact.count, layout.device, layout.members)
            for name, kind in kinds.items()
        }

    def sums(self) -> Arrays:
        """Add up the values of each scene, to arrays (members,) by name."""
        pairs = zip(self._totals.items(), self.each.values(), strict=True)
        return {name: total(array) for (name, total), array in pairs}


def share_kinds(layout: Layout) -> dict[str, Any]:
    """Return the types of `SHARES` by name."""
    return {name: layout.precision.real if name == "square" else layout.precision.vector for name in SHARES}


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
        self.contacts = [Contact(one, spacing, layout) for one in touching if len(one.obstacles)]
        self._poses = [contact.poses(part.made_of.walls.each) for contact in self.contacts]
        self._period = layout.precision.vector(*padded(periods[None])[0])
        self._shares = [Totals(contact, share_kinds(layout)) for contact in self.contacts]
        self._sums: list[Arrays] = [{} for _ in self.contacts]

    def bodies(self, number: int) -> tuple[FreeBody, FreeBody]:
        """Return the body of a contact and the other free body; the first one twice where the other is not free."""
        touching, bodies = self.contacts[number].touching, self.part.bodies
        own = bodies[touching.body]
        return own, own if touching.other < 0 else bodies[touching.other]

    def known(self, step: StepContext, number: int) -> tuple[Named, ...]:
        """Return the arrays and constants of a contact by the names that kernels have for them."""
        contact, (own, other) = self.contacts[number], self.bodies(number)
        constants: dict[str, Any] = {
            "particles": contact.count,
            "period": self._period,
            "is_free": contact.touching.other >= 0,
            "volumes": self.layout.precision.pair(own.table.mass.volume, other.table.mass.volume),
            "own": contact.own,
        }
        densities = self.densities(step.parameters, number)
        return constants, densities, contact.found, self._sums[number], self._poses[number], own.constants

    def densities(self, parameters: Parameters, number: int, suffix: str = "") -> Arrays:
        """Return the densities of both solids, or their tangents or adjoints, by the kernels' names."""
        names = (f"density{suffix}", f"other_density{suffix}")
        return {name: parameters[body.table.weight] for name, body in zip(names, self.bodies(number), strict=True)}

    def given(self, number: int, each: Sequence[FreeBody | Changes]) -> Arrays:
        """Return the momenta that both solids get, or their changes."""
        touching = self.contacts[number].touching
        return given_to(each, touching.body, touching.other)

    def look(self, step: StepContext) -> None:
        """Find the contacts of a step, and add the momenta that bodies get from them."""
        for number, (contact, shares) in enumerate(zip(self.contacts, self._shares, strict=True)):
            for array in contact.found.values():
                array.zero_()
            for place in contact.places:
                step.launch(self.kernels.look, place, *self.known(step, number), threads=contact.all)
            step.launch(self.kernels.push.forward, shares.each, *self.known(step, number), threads=contact.all)
            self._sums[number], given = shares.sums(), self.given(number, self.part.bodies)
            step.launch(self.kernels.give.forward, given, *self.known(step, number), threads=self.layout.members)

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
        self._shares = [Totals(contact, share_kinds(contacts.layout), "_dot") for contact in contacts.contacts]

    def look(self, step: StepContext, dot: Tangents) -> None:
        """Add the tangents of the momenta that bodies get from contacts in `Contacts.look`."""
        contacts = self._contacts
        for number, shares in enumerate(self._shares):
            known = contacts.known(step, number)
            step.launch(contacts.kernels.push.tangent, shares.each, *known, threads=contacts.contacts[number].all)
            rates = contacts.densities(dot.parameters, number, "_dot"), {"time_step_dot": dot.parameters["time_step"]}
            moved = contacts.given(number, self._changes), shares.sums()
            step.launch(contacts.kernels.give.tangent, *moved, *rates, *known, threads=contacts.layout.members)


class ContactsAdjoint:
    """The adjoint of the contacts between bodies, for reverse mode."""

    def __init__(self, contacts: Contacts, changes: Sequence[Changes]):
        self._contacts, self._changes, layout = contacts, changes, contacts.layout
        vectors = dict.fromkeys(("after", "turned", "other_after", "other_turned"), layout.precision.vector)
        kinds = {**vectors, "other_scales": layout.precision.real}
        self._moved = [Totals(contact, kinds, "_bar", end="") for contact in contacts.contacts]
        sums = {f"{name}_sum_bar": (layout.members, kind) for name, kind in share_kinds(layout).items()}
        self._sums = zeros(sums, layout.device)

    def look(self, step: StepContext, bar: Adjoints) -> None:
        """Apply the adjoint of `Contacts.look`: from adjoints of the bodies' momenta to adjoints of their poses."""
        contacts = self._contacts
        for number, (contact, moved) in enumerate(zip(contacts.contacts, self._moved, strict=True)):
            rates = contacts.densities(bar.parameters, number, "_bar"), {"time_step_bar": bar.parameters["time_step"]}
            known = (self._sums, *contacts.known(step, number))
            given = contacts.given(number, self._changes)
            step.launch(contacts.kernels.give.adjoint, given, *rates, *known, threads=contacts.layout.members)
            step.launch(contacts.kernels.push.adjoint, moved.each, *known, threads=contact.all)
            bars, own = moved.sums(), ("after_bar", "turned_bar")
            bar.solids.add_whole(contacts.bodies(number)[0].table.number, **{name: bars[name] for name in own})
            if contact.touching.against >= 0:
                others = {name: bars[f"other_{name}"] for name in (*own, "scales_bar")}
                bar.solids.add_whole(contact.touching.against, **others)
