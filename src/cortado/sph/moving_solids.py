"""Solids that move as they are told: a part of a step that puts their walls where they are at its end.

A solid begins at the position c_0 with the rotation R(w_0). At the end of a step it is displaced by d and turned by w:
a wall particle with the place r in its frame is at c_0 + d + R(w) R(w_0) r then, and has the velocity that leads there
from where it was, over the time step. States have the position c, the turn w, w_0, and by which scale it is stretched
(`cortado.particles.moving_walls`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.precision import Precision
from cortado.errors import MissingDerivativeError
from cortado.particles.moving_walls import MovingWalls, matrix_of
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Entry, Layout, Parameters, State, StateField
from cortado.particles.wall_terms import share_kinds
from cortado.scene.motions import displacement_name, position_name, rotation_name, scale_name, turn_name
from cortado.scene.parameters import Axis
from cortado.sph.integration import integration_module
from cortado.sph.parts import Adjoints, Part, PartAdjoint, PartTangent, StepContext, Tangents
from cortado.sph.rotations import rotations

FIELDS = {"position": position_name, "turn": turn_name, "rotation": rotation_name, "scale": scale_name}
"""Names of a solid's state fields, by the names that kernels have for them."""


@dataclass(frozen=True)
class PoseKernels:
    """Kernels of the poses of one moving solid, with a thread for each scene."""

    begin: Any
    """The solid's poses before and after a step."""
    tangent: Any
    """The tangents of these poses."""
    end: Any
    """The solid's state at the end of a step, or its tangent from the tangent before."""
    adjoint: Any
    """From the adjoints of the poses and of the state at the end to those of the parameters and of the state before."""


@cache
def _kernels(precision: Precision, dimension: int) -> PoseKernels:
    """Make the kernels of moving solids' poses, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    of = rotations(precision, dimension)
    angle, rotation, further, back = of.angle, of.rotation, of.further, of.back
    module = integration_module(precision, False)
    state = bundle(position=vector, turn=angle, rotation=angle, scale=real)
    shares = bundle(**share_kinds(precision))

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        number: int,
        step: wp.array(dtype=wp.int32),
        of: state,
        place: wp.array(dtype=vector),
        displacements: wp.array2d(dtype=vector),
        turns_told: wp.array2d(dtype=angle),
        # out
        before: wp.array2d(dtype=vector),
        turns_before: wp.array2d(dtype=matrix),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        scales: wp.array2d(dtype=real),
    ):
        b = wp.tid()
        k = step[b]
        begun = rotation(of.rotation[b])
        scales[b, number] = of.scale[b]
        before[b, number] = of.position[b]
        after[b, number] = place[b] + displacements[b, k]
        turns_before[b, number] = rotation(of.turn[b]) * begun
        turns[b, number] = rotation(turns_told[b, k]) * begun

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        number: int,
        step: wp.array(dtype=wp.int32),
        of: state,
        dot: state,
        turns_told: wp.array2d(dtype=angle),
        place_dot: wp.array(dtype=vector),
        displacements_dot: wp.array2d(dtype=vector),
        turns_told_dot: wp.array2d(dtype=angle),
        # out
        before_dot: wp.array2d(dtype=vector),
        turned_before_dot: wp.array2d(dtype=vector),
        after_dot: wp.array2d(dtype=vector),
        turned_dot: wp.array2d(dtype=vector),
        growths: wp.array2d(dtype=real),
    ):
        b = wp.tid()
        k = step[b]
        growths[b, number] = dot.scale[b] / of.scale[b]
        begun_dot = further(of.rotation[b], dot.rotation[b])
        before, after = of.turn[b], turns_told[b, k]
        before_dot[b, number] = dot.position[b]
        after_dot[b, number] = place_dot[b] + displacements_dot[b, k]
        turned_before_dot[b, number] = further(before, dot.turn[b]) + rotation(before) * begun_dot
        turned_dot[b, number] = further(after, turns_told_dot[b, k]) + rotation(after) * begun_dot

    @wp.kernel(module=module, enable_backward=False)
    def end(
        step: wp.array(dtype=wp.int32),
        begun: wp.array(dtype=angle),
        scale_begun: wp.array(dtype=real),
        place: wp.array(dtype=vector),
        displacements: wp.array2d(dtype=vector),
        turns_told: wp.array2d(dtype=angle),
        # out
        position: wp.array(dtype=vector),
        turn: wp.array(dtype=angle),
        rotation: wp.array(dtype=angle),
        scale: wp.array(dtype=real),
    ):
        b = wp.tid()
        position[b] = place[b] + displacements[b, step[b]]
        turn[b] = turns_told[b, step[b]]
        rotation[b] = begun[b]
        scale[b] = scale_begun[b]

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        step: wp.array(dtype=wp.int32),
        of: state,
        turns_told: wp.array2d(dtype=angle),
        share: shares,
        # in and out: at first of the state at the end, at last of that before
        bar: state,
        place_bar: wp.array(dtype=vector),
        displacements_bar: wp.array2d(dtype=vector),
        turns_told_bar: wp.array2d(dtype=angle),
    ):
        b = wp.tid()
        k = step[b]
        before, after = of.turn[b], turns_told[b, k]
        moved_bar = bar.position[b] + share.force[b]
        place_bar[b] = place_bar[b] + moved_bar
        displacements_bar[b, k] = displacements_bar[b, k] + moved_bar
        turns_told_bar[b, k] = turns_told_bar[b, k] + bar.turn[b] + back(after, share.torque[b])
        begun_bar = wp.transpose(rotation(after)) * share.torque[b]
        begun_bar += wp.transpose(rotation(before)) * share.torque_before[b]
        bar.position[b] = share.force_before[b]
        bar.turn[b] = back(before, share.torque_before[b])
        bar.rotation[b] = bar.rotation[b] + back(of.rotation[b], begun_bar)
        bar.scale[b] = bar.scale[b] + share.growth[b] / of.scale[b]

    return PoseKernels(begin, tangent, end, adjoint)


@dataclass(frozen=True)
class MovingSolids:
    """A maker of the part that moves solids along given paths in a solver."""

    numbers: Mapping[str, int]
    """Numbers of the solids with given paths, by name, among all solids that move."""
    dimension: int
    search: NeighbourSearch
    """The search for neighbours that has the walls of the solids."""

    @property
    def walls(self) -> MovingWalls:
        """Return the wall particles in which the search finds neighbours."""
        assert self.search.moving is not None
        return self.search.moving

    def part(self, layout: Layout, requires_grad: bool) -> "MovingSolidsPart":
        if requires_grad:
            raise MissingDerivativeError("solids that move have no tape: try gradients.Exact.")
        return MovingSolidsPart(self, layout)


class MovingSolidsPart(Part):
    """The part of a step that puts walls where they are at its end: its own, and those of parts that come before it."""

    def __init__(self, made_of: MovingSolids, layout: Layout):
        self.made_of, self.layout = made_of, layout
        angle = Entry.NUMBER if made_of.dimension == 2 else Entry.VECTOR
        self.fields = tuple(
            field
            for name in made_of.numbers
            for field in (
                StateField(position_name(name), "m", Entry.VECTOR, Axis.SCALAR, position_name(name)),
                StateField(turn_name(name), "rad", angle, Axis.SCALAR),
                StateField(rotation_name(name), "rad", angle, Axis.SCALAR, rotation_name(name)),
                StateField(scale_name(name), "", Entry.NUMBER, Axis.SCALAR, scale_name(name)),
            )
        )
        """Where they are, how far they are turned from how they began, how that was, and how large they are."""
        self.kernels = _kernels(layout.precision, made_of.dimension)
        self.begun = layout.state(self.fields)
        """What a step began from."""

    def begin(self, step: StepContext, state: State) -> None:
        walls, search = self.made_of.walls, self.made_of.search
        for field in self.fields:
            wp.copy(self.begun[field.name], state[field.name])
        for name, number in self.made_of.numbers.items():
            known = self.state(self.begun, name), self.told(step.parameters, name)
            step.launch(self.kernels.begin, *known, walls.named, number=number, threads=self.layout.members)
        walls.write(step.parameters["time_step"], search.walls)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        self.write_end(step, step.parameters, self.begun, state)

    def write_end(self, step: StepContext, parameters: Parameters, begun: State, state: State) -> None:
        """Write the fields of moving solids at the end of a step, or their tangents."""
        for name in self.made_of.numbers:
            kept = {"begun": begun[rotation_name(name)], "scale_begun": begun[scale_name(name)]}
            new = {**self.state(state, name), **self.told(parameters, name), **kept}
            step.launch(self.kernels.end, new, threads=self.layout.members)

    def state(self, state: State, name: str, suffix: str = "") -> dict[str, wp.array]:
        """Return a solid's fields of a state by the names that kernels have for them."""
        return {f"{label}{suffix}": state[name_of(name)] for label, name_of in FIELDS.items()}

    def told(self, parameters: Parameters, name: str, suffix: str = "") -> dict[str, wp.array]:
        """Return the parameters of a solid's given path by the names that kernels have for them."""
        told = {"place": position_name(name), "displacements": displacement_name(name), "turns_told": turn_name(name)}
        return {f"{label}{suffix}": parameters[parameter] for label, parameter in told.items()}

    def new_tangent(self) -> "MovingSolidsTangent":
        return MovingSolidsTangent(self)

    def new_adjoint(self) -> "MovingSolidsAdjoint":
        return MovingSolidsAdjoint(self)


class MovingSolidsTangent(PartTangent):
    """The tangent of walls of solids with given paths, for forward mode."""

    def __init__(self, part: MovingSolidsPart):
        self._part = part
        self._begun = part.layout.state(part.fields)

    def begin(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        part, walls = self._part, self._part.made_of.walls
        for field in part.fields:
            wp.copy(self._begun[field.name], state_dot[field.name])
        for name, number in part.made_of.numbers.items():
            dots = {**part.state(self._begun, name, "_dot"), **part.told(dot.parameters, name, "_dot")}
            known = part.state(part.begun, name), part.told(step.parameters, name)
            step.launch(part.kernels.tangent, dots, *known, walls.named, number=number, threads=part.layout.members)
        sizes = step.parameters["time_step"], dot.parameters["time_step"]
        walls.write_tangent(*sizes, part.made_of.search.walls)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        self._part.write_end(step, dot.parameters, self._begun, state_dot)


class MovingSolidsAdjoint(PartAdjoint):
    """The adjoint of solids with given paths, from what particles have added to the adjoints of poses."""

    def __init__(self, part: MovingSolidsPart):
        self._part = part

    def begin(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        part = self._part
        for name, number in part.made_of.numbers.items():
            bars = {**part.state(state_bar, name, "_bar"), **part.told(bar.parameters, name, "_bar")}
            known = part.state(part.begun, name), part.told(step.parameters, name), bar.solids.collect(number)
            step.launch(part.kernels.adjoint, bars, *known, threads=part.layout.members)
