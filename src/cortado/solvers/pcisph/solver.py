"""PCISPH (Solenthaler and Pajarola 2009): steps with tangent and adjoint, and two factors on the pressure correction.
`docs/discretisation.md` has the equations.

*Density ratios*: The pressure correction assumes neighbours of equal mass, but a pressure moves lighter neighbours
further. The pressure iteration diverges if a correction changes a density by more than twice the wanted amount. The
density-ratio relaxation, a factor on the correction, is 1 among particles of equal or greater mass. For a large sum t
over lighter neighbours, the density-ratio relaxation tends to 1 / (1 + t / 2), the value for a lattice.

*Walls*: The pressure correction assumes a filled neighbourhood, but beside a wall the same pressure changes the density
more. A particle that approaches a wall also meets a steeper kernel gradient, so the wall relaxation doubles the density
change by walls. The wall relaxation changes the rate of convergence, but not the converged pressure. Kernel gradients
are scaled before they are squared, because their squares overflow in float32 for small spacings.
"""

from collections.abc import Sequence
from functools import cache, partial
from math import inf
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

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
from cortado.solvers.solver import Counts, Solver, WithinBar
from cortado.sph.density import density_solid_kernel, wall_slope_sums, wall_slope_term
from cortado.sph.parts import StepContext

SOFTNESS = 0.2
"""Constant a of the density-ratio relaxation, which makes the relaxation smooth for equal masses [-]."""


@cache
def density_ratio_kernels(discretisation: Discretisation) -> SimpleNamespace:
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    weight, gradient = pair.weight, pair.gradient
    modules = discretisation.modules("density_ratio")
    a, typed = wp.constant(real(SOFTNESS)), TypesByName(real, {neighbourhood: "s", vector: "x"})

    @fluid_sum(discretisation)
    def density_ratio_sum(x_ij: vector, m_i: real, m_j: real, s: neighbourhood) -> real:
        return weight(x_ij, s) * (m_i / m_j - real(1.0))

    @tangent_of(density_ratio_sum)
    @fluid_sum(discretisation, typed, ahead=False)
    def density_ratio_sum_tangent(x_ij, x_dot_ij, m_i, m_j, m_dot_i, m_dot_j, s) -> real:
        ratio = m_i / m_j
        change = wp.dot(gradient(x_ij, s), x_dot_ij) * (ratio - real(1.0))
        return change + weight(x_ij, s) * ratio * (m_dot_i / m_i - m_dot_j / m_j)

    @adjoint_of(density_ratio_sum)
    @fluid_sum(discretisation, typed)
    def density_ratio_sum_adjoint(x_ij, m_i, m_j, t_bar_i, t_bar_j, s) -> tuple[vector, real]:
        own = t_bar_i * m_i / m_j
        other = t_bar_j * m_j / m_i
        return (own - t_bar_i + other - t_bar_j) * gradient(x_ij, s), weight(x_ij, s) * (own - other) / m_i

    def relaxation(wall_y_i: real, t_i: real) -> real:
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

    @typed.kernel(adjoint_module)
    def wall_relaxation_adjoint(s, x, y, y_bar, x_bar, slope_bar):
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
    """Make the kernel that divides the adjoint of the pressure acceleration by the particle's density."""
    real, vector = discretisation.precision.real, discretisation.precision.vector

    @particle_kernel(discretisation.module(False, "pcisph"), "scaled_bar")
    def scale_adjoint(time_step: real, m_i: real, v_bar_i: vector) -> vector:
        return (time_step / m_i) * v_bar_i

    return scale_adjoint


class Pcisph(ParticleSolver):
    topic = "pcisph"

    def __init__(self, system: ParticleSystem, limits: LoopLimits | None, requires_grad: bool = False):
        super().__init__(system, requires_grad)
        self.limits, own = limits, self.discretisation
        self.kernels = SimpleNamespace(
            wall_relaxation=wall_kernels(own),
            density_ratio=density_ratio_kernels(own) if self.layout.phases > 1 else None,
            pressure=pressure_kernels(own),
            force=pressure_force_kernels(own),
            scale_adjoint=scaling_kernel(own),
        )
        wall_y, t = self.numbers(), self.numbers()
        y = self.numbers() if self.layout.phases > 1 else wall_y
        self.known: dict[str, Any] = {"wall_y": wall_y, "t": t, "y": y, "stiffness": self.lattice.stiffness}
        self.iterates = SimpleNamespace(x_star=[], v_star=[], p=[self.numbers()], c=[])
        """Predicted states and pressures of the iterations of a step. Without derivatives, the solver stores only the
        latest iteration. ``p`` has the pressures before each iteration, which are 0 before the first iteration."""
        Pcisph.reserve(self, (1,))
        self.pressure_loop = Loop(limits, self.layout, self.launch)
        self.loops = (self.pressure_loop,)
        self.known |= {"rounds": self.pressure_loop.rounds, "acceleration": self.accelerations[-1]}

    def step(self, state: State, new_state: State, parameters: Parameters, log: IterationLog) -> None:
        context = self.predict(state, parameters)
        self.pressure_loop.run(lambda k: self.iterate(k, 0, context))
        self.write_state((0,), parameters, new_state)
        self.end_step(self.iterates.x_star[0], self.iterates.v_star[0], new_state, log)

    def reserve(self, counts: Counts) -> None:
        it = self.iterates
        while len(it.x_star) <= counts[0]:
            it.x_star.append(self.vectors())
            it.v_star.append(self.vectors())
            it.p.append(self.numbers())
            it.c.append(self.numbers())

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

    def differentiable(self) -> Self:
        return type(self)(self.system.of_one_lane(), self.limits, requires_grad=True)

    def tangent(self, parameters_dot: Parameters) -> "PcisphTangent":
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> "PcisphAdjoint":
        return PcisphAdjoint(self, steps)

    def predict(self, state: State, parameters: Parameters) -> StepContext:
        it, context = self.iterates, self.sort(state, parameters)
        with context.aside():
            context.launch(self.kernels.wall_relaxation.forward, y=self.known["wall_y"])
            if ratio := self.kernels.density_ratio:
                context.launch(ratio.total.forward, self.known)
                context.launch(ratio.relaxation.forward, self.known)
        self.accelerate(context)
        context.launch(self.integration.predict, self.known, x_star=it.x_star[0], v_star=it.v_star[0])
        context.join()
        return context

    def iterate(self, k: int, slot: int, context: StepContext) -> None:
        it, before = self.iterates, max(slot - 1, 0)
        pressures = {"p_in": it.p[0] if k == 0 else it.p[max(slot - 1, 1)], "p_out": it.p[max(slot, 1)]}
        pressures |= {"x_star": it.x_star[before], "c": it.c[before], "error": self.pressure_loop.errors}
        context.launch(self.kernels.pressure.forward, self.known, pressures, k=k)
        moved = {"x_before": it.x_star[before], "v_before": it.v_star[before], "c": it.c[before]}
        new = {"x_star": it.x_star[slot], "v_star": it.v_star[slot]}
        context.launch(self.kernels.force.forward, self.known, moved, new, k=k)


class PcisphAdjoint(ParticleAdjoint):
    def __init__(self, solver: Pcisph, steps: int):
        super().__init__(solver, steps)
        self._solver = solver
        precision = solver.layout.precision
        numbers = dict.fromkeys(("p_bar", "y_bar", "r", "t_bar"), precision.real)
        vectors = dict.fromkeys(("scaled_bar", "slope_bar"), precision.vector)
        self._own = solver.layout.arrays(**numbers, **vectors)
        self._own["wall_y_bar"] = self._own["y_bar"]

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        state_bar.clear()
        self.step(counts, state_bar, parameters, within)

    def step(self, counts: Counts, state_bar: State, parameters: Parameters, within: WithinBar | None = None) -> None:
        (iterations,) = counts
        solver, it, kernels, topic = self._solver, self._solver.iterates, self._solver.kernels, self._solver.topic
        context, known, own = solver.context(parameters), (self._own, *self.bar.named, solver.known), self._own
        self.begin_step(context, self.unsort(context, state_bar), it.v_star[iterations])
        context.launch(kernels.scale_adjoint, *self.bar.named, own)
        own["y_bar"].zero_()
        own["p_bar"].zero_()
        for given in () if within is None else (within.p, within.stress):
            if given is not None:
                add(given, own["p_bar"])
        pushed = partial(solid_kernel, solver.discretisation, "pcisph", pressure_term, looped=True)
        densities = partial(density_solid_kernel, solver.discretisation, topic, looped=True)
        for k in reversed(range(iterations)):
            at = {"k": k, "p_in": it.p[k], "p_out": it.p[k + 1], "c": it.c[k]}
            at |= {"x_star": it.x_star[k], "v_star": it.v_star[k]}
            context.launch(kernels.force.adjoint, at, *known)
            self.bar.solids.add(context.launch, pushed, at, *known)
            context.launch(kernels.pressure.adjoint, at, *known)
            self.bar.solids.add(context.launch, densities, at, *known, x=it.x_star[k], bar=own["r"])
        self.predict(context, within)
        if ratio := kernels.density_ratio:
            context.launch(ratio.relaxation.adjoint, *known)
            context.launch(ratio.total.adjoint, *known)
        context.launch(kernels.wall_relaxation.adjoint, *known, y=solver.known["wall_y"])
        slopes = wall_slope_term(solver.discretisation).solid_kernel
        self.bar.solids.add(context.launch, slopes, *known)
        self.mix(context, state_bar)
        self.sort(context, state_bar)


class PcisphTangent(ParticleTangent):
    def __init__(self, solver: Pcisph, parameters_dot: Parameters):
        super().__init__(solver, parameters_dot)
        self._solver = solver
        precision = solver.layout.precision
        vectors = dict.fromkeys(("x_star", "v_star"), precision.vector)
        self._own = solver.layout.arrays("_dot", **vectors, **dict.fromkeys(("c", "y", "wall_y", "t"), precision.real))
        self._own["acceleration_dot"] = self._accelerations_dot[-1]
        self._zero_pressure, *self._p_dot = (solver.numbers() for _ in range(3))

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        (iterations,) = counts
        solver, it, kernels, own = self._solver, self._solver.iterates, self._solver.kernels, self._own
        context, known = solver.context(parameters), (own, *self.dot.named, solver.known)
        self.sort(context, state_dot)
        ratio, wall = kernels.density_ratio, kernels.wall_relaxation.tangent
        wall_y_dot = own["wall_y_dot"] if ratio else own["y_dot"]
        context.launch(wall, *known, y=solver.known["wall_y"], y_dot=wall_y_dot)
        if ratio:
            context.launch(ratio.total.tangent, *known)
            context.launch(ratio.relaxation.tangent, *known)
        self.predict(context, it.v_star[0], own["x_star_dot"], own["v_star_dot"])
        p_dot_before = self._zero_pressure
        for k in range(iterations):
            p_dot = self._p_dot[k % 2]
            at = {"k": k, "p_in": it.p[k], "p_in_dot": p_dot_before, "p_out": it.p[k + 1], "p_out_dot": p_dot}
            at |= {"c": it.c[k], "x_star": it.x_star[k], "v_star": it.v_star[k + 1]}
            context.launch(kernels.pressure.tangent, at, *known)
            context.launch(kernels.force.tangent, at, *known)
            p_dot_before = p_dot
        self.unsort(context, own["x_star_dot"], own["v_star_dot"], state_dot)

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        own = [p_dot.numpy().reshape(len(rounds), -1) for p_dot in self._p_dot]
        return np.concatenate([own[(k - 1) % 2][b] for b, k in enumerate(rounds)])

    stresses = pressures


class Maker:
    batches = True

    def __init__(self, table: PcisphSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        table, counts = self._table, (self._table.minimum_iterations, self._table.maximum_iterations)
        greatest = inf if table.maximum_density_tolerance is None else table.maximum_density_tolerance
        limits = LoopLimits(*counts, table.density_tolerance, greatest) if setting.scene.forces.pressure else None
        return Pcisph(particle_system(setting), limits)
