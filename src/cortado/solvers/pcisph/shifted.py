"""PCISPH whose particles are shifted at the end of a step to where they are fewer, as those of the projection are
(`cortado.solvers.projection.shifting`), so that a lattice that is sheared does not stay one. The shift is a part of the
step: it is found from the state that the step begins from, x' = x* + delta(x, v), and so needs no pressure.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Self

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.fields import POSITIONS, VELOCITIES
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout, Parameters, State
from cortado.solvers.loop import LoopLimits
from cortado.solvers.particles import ParticleSolver, ParticleSystem
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.projection.beside import beside_solid_kernel
from cortado.solvers.projection.constants import ProjectionConstants
from cortado.solvers.projection.shifting import shift_kernels
from cortado.solvers.projection.surroundings import entries, surrounding_kernels
from cortado.solvers.projection.velocity_gradient import velocity_gradient_kernels
from cortado.solvers.solver import StepAdjoint
from cortado.sph.integration import integration_module
from cortado.sph.moment_functions import matrix_type, symmetric
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


class Shift(Part):
    """The shift of the particles of one solver."""

    def __init__(self, maker: ShiftMaker, layout: Layout):
        precision, own = layout.precision, (maker.discretisation, maker.dimension)
        self.discretisation = maker.discretisation
        self.surroundings, self.gradient = surrounding_kernels(*own), velocity_gradient_kernels(*own)
        self.shift = shift_kernels(*own)
        self.place, self.place_adjoint = place_kernels(precision)
        constants = maker.constants
        self.constants = {
            "least": constants.least_diagonal,
            "per_nearest": 1.0 / constants.nearest_weight,
            "spacing": constants.spacing,
        }
        self.layout = layout
        self.around, self.flow = self.like_around(""), self.like_flow("")
        self._free, self._delta = layout.state((POSITIONS,)).positions, self.vectors()
        self.unpulled = self.like_pull("")
        """No tension: the pressure is not yet known."""

    def arrays(self, suffix: str, **kinds: Any) -> dict[str, wp.array]:
        """Arrays (n,) of zeros by name and suffix, of Warp types."""
        size, device = self.layout.all_particles, self.layout.device
        return {f"{name}{suffix}": wp.zeros(size, dtype=kind, device=device) for name, kind in kinds.items()}

    def like_around(self, suffix: str) -> dict[str, wp.array]:
        """Room for tangents or adjoints of what is around particles."""
        return self.arrays(suffix, **entries(self.layout.precision))

    def like_flow(self, suffix: str) -> dict[str, wp.array]:
        """Room for A, its tangents or its adjoints."""
        return self.arrays(suffix, A=matrix_type(self.layout.precision))

    def like_pull(self, suffix: str) -> dict[str, wp.array]:
        """Room for tangents or adjoints of k."""
        return self.arrays(suffix, k=self.layout.precision.real)

    def vectors(self) -> wp.array:
        """(n,) vectors, all 0."""
        return self.arrays("", one=self.layout.precision.vector)["one"]

    def settle(self, step: StepContext) -> None:
        step.launch(self.surroundings.forward, self.around, self.constants)
        step.launch(self.gradient.forward, self.flow, v_flow=step.fields["v"])
        step.launch(self.shift.forward, self.around, self.flow, self.constants, self.unpulled, delta=self._delta)

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
        self._around, self._unpulled = shift.like_around("_dot"), shift.like_pull("_dot")
        self._flow = shift.like_flow("_dot")

    def sort(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        shift = self._shift
        known = (*dot.named, self._around, shift.around, shift.constants, shift.unpulled, self._unpulled)
        step.launch(shift.surroundings.tangent, *known)
        step.launch(shift.gradient.tangent, *known, self._flow, v_flow=step.fields["v"], v_flow_dot=dot.fields["v"])
        step.launch(shift.shift.tangent, *known, shift.flow, self._flow, delta_dot=self._delta_dot)

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        x_dot = state_dot.positions
        step.launch(self._shift.place, x_free=x_dot, delta=self._delta_dot, x=x_dot)


class ShiftAdjoint(PartAdjoint):
    """Reverse mode of a shift; every sum is a gather."""

    def __init__(self, shift: Shift):
        self._shift, self._delta_bar = shift, shift.vectors()
        self._around, self._flow = shift.like_around("_bar"), shift.like_flow("_bar")
        self._unused = shift.like_pull("_bar")
        six = symmetric(shift.layout.precision).kind
        self._moments = shift.arrays("_pull", M=six, Q=six)

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        step.launch(self._shift.place_adjoint, x_scene_bar=moved_bar.positions, delta_bar=self._delta_bar)
        return moved_bar

    def sort(self, step: StepContext, bar: Adjoints, state_bar: State) -> None:
        shift = self._shift
        for array in (*self._around.values(), *self._flow.values()):
            array.zero_()
        around = (*bar.named, self._around, shift.around)
        known = (*around, shift.constants, shift.unpulled, self._unused)
        step.launch(shift.shift.adjoint, *known, self._flow, shift.flow, delta_bar=self._delta_bar)
        step.launch(shift.gradient.adjoint, *known, self._flow, v_flow=step.fields["v"], v_flow_bar=bar.fields["v"])
        for kernel in shift.surroundings.adjoint:
            step.launch(kernel, *known, self._moments)
        bar.solids.add(step.launch, partial(beside_solid_kernel, shift.discretisation), *around)
