"""Rigid bodies that fluid and gravity move, as a part of a step.

At the start of a step, a body's walls are put at the predicted pose, which the body would reach with its current
velocities. The solver then changes the velocity and the angular momentum of the body. At the end of the step, the body
moves with its new velocity and angular velocity. Momentum and angular momentum are conserved.

A state stores the rotation of a body since the start, minus the unit matrix, as the columns of a matrix. Kernels use
the mass of a body instead of its density if the scene gives a mass. The volumes of bodies are in units of a particle's
volume.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add
from cortado.discretise.solid import Mass
from cortado.errors import MissingDerivativeError
from cortado.particles.moving_walls import MovingWalls
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.particles.state import Entry, Layout, Parameters, State, StateField, clear
from cortado.scene.links import Hold, Joint, inertia_about
from cortado.scene.motions import AXES, angular_velocity_name, position_name, rotation_name, velocity_name
from cortado.scene.parameters import Axis
from cortado.sph.moving_solids import free_module, hold_functions, hold_numbers, rotations
from cortado.sph.parts import Adjoints, Part, PartAdjoint, PartTangent, StepContext, Tangents

MOTION = ("V", "W", "L")
GIVEN = ("pushed", "twisted")


@cache
def free_kernels(precision: Precision, dimension: int) -> tuple[Kernels, Kernels]:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    flat, rotation, hold = rotations(precision, dimension), rotations(precision, 3).rotation, hold_functions(precision)
    rate, freed, spin, held = hold.rate, hold.freed, hold.spin, hold.kind
    angle, begun_rotation, modules = flat.angle, flat.rotation, [free_module(precision, f"bodies_{dimension}d")] * 3

    @wp.func
    def about(w: angle) -> vector:
        if wp.static(dimension == 2):
            return vector(real(0.0), real(0.0), w)
        else:
            return w

    @wp.func
    def angle_of(w: vector) -> angle:
        if wp.static(dimension == 2):
            return w[2]
        else:
            return w

    @wp.func
    def column(Q: matrix, k: int) -> vector:
        return vector(Q[0, k], Q[1, k], Q[2, k])

    @wp.func
    def evened(Q: matrix) -> matrix:
        """Return the rotation matrix ``Q`` minus the unit matrix, after a correction of round-off."""
        return real(0.5) * Q * (real(3.0) * wp.identity(n=3, dtype=real) - wp.transpose(Q) * Q) - wp.identity(
            n=3, dtype=real
        )

    numbers = "time_step density volume" + " rotation angular_velocity" * (dimension == 2)
    typed = TypesByName(vector, {real: numbers, matrix: "inertia inverse turns_before", held: "hold"})

    @typed
    def predict(
        time_step_i, position_i, turn_x_i, turn_y_i, turn_z_i, rotation_i, velocity_i, angular_velocity_i, density_i,
        gravity_i, volume, inertia, hold,
    ) -> tuple[vector, matrix, vector, matrix, vector, vector, vector]:  # fmt: skip
        R = (wp.identity(n=3, dtype=real) + wp.matrix_from_cols(turn_x_i, turn_y_i, turn_z_i)) * begun_rotation(
            rotation_i
        )
        w, v = freed(about(angular_velocity_i), hold), wp.cw_mul(hold.moving, velocity_i)
        turned, arm = rotation(time_step_i * w) * R, R * hold.arm
        ahead, weight = position_i + time_step_i * v + (arm - turned * hold.arm), density_i * volume * gravity_i
        L = density_i * rate(R, inertia, w) - time_step_i * wp.cross(arm, weight)
        return position_i, R, ahead, turned, v - wp.cross(w, turned * hold.arm), w, L

    @typed
    def end(
        time_step_i, position_i, turn_x_i, turn_y_i, turn_z_i, rotation_i, turns_before_i, V_i, W_i, L_i, density_i,
        inertia, inverse, hold,
    ) -> tuple[vector, vector, vector, vector, angle, vector, angle]:  # fmt: skip
        turning = rotation(time_step_i * W_i)
        Q = evened(turning * (wp.identity(n=3, dtype=real) + wp.matrix_from_cols(turn_x_i, turn_y_i, turn_z_i)))
        R = turning * turns_before_i
        w, v, arm = spin(R, inertia, inverse, L_i, hold) / density_i, wp.cw_mul(hold.moving, V_i), R * hold.arm
        x = position_i + time_step_i * v + (turns_before_i * hold.arm - arm)
        return x, column(Q, 0), column(Q, 1), column(Q, 2), rotation_i, v - wp.cross(w, arm), angle_of(w)

    turned = {"turns": "turned", "turns_before": "turned_before"}
    poses, kept = ["before", "turns_before", "after", "turns"], ["position", "turn_x", "turn_y", "turn_z", "rotation"]
    moves = ["velocity", "angular_velocity"]
    at_start: dict[str, Any] = {"numbers": ["volume", "inertia", "hold"], "written": moves, "told": ["gravity"]}
    begins = pointwise_kernels(precision, modules, lambda _: predict, [*poses, *MOTION], turned=turned, **at_start)
    at_end: dict[str, Any] = {"numbers": ["inertia", "inverse", "hold"], "written": [*MOTION, "turns_before"]}
    new, replaced = [f"{name}_new" for name in (*kept, *moves)], {f"{name}_new": name for name in kept}
    return begins, pointwise_kernels(precision, modules, lambda _: end, new, replaced, turned=turned, **at_end)


NAMES = {"position": position_name, "rotation": rotation_name}
NAMES |= {"velocity": velocity_name, "angular_velocity": angular_velocity_name}


@dataclass(frozen=True)
class FreeTable:
    name: str
    number: int
    weight: str
    """Name of the parameter for the density or the mass of the body."""
    mass: Mass
    """Mass and inertia of the body for a density or mass of 1."""
    hold: Hold
    sticks: bool = False

    @property
    def inertia(self) -> np.ndarray:
        """Return the inertia (3, 3) about the body's hinge, or without a hinge about the centre of mass."""
        return inertia_about(self.hold, self.mass)

    @property
    def bounds(self) -> dict[str, float]:
        """A body that cannot move has an infinite volume. A body that cannot turn has an inverse inertia of 0."""
        goes, turns = any((*self.hold.moving, *self.hold.arm)), self.hold.turning > 0
        greatest = np.linalg.eigvalsh(np.linalg.pinv(self.mass.inertia)).max()
        return {"pushed_volume": self.mass.volume if goes else np.inf, "greatest": float(greatest) if turns else 0.0}


@dataclass(frozen=True)
class FreeSolids:
    tables: Sequence[FreeTable]
    dimension: int
    walls: MovingWalls
    pushes: "Sequence[Callable[[FreeSolidsPart], Push]]"
    joints: Sequence[Joint] = ()

    def part(self, layout: Layout, requires_grad: bool) -> "FreeSolidsPart":
        if requires_grad:
            raise MissingDerivativeError("Warp's tape cannot differentiate moving solids: take gradients.Exact.")
        return FreeSolidsPart(self, layout)


class Push(Protocol):
    """Protocol of forces on free bodies in addition to fluid and gravity, such as contacts and springs."""

    @property
    def derivatives(self) -> tuple[type, type]:
        """Classes of tangent and adjoint, with methods ``look`` that add to `Changes.given` or read its adjoints."""

    def look(self, step: StepContext) -> None:
        """Add the momenta by this force to `FreeBody.given` of the rigid bodies."""


def given_to(each: "Sequence[FreeBody | Changes]", body: int, other: int) -> dict[str, wp.array]:
    """Return the momenta of two rigid bodies by kernel argument name. An ``other`` of -1 returns the first momenta
    twice."""
    others = each[body if other < 0 else other].given
    return {**each[body].given, **{name.replace("ed", "ed_other", 1): array for name, array in others.items()}}


class Motions:
    """Vectors (members,) by kernel argument name, for example velocities before and after the solve for pressures."""

    def __init__(self, layout: Layout, suffix: str = ""):
        vectors = {"shape": layout.members, "dtype": layout.precision.vector, "device": layout.device}
        self.before, self.moved = ({f"{name}{suffix}": wp.zeros(**vectors) for name in MOTION} for _ in range(2))
        self.given, self.pressed = ({f"{name}{suffix}": wp.zeros(**vectors) for name in GIVEN} for _ in range(2))
        """``given`` has momenta by contacts, springs and friction, ``pressed`` momenta by the previous step's
        pressures."""


class FreeBody(Motions):
    def __init__(self, table: FreeTable, poses: Named, dimension: int, layout: Layout):
        super().__init__(layout)
        self.table = table
        angle = Entry.NUMBER if dimension == 2 else Entry.VECTOR
        kinds = {"position": ("m", Entry.VECTOR), "rotation": ("rad", angle)}
        kinds |= {"velocity": ("m/s", Entry.VECTOR), "angular_velocity": ("rad/s", angle)}
        self.names = {label: name(table.name) for label, name in NAMES.items()}
        self.names |= {label: f"{table.name}.{label}" for label in AXES}
        """Names of the body's state fields, by names of kernel arguments."""
        named = ((self.names[label], *kind) for label, kind in kinds.items())
        begun = (StateField(name, unit, entry, Axis.SCALAR, name) for name, unit, entry in named)
        self.fields = (*begun, *(StateField(self.names[label], "", Entry.VECTOR, Axis.SCALAR) for label in AXES))
        self.begun = layout.state(self.fields)
        matrix = layout.precision.matrix
        inertia, inverse = table.inertia, np.linalg.pinv(table.inertia)
        self.constants: dict[str, Any] = {**poses, "inertia": matrix(*inertia.ravel())}
        self.constants |= {"inverse": matrix(*inverse.ravel()), "volume": table.mass.volume}
        self.constants |= {"solid": table.number, "hold": hold_numbers(table.hold, layout.precision)}
        self.constants |= table.bounds

    def state(self, state: State, suffix: str = "") -> dict[str, wp.array]:
        return {f"{label}{suffix}": state[name] for label, name in self.names.items()}

    def known(self, step: StepContext) -> tuple[Named, ...]:
        return self.constants, self.state(self.begun), {"density": step.parameters[self.table.weight]}


class Changes(Motions):
    def __init__(self, body: FreeBody, layout: Layout, suffix: str):
        super().__init__(layout, suffix)
        self.body, self._suffix = body, suffix
        self.turned_end = wp.zeros(layout.members, dtype=layout.precision.vector, device=layout.device)
        """Adjoint of a small rotation of the body at the end of the step."""

    def known(self, of: Parameters, state: State) -> dict[str, wp.array]:
        names = {"time_step": "time_step", "gravity": "gravity", "density": self.body.table.weight}
        sizes = {f"{label}{self._suffix}": of[name] for label, name in names.items()}
        return {**self.body.state(state, self._suffix), **self.body.state(state, f"_new{self._suffix}"), **sizes}

    def clear(self) -> None:
        for group in (self.before, self.moved, self.given, self.pressed, {"turned_end": self.turned_end}):
            clear(group.values())


class FreeSolidsTangent(PartTangent):
    def __init__(self, part: Any):
        super().__init__(part)
        self.bodies = [Changes(body, part.layout, "_dot") for body in part.bodies]
        self._pushes = [push.derivatives[0](push, self.bodies) for push in part.pushes]

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        for own in self.bodies:
            known = own.known(dot.parameters, state_dot), own.before, *own.body.known(step)
            step.launch(self.part.begins.tangent, *known, threads=self.part.layout.members)

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        for own in self.bodies:
            clear(own.given.values())
        for push in self._pushes:
            push.look(step, dot)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        for own in self.bodies:
            known = own.known(dot.parameters, state_dot), own.moved, own.body.moved, *own.body.known(step)
            step.launch(self.part.ends.tangent, *known, threads=self.part.layout.members)


class FreeSolidsAdjoint(PartAdjoint):
    def __init__(self, part: Any):
        super().__init__(part)
        self.bodies = [Changes(body, part.layout, "_bar") for body in part.bodies]
        self._pushes = [push.derivatives[1](push, self.bodies) for push in reversed(part.pushes)]

    def end(self, step: StepContext, bar: Any, state_bar: State, moved_bar: State) -> State:
        for own in self.bodies:
            known = own.known(bar, state_bar), own.moved, own.body.moved, *own.body.known(step)
            end = {"turned_before_bar": own.turned_end}
            step.launch(self.part.ends.adjoint, end, *known, threads=self.part.layout.members)
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        for push in self._pushes:
            push.look(step, bar)

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        for own in self.bodies:
            given = bar.solids.collect(own.body.table.number)
            add(own.turned_end, given["turned_before_bar"])
            known = own.known(bar.parameters, state_bar), own.before, given, *own.body.known(step)
            step.launch(self.part.begins.adjoint, *known, threads=self.part.layout.members)
            own.clear()


class FreeSolidsPart(Part):
    derivatives = FreeSolidsTangent, FreeSolidsAdjoint

    def __init__(self, made_of: FreeSolids, layout: Layout):
        self.made_of, self.layout = made_of, layout
        poses = made_of.walls.each
        self.bodies = [FreeBody(table, poses[table.number], made_of.dimension, layout) for table in made_of.tables]
        self.fields = tuple(field for body in self.bodies for field in body.fields)
        self.begins, self.ends = free_kernels(layout.precision, made_of.dimension)
        self.pushes = [push(self) for push in made_of.pushes]

    def begin(self, step: StepContext, state: State) -> None:
        for body in self.bodies:
            for field in body.fields:
                wp.copy(body.begun[field.name], state[field.name])
            step.launch(self.begins.forward, body.before, *body.known(step), threads=self.layout.members)

    def sort(self, step: StepContext, state: State) -> None:
        for body in self.bodies:
            clear(body.given.values())
        for push in self.pushes:
            push.look(step)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        for body in self.bodies:
            new = body.state(state, "_new")
            step.launch(self.ends.forward, new, body.moved, *body.known(step), threads=self.layout.members)
