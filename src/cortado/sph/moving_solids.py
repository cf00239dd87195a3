"""Solids with a prescribed path, and the motion of free bodies by their momenta, with fixed axes and hinges.

A free body changes its velocity only along free axes, and its angular velocity only about free axes. A body on a hinge
turns about the hinge: its inertia and its angular momentum are about the hinge, and its centre of mass moves with the
rotation.

A prescribed path displaces and turns a solid from its initial pose. A wall particle has the velocity of its
displacement in a step divided by the time step.

A rotation is a rotation vector (Rodrigues) in 3-D, and an angle in 2-D. If the rotation vector w changes by a small
vector u, the rotation is followed by the small rotation J u with the Jacobian

    J = I + (1 - cos |w|) / |w|^2 [w] + (|w| - sin |w|) / |w|^3 [w]^2,

where I is the unit matrix and [w] the matrix of the cross product with w.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.errors import MissingDerivativeError
from cortado.particles.moving_walls import MovingWalls, turn_functions
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Entry, Layout, Parameters, State, StateField
from cortado.scene.links import Hold
from cortado.scene.motions import displacement_name, position_name, rotation_name, scale_name, turn_name
from cortado.scene.parameters import Axis
from cortado.sph.parts import Adjoints, Part, PartAdjoint, PartTangent, StepContext, Tangents, integration_module


@cache
def hold_type(precision: Precision) -> Any:
    """The fields are explained in `cortado.scene.links.Hold`."""
    vectors = dict.fromkeys(("moving", "arm", "axis"), precision.vector)
    return struct_of("HoldNumbers", precision, **vectors, turning=wp.int32)


def hold_numbers(hold: Hold, precision: Precision) -> Any:
    made = hold_type(precision)()
    for name in ("moving", "arm", "axis"):
        setattr(made, name, precision.vector(*getattr(hold, name)))
    made.turning = hold.turning
    return made


@cache
def hold_functions(precision: Precision) -> SimpleNamespace:
    """``root`` multiplies a vector by a square root of the inverse inertia."""
    vector, matrix, hold = precision.vector, precision.matrix, hold_type(precision)

    @wp.func
    def rate(R: matrix, A: matrix, w: vector) -> vector:
        return R * (A * (wp.transpose(R) * w))

    @wp.func
    def freed(w: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = w
        elif h.turning == 2:
            found = w - wp.dot(h.axis, w) * h.axis
        elif h.turning == 1:
            found = wp.dot(h.axis, w) * h.axis
        return found

    @wp.func
    def spin(R: matrix, inertia: matrix, inverse: matrix, L: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = rate(R, inverse, L)
        elif h.turning == 2:
            across = rate(R, inverse, h.axis)
            found = rate(R, inverse, L) - wp.dot(across, L) / wp.dot(h.axis, across) * across
        elif h.turning == 1:
            found = wp.dot(h.axis, L) / wp.dot(h.axis, rate(R, inertia, h.axis)) * h.axis
        return found

    @wp.func
    def root(R: matrix, inertia: matrix, half: matrix, T: vector, h: hold) -> vector:
        found = vector()
        if h.turning == 3:
            found = half * (wp.transpose(R) * T)
        elif h.turning == 2:
            across = wp.normalize(half * (wp.transpose(R) * h.axis))
            whole = half * (wp.transpose(R) * T)
            found = whole - wp.dot(across, whole) * across
        elif h.turning == 1:
            found = wp.dot(h.axis, T) / wp.sqrt(wp.dot(h.axis, rate(R, inertia, h.axis))) * h.axis
        return found

    return SimpleNamespace(kind=hold, rate=rate, freed=freed, spin=spin, root=root)


def free_module(precision: Precision, topic: str = "bodies") -> Any:
    """Kernels that only some bodies need have their own ``topic``, so that Warp compiles no other kernels again."""
    return kernel_module(f"free_{topic}_derivative_{precision.name}")


@cache
def move_kernels(precision: Precision) -> Kernels:
    real, vector, matrix, hold = precision.real, precision.vector, precision.matrix, hold_functions(precision)
    spin, vectors = hold.spin, "gravity V W L pulled twisted"

    @TypesByName(real, {vector: vectors, matrix: "inertia inverse turns", hold.kind: "hold"})
    def move(
        time_step_i, gravity_i, density_i, volume, inertia, inverse, hold, turns_i, V_0_i, W_0_i, L_0_i, pulled_sum_i,
        twisted_sum_i,
    ) -> tuple[vector, vector, vector, vector, vector]:  # fmt: skip
        arm = turns_i * hold.arm
        L = L_0_i + twisted_sum_i - wp.cross(arm, pulled_sum_i)
        W = spin(turns_i, inertia, inverse, L, hold) / density_i
        V = V_0_i + time_step_i * gravity_i + pulled_sum_i / (density_i * volume)
        V = wp.cw_mul(hold.moving, V) - wp.cross(W, arm)
        return V, L, W, V - V_0_i, W - W_0_i

    names: dict[str, Any] = {"numbers": ["volume", "inertia", "inverse", "hold"], "told": ["gravity"]}
    names |= {"written": ["pulled_sum", "twisted_sum"], "turned": {"turns": "turned"}}
    results = ["V", "L", "W", "faster", "turned_faster"]
    return pointwise_kernels(precision, [free_module(precision)] * 3, lambda _: move, results, **names)


SMALL = 1e-3


@cache
def rotations(precision: Precision, dimension: int) -> SimpleNamespace:
    """The Warp type ``angle`` is a number in 2-D and a vector in 3-D. ``rotation`` returns the rotation matrix."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix

    @wp.func
    def about_z(turn: real) -> matrix:
        c, s, no, one = wp.cos(turn), wp.sin(turn), real(0.0), real(1.0)
        return matrix(c, -s, no, s, c, no, no, no, one)

    @wp.func
    def rotation(turn: vector) -> matrix:
        size, unit = wp.length(turn), wp.identity(n=3, dtype=real)
        if size == real(0.0):
            return unit
        cross = wp.skew(turn / size)
        return unit + wp.sin(size) * cross + (real(1.0) - wp.cos(size)) * (cross * cross)

    @wp.func
    def further(turn: vector, change: vector) -> vector:
        square = wp.dot(turn, turn)
        a = real(0.5) - square / real(24.0) + square * square / real(720.0)
        b = real(1.0 / 6.0) - square / real(120.0) + square * square / real(5040.0)
        if square > real(SMALL):
            size = wp.sqrt(square)
            half = wp.sin(real(0.5) * size)
            a = real(2.0) * half * half / square
            b = (size - wp.sin(size)) / (square * size)
        across = wp.cross(turn, change)
        return change + a * across + b * wp.cross(turn, across)

    turning = turn_functions(precision)[0]

    @wp.func_grad(rotation)
    def rotation_adjoint(turn: vector, adj_ret: matrix):
        """Apply the transposed Jacobian of a rotation. Warp's generated adjoint of a rotation would be 0 at angle 0."""
        wp.adjoint[turn] += further(-turn, turning(rotation(turn), adj_ret))

    angle, found = (real, about_z) if dimension == 2 else (vector, rotation)
    return SimpleNamespace(angle=angle, rotation=found)


FIELDS = {"position": position_name, "turn": turn_name, "rotation": rotation_name, "scale": scale_name}


@cache
def pose_kernels(precision: Precision, dimension: int) -> tuple[Kernels, Kernels]:
    real, vector, matrix, of = precision.real, precision.vector, precision.matrix, rotations(precision, dimension)
    angle, rotation = of.angle, of.rotation

    typed = TypesByName(angle, {vector: "position place displacements", real: "scale"})

    @typed
    def pose(
        position_i, turn_i, rotation_i, scale_i, place_i, displacements_i, turns_told_i
    ) -> tuple[vector, matrix, vector, matrix, real]:
        begun = rotation(rotation_i)
        return position_i, rotation(turn_i) * begun, place_i + displacements_i, rotation(turns_told_i) * begun, scale_i

    @typed
    def end(rotation_i, scale_i, place_i, displacements_i, turns_told_i) -> tuple[vector, angle, angle, real]:
        return place_i + displacements_i, turns_told_i, rotation_i, scale_i

    topic, told = f"moving_solids_{dimension}d", ["displacements", "turns_told"]
    modules = [integration_module(precision, False, topic=topic)] * 3
    turned = {"turns": "turned", "turns_before": "turned_before"}
    poses, written = ["before", "turns_before", "after", "turns", "scales"], ["position", "turn"]
    ends, kept = [f"{name}_new" for name in FIELDS], {f"{name}_new": name for name in ("rotation", "scale")}
    begins = pointwise_kernels(precision, modules, lambda _: pose, poses, written=written, told=told, turned=turned)
    return begins, pointwise_kernels(precision, modules, lambda _: end, ends, kept, told=told)


@dataclass(frozen=True)
class MovingSolids:
    numbers: Mapping[str, int]
    dimension: int
    search: NeighbourSearch

    @property
    def walls(self) -> MovingWalls:
        assert self.search.moving is not None
        return self.search.moving

    def part(self, layout: Layout, requires_grad: bool) -> "MovingSolidsPart":
        if requires_grad:
            raise MissingDerivativeError("Warp's tape cannot differentiate moving solids: take gradients.Exact.")
        return MovingSolidsPart(self, layout)


class MovingSolidsTangent(PartTangent):
    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        walls = self.part.made_of.walls
        self._launch(self.part.poses.tangent, step, dot, state_dot)
        sizes = step.parameters["time_step"], dot.parameters["time_step"]
        walls.write_tangent(*sizes, self.part.made_of.search.walls)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        self._launch(self.part.ends.tangent, step, dot, state_dot)

    def _launch(self, kernel: Any, step: StepContext, dot: Tangents, state_dot: State) -> None:
        part = self.part
        for name, number in part.made_of.numbers.items():
            dots = part.told(dot.parameters, name, "_dot"), part.state(state_dot, name, "_new_dot")
            known = part.state(part.begun, name), part.told(step.parameters, name), part.made_of.walls.each[number]
            step.launch(kernel, part.state(state_dot, name, "_dot"), *dots, *known, threads=part.layout.members)


class MovingSolidsAdjoint(PartAdjoint):
    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        part = self.part
        for name, number in part.made_of.numbers.items():
            bars = part.told(bar.parameters, name, "_bar"), part.state(state_bar, name, "_new_bar")
            known = part.state(part.begun, name), part.told(step.parameters, name), bar.solids.collect(number)
            for kernels in (part.ends, part.poses):
                all_bars = part.state(state_bar, name, "_bar"), *bars
                step.launch(kernels.adjoint, *all_bars, *known, threads=part.layout.members)


class MovingSolidsPart(Part):
    derivatives = MovingSolidsTangent, MovingSolidsAdjoint

    def __init__(self, made_of: MovingSolids, layout: Layout):
        self.made_of, self.layout = made_of, layout
        angle = Entry.NUMBER if made_of.dimension == 2 else Entry.VECTOR
        self.fields: tuple[StateField, ...] = ()
        for name in made_of.numbers:
            self.fields += (
                StateField(position_name(name), "m", Entry.VECTOR, Axis.SCALAR, position_name(name)),
                StateField(turn_name(name), "rad", angle, Axis.SCALAR),
                StateField(rotation_name(name), "rad", angle, Axis.SCALAR, rotation_name(name)),
                StateField(scale_name(name), "", Entry.NUMBER, Axis.SCALAR, scale_name(name)),
            )
        self.poses, self.ends = pose_kernels(layout.precision, made_of.dimension)
        self.begun = layout.state(self.fields)

    def begin(self, step: StepContext, state: State) -> None:
        walls, search = self.made_of.walls, self.made_of.search
        for field in self.fields:
            wp.copy(self.begun[field.name], state[field.name])
        for name, number in self.made_of.numbers.items():
            known = self.state(self.begun, name), self.told(step.parameters, name)
            step.launch(self.poses.forward, *known, walls.each[number], threads=self.layout.members)
        walls.write(step.parameters["time_step"], search.walls)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        for name in self.made_of.numbers:
            known = self.state(self.begun, name), self.told(step.parameters, name), self.state(state, name, "_new")
            step.launch(self.ends.forward, *known, threads=self.layout.members)

    def state(self, state: State, name: str, suffix: str = "") -> dict[str, wp.array]:
        return {f"{label}{suffix}": state[name_of(name)] for label, name_of in FIELDS.items()}

    def told(self, parameters: Parameters, name: str, suffix: str = "") -> dict[str, wp.array]:
        told = {"place": position_name(name), "displacements": displacement_name(name), "turns_told": turn_name(name)}
        return {f"{label}{suffix}": parameters[parameter] for label, parameter in told.items()}
