"""Contacts of free bodies with the container, solids and each other: a smooth penalty with restitution and friction.

At the predicted pose of a body, surface points j of the body are inside another solid at depths d_j > 0. The depth d_j
is measured along the normal n_j of the face above point j. Point j has the weight w_j = d_j^3 / sum d_j^3. The depth of
the contact, D = sum_j w_j d_j, is near the greatest depth for any number of points. The contact gives the body the
momentum

    P = (q / dt) m D sum_j w_j n_j,   1 / m = 1 / M + r^2 / I,

and gives the other solid the momentum -P. Here q is the stiffness, dt the time step, M the mass of the body, r the arm
of P, and I the least moment of inertia. If the other solid is free, 1 / m also includes 1 / M and r^2 / I of the other
solid. A body in contact oscillates with the angular frequency sqrt(q) / dt. Two free bodies have two contacts of the
weight one half, because surface points of each body are inside the other body.

*Restitution*: The product of beta - 1 and the growth of D in the step is added to D. The factor beta is a function of
the coefficient of restitution e. The function beta(e) is fitted to simulated impacts on a wall, so that a body rebounds
at e times its speed. For e from 0.03 to 0.95, the error of the fit is at most 0.004. For e = 1 a body rebounds at 0.98
times its speed.

*Friction* (Coulomb): The momentum Q = sum_j w_j (m_j u_j + M g dt) would stop all slip. Point j slips with the velocity
u_j and has the effective mass m_j. The term M g dt, with gravity g along the face, is zero if the other solid is free.
With the coefficient of friction mu, the contact gives the body the momentum

    -Q / (1 + t^8)^(1/8),   t = sum_j w_j |m_j u_j + M g dt| / (mu (q / dt) m D).

If Q is small, the friction momentum stops the slip. If Q is large, the friction momentum is mu times the normal
momentum. A body at rest on a slope creeps at a speed of up to t^8 / 8 times M g dt / m_j.

Derivatives jump when a contact begins or the face above a point changes. At mu = 0 the derivative with respect to mu is
one-sided.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import Named, bundle
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add, sum_of
from cortado.discretise.shapes import Points
from cortado.particles.moving_walls import resting_pose
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Layout, Parameters, clear, padded, zeros
from cortado.scene.motions import RESTITUTION, friction_name, restitution_name
from cortado.solvers.obstacles import Obstacle, middle_of, obstacle_mesh
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart, given_to
from cortado.sph.friction_kernels import lift_kernels
from cortado.sph.moving_solids import free_module, hold_type
from cortado.sph.parts import Adjoints, StepContext, Tangents

STIFFNESS = 0.04
"""Stiffness q of a contact [-]."""
FAR = 1e6
"""Greatest distance of the search for faces [m]."""
SHARES = ("pushes", "drags", "scales")
"""Names of arrays over surface points: the normal momentum, the friction momentum and the weight of each point."""
OWN = ("before", "turned_before", "after", "turned")
POSES = ("before", "turns_before", "after", "turns")
NUMBERS = ("time_step", "density", "other_density")


@cache
def contact_kernels(precision: Precision) -> SimpleNamespace:
    real, vector, matrix, pair = precision.real, precision.vector, precision.matrix, precision.pair
    modules, stiffness = [free_module(precision, "contacts")] * 3, wp.constant(real(STIFFNESS))

    @wp.func
    def vec(a: wp.vec3f) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def along(way: real, length: real) -> real:
        """Return a distance along an axis to the nearest periodic image [m]."""
        found = way
        if length > real(0.0):
            found = way - length * wp.round(way / length)
        return found

    no, half, one, tiny = (wp.constant(real(value)) for value in (0.0, 0.5, 1.0, precision.tiny))
    vectors, six = "before after other_before other_after own face shift lift slides", precision.six
    kinds = {
        matrix: "turns turns_before other_turns other_turns_before pushes_sum drags_sum",
        six: "scales_sum",
        pair: "volumes greatest",
        bool: "is_free",
    }
    typed = TypesByName(real, {vector: vectors, hold_type(precision): "hold", **kinds})

    @wp.func
    def ease(density: real, other: real, volumes: pair, greatest: pair, is_free: bool, arms: pair) -> real:
        """Return the inverse of the effective mass of two solids in contact."""
        found = (one / volumes[0] + greatest[0] * arms[0]) / density
        if is_free:
            found += (one / volumes[1] + greatest[1] * arms[1]) / other
        return found

    @wp.func
    def column(M: matrix, k: int) -> vector:
        return vector(M[0, k], M[1, k], M[2, k])

    @wp.func
    def mean(own: real, other: real, is_free: bool) -> real:
        return wp.where(is_free, half * (own + other), own)

    @wp.func
    def eased(t: real) -> real:
        fourth = (t * t) * (t * t)
        return one / wp.sqrt(wp.sqrt(wp.sqrt(one + fourth * fourth)))

    @typed.kernel(modules[0])
    def look(
        particles: int, period: vector, axes: vector, mesh: wp.uint64, origin: vector, inner: vector, side: real, own,
        after, turns, other_after, other_turns, other_scales,
        of: bundle(face=vector, plane=real, shift=vector, depth=real),
    ):  # fmt: skip
        """Find the depth of a surface point in the mesh of a solid, and the face above the point."""
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
        n = side * wp.normalize(wp.cw_mul(axes, wp.cross(second - first, third - first)))
        d = other_scales[b] * wp.dot(n, first - y)
        if d > of.depth[j]:
            of.face[j] = n
            of.plane[j] = wp.dot(n, first + inner)
            of.shift[j] = way - x + origin
            of.depth[j] = d

    @typed
    def push(
        time_step, lift, density, other_density, before, turns_before, after, turns, other_before, other_turns_before,
        other_after, other_turns, other_scales, volumes, greatest, is_free, hold, slides, own_i, face_i, plane_i,
        shift_i,
    ) -> tuple[matrix, matrix, six]:  # fmt: skip
        r, n = turns * own_i, other_turns * face_i
        x = after + r - other_after - shift_i
        y = wp.transpose(other_turns) * x
        y_before = wp.transpose(other_turns_before) * (before + turns_before * own_i - other_before - shift_i)
        d = other_scales * plane_i - wp.dot(face_i, y)
        d_before = wp.max(other_scales * plane_i - wp.dot(face_i, y_before), no)
        u, g = other_turns * (y - y_before - time_step * slides), wp.cw_mul(hold.moving, lift)
        u, g = u - wp.dot(n, u) * n, wp.where(is_free, no, density * volumes[0]) * (g - wp.dot(n, g) * n)
        size = wp.dot(u, u) + tiny
        arm, other_arm = wp.cross(r, u), wp.cross(x, u)
        arms = pair(wp.dot(arm, arm) / size, wp.dot(other_arm, other_arm) / size)
        w = d * d * d
        stop = u / (time_step * ease(density, other_density, volumes, greatest, is_free, arms)) - g
        slide = w * wp.sqrt(wp.dot(stop, stop) + tiny)
        f, drag = w * n, w * stop
        begun = d_before * d_before * d_before
        pushes = wp.matrix_from_cols(f, wp.cross(r, f), wp.cross(x, f))
        drags = wp.matrix_from_cols(drag, wp.cross(r, drag), wp.cross(x, drag))
        return pushes, drags, six(w, w * d, begun, begun * d_before, slide, no)

    @typed
    def give(
        time_step_i, density_i, other_density_i, restitution_i, other_restitution_i, friction_i, other_friction_i,
        is_free, volumes, greatest, pushes_sum_i, drags_sum_i, scales_sum_i,
    ) -> tuple[vector, vector, vector, vector]:  # fmt: skip
        part, grip, share, cube = no, no, wp.where(is_free, half, one), scales_sum_i[0]
        if cube > no:
            turn, back = column(pushes_sum_i, 1) / cube, column(pushes_sum_i, 2) / cube
            arms, by = pair(wp.dot(turn, turn), wp.dot(back, back)), share / cube
            u = wp.log(mean(restitution_i, other_restitution_i, is_free) + real(0.03))
            beta = real(0.02943804) + u * (real(-3.44174961) + u * (real(0.11397519) - real(0.21607366) * u))
            deep = beta * scales_sum_i[1] / cube
            if scales_sum_i[2] > no:
                deep += (one - beta) * scales_sum_i[3] / scales_sum_i[2]
            light = ease(density_i, other_density_i, volumes, greatest, is_free, arms)
            part = by * stiffness * wp.max(deep, no) / (time_step_i * light)
            most, stop = mean(friction_i, other_friction_i, is_free) * part * cube, by * scales_sum_i[4]
            if stop > most:
                grip = by * (most / stop) * eased(most / stop)
            elif most > no:
                grip = by * eased(stop / most)
        found, against = part * pushes_sum_i - grip * drags_sum_i, wp.where(is_free, -one, no)
        return column(found, 0), column(found, 1), against * column(found, 0), against * column(found, 2)

    moved = [*POSES, *(f"other_{name}" for name in POSES), "other_scales", "lift", *NUMBERS]
    turned = dict(zip(POSES[1::2], OWN[1::2], strict=True))
    turned |= {f"other_{name}": f"other_{turn}" for name, turn in turned.items()}
    numbers = ["is_free", "volumes", "greatest"]
    roles: dict[str, Any] = {"numbers": [*numbers, "hold", "slides"], "written": moved, "where": "depth"}
    roles |= {"known": ["own", "face", "plane", "shift"], "summed": SHARES, "turned": turned}
    given = [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")]
    roles_of_sums: dict[str, Any] = {"numbers": numbers, "written": [f"{name}_sum" for name in SHARES]}
    pushes = pointwise_kernels(precision, modules, lambda _: push, SHARES, **roles)
    gives = pointwise_kernels(precision, modules, lambda _: give, given, **roles_of_sums)
    return SimpleNamespace(look=look, push=pushes, give=gives)


Arrays = dict[str, wp.array]


@dataclass(frozen=True)
class Touching:
    """Solids that a free body may touch: either all solids at rest, or one moving solid."""

    body: int
    against: int
    """Index of the touched solid among the moving solids; -1 for solids at rest."""
    other: int
    """Index of the touched solid among the free bodies; -1 for a solid that is not a free body."""
    obstacles: Sequence[Obstacle]
    points: Points
    """Array of shape (n, d) with points of the body's surface in the body's frame [m]."""
    slides: Sequence[float] = ()
    """Vector of shape (d,): velocity of the touched solid's sliding surface in the solid's frame [m/s]."""


class Contact:
    def __init__(self, touching: Touching, spacing: float, layout: Layout):
        self.touching, precision, device = touching, layout.precision, layout.device
        self.meshes = [obstacle_mesh(one, spacing, device) for one in touching.obstacles]
        self.places: list[dict[str, Any]] = []
        for one, mesh in zip(touching.obstacles, self.meshes, strict=True):
            middle, none = precision.vector_of(middle_of(one)), precision.vector()
            origin, inner = (middle, none) if touching.against < 0 else (none, middle)
            side = -1.0 if one.is_hollow else 1.0
            self.places.append({"mesh": mesh.id, "origin": origin, "inner": inner, "side": side})
        points, real, vector = padded(touching.points), precision.real, precision.vector
        self.slides = precision.vector_of(touching.slides or (0.0, 0.0))
        self.count, self.layout = len(points), layout
        self.own = wp.array(np.tile(points, (layout.members, 1)), dtype=vector, device=device)
        self.all = layout.members * self.count
        self.found = self.arrays({"face": vector, "plane": real, "shift": vector, "depth": real})
        """Nearest faces above the surface points of the body."""

    def given(self, each: Sequence[FreeBody | Changes]) -> Arrays:
        return given_to(each, self.touching.body, self.touching.other)

    def arrays(self, kinds: Mapping[str, Any]) -> Arrays:
        return {name: wp.zeros(self.all, dtype=kind, device=self.layout.device) for name, kind in kinds.items()}


class Totals:
    def __init__(self, contact: Contact, kinds: Mapping[str, Any], suffix: str = "", end: str = "_sum"):
        size = contact.count, contact.layout.device, contact.layout.members
        self.each = contact.arrays({f"{name}{suffix}": kind for name, kind in kinds.items()})
        self._totals = {f"{name}{end}{suffix}": sum_of(kind, *size) for name, kind in kinds.items()}

    def sums(self) -> Arrays:
        pairs = zip(self._totals.items(), self.each.values(), strict=True)
        return {name: total(array) for (name, total), array in pairs}


def share_kinds(layout: Layout) -> dict[str, Any]:
    matrix = layout.precision.matrix
    return dict(zip(SHARES, (matrix, matrix, layout.precision.six), strict=True))


class ContactsTangent:
    def __init__(self, contacts: "Contacts", changes: Sequence[Changes]):
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
            moved = contacts.contacts[number].given(self._changes), shares.sums()
            step.launch(contacts.kernels.give.tangent, *moved, *known, threads=members)


def lift_sizes(of: Tangents | Adjoints, suffix: str) -> Arrays:
    return {f"{name}{suffix}": of.parameters[name] for name in ("time_step", "gravity")}


class ContactsAdjoint:
    def __init__(self, contacts: "Contacts", changes: Sequence[Changes]):
        self._contacts, self._changes, layout = contacts, changes, contacts.layout
        vectors = [*OWN, *(f"other_{name}" for name in OWN), "lift"]
        kinds = dict.fromkeys(vectors, layout.precision.vector)
        kinds |= dict.fromkeys(("other_scales", *NUMBERS), layout.precision.real)
        self._moved = [Totals(contact, kinds, "_bar", end="") for contact in contacts.contacts]
        sums = {f"{name}_sum_bar": (layout.members, kind) for name, kind in share_kinds(layout).items()}
        self._sums = zeros(sums, layout.device)

    def look(self, step: StepContext, bar: Adjoints) -> None:
        contacts, members = self._contacts, self._contacts.layout.members
        for number, (contact, moved) in enumerate(zip(contacts.contacts, self._moved, strict=True)):
            numbers = contacts.numbers(bar.parameters, number, "_bar")
            known = (self._sums, *contacts.known(step, number))
            given = contact.given(self._changes)
            step.launch(contacts.kernels.give.adjoint, given, numbers, *known, threads=members)
            step.launch(contacts.kernels.push.adjoint, moved.each, *known, threads=contact.all)
            bars = moved.sums()
            for name in NUMBERS:
                add(bars[f"{name}_bar"], numbers[f"{name}_bar"])
            step.launch(contacts.lifts.adjoint, lift_sizes(bar, "_bar"), bars, contacts.lift, threads=members)
            own = [f"{name}_bar" for name in OWN]
            bar.solids.add_whole(contacts.bodies(number)[0].table.number, **{name: bars[name] for name in own})
            if contact.touching.against >= 0:
                others = {name: bars[f"other_{name}"] for name in (*own, "scales_bar")}
                bar.solids.add_whole(contact.touching.against, **others)


class Contacts:
    derivatives = ContactsTangent, ContactsAdjoint

    def __init__(self, part: FreeSolidsPart, touching: Sequence[Touching], spacing: float, periods: Points):
        """``periods`` (d,) are the lengths of the periodic box [m], 0 along axes that are not periodic."""
        layout = part.layout
        self.part, self.layout, self.kernels = part, layout, contact_kernels(layout.precision)
        self.contacts = [Contact(one, spacing, layout) for one in touching if len(one.obstacles)]
        of_solids = part.made_of.walls.each
        self._poses: list[Named] = []
        for against in (contact.touching.against for contact in self.contacts):
            other = resting_pose(layout) if against < 0 else of_solids[against]
            self._poses.append({f"other_{name}": array for name, array in other.items()})
        self._period, self._axes = map(layout.precision.vector_of, (periods, np.ones_like(periods)))
        self._shares = [Totals(contact, share_kinds(layout)) for contact in self.contacts]
        self._sums: list[Arrays] = [{} for _ in self.contacts]
        self._unsaid: Arrays = {}
        for label, value in (("friction", 0.0), ("restitution", RESTITUTION)):
            for name, number in ((label, value), (f"{label}_dot", 0.0), (f"{label}_bar", 0.0)):
                self._unsaid[name] = wp.full(layout.members, number, layout.precision.real, layout.device)
        self.lifts = lift_kernels(layout.precision)
        self.lift = {"lift": wp.zeros(layout.members, dtype=layout.precision.vector, device=layout.device)}

    def bodies(self, number: int) -> tuple[FreeBody, FreeBody]:
        """Return both free bodies of a contact. A body that touches no free body is returned twice."""
        touching, bodies = self.contacts[number].touching, self.part.bodies
        own = bodies[touching.body]
        return own, own if touching.other < 0 else bodies[touching.other]

    def known(self, step: StepContext, number: int) -> tuple[Named, ...]:
        contact, (own, other), pair = self.contacts[number], self.bodies(number), self.layout.precision.pair
        constants: dict[str, Any] = {"period": self._period, "axes": self._axes, "slides": contact.slides}
        constants |= {"particles": contact.count, "own": contact.own, "is_free": contact.touching.other >= 0}
        constants["volumes"] = pair(own.table.mass.volume, other.table.mass.volume)
        constants["greatest"] = pair(own.table.bounds["greatest"], other.table.bounds["greatest"])
        known = constants, self.numbers(step.parameters, number), contact.found, self._sums[number]
        return *known, self._poses[number], own.constants, self.lift

    def numbers(self, parameters: Parameters, number: int, suffix: str = "") -> Arrays:
        found = {f"time_step{suffix}": parameters["time_step"]}
        for way, body in zip(("", "other_"), self.bodies(number), strict=True):
            name, weight = body.table.name, body.table.weight
            of = {"density": weight, "friction": friction_name(name), "restitution": restitution_name(name)}
            for label, one in of.items():
                value = parameters[one] if one in parameters.names else self._unsaid[f"{label}{suffix}"]
                found[f"{way}{label}{suffix}"] = value
        return found

    def look(self, step: StepContext) -> None:
        step.launch(self.lifts.forward, self.lift, threads=self.layout.members)
        for number, (contact, shares) in enumerate(zip(self.contacts, self._shares, strict=True)):
            clear(contact.found.values())
            for place in contact.places:
                step.launch(self.kernels.look, place, *self.known(step, number), threads=contact.all)
            step.launch(self.kernels.push.forward, shares.each, *self.known(step, number), threads=contact.all)
            self._sums[number], given = shares.sums(), contact.given(self.part.bodies)
            step.launch(self.kernels.give.forward, given, *self.known(step, number), threads=self.layout.members)
