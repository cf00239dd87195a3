"""Solids that move as they are told: a part of a step that puts their walls where they are at its end.

A wall particle with the place r in the frame of its solid is at c + R r, with the middle c and the rotation R of the
solid at the end of the step, and has the velocity that leads there from where it was, over the time step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.fields import Entry, StateField
from cortado.particles.moving_walls import matrix_of
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Layout, Parameters, State
from cortado.scene.motions import displacement_name, turn_name
from cortado.scene.parameters.parameter import Axis
from cortado.sph.integration import integration_module
from cortado.sph.part import Part, PartAdjoint, PartTangent
from cortado.sph.parts import StepContext


@cache
def _kernels(precision: Precision, dimension: int) -> tuple[Any, Any]:
    """The one that finds the poses of a solid before and after a step, and the one that writes the state after it."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    angle = real if dimension == 2 else vector
    module = integration_module(precision, False)

    if dimension == 2:

        @wp.func
        def rotation(turn: angle) -> matrix:
            c, s, no, one = wp.cos(turn), wp.sin(turn), real(0.0), real(1.0)
            return matrix(c, -s, no, s, c, no, no, no, one)

    else:

        @wp.func
        def rotation(turn: angle) -> matrix:
            """By the formula of Rodrigues."""
            size, no, one = wp.length(turn), real(0.0), real(1.0)
            unit = matrix(one, no, no, no, one, no, no, no, one)
            if size == real(0.0):
                return unit
            n = turn / size
            cross = matrix(no, -n[2], n[1], n[2], no, -n[0], -n[1], n[0], no)
            return unit + wp.sin(size) * cross + (real(1.0) - wp.cos(size)) * (cross * cross)

    @wp.kernel(module=module, enable_backward=False)
    def pose(
        number: int,
        step: wp.array(dtype=wp.int32),
        displacement: wp.array(dtype=vector),
        turn: wp.array(dtype=angle),
        displacements: wp.array2d(dtype=vector),
        turns_told: wp.array2d(dtype=angle),
        middles: wp.array2d(dtype=vector),
        turned: wp.array2d(dtype=matrix),
        # out
        before: wp.array2d(dtype=vector),
        turns_before: wp.array2d(dtype=matrix),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
    ):
        """``middles`` and ``turned``: how solids begin."""
        b = wp.tid()
        k = step[b]
        before[b, number] = middles[b, number] + displacement[b]
        after[b, number] = middles[b, number] + displacements[b, k]
        turns_before[b, number] = rotation(turn[b]) * turned[b, number]
        turns[b, number] = rotation(turns_told[b, k]) * turned[b, number]

    @wp.kernel(module=module, enable_backward=False)
    def end(
        step: wp.array(dtype=wp.int32),
        displacements: wp.array2d(dtype=vector),
        turns_told: wp.array2d(dtype=angle),
        # out
        displacement: wp.array(dtype=vector),
        turn: wp.array(dtype=angle),
    ):
        b = wp.tid()
        displacement[b] = displacements[b, step[b]]
        turn[b] = turns_told[b, step[b]]

    return pose, end


@dataclass(frozen=True)
class MovingSolids:
    """Makes the part of one solver."""

    names: Sequence[str]
    dimension: int
    search: NeighbourSearch
    """Whose walls are theirs."""

    def part(self, layout: Layout, requires_grad: bool) -> "MovingSolidsPart":
        return MovingSolidsPart(self, layout)


class MovingSolidsPart(Part):
    """Puts walls where they are at the end of each step."""

    def __init__(self, made_of: MovingSolids, layout: Layout):
        self._made_of, self._layout = made_of, layout
        angle = Entry.NUMBER if made_of.dimension == 2 else Entry.VECTOR
        self.fields = tuple(
            field
            for name in made_of.names
            for field in (
                StateField(displacement_name(name), "m", Entry.VECTOR, Axis.SCALAR),
                StateField(turn_name(name), "rad", angle, Axis.SCALAR),
            )
        )
        """How far they are from where they began, and turned."""
        self._pose, self._end = _kernels(layout.precision, made_of.dimension)

    def begin(self, step: StepContext, state: State) -> None:
        search = self._made_of.search
        walls = search.moving
        assert walls is not None
        own: dict[str, Any] = {
            "middles": walls.begun.positions,
            "turned": walls.begun.turns,
            "before": walls.before.positions,
            "turns_before": walls.before.turns,
            "after": walls.after.positions,
            "turns": walls.after.turns,
            "threads": self._layout.members,
        }
        for number, name in enumerate(self._made_of.names):
            now = {"displacement": state[displacement_name(name)], "turn": state[turn_name(name)]}
            step.launch(self._pose, now, self._told(step.parameters, name), number=number, **own)
        walls.write(step.parameters["time_step"], search.walls)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        for name in self._made_of.names:
            new = {"displacement": state[displacement_name(name)], "turn": state[turn_name(name)]}
            step.launch(self._end, new, self._told(step.parameters, name), threads=self._layout.members)

    def _told(self, parameters: Parameters, name: str) -> dict[str, wp.array]:
        told = parameters[displacement_name(name)], parameters[turn_name(name)]
        return dict(zip(("displacements", "turns_told"), told, strict=True))

    def new_tangent(self) -> PartTangent:
        """Nothing that has a derivative changes where they are."""
        return PartTangent()

    def new_adjoint(self) -> PartAdjoint:
        """As `new_tangent`."""
        return PartAdjoint()
