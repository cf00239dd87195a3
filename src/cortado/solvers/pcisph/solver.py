"""Predictive-corrective incompressible SPH (Solenthaler and Pajarola 2009) as the solver of a scene: its steps, their
tangent and adjoint, and two factors on the pressure correction delta of an iteration.

delta is derived for particles of equal mass, but a particle's pressure moves lighter neighbours further, by the ratio
of the masses. The iteration diverges if a density changes by more than twice the wanted amount, so delta is multiplied
by the density-ratio relaxation

    1 / (1 + e(t_i)),   t_i = V sum_j W_ij (m_i / m_j - 1),   e(t) = t^2 / (2 (t + a)) for t > 0, else 0,

which is 1 among particles of equal or greater mass, and tends to 1 / (1 + t / 2), the value for a lattice. The constant
a makes e smooth at t = 0.

delta is derived for a particle with a filled neighbourhood. Beside a wall the same pressure changes a particle's own
density more, by |S_i|^2 / (2 sum_j G_j . G_j of the prototype) with S_i = sum_b w_b G_ib. Beyond 2 the iteration
overshoots and kicks the particle away. A particle that approaches a wall meets a steeper gradient than at the start of
the step, so the response is doubled: delta is multiplied by the wall relaxation

    y_i = 1 / (1 + |S_i|^2 / response),   response = sum_j G_j . G_j,

which is 1 away from walls, and smooth. The relaxation changes the rate of convergence, not the limit. Sums are
multiplied by response^(-1/2) before they are squared: in float32 the square of a gradient overflows for small spacings.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from math import inf
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.modules import Kernels
from cortado.device.precision import TypesByName
from cortado.device.reduction import add
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels, sum_kernels
from cortado.particles.state import Parameters, State
from cortado.particles.wall_terms import solid_kernel
from cortado.scene.solvers import PcisphSolver
from cortado.solvers.build import SolverSetting, particle_system
from cortado.solvers.loop import IterationLog, Loop, LoopLimits
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.particles import ParticleSolver, ParticleSystem
from cortado.solvers.pcisph.pressure import pressure_force_kernels, pressure_kernels, pressure_term
from cortado.solvers.solver import Counts, Solver, StepAdjoint, StepTangent, WithinBar
from cortado.sph.density import density_solid_kernel, wall_slope_sums, wall_slope_term
from cortado.sph.parts import StepContext

SOFTNESS = 0.2
"""The softness a of the density-ratio relaxation [-]."""


@cache
def density_ratio_kernels(discretisation: Discretisation) -> SimpleNamespace:
    """Make the kernels of t, and of y from t and the relaxation beside walls; the adjoint of y overwrites the adjoints
    of both."""
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    weight, gradient = pair.weight, pair.gradient
    modules = discretisation.modules("density_ratio")
    a, typed = wp.constant(real(SOFTNESS)), TypesByName(real, {neighbourhood: "s", vector: "x"})

    @fluid_sum(discretisation)
    def density_ratio_sum(x_ij: vector, m_i: real, m_j: real, s: neighbourhood) -> real:
        return weight(x_ij, s) * (m_i / m_j - real(1.0))

    @tangent_of(density_ratio_sum)
    @fluid_sum(discretisation, ahead=False)
    @typed
    def density_ratio_sum_tangent(x_ij, x_dot_ij, m_i, m_j, m_dot_i, m_dot_j, s) -> real:
        ratio = m_i / m_j
        change = wp.dot(gradient(x_ij, s), x_dot_ij) * (ratio - real(1.0))
        return change + weight(x_ij, s) * ratio * (m_dot_i / m_i - m_dot_j / m_j)

    @adjoint_of(density_ratio_sum)
    @fluid_sum(discretisation)
    @typed
    def density_ratio_sum_adjoint(x_ij, m_i, m_j, t_bar_i, t_bar_j, s) -> tuple[vector, real]:
        own = t_bar_i * m_i / m_j
        other = t_bar_j * m_j / m_i
        return (own - t_bar_i + other - t_bar_j) * gradient(x_ij, s), weight(x_ij, s) * (own - other) / m_i

    def relaxation(wall_y_i: real, t_i: real) -> real:
        """Return y_wall / (1 + e(t))."""
        excess = real(0.0)
        if t_i > real(0.0):
            excess = real(0.5) * t_i * t_i / (t_i + a)
        return wall_y_i / (real(1.0) + excess)

    sums = density_ratio_sum, density_ratio_sum_tangent, density_ratio_sum_adjoint
    precision, replaced = discretisation.precision, {"y": "wall_y"}
    return SimpleNamespace(
        total=sum_kernels("density_ratio", modules, sums, "t", times="s.volume"),
        relaxation=pointwise_kernels(precision, modules, lambda _: relaxation, ["y"], replaced, written=["t"]),
    )


@cache
def wall_kernels(discretisation: Discretisation) -> Kernels:
    """Make the kernels of the pressure relaxation beside walls."""
    real, vector, neighbourhood = discretisation.types
    sums = wall_slope_sums(discretisation)
    slope, change, LANES = sums.slope, sums.change, discretisation.lanes
    module, tangent_module, adjoint_module = discretisation.modules("pcisph")
    lane, typed = discretisation.lane, TypesByName(real, {neighbourhood: "s", vector: "x slope"})

    @particle_kernel(module, "y", [over(slope, "total")])
    def wall_relaxation(total: vector, s: neighbourhood) -> real:
        scaled = s.response_scale * total
        return real(1.0) / (real(1.0) + wp.dot(scaled, scaled))

    @particle_kernel(tangent_module, "y_dot", [over(slope, "total"), over(sums.tangent, "total_dot")])
    def wall_relaxation_tangent(total: vector, total_dot: vector, y_i: real, s: neighbourhood) -> real:
        along = wp.dot(s.response_scale * total, s.response_scale * total_dot)
        return real(-2.0) * y_i * y_i * along

    @wp.kernel(module=adjoint_module, enable_backward=False)
    @typed.arrays
    def wall_relaxation_adjoint(s, x, y, y_bar, x_bar, slope_bar):
        """Add to the adjoint of positions from that of y; ``slope_bar`` gets the adjoint of S."""
        i = s.first + wp.tid() // LANES
        total = s.response_scale * slope(i, x, s)
        along = (real(-2.0) * y_bar[i] * y[i] * y[i] * s.response_scale) * total
        x_sum = change(i, x, along, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        slope_bar[i] = along

    return Kernels(wall_relaxation, wall_relaxation_tangent, wall_relaxation_adjoint)


@cache
def scaling_kernel(discretisation: Discretisation) -> Any:
    """Make the kernel of the adjoint of the pressure acceleration over m."""
    real, vector = discretisation.precision.real, discretisation.precision.vector

    @particle_kernel(discretisation.module(False, "pcisph"), "scaled_bar")
    def scale_adjoint(time_step: real, m_i: real, v_bar_i: vector) -> vector:
        return (time_step / m_i) * v_bar_i

    return scale_adjoint


class Iterates:
    """Predicted states and pressures of the iterations of one step; a run overwrites a single slot."""

    def __init__(self, numbers: Callable[[], wp.array], vectors: Callable[[], wp.array]):
        self._numbers, self._vectors = numbers, vectors
        self.x_star: list[wp.array] = []
        self.v_star: list[wp.array] = []
        self.p: list[wp.array] = [numbers()]
        """``p[k]`` before iteration k; ``p[0]`` is 0 and never written."""
        self.c: list[wp.array] = []
        self.reserve(1)

    def reserve(self, iterations: int) -> None:
        while len(self.x_star) <= iterations:
            self.x_star.append(self._vectors())
            self.v_star.append(self._vectors())
            self.p.append(self._numbers())
            self.c.append(self._numbers())


class PcisphSteps(ParticleSolver):
    topic = "pcisph"

    def __init__(self, system: ParticleSystem, limits: LoopLimits | None, requires_grad: bool = False):
        """Prepare steps of a system; ``limits`` None leaves the pressure out."""
        super().__init__(system, requires_grad)
        self.limits, own = limits, self.discretisation
        self.kernels = SimpleNamespace(
            wall_relaxation=wall_kernels(own),
            density_ratio=density_ratio_kernels(own) if self.layout.phases > 1 else None,
            pressure=pressure_kernels(own),
            force=pressure_force_kernels(own),
            scale_adjoint=scaling_kernel(own),
        )
        self.wall_relaxation, self.density_ratio = self.numbers(), self.numbers()
        self.pressure_relaxation = self.numbers() if self.layout.phases > 1 else self.wall_relaxation
        """(n,) factor of delta [-], below 1 beside walls and among lighter neighbours"""
        self.iterates = Iterates(self.numbers, self.vectors)
        self.pressure_loop = Loop(limits, self.layout, self.launch)
        self.loops = (self.pressure_loop,)

    def step(self, state: State, new_state: State, parameters: Parameters, log: IterationLog) -> None:
        context = self.predict(state, parameters)
        self.pressure_loop.run(lambda k: self.iterate(k, 0, context))
        self.write_state((0,), parameters, new_state)
        self.end_step(self.iterates.x_star[0], self.iterates.v_star[0], new_state, log)

    def reserve(self, counts: Counts) -> None:
        (iterations,) = counts
        self.iterates.reserve(iterations)

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        self.reserve(counts)
        context = self.predict(state, parameters)
        for k in range(*counts):
            self.iterate(k, k + 1, context)

    def write_state(self, counts: Counts, parameters: Parameters, new_state: State) -> None:
        (iterations,) = counts
        it = self.iterates
        self.unsort(self.context(parameters), it.x_star[iterations], it.v_star[iterations], new_state)

    def pressures(self) -> wp.array | None:
        return None if self.limits is None else self.iterates.p[1]

    def predict(self, state: State, parameters: Parameters) -> StepContext:
        """Do all of a step before the pressure iterations: sort, compute y, add up explicit forces, and predict v* = v
        + dt a, x* = x + dt v*."""
        it, context = self.iterates, self.sort(state, parameters)
        with context.aside():
            self._relax(context)
        first = {"x_star": it.x_star[0], "v_star": it.v_star[0]}
        context.launch(self.integration.predict, acceleration=self.accelerate(context), **first)
        context.join()
        return context

    def _relax(self, context: StepContext) -> None:
        kernels = self.kernels
        context.launch(kernels.wall_relaxation.forward, y=self.wall_relaxation)
        if kernels.density_ratio:
            found = {"t": self.density_ratio, "wall_y": self.wall_relaxation, "y": self.pressure_relaxation}
            context.launch(kernels.density_ratio.total.forward, t=found["t"])
            context.launch(kernels.density_ratio.relaxation.forward, found)

    def iterate(self, k: int, slot: int, context: StepContext) -> None:
        """Do pressure iteration k, from the previous slot to ``slot``; a run uses only slot 0."""
        it, kernels, before = self.iterates, self.kernels, max(slot - 1, 0)
        going = {"k": k, "rounds": self.pressure_loop.rounds}
        context.launch(
            kernels.pressure.forward,
            going,
            stiffness=self.lattice.stiffness,
            y=self.pressure_relaxation,
            x_star=it.x_star[before],
            p_in=it.p[0] if k == 0 else it.p[max(slot - 1, 1)],
            p_out=it.p[max(slot, 1)],
            c=it.c[before],
            error=self.pressure_loop.errors,
        )
        going |= {"x_before": it.x_star[before], "v_before": it.v_star[before]}
        new = {"x_star": it.x_star[slot], "v_star": it.v_star[slot]}
        context.launch(kernels.force.forward, going, acceleration=self.accelerations[-1], c=it.c[before], **new)


class PcisphAdjoint(ParticleAdjoint):
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
        """Turn the adjoint of a step's result into the adjoint of the last prediction."""
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
        (iterations,) = counts
        solver, it, kernels, scaled_bar = self._solver, self._solver.iterates, self._solver.kernels, self._scaled_bar
        context, known = solver.context(parameters), self.bar.named
        pressure_bar = {"y_bar": self._y_bar, "p_bar": self._p_bar}
        for k in reversed(range(iterations)):
            going = {"k": k, "rounds": solver.pressure_loop.rounds}
            given = {"stiffness": solver.lattice.stiffness, "y": solver.pressure_relaxation, "c": it.c[k]}
            pressures = {"p_in": it.p[k], "p_out": it.p[k + 1], **pressure_bar}
            context.launch(kernels.force.adjoint, going, *known, given, pressures, scaled_bar=scaled_bar, r=self._r)
            pushed = partial(solid_kernel, solver.discretisation, "pcisph", pressure_term, looped=True)
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
        predicted = {"x_star_dot": self._x_star_dot, "v_star_dot": self._v_star_dot}
        self.predict(context, it.v_star[0], **predicted)
        accelerations = {"acceleration": solver.accelerations[-1], "acceleration_dot": self._accelerations_dot[-1]}
        p_dot_before = self._zero_pressure
        for k in range(iterations):
            p_dot, c_dot = self._p_dot[k % 2], self._c_dot
            going = {"k": k, "rounds": solver.pressure_loop.rounds}
            given = {"stiffness": solver.lattice.stiffness, "y": solver.pressure_relaxation, "y_dot": self._y_dot}
            pressures = {"p_in": it.p[k], "p_in_dot": p_dot_before, "p_out": it.p[k + 1], "p_out_dot": p_dot}
            there = {"x_star": it.x_star[k], "x_star_dot": self._x_star_dot}
            context.launch(kernels.pressure.tangent, going, *known, given, pressures, there, c_dot=c_dot)
            forces = {"c": it.c[k], "c_dot": c_dot, "v_star": it.v_star[k + 1]}
            context.launch(kernels.force.tangent, going, *known, **accelerations, **forces, **predicted)
            p_dot_before = p_dot
        self.unsort(context, self._x_star_dot, self._v_star_dot, state_dot)

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        own = [p_dot.numpy().reshape(len(rounds), -1) for p_dot in self._p_dot]
        return np.concatenate([own[(k - 1) % 2][b] for b, k in enumerate(rounds)])

    stresses = pressures

    def _relax(self, known: tuple[Named, ...], context: StepContext) -> None:
        solver, kernels = self._solver, self._solver.kernels
        y_dot = self._wall_y_dot if kernels.density_ratio else self._y_dot
        context.launch(kernels.wall_relaxation.tangent, *known, y=solver.wall_relaxation, y_dot=y_dot)
        if kernels.density_ratio:
            ratio, t_dot = kernels.density_ratio, {"t_dot": self._t_dot}
            own = {"t": solver.density_ratio, "wall_y": solver.wall_relaxation, "wall_y_dot": y_dot}
            context.launch(ratio.total.tangent, *known, t_dot)
            context.launch(ratio.relaxation.tangent, own, t_dot, y_dot=self._y_dot)


class Pcisph(PcisphSteps):
    def differentiable(self) -> Self:
        return type(self)(self.system.of_one_lane(), self.limits, requires_grad=True)

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return PcisphAdjoint(self, steps)


class PcisphMaker:
    batches = True

    def __init__(self, table: PcisphSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        table, counts = self._table, (self._table.minimum_iterations, self._table.maximum_iterations)
        greatest = inf if table.maximum_density_tolerance is None else table.maximum_density_tolerance
        limits = LoopLimits(*counts, table.density_tolerance, greatest) if setting.scene.forces.pressure else None
        return Pcisph(particle_system(setting), limits)


maker = PcisphMaker
