"""Springs of free bodies, and springs and motors at hinges.

A spring connects a point of a free body to a point of a second solid, or to a point fixed in space. The tension is

    t = k (l - l_0) + C u,

with the stiffness k, the length l, the rest length l_0, the damping C, and the rate of extension u. A slack spring only
pulls, with a tension of at least 0. The body gets the momentum of the tension in a time step, and the second solid gets
the opposite momentum. Spring forces use the poses at the start of a step, and the new velocities then move the bodies
(symplectic Euler). Without damping, the time step must be at most 2 / omega for a spring of angular frequency omega.

A spring and a motor at a hinge give a body, turned by the angle phi about the hinge, the torque

    T - k (phi - phi_0) - C (r - s),

with the motor's torque T, the stiffness k, the rest angle phi_0, the damping C, the angular velocity r about the hinge,
and the motor's speed s. The hinge gives the second solid the opposite torque. At half a turn, the angle phi jumps from
pi to -pi.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.particles.moving_walls import resting_pose
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Layout, Parameters, clear, zeros
from cortado.scene.links import Ends, Joint
from cortado.sph.free_solids import Changes, FreeBody, FreeSolidsPart, given_to
from cortado.sph.parts import Adjoints, StepContext, Tangents

TAUT = 0.01
NUMBERS = ("stiffness", "rest_length", "damping")
TURNING = ("stiffness", "rest_angle", "damping", "torque", "speed")
POSES = (
    ("c_0", "e_0", "before", "before"),
    ("R_0", "E_0", "turns_before", "turned_before"),
    ("c", "e", "after", "after"),
    ("R", "E", "turns", "turned"),
)
"""Kernel arguments of two solids and names of arrays, for each pose before or after a step."""
TURNED = {name: f"{name}_turn" for name in ("R_0", "R", "E_0", "E")}


@cache
def constants_types(precision: Precision) -> tuple[Any, Any]:
    vector, matrix, both = precision.vector, precision.matrix, {"is_free": wp.bool}
    spring, hinge = {"own": vector, "anchor": vector, "slack": wp.bool}, {"begun": matrix, "other_begun": matrix}
    return struct_of("Spring", precision, **spring, **both), struct_of("Hinge", precision, axis=vector, **hinge, **both)


@cache
def spring_kernels(precision: Precision) -> tuple[Kernels, Kernels, Kernels]:
    """Make the kernels of the momentum by a spring, of its force and length, and of the angular momentum by a hinge."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    (spring_of, hinge_of), kinds = constants_types(precision), {vector: "c_0 c e_0 e W", matrix: "R_0 R E_0 E"}
    taut, tiny, no, one = (wp.constant(real(value)) for value in (TAUT, precision.tiny, 0.0, 1.0))
    typed = TypesByName(real, {**kinds, spring_of: "spring", hinge_of: "hinge"})

    @wp.func
    def tension(k: real, rest: real, c: real, dt: real, d: vector, moved: vector, slack: bool) -> real:
        """``d`` is the vector between the ends of a spring. ``moved`` is the change of ``d`` in a step."""
        length = wp.sqrt(wp.dot(d, d) + tiny)
        longer, rate = length - rest, wp.dot(d, moved) / (length * dt)
        found = k * longer + c * rate
        if slack:
            share = wp.clamp(longer / (taut * rest + tiny), no, one)
            found = wp.max(k * longer + share * c * rate, no)
        return found

    @typed
    def pull(
        time_step_i, stiffness_i, rest_length_i, damping_i, c_0_i, R_0_i, c_i, R_i, e_0_i, E_0_i, e_i, E_i, spring, cell
    ) -> tuple[vector, vector, vector, vector]:
        arm, other_arm = R_0_i * spring.own, E_0_i * spring.anchor
        d = e_0_i + other_arm - c_0_i - arm
        moved = e_i + E_i * spring.anchor - c_i - R_i * spring.own - d
        t = tension(stiffness_i, rest_length_i, damping_i, time_step_i, d, moved, spring.slack)
        P = (time_step_i * t / (cell * wp.sqrt(wp.dot(d, d) + tiny))) * d
        against = wp.where(spring.is_free, -one, no)
        return P, wp.cross(arm, P), against * P, against * wp.cross(other_arm, P)

    @typed
    def read(
        time_step_i, stiffness_i, rest_length_i, damping_i, c_0_i, R_0_i, c_i, R_i, e_0_i, E_0_i, e_i, E_i, spring
    ) -> vector:
        d = e_0_i + E_0_i * spring.anchor - c_0_i - R_0_i * spring.own
        moved = e_i + E_i * spring.anchor - c_i - R_i * spring.own - d
        t = tension(stiffness_i, rest_length_i, damping_i, time_step_i, d, moved, spring.slack)
        return vector(t, wp.sqrt(wp.dot(d, d) + tiny), no)

    @wp.func
    def about(Q: matrix) -> vector:
        return vector(Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1])

    @typed
    def twist(
        time_step_i, stiffness_i, rest_angle_i, damping_i, torque_i, speed_i, R_0_i, W_i, E_0_i, E_i, hinge, cell
    ) -> tuple[vector, vector]:
        P = E_0_i * wp.transpose(hinge.other_begun)
        Q, a = wp.transpose(P) * R_0_i * wp.transpose(hinge.begun), P * hinge.axis
        angle = wp.atan2(wp.dot(hinge.axis, about(Q)), Q[0, 0] + Q[1, 1] + Q[2, 2] - one)
        turned = about(E_i * wp.transpose(E_0_i)) / (real(2.0) * time_step_i)
        rate = wp.dot(a, W_i - turned) - speed_i
        torque = torque_i - stiffness_i * (angle - rest_angle_i) - damping_i * rate
        found = (time_step_i * torque / cell) * a
        return found, wp.where(hinge.is_free, -one, no) * found

    modules = [kernel_module(f"springs_derivative_{precision.name}")] * 3
    given = [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")]
    names: dict[str, Any] = {"written": [*"cReE", "c_0", "R_0", "e_0", "E_0"], "turned": TURNED}
    pulls = pointwise_kernels(precision, modules, lambda _: pull, given, numbers=["spring", "cell"], **names)
    reads = pointwise_kernels(precision, modules, lambda _: read, ["reading"], numbers=["spring"], **names)
    names = {"written": ["R_0", "E_0", "E"], "told": ["torque", "speed"], "numbers": ["hinge", "cell"]}
    return pulls, reads, pointwise_kernels(precision, modules, lambda _: twist, given[1::2], turned=TURNED, **names)


def numbers_of(parameters: Parameters, name: str, ends: Sequence[str], suffix: str = "") -> Named:
    return {f"{end}{suffix}": parameters[f"{name}.{end}"] for end in ends}


class SpringsTangent:
    def __init__(self, springs: "Springs", changes: Sequence[Changes]):
        self._springs, self._changes = springs, changes

    def look(self, step: StepContext, dot: Tangents) -> None:
        own, sizes = self._springs, {"time_step_dot": dot.parameters["time_step"]}
        for kernels, of, ends, known in own.each(step, self._changes):
            dots = numbers_of(dot.parameters, of.name, ends, "_dot"), sizes, self._changes[of.body].before
            step.launch(kernels.tangent, *dots, *known, threads=own.layout.members)


class PoseBars:
    def __init__(self, springs: "Springs"):
        self._springs, layout = springs, springs.layout
        names = (TURNED.get(name, name) for own, other, *_ in POSES for name in (own, other))
        self.named = zeros({f"{one}_bar": (layout.members, layout.precision.vector) for one in names}, layout.device)

    def add(self, of: Ends | Joint, bar: Adjoints) -> None:
        for k, number in enumerate((self._springs.number(of.body), of.against)):
            if number >= 0:
                names = {f"{row[3]}_bar": f"{TURNED.get(row[k], row[k])}_bar" for row in POSES}
                bar.solids.add_whole(number, **{name: self.named[one] for name, one in names.items()})
        clear(self.named.values())


class SpringsAdjoint:
    def __init__(self, springs: "Springs", changes: Sequence[Changes]):
        self._springs, self._changes, self._poses = springs, changes, PoseBars(springs)

    def look(self, step: StepContext, bar: Adjoints) -> None:
        own, sizes = self._springs, {"time_step_bar": bar.parameters["time_step"]}
        for kernels, of, ends, known in own.each(step, self._changes):
            bars = numbers_of(bar.parameters, of.name, ends, "_bar"), sizes, self._changes[of.body].before
            step.launch(kernels.adjoint, *bars, self._poses.named, *known, threads=own.layout.members)
            self._poses.add(of, bar)


class Springs:
    derivatives = SpringsTangent, SpringsAdjoint

    def __init__(self, part: FreeSolidsPart, springs: Sequence[Ends], turned: Sequence[Joint], layout: Layout):
        self.part, self.springs, self.turned, self.layout = part, springs, turned, layout
        self.pull, self.read, self.twist = spring_kernels(layout.precision)
        self._rest = resting_pose(layout)

    def ends(self, of: Ends | Joint) -> Named:
        found: dict[str, wp.array] = {}
        each = self.part.made_of.walls.each
        pose, other_pose = each[self.number(of.body)], self._rest if of.against < 0 else each[of.against]
        for own, other, name, change in POSES:
            found |= {own: pose[name], f"{TURNED.get(own, own)}_dot": pose[f"{change}_dot"]}
            found |= {other: other_pose[name], f"{TURNED.get(other, other)}_dot": other_pose[f"{change}_dot"]}
        return found

    def known(self, of: Ends | Joint) -> tuple[Named, ...]:
        precision, (spring_of, hinge_of) = self.layout.precision, constants_types(self.layout.precision)
        if isinstance(of, Ends):
            spring = spring_of()
            spring.own, spring.anchor = map(precision.vector_of, (of.point, of.anchor))
            spring.slack, spring.is_free = of.slack, of.other >= 0
            return self.ends(of), {"spring": spring}
        hinge = hinge_of()
        hinge.axis, hinge.is_free = precision.vector(*of.axis), of.other >= 0
        hinge.begun, hinge.other_begun = (precision.matrix(*one.turn.ravel()) for one in of.begun)
        return self.ends(of), {"hinge": hinge}, self.part.bodies[of.body].before

    def number(self, body: int) -> int:
        return self.part.bodies[body].table.number

    def each(
        self, step: StepContext, bodies: Sequence[FreeBody | Changes]
    ) -> Iterator[tuple[Kernels, Ends | Joint, Sequence[str], tuple[Named, ...]]]:
        all_of: list[Ends | Joint] = [*self.springs, *self.turned]
        for of in all_of:
            kernels, ends = (self.pull, NUMBERS) if isinstance(of, Ends) else (self.twist, TURNING)
            given = given_to(bodies, of.body, of.other)
            yield kernels, of, ends, (given, numbers_of(step.parameters, of.name, ends), *self.known(of))

    def look(self, step: StepContext) -> None:
        for kernels, _, _, known in self.each(step, self.part.bodies):
            step.launch(kernels.forward, *known, threads=self.layout.members)


def springs_in(solver: Any) -> Iterator[tuple[Springs, Ends]]:
    for part in solver.parts:
        for pushes in part.pushes if isinstance(part, FreeSolidsPart) else ():
            if isinstance(pushes, Springs):
                yield from ((pushes, spring) for spring in pushes.springs)
