"""PCISPH as the solver of a scene: its steps, put together with their derivatives: the tangent of a replayed step, and
its transpose, the adjoint.
"""

from collections.abc import Sequence
from functools import partial
from math import inf
from typing import Self

import numpy as np
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.particles.state import Parameters, State
from cortado.scene.solvers import PcisphSolver
from cortado.solvers.build import SolverSetting, particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.pcisph.pressure import pressure_solid_kernel
from cortado.solvers.pcisph.steps import PcisphSteps
from cortado.solvers.solver import Counts, Solver, StepAdjoint, StepTangent, WithinBar
from cortado.sph.density import density_solid_kernel, wall_slope_term
from cortado.sph.parts import StepContext


class PcisphAdjoint(ParticleAdjoint):
    """The adjoint of PCISPH steps, one step at a time, of a run with some parameters."""

    def __init__(self, solver: PcisphSteps, steps: int):
        super().__init__(solver, steps)
        self._solver = solver
        self._scaled_bar, self._slope_bar = solver.vectors(), solver.vectors()
        self._p_bar, self._y_bar, self._r, self._t_bar = (solver.numbers() for _ in range(4))

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        self._begin(counts, state_bar, parameters)
        self._go_back(counts, state_bar, parameters)

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        state_bar.clear()
        self._begin(counts, state_bar, parameters)
        add(within.p, self._p_bar)
        if within.stress is not None:
            add(within.stress, self._p_bar)
        self._go_back(counts, state_bar, parameters, within)

    def _begin(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        """Go back from the adjoint of a step's result to that of the last prediction."""
        (iterations,) = counts
        solver = self._solver
        context = solver.context(parameters)
        free_bar = self.unsort(context, state_bar)
        self.begin_step(context, free_bar, solver.iterates.v_star[iterations])
        context.launch(solver.kernels.scale_adjoint, *self.bar.named, scaled_bar=self._scaled_bar)
        self._y_bar.zero_()
        self._p_bar.zero_()

    def _go_back(
        self, counts: Counts, state_bar: State, parameters: Parameters, within: WithinBar | None = None
    ) -> None:
        """Go back from the adjoint of the last prediction to that of the state, through the step in reverse: the
        iterations, prediction with all forces, relaxation of the pressure, sorting."""
        (iterations,) = counts
        solver, it, kernels, scaled_bar = self._solver, self._solver.iterates, self._solver.kernels, self._scaled_bar
        context, known = solver.context(parameters), self.bar.named
        pressure_bar = {"y_bar": self._y_bar, "p_bar": self._p_bar}
        for k in reversed(range(iterations)):
            going = {"k": k, "rounds": solver.pressure_loop.rounds}
            context.launch(
                kernels.force.adjoint,
                going,
                *known,
                stiffness=solver.lattice.stiffness,
                y=solver.pressure_relaxation,
                p_in=it.p[k],
                p_out=it.p[k + 1],
                c=it.c[k],
                scaled_bar=scaled_bar,
                r=self._r,
                **pressure_bar,
            )
            pushed = partial(pressure_solid_kernel, solver.discretisation)
            self.bar.solids.add(context.launch, pushed, going, *known, scaled_bar=scaled_bar, c=it.c[k])
            predicted = {"x_star": it.x_star[k], "v_star": it.v_star[k]}
            context.launch(kernels.pressure.adjoint, going, *known, r=self._r, scaled_bar=scaled_bar, **predicted)
            densities = partial(density_solid_kernel, solver.discretisation, solver.topic, looped=True)
            self.bar.solids.add(context.launch, densities, going, *known, x=it.x_star[k], bar=self._r)
        self.predict(context, within)
        if kernels.density_ratio:
            ratio, own = kernels.density_ratio, {"t": solver.density_ratio, "wall_y": solver.wall_relaxation}
            bars = {"wall_y_bar": self._y_bar, "t_bar": self._t_bar}
            context.launch(ratio.relaxation.adjoint, own, bars)
            context.launch(ratio.total.adjoint, *known, bars)
        relaxed = {"y": solver.wall_relaxation, "y_bar": self._y_bar, "slope_bar": self._slope_bar}
        context.launch(kernels.wall_relaxation.adjoint, *known, relaxed)
        slopes = wall_slope_term(solver.discretisation).solid_kernel
        self.bar.solids.add(context.launch, slopes, *known, slope_bar=self._slope_bar)
        self.mix(context, state_bar)
        self.sort(context, state_bar)


class PcisphTangent(ParticleTangent):
    """The tangent of PCISPH steps, one step at a time, of a run along tangents of its parameters."""

    def __init__(self, solver: PcisphSteps, parameters_dot: Parameters):
        super().__init__(solver, parameters_dot)
        self._solver = solver
        self._x_star_dot, self._v_star_dot = solver.vectors(), solver.vectors()
        scalars = (solver.numbers() for _ in range(7))
        self._zero_pressure, *self._p_dot, self._c_dot, self._y_dot, self._wall_y_dot, self._t_dot = scalars

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        (iterations,) = counts
        solver, it, kernels, known = self._solver, self._solver.iterates, self._solver.kernels, self.dot.named
        context = solver.context(parameters)
        self.sort(context, state_dot)
        self._relax(known, context)
        accelerations = {"acceleration": solver.accelerations[-1], "acceleration_dot": self.accelerate(context)}
        predicted = {"x_star_dot": self._x_star_dot, "v_star_dot": self._v_star_dot}
        context.launch(solver.integration.predict_tangent, *known, **accelerations, v_star=it.v_star[0], **predicted)
        p_dot_before = self._zero_pressure
        for k in range(iterations):
            p_dot, c_dot = self._p_dot[k % 2], self._c_dot
            going = {"k": k, "rounds": solver.pressure_loop.rounds}
            context.launch(
                kernels.pressure.tangent,
                going,
                *known,
                stiffness=solver.lattice.stiffness,
                y=solver.pressure_relaxation,
                y_dot=self._y_dot,
                x_star=it.x_star[k],
                x_star_dot=self._x_star_dot,
                p_in=it.p[k],
                p_in_dot=p_dot_before,
                p_out=it.p[k + 1],
                p_out_dot=p_dot,
                c_dot=c_dot,
            )
            forces = {"c": it.c[k], "c_dot": c_dot, "v_star": it.v_star[k + 1]}
            context.launch(kernels.force.tangent, going, *known, **accelerations, **forces, **predicted)
            p_dot_before = p_dot
        self.unsort(context, self._x_star_dot, self._v_star_dot, state_dot)

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        own = [p_dot.numpy().reshape(len(rounds), -1) for p_dot in self._p_dot]
        return np.concatenate([own[(k - 1) % 2][b] for b, k in enumerate(rounds)])

    stresses = pressures

    def _relax(self, known: tuple[Named, ...], context: StepContext) -> None:
        """Compute the tangent of the pressure relaxation."""
        solver, kernels = self._solver, self._solver.kernels
        y_dot = self._wall_y_dot if kernels.density_ratio else self._y_dot
        context.launch(kernels.wall_relaxation.tangent, *known, y=solver.wall_relaxation, y_dot=y_dot)
        if kernels.density_ratio:
            ratio, t_dot = kernels.density_ratio, {"t_dot": self._t_dot}
            own = {"t": solver.density_ratio, "wall_y": solver.wall_relaxation, "wall_y_dot": y_dot}
            context.launch(ratio.total.tangent, *known, t_dot)
            context.launch(ratio.relaxation.tangent, own, t_dot, y_dot=self._y_dot)


class Pcisph(PcisphSteps):
    """The solver by predictive-corrective incompressible SPH, with its derivatives; see `Solver`."""

    def differentiable(self) -> Self:
        """Return a solver over this neighbour search with arrays of its own that Warp's tape can differentiate."""
        return type(self)(self.system.of_one_lane(), self.limits, requires_grad=True)

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return PcisphAdjoint(self, steps)


class PcisphMaker:
    """A maker of the PCISPH solver that the table [solver] of a scene describes."""

    batches = True

    def __init__(self, table: PcisphSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Make the PCISPH solver of a scene that is cut into particles, on a device."""
        limits = pressure_limits(self._table) if setting.scene.forces.pressure else None
        return Pcisph(particle_system(setting), limits)


maker = PcisphMaker


def pressure_limits(table: PcisphSolver) -> LoopLimits:
    """Return the bounds on iterations and density errors at which PCISPH's pressure loop stops."""
    greatest = table.maximum_density_tolerance
    return LoopLimits(
        table.minimum_iterations,
        table.maximum_iterations,
        table.density_tolerance,
        inf if greatest is None else greatest,
    )
