"""Springs that pull free bodies, and springs and motors that turn bodies about hinges.

A spring leads from the point q = c + R p of a body to the point q' of another solid, or of the world. With the length l
= |q' - q|, the unit vector n along the spring, the stiffness k, rest length l_0 and damping C, the tension is

    t = k (l - l_0) + C n . (w' - w),

where w and w' are the velocities of both points. The body gets the momentum dt t n and its moment about the body's
middle; the other solid gets the opposite. Forces use the poses at the start of a step, and the new velocities then move
the bodies: symplectic Euler. Without damping, a spring of frequency omega has the period of arccos(1 - (omega dt)^2 /
2) / dt, within (omega dt)^2 / 24, and dt must be at most 2 / omega.

A slack spring only pulls: t = max(k (l - l_0) + s C n . (w' - w), 0), with s from 0 at l_0 to 1 at 1.01 l_0, and t = 0
below l_0. At the corner the derivative is one-sided.

A body turned by the angle phi about a hinge with axis a gets the torque T - k (phi - phi_0) - C (a . (W - W') - s),
with the motor's torque T and speed s; the other solid gets the opposite. If the hinge is at another solid, which turns
with W', a and phi belong to the frame of that solid. At a half turn phi jumps from pi to -pi.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.particles.moving_walls import resting_pose
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Layout, Parameters, padded
from cortado.scene.hinges import Joint
from cortado.scene.springs import Ends
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart, given_to
from cortado.sph.parts import Adjoints, StepContext, Tangents

TAUT = 0.01
OWN = ("before", "turns_before", "after", "turns")
NUMBERS = ("stiffness", "rest_length", "damping")
TURNING = ("stiffness", "rest_angle", "damping", "torque", "speed")


@cache
def spring_kernels(precision: Precision) -> tuple[Kernels, Kernels, Kernels]:
    """Make the kernels of springs and hinges, with a thread for each scene: the momenta by a spring, its force and
    length as components of a vector, and the angular momentum by a hinge."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    taut, tiny, no, one = (wp.constant(real(value)) for value in (TAUT, precision.tiny, 0.0, 1.0))
    places = "before after other_before other_after own anchor"
    typed = TypesByName(real, {vector: places, matrix: "turns other_turns", bool: "slack is_free"})

    @wp.func
    def tension(k: real, rest: real, c: real, dt: real, d: vector, moved: vector, slack: bool) -> real:
        """Return t for the vector d between the ends; ``moved`` is its change, ``tiny`` is for ends that meet."""
        length = wp.sqrt(wp.dot(d, d) + tiny)
        longer, rate = length - rest, wp.dot(d, moved) / (length * dt)
        found = k * longer + c * rate
        if slack:
            share = wp.clamp(longer / (taut * rest + tiny), no, one)
            found = wp.max(k * longer + share * c * rate, no)
        return found

    @typed
    def pull(
        time_step_i,
        stiffness_i,
        rest_length_i,
        damping_i,
        before_i,
        turns_before_i,
        after_i,
        turns_i,
        other_before_i,
        other_turns_before_i,
        other_after_i,
        other_turns_i,
        own,
        anchor,
        cell,
        slack,
        is_free,
    ) -> tuple[vector, vector, vector, vector]:
        arm, other_arm = turns_before_i * own, other_turns_before_i * anchor
        d = other_before_i + other_arm - before_i - arm
        moved = other_after_i + other_turns_i * anchor - after_i - turns_i * own - d
        t = tension(stiffness_i, rest_length_i, damping_i, time_step_i, d, moved, slack)
        P = (time_step_i * t / (cell * wp.sqrt(wp.dot(d, d) + tiny))) * d
        against = wp.where(is_free, -one, no)
        return P, wp.cross(arm, P), against * P, against * wp.cross(other_arm, P)

    @typed
    def read(
        time_step_i,
        stiffness_i,
        rest_length_i,
        damping_i,
        before_i,
        turns_before_i,
        after_i,
        turns_i,
        other_before_i,
        other_turns_before_i,
        other_after_i,
        other_turns_i,
        own,
        anchor,
        slack,
    ) -> vector:
        d = other_before_i + other_turns_before_i * anchor - before_i - turns_before_i * own
        moved = other_after_i + other_turns_i * anchor - after_i - turns_i * own - d
        t = tension(stiffness_i, rest_length_i, damping_i, time_step_i, d, moved, slack)
        return vector(t, wp.sqrt(wp.dot(d, d) + tiny), no)

    @wp.func
    def about(Q: matrix) -> vector:
        return vector(Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1])

    matrices = "turns_before other_turns_before other_turns begun other_begun"

    @TypesByName(real, {vector: "W axis", matrix: matrices, bool: "is_free"})
    def twist(
        time_step_i,
        stiffness_i,
        rest_angle_i,
        damping_i,
        torque_i,
        speed_i,
        turns_before_i,
        W_i,
        other_turns_before_i,
        other_turns_i,
        axis,
        begun,
        other_begun,
        cell,
        is_free,
    ) -> tuple[vector, vector]:
        P = other_turns_before_i * wp.transpose(other_begun)
        Q, a = wp.transpose(P) * turns_before_i * wp.transpose(begun), P * axis
        angle = wp.atan2(wp.dot(axis, about(Q)), Q[0, 0] + Q[1, 1] + Q[2, 2] - one)
        turned = about(other_turns_i * wp.transpose(other_turns_before_i)) / (real(2.0) * time_step_i)
        rate = wp.dot(a, W_i - turned) - speed_i
        torque = torque_i - stiffness_i * (angle - rest_angle_i) - damping_i * rate
        found = (time_step_i * torque / cell) * a
        return found, wp.where(is_free, -one, no) * found

    modules = [kernel_module(f"springs_derivative_{precision.name}")] * 3
    poses = [*OWN, *(f"other_{name}" for name in OWN)]
    turned = {"turns": "turned", "turns_before": "turned_before"}
    turned |= {f"other_{name}": f"other_{turn}" for name, turn in turned.items()}
    ends = ["own", "anchor", "slack"]
    given = [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")]
    pulls = pointwise_kernels(
        precision, modules, lambda _: pull, given, numbers=[*ends, "cell", "is_free"], written=poses, turned=turned
    )
    reads = pointwise_kernels(
        precision, modules, lambda _: read, ["reading"], numbers=ends, written=poses, turned=turned
    )
    names: dict[str, Any] = {"numbers": ["axis", "begun", "other_begun", "cell", "is_free"], "turned": turned}
    names |= {"written": ["turns_before", "other_turns_before", "other_turns"], "told": ["torque", "speed"]}
    results = ["twisted:twisted", "twisted_other:twisted_other"]
    twists = pointwise_kernels(precision, modules, lambda _: twist, results, **names)
    return pulls, reads, twists


class Springs:
    def __init__(self, part: FreeSolidsPart, springs: Sequence[Ends], turned: Sequence[Joint], layout: Layout):
        self.part, self.springs, self.turned, self.layout = part, springs, turned, layout
        self.pull, self.read, self.twist = spring_kernels(layout.precision)
        self.vectors = {"dtype": layout.precision.vector, "device": layout.device}
        self._rest = resting_pose(layout)

    def ends(self, of: Ends | Joint) -> Named:
        each = self.part.made_of.walls.each
        other = self._rest if of.against < 0 else each[of.against]
        return {**each[self.number(of.body)], **{f"other_{name}": array for name, array in other.items()}}

    def poses(self, spring: Ends) -> tuple[Named, ...]:
        vector = self.layout.precision.vector
        own, anchor = (vector(*padded(place[None])[0]) for place in (spring.point, spring.anchor))
        return self.ends(spring), {"own": own, "anchor": anchor, "slack": spring.slack, "is_free": spring.other >= 0}

    def number(self, body: int) -> int:
        return self.part.bodies[body].table.number

    def known(self, of: Joint) -> tuple[Named, ...]:
        matrix, body = self.layout.precision.matrix, self.part.bodies[of.body]
        begun, other_begun = (matrix(*one.turn.ravel()) for one in of.begun)
        constants = {"axis": self.layout.precision.vector(*of.axis), "begun": begun, "other_begun": other_begun}
        return self.ends(of), constants, {"is_free": of.other >= 0}, body.before

    def each(
        self, step: StepContext, bodies: Sequence[FreeBody | Changes]
    ) -> Iterator[tuple[Kernels, Ends | Joint, Sequence[str], tuple[Named, ...]]]:
        """Yield kernels, spring or hinge, names of its parameters, and kernel arguments with momenta of ``bodies``."""
        for spring in self.springs:
            known = numbers_of(step.parameters, spring.name, NUMBERS), *self.poses(spring)
            yield self.pull, spring, NUMBERS, (given_to(bodies, spring.body, spring.other), *known)
        for of in self.turned:
            known = numbers_of(step.parameters, of.name, TURNING), *self.known(of)
            yield self.twist, of, TURNING, (given_to(bodies, of.body, of.other), *known)

    def look(self, step: StepContext) -> None:
        for kernels, _, _, known in self.each(step, self.part.bodies):
            step.launch(kernels.forward, *known, threads=self.layout.members)

    def tangent(self, changes: Sequence[Changes]) -> "SpringsTangent":
        return SpringsTangent(self, changes)

    def adjoint(self, changes: Sequence[Changes]) -> "SpringsAdjoint":
        return SpringsAdjoint(self, changes)


def numbers_of(parameters: Parameters, name: str, ends: Sequence[str], suffix: str = "") -> Named:
    return {f"{end}{suffix}": parameters[f"{name}.{end}"] for end in ends}


class SpringsTangent:
    def __init__(self, springs: Springs, changes: Sequence[Changes]):
        self._springs, self._changes = springs, changes

    def look(self, step: StepContext, dot: Tangents) -> None:
        own, sizes = self._springs, {"time_step_dot": dot.parameters["time_step"]}
        for kernels, of, ends, known in own.each(step, self._changes):
            dots = numbers_of(dot.parameters, of.name, ends, "_dot"), sizes, self._changes[of.body].before
            step.launch(kernels.tangent, *dots, *known, threads=own.layout.members)


class PoseBars:
    def __init__(self, springs: Springs):
        names = [f"{name}_bar" for name in ("before", "turned_before", "after", "turned")]
        self._springs, self._names = springs, names
        members, vectors = springs.layout.members, springs.vectors
        self.named = {f"{way}{name}": wp.zeros(members, **vectors) for way in ("", "other_") for name in names}

    def add(self, of: Ends | Joint, bar: Adjoints) -> None:
        for way, number in (("", self._springs.number(of.body)), ("other_", of.against)):
            if number >= 0:
                bar.solids.add_whole(number, **{name: self.named[f"{way}{name}"] for name in self._names})
        for array in self.named.values():
            array.zero_()


class SpringsAdjoint:
    def __init__(self, springs: Springs, changes: Sequence[Changes]):
        self._springs, self._changes, self._poses = springs, changes, PoseBars(springs)

    def look(self, step: StepContext, bar: Adjoints) -> None:
        own, sizes = self._springs, {"time_step_bar": bar.parameters["time_step"]}
        for kernels, of, ends, known in own.each(step, self._changes):
            bars = numbers_of(bar.parameters, of.name, ends, "_bar"), sizes, self._changes[of.body].before
            step.launch(kernels.adjoint, *bars, self._poses.named, *known, threads=own.layout.members)
            self._poses.add(of, bar)


def springs_in(solver: Any) -> Iterator[tuple[Springs, Ends]]:
    for part in solver.parts:
        for pushes in part.pushes if isinstance(part, FreeSolidsPart) else ():
            if isinstance(pushes, Springs):
                yield from ((pushes, spring) for spring in pushes.springs)
