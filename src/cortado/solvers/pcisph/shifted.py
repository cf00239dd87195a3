"""PCISPH whose particles are shifted at the end of a step to where they are fewer, as those of the projection are
(`cortado.solvers.projection.shifting`), so that a lattice that is sheared does not stay one. The shift is a part of the
step: it is found from the state that the step begins from, x' = x* + delta(x, v), and so needs no pressure.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.fields import POSITIONS, VELOCITIES
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout, Parameters, State
from cortado.solvers.loop import LoopLimits
from cortado.solvers.particles import ParticleSolver, ParticleSystem
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.projection.constants import ProjectionConstants
from cortado.solvers.projection.measured import Surroundings
from cortado.solvers.projection.shifting import shift_kernels
from cortado.solvers.projection.velocity_gradient import velocity_gradient_kernels
from cortado.solvers.solver import StepAdjoint
from cortado.sph.integration import integration_module
from cortado.sph.moment_functions import matrix_type
from cortado.sph.part import Part, PartAdjoint, PartTangent
from cortado.sph.parts import Adjoints, StepContext, Tangents


class ShiftedPcisph(Pcisph):
    """PCISPH with a shift. It has no tape and no frozen geometry, as the shift has neither."""

    def __init__(self, system: ParticleSystem, constants: ProjectionConstants, limits: LoopLimits | None):
        shift = ShiftMaker(system.discretisation, constants, system.walled.dimension)
        called = f"{system.called} with shifting"
        super().__init__(replace(system, called=called, parts=[shift, *system.parts]), limits)

    def differentiable(self) -> Self:
        return ParticleSolver.differentiable(self)

    def frozen_adjoint(self, steps: int) -> StepAdjoint:
        return ParticleSolver.frozen_adjoint(self, steps)


@dataclass(frozen=True)
class ShiftMaker:
    """Makes the part that shifts particles, in 2 or 3 dimensions."""

    discretisation: Discretisation
    constants: ProjectionConstants
    dimension: int

    def part(self, layout: Layout, requires_grad: bool) -> "Shift":
        """The part of one solver; it is never on a tape."""
        return Shift(self, layout)


@cache
def place_kernels(precision: Precision) -> tuple[Any, Any]:
    """The kernel that adds shifts of sorted particles to positions, and that which takes the adjoint from there."""
    vector = precision.vector

    @wp.kernel(module=integration_module(precision, True))
    def place(
        order: wp.array(dtype=wp.int32),
        x_free: wp.array(dtype=vector),
        delta: wp.array(dtype=vector),
        # out
        x: wp.array(dtype=vector),
    ):
        i = wp.tid()
        x[order[i]] = x_free[order[i]] + delta[i]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def place_adjoint(
        order: wp.array(dtype=wp.int32),
        x_scene_bar: wp.array(dtype=vector),
        # out
        delta_bar: wp.array(dtype=vector),
    ):
        i = wp.tid()
        delta_bar[i] = x_scene_bar[order[i]]

    return place, place_adjoint


class SurroundingsApart(Surroundings):
    """Those of a solver that measures the density itself: their own one, to the last places the same, stands apart."""

    def like_density(self, suffix: str) -> dict[str, wp.array]:
        return self.layout.arrays(suffix, n=self.layout.precision.real)


class Shift(Part):
    """The shift of the particles of one solver."""

    def __init__(self, maker: ShiftMaker, layout: Layout):
        self.layout, own = layout, (maker.discretisation, maker.dimension)
        self.surroundings = SurroundingsApart(maker.discretisation, layout, "", maker.dimension, maker.constants)
        self.gradient, self.shift = velocity_gradient_kernels(*own), shift_kernels(*own)
        self.place, self.place_adjoint = place_kernels(layout.precision)
        self.constants = {**self.surroundings.constants, "spacing": maker.constants.spacing}
        self.flow, self.unpulled = self.like_flow(""), self.like_pull("")
        """A; and no tension, as the pressure is not yet known."""
        self._free, self._delta = layout.state((POSITIONS,)).positions, self.vectors()

    def like_flow(self, suffix: str) -> dict[str, wp.array]:
        """Room for A, its tangents or its adjoints."""
        return self.layout.arrays(suffix, A=matrix_type(self.layout.precision))

    def like_pull(self, suffix: str) -> dict[str, wp.array]:
        """Room for tangents or adjoints of k."""
        return self.layout.arrays(suffix, k=self.layout.precision.real)

    def vectors(self) -> wp.array:
        """(n,) vectors, all 0."""
        return self.layout.arrays(one=self.layout.precision.vector)["one"]

    def settle(self, step: StepContext) -> None:
        self.surroundings.measure(step)
        known = self.surroundings.around, self.flow
        step.launch(self.gradient.forward, self.flow, v_flow=step.fields["v"])
        step.launch(self.shift.forward, *known, self.constants, self.unpulled, delta=self._delta)

    def target(self, moved: State) -> State:
        return State((POSITIONS, VELOCITIES), {"positions": self._free, "velocities": moved.velocities}, moved.batch)

    def end(self, step: StepContext, state: State, moved: State) -> None:
        step.launch(self.place, x_free=self._free, delta=self._delta, x=moved.positions)

    def new_tangent(self) -> "ShiftTangent":
        return ShiftTangent(self)

    def new_adjoint(self) -> "ShiftAdjoint":
        return ShiftAdjoint(self)


class ShiftTangent(PartTangent):
    """Forward mode of a shift."""

    def __init__(self, shift: Shift):
        self._shift, self._delta_dot = shift, shift.vectors()
        self._surroundings, self._unpulled = shift.surroundings.new_tangent(), shift.like_pull("_dot")
        self._flow = shift.like_flow("_dot")

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        shift, own = self._shift, self._surroundings
        own.measure(step, dot)
        known = (*dot.named, own.around, shift.surroundings.around, shift.constants, shift.unpulled, self._unpulled)
        step.launch(shift.gradient.tangent, *known, self._flow, v_flow=step.fields["v"], v_flow_dot=dot.fields["v"])
        step.launch(shift.shift.tangent, *known, shift.flow, self._flow, delta_dot=self._delta_dot)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        x_dot = state_dot.positions
        step.launch(self._shift.place, x_free=x_dot, delta=self._delta_dot, x=x_dot)


class ShiftAdjoint(PartAdjoint):
    """Reverse mode of a shift; every sum is a gather."""

    def __init__(self, shift: Shift):
        self._shift, self._delta_bar = shift, shift.vectors()
        self._surroundings, self._flow = shift.surroundings.new_adjoint(), shift.like_flow("_bar")
        self._unused = shift.like_pull("_bar")

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        step.launch(self._shift.place_adjoint, x_scene_bar=moved_bar.positions, delta_bar=self._delta_bar)
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        shift, own = self._shift, self._surroundings
        own.begin()
        for array in self._flow.values():
            array.zero_()
        known = (*bar.named, own.around, shift.surroundings.around, shift.constants, shift.unpulled, self._unused)
        step.launch(shift.shift.adjoint, *known, self._flow, shift.flow, delta_bar=self._delta_bar)
        step.launch(shift.gradient.adjoint, *known, self._flow, v_flow=step.fields["v"], v_flow_bar=bar.fields["v"])
        own.measure(step, bar)
