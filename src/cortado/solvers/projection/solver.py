"""The velocity projection as the solver of a scene, with the tangent and the adjoint of a replayed step; every sum is a
gather."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import inf

import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.errors import InputError
from cortado.particles.state import Parameters, State
from cortado.particles.wall_terms import solid_kernel
from cortado.scene.solvers import ProjectionSolver
from cortado.solvers.build import SolverSetting, particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.projection.bodies import BodiesAdjoint, BodiesTangent
from cortado.solvers.projection.coarse import CoarseAdjoint, CoarseTangent
from cortado.solvers.projection.lattice import coarse_grid, endless, lattice_constants
from cortado.solvers.projection.mean_stress import pressed_kernels
from cortado.solvers.projection.repair import repair_term
from cortado.solvers.projection.steps import IMPULSE, KICK, ProjectionSteps
from cortado.solvers.projection.surroundings import SurroundingsAdjoint, SurroundingsTangent
from cortado.solvers.projection.wall_sums import FaceShares
from cortado.solvers.solver import Counts, Solver, StepAdjoint, StepTangent, WithinBar
from cortado.sph.free_solids import FreeSolidsAdjoint, FreeSolidsTangent
from cortado.sph.parts import StepContext


class ProjectionTangent(ParticleTangent):
    density: SurroundingsTangent

    def __init__(self, solver: ProjectionSteps, parameters_dot: Parameters):
        super().__init__(solver, parameters_dot)
        self._solver: ProjectionSteps = solver
        self._around = self.density.around
        self._pull = solver.layout.arrays(T=solver.pull.dtype, T_dot=solver.pull.dtype)
        self._x_star_dot, self._v_star_dot, self._kick_dot = (solver.vectors() for _ in range(3))
        self._u_dot, self._delta_dot, self._x_moved_dot, self._x_now_dot = (solver.vectors() for _ in range(4))
        self._v_end_dot = self._u_dot if solver.following is None else solver.vectors()
        self._k_dot, self._y_dot, self._c_dot = (solver.numbers() for _ in range(3))
        self._A_dot = wp.zeros_like(solver.iterates[0]["A"])
        free = [part for part in self._parts if isinstance(part, FreeSolidsTangent)]
        self._bodies = None if solver.bodies is None else BodiesTangent(solver.bodies, free[0].bodies)
        self._coarse = CoarseTangent(solver.coarse, solver.layout, self._bodies, self.dot)

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        solver, kernels = self._solver, self._solver.kernels
        context = solver.context(parameters)
        self.sort(context, state_dot)
        known = (*self.dot.named, self._around, solver.around)
        if self._bodies is not None:
            pressures = solver.carried[IMPULSE], self.carried_dot[IMPULSE]
            self._bodies.begin(context, self.dot, solver.around, self._around, pressures)
        self.predict(context, solver.v_star, self._x_star_dot, self._v_star_dot)
        self._project(context, known, counts[0])
        v_new = {"v_new": solver.iterates[counts[0]]["u"], "v_new_dot": self._u_dot}
        flow = {"A": solver.last_gradient(counts[0]), "A_dot": self._A_dot}
        pull = {"k": solver.iterates[counts[0]]["k"], "k_dot": self._k_dot}
        context.launch(kernels.shift.tangent, *known, solver.spaced, flow, pull, delta_dot=self._delta_dot)
        moved = {"x_moved_dot": self._x_moved_dot, "delta": solver.delta, "delta_dot": self._delta_dot}
        context.launch(kernels.moving.tangent, *known, v_new, moved)
        wp.copy(self._x_now_dot, self._x_moved_dot)
        self._c_dot.zero_()
        omegas = solver.repair_relaxations
        for k in range(counts[1]):
            at, new = solver.repaired[k], solver.repaired[k + 1]
            measured = {"x_now": at["x_now"], "c_in": at["c"], "excess": at["excess"]}
            change = {"x_now_dot": self._x_now_dot, "c_in_dot": self._c_dot, "c_out_dot": self._c_dot}
            context.launch(kernels.repair.measure.tangent, *known, measured, change, omega=omegas[k])
            there = {"c": new["c"], "x_moved": solver.x_moved, "x_now": new["x_now"], "held": new["held"]}
            change = {"c_dot": self._c_dot, "x_moved_dot": self._x_moved_dot, "x_now_dot": self._x_now_dot}
            context.launch(kernels.repair.move.tangent, *known, there, change)
        if solver.following is not None:
            ends = {"x_now": solver.repaired[counts[1]]["x_now"], "x_now_dot": self._x_now_dot}
            context.launch(solver.following.tangent, *known, flow, v_new, ends, v_end_dot=self._v_end_dot)
        if solver.sides is not None:
            solver.sides.tangent(context, self.dot, solver.repaired[counts[1]]["x_now"], self._x_now_dot)
        carried = {IMPULSE: self._k_dot, KICK: self._kick_dot}
        self.unsort(context, self._x_now_dot, self._v_end_dot, state_dot, **carried)

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        return self._over_time(self._solver.iterates[rounds[0]]["k"], self._k_dot.numpy())

    def stresses(self, rounds: Sequence[int]) -> NDArray:
        solver, at = self._solver, {**self._pull, "k": self._solver.iterates[rounds[0]]["k"], "k_dot": self._k_dot}
        context, around = solver.context(solver.parameters), (solver.around, self._around)
        change = solver.mean_stress.tangent(context, self.dot, around, at)
        return self._over_time(solver.mean_stress.impulses(context, solver.around, at), change)

    def _over_time(self, impulses: wp.array, change: NDArray) -> NDArray:
        """Return the tangent of impulses divided by the time step, given the tangent of the impulses."""
        particles = self._solver.layout.particles
        dt, dt_dot = (of.parameters["time_step"].numpy().repeat(particles) for of in (self._solver, self.dot))
        found: NDArray = change / dt - impulses.numpy() * dt_dot / dt**2
        return found

    def _project(self, context: StepContext, known: tuple[Named, ...], iterations: int) -> None:
        solver, kernels = self._solver, self._solver.kernels.pressure
        beginning = solver.kernels.beginning
        before = {"k_before": solver.carried[IMPULSE], "k_before_dot": self.carried_dot[IMPULSE]}
        before |= {"kick_before": solver.carried[KICK], "kick_before_dot": self.carried_dot[KICK]}
        before |= {"surfaced": solver.density.surfaced, "v_star": solver.v_star}
        change = {"u_dot": self._u_dot, "y_dot": self._y_dot, "k_dot": self._k_dot}
        context.launch(beginning.tangent, *known, solver.spaced, before, change, v_star_dot=self._v_star_dot)
        self._coarse.begin(context, known)
        for k in range(iterations):
            at = solver.corrected[k]
            solver.coarse.where_due(k, partial(self._correct, context, known, k, change))
            drift = self._drift(context, at)
            new = {"A_dot": self._A_dot, "k_out_dot": self._k_dot, "y_out_dot": self._y_dot}
            beta = solver.momentum(k)
            context.launch(kernels.update.tangent, *known, at, solver.relaxed, change, new, **drift, beta=beta)
            self._press(context, known, solver.iterates[k + 1])
        if self._bodies is not None:
            self._bodies.settle(context, self.dot, solver.iterates[iterations]["y"], self._y_dot)

    def _correct(self, context: StepContext, known: tuple[Named, ...], k: int, change: dict[str, wp.array]) -> None:
        before = {**self._solver.iterates[k], **change}
        drift = self._drift(context, before)
        self._coarse.correct(context, k, (drift, *known), before, self._solver.corrected[k])

    def _drift(self, context: StepContext, at: dict[str, wp.array]) -> dict[str, wp.array]:
        if self._bodies is None:
            return {}
        drift_dot = self._around["drift_dot"]
        return {"drift_dot": self._bodies.drifted(context, self.dot, drift_dot, at["y"], self._y_dot)}

    def _press(self, context: StepContext, known: tuple[Named, ...], at: dict[str, wp.array]) -> None:
        solver, kernels = self._solver, self._solver.kernels.velocity
        pull = {**self._pull, "y": at["y"], "y_dot": self._y_dot}
        context.launch(kernels.pull_tangent, *known, pull)
        predicted = {"v_star": solver.v_star, "v_star_dot": self._v_star_dot}
        found = {"u": at["u"], "u_dot": self._u_dot, "kick_dot": self._kick_dot}
        context.launch(kernels.velocity.tangent, *known, pull, predicted, found)


class ProjectionAdjoint(ParticleAdjoint):
    density: SurroundingsAdjoint

    def __init__(self, solver: ProjectionSteps, steps: int):
        super().__init__(solver, steps)
        self._solver: ProjectionSteps = solver
        self._around = self.density.around
        self._x_now_bar, self._x_moved_bar, self._u_bar, self._f = (solver.vectors() for _ in range(4))
        self._kick_bar, self._kick_before_bar = (solver.vectors() for _ in range(2))
        self.bar = replace(self.bar, kick=self._kick_before_bar)
        self._A_bar = wp.zeros_like(solver.iterates[0]["A"])
        self._faces = FaceShares(solver.discretisation, solver.layout, len(solver.system.faces.solids))
        self._pull, push = (wp.zeros_like(solver.pull) for _ in range(2))
        self._m_unused, self._k_before_bar, self._n_now_bar = (solver.numbers() for _ in range(3))
        self._k_bar, self._y_bar, self._c_bar, d_bar, self._q_bar = (solver.numbers() for _ in range(5))
        free = [part for part in self._parts if isinstance(part, FreeSolidsAdjoint)]
        self._bodies = None if solver.bodies is None else BodiesAdjoint(solver.bodies, free[0].bodies)
        self._steps = {"k_bar": self._k_bar, "y_bar": self._y_bar, "d_bar": d_bar, "S": push}
        self._drift_bar = {} if self._bodies is None else {"drift_bar": self._bodies.drift_bar}
        self._coarse = CoarseAdjoint(solver.coarse, solver.layout, self._bodies, self.bar, self._faces)

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        self._begin(state_bar, parameters)
        self._go_back(counts, state_bar, parameters)

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        solver = self._solver
        state_bar.clear()
        self._begin(state_bar, parameters)
        context, known = solver.context(parameters), self.bar.named
        pressed, k = pressed_kernels(solver.layout.precision).adjoint, solver.iterates[counts[0]]["k"]
        context.launch(pressed, *known, impulse=k, p_bar=within.p, impulse_bar=self._k_bar)
        if within.stress is not None:
            self._q_bar.zero_()
            at = {"k": k, "T": solver.pull, "k_bar": self._k_bar, "q_bar": self._q_bar}
            q = solver.mean_stress.impulses(context, solver.around, at)
            context.launch(pressed, *known, impulse=q, p_bar=within.stress, impulse_bar=at["q_bar"])
            solver.mean_stress.adjoint(context, self.bar, (solver.around, self._around), at)
        self._go_back(counts, state_bar, parameters, within)

    def _begin(self, state_bar: State, parameters: Parameters) -> None:
        """Turn the adjoint of a step's result into the adjoints of the last positions, velocities and k."""
        solver, context = self._solver, self._solver.context(parameters)
        free_bar = self.unsort(context, state_bar)
        scene = {
            "x_scene": free_bar.positions,
            "v_scene": free_bar.velocities,
            "m_scene": state_bar["reference_density"],
        }
        new = {"x": self._x_now_bar, "v": self._u_bar, "m": self._m_unused}
        context.launch(solver.integration.sort, scene, new)
        own = (self._x_moved_bar, self._c_bar, self._y_bar, self._A_bar)
        for array in (*self.bar.fields.arrays(), *own):
            array.zero_()
        self.density.begin()
        wp.copy(self._k_bar, self.carried_bar[IMPULSE])
        wp.copy(self._kick_bar, self.carried_bar[KICK])
        if self._bodies is not None:
            self._bodies.begin()

    def _go_back(
        self, counts: Counts, state_bar: State, parameters: Parameters, within: WithinBar | None = None
    ) -> None:
        """Turn the adjoints that `_begin` wrote into the adjoint of the state, through the step in reverse."""
        solver, kernels, context = self._solver, self._solver.kernels, self._solver.context(parameters)
        known = (*self.bar.named, self._around, solver.around)
        last = solver.iterates[counts[0]]
        flow = {"A": solver.last_gradient(counts[0]), "A_bar": self._A_bar}
        v_new = {"v_new": last["u"], "v_new_bar": self._u_bar}
        if solver.sides is not None:
            solver.sides.adjoint(context, self.bar, solver.repaired[counts[1]]["x_now"], self._x_now_bar)
        if solver.following is not None:
            ends = {"x_now": solver.repaired[counts[1]]["x_now"], "x_now_bar": self._x_now_bar}
            context.launch(solver.following.adjoint, *known, flow, v_new, ends)
        self._mend(context, known, counts[1])
        context.launch(kernels.moving.adjoint, *known, v_new, delta=solver.delta, delta_bar=self._x_moved_bar)
        pull = {"k": last["k"], "k_bar": self._k_bar}
        context.launch(kernels.shift.adjoint, *known, solver.spaced, flow, pull, delta_bar=self._x_moved_bar)
        self._project(context, known, counts[0])
        before = {"k_before": solver.carried[IMPULSE], "k_before_bar": self._k_before_bar}
        before |= {"kick_before": solver.carried[KICK], "kick_before_bar": self._kick_before_bar}
        before |= {"surfaced": solver.density.surfaced, "v_star": solver.v_star}
        steps = {"k_bar": self._k_bar, "y_bar": self._y_bar, "u_bar": self._u_bar, "v_star_bar": self.bar.fields["v"]}
        context.launch(kernels.beginning.adjoint, *known, solver.spaced, before, steps)
        if self._bodies is not None:
            self._bodies.finish(context, self.bar, solver.around, self._around)
        context.launch(kernels.velocity.time_adjoint, *known, acceleration=solver.accelerations[-1])
        self.predict(context, within)
        if self._bodies is not None:
            pressures = solver.carried[IMPULSE], self._k_before_bar
            self._bodies.release(context, self.bar, solver.around, self._around, pressures)
        self.mix(context, state_bar)
        self.sort(context, state_bar, **{IMPULSE: self._k_before_bar, KICK: self._kick_before_bar})

    def _mend(self, context: StepContext, known: tuple[Named, ...], repairs: int) -> None:
        solver, kernels = self._solver, self._solver.kernels.repair
        begin, move = kernels.move.adjoint
        for k in reversed(range(repairs)):
            at, new = solver.repaired[k], solver.repaired[k + 1]
            bars = {"x_now_bar": self._x_now_bar, "x_moved_bar": self._x_moved_bar, "f": self._f}
            context.launch(begin, *known, bars, x_now=new["x_now"], held=new["held"], x_moved=solver.x_moved)
            measured = {"c_in": at["c"], "c_out": new["c"], "excess": at["excess"]}
            own = {"c_bar": self._c_bar, "n_now_bar": self._n_now_bar, "f": self._f}
            context.launch(move, *known, measured, own, omega=solver.repair_relaxations[k])
            own = {"x_now": at["x_now"], "n_now_bar": self._n_now_bar, "x_now_bar": self._x_now_bar}
            context.launch(kernels.measure.adjoint, *known, own)
            own = {**own, "x": at["x_now"]}
            self._faces.add(context, self.bar, context.fields.named(), solver.around, u=self._f, spread=new["c"])
            self._faces.add(context, self.bar, solver.around, own, weighted=self._n_now_bar)
            densities = partial(solid_kernel, solver.discretisation, "projection", repair_term)
            self.bar.solids.add(context.launch, densities, *known, own)
        add(self._x_now_bar, self._x_moved_bar)

    def _project(self, context: StepContext, known: tuple[Named, ...], iterations: int) -> None:
        solver = self._solver
        if self._bodies is not None:
            self._bodies.settle(context, self.bar, solver.iterates[iterations]["y"], self._y_bar)
        self._coarse.begin()
        for k in reversed(range(iterations)):
            self._press(context, known, solver.iterates[k + 1])
            self._back(context, known, solver.corrected[k], solver.momentum(k), moves=k == iterations - 1)
            solver.coarse.where_due(k, partial(self._correct, context, known, k))
        self._coarse.finish(context, known, solver.around["coarse"])

    def _correct(self, context: StepContext, known: tuple[Named, ...], k: int) -> None:
        solver, at = self._solver, self._solver.iterates[k]
        self._coarse.correct(context, k, (self._drift_bar, *known), at, solver.corrected[k], self._steps, self._u_bar)
        wp.copy(self._f, self._u_bar)
        self._diverge(context, known, solver.kernels.pressure.update.adjoint[1], at, self._steps)
        add(self._f, self._u_bar)

    def _press(self, context: StepContext, known: tuple[Named, ...], at: dict[str, wp.array]) -> None:
        solver, velocity = self._solver, self._solver.kernels.velocity
        found = {"u": at["u"], "u_bar": self._u_bar, "kick_bar": self._kick_bar, "v_star": solver.v_star}
        steps = {"f": self._f, "T": self._pull, "y": at["y"]}
        context.launch(velocity.own_adjoint, *known, found, steps)
        context.launch(velocity.velocity.adjoint, *known, steps, y_bar=self._y_bar)
        self._faces.add(context, self.bar, context.fields.named(), solver.around, u=self._f, spread=at["y"])

    def _back(
        self, context: StepContext, known: tuple[Named, ...], at: dict[str, wp.array], beta: float, moves: bool
    ) -> None:
        """Apply the adjoint of one pressure iteration, from k' and y' to k, y and u. With ``moves`` A has an adjoint
        too, because the iteration's A moves particles."""
        solver, pressure = self._solver, self._solver.kernels.pressure
        (clamp, divergence, whole), steps = pressure.update.adjoint, self._steps
        context.launch(clamp, *known, at, solver.relaxed, steps, **self._drift_bar, beta=beta)
        if moves:
            context.launch(pressure.whole_adjoint, *known, steps, A_bar=self._A_bar)
            divergence, steps = whole, {**steps, "S": self._A_bar}
        self._diverge(context, known, divergence, at, steps)

    def _diverge(
        self, context: StepContext, known: tuple[Named, ...], kernel: wp.Kernel, at: dict[str, wp.array], steps: Named
    ) -> None:
        """Turn the adjoints d_bar and S in ``steps`` into the adjoint of u."""
        context.launch(kernel, *known, at, steps, u_bar=self._u_bar)
        around = context.fields.named(), self._solver.around
        self._faces.add(context, self.bar, *around, u=at["u"], spread=steps["d_bar"])
        if self._bodies is not None:
            self._bodies.drifted(context, self.bar, self._around["drift_bar"], at["y"], self._y_bar)


class Projection(ProjectionSteps):
    """The projection solver with derivatives; see `Solver`."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return ProjectionTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return ProjectionAdjoint(self, steps)


class ProjectionMaker:
    batches = True

    def __init__(self, table: ProjectionSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Make the projection solver, or without pressure PCISPH, as then the steps of all solvers are equal."""
        system, table = particle_system(setting), self._table
        if not setting.scene.forces.pressure:
            return Pcisph(system, None)
        if setting.batch is not None and table.tolerance is not None:
            raise InputError(
                f"batch is {setting.batch}, but must be left out, as solver.tolerance is that of one scene."
            )
        grid = coarse_grid(setting.scene, setting.discrete, system.layout.particles)
        constants = lattice_constants(setting.scene, setting.discrete)
        limits = LoopLimits(table.iterations, table.iterations, 0.0, 0.0)
        if table.tolerance is not None:
            limits = LoopLimits(table.iterations, table.maximum_iterations, table.tolerance, inf)
        own = table.repairs, table.velocities_follow, grid, endless(setting.discrete)
        return Projection(system, constants, limits, *own)


maker = ProjectionMaker
