"""The projection as the solver of a scene, with the tangent and the adjoint of a step."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import Named
from cortado.device.reduction import add
from cortado.errors import InputError
from cortado.particles.state import Parameters, State, clear
from cortado.particles.wall_terms import solid_kernel
from cortado.scene.solvers import ProjectionSolver
from cortado.solvers.build import SolverSetting, particle_system
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
        layout, precision = solver.layout, solver.layout.precision
        vectors = dict.fromkeys(("x_star", "v_star", "kick", "u", "delta", "x_moved", "x_now"), precision.vector)
        numbers = dict.fromkeys("kyc", precision.real)
        own = layout.arrays("_dot", **vectors, **numbers, A=precision.matrix, T=precision.six)
        v_end = own["u_dot"] if solver.following is None else solver.vectors()
        shared = {"v_new": "u", "u_out": "u", "k_out": "k", "y_out": "y", "c_in": "c", "c_out": "c"}
        self._own: dict[str, wp.array] = {
            **own,
            **{f"{name}_dot": own[f"{other}_dot"] for name, other in shared.items()},
            **{"v_end_dot": v_end, **layout.arrays(T=precision.six)},
            **{"k_before_dot": self.carried_dot[IMPULSE], "kick_before_dot": self.carried_dot[KICK]},
        }
        self._around = self.density.around
        self._known = self._own, *self.dot.named, self._around, solver.known
        self._bodies = None
        if solver.bodies is not None:
            (part,) = (part for part in self._parts if isinstance(part, FreeSolidsTangent))
            self._bodies = BodiesTangent(solver.bodies, part.bodies, self.dot, self._around)
        self._coarse = CoarseTangent(solver.coarse, self._bodies, self._known)

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        solver, kernels, own, known = self._solver, self._solver.kernels, self._own, self._known
        context, (iterations, repairs) = solver.context(parameters), counts
        self.sort(context, state_dot)
        if self._bodies is not None:
            self._bodies.begin(context, solver.carried[IMPULSE], self.carried_dot[IMPULSE])
        self.predict(context, solver.known["v_star"], own["x_star_dot"], own["v_star_dot"])
        context.launch(kernels.beginning.tangent, *known)
        self._coarse.begin(context)
        for k in range(iterations):
            self._iterate(context, k)
        if self._bodies is not None:
            self._bodies.settle(context, solver.iterates[iterations]["y"], own["y_dot"])
        end = solver.end_of(iterations)
        context.launch(kernels.shift.tangent, end, *known)
        context.launch(kernels.moving.tangent, end, *known)
        wp.copy(own["x_now_dot"], own["x_moved_dot"])
        own["c_dot"].zero_()
        for k in range(repairs):
            at, omega = solver.repaired[k], solver.repair_relaxations[k]
            context.launch(kernels.repair.measure.tangent, at, *known, c_in=at["c"], omega=omega)
            context.launch(kernels.repair.move.tangent, solver.repaired[k + 1], *known)
        last = solver.repaired[repairs]
        if solver.following is not None:
            context.launch(solver.following.tangent, end, last, *known)
        if solver.sides is not None:
            solver.sides.tangent(context, self.dot, last["x_now"], own["x_now_dot"])
        carried = {IMPULSE: own["k_dot"], KICK: own["kick_dot"]}
        self.unsort(context, own["x_now_dot"], own["v_end_dot"], state_dot, **carried)

    def _iterate(self, context: StepContext, k: int) -> None:
        solver, kernels, known = self._solver, self._solver.kernels, self._known
        old, at, new = solver.iterates[k], solver.corrected[k], solver.iterates[k + 1]

        def correct() -> None:
            self._coarse.correct(context, k, {"drift_dot": self._drift(context, old)}, old, at)

        solver.coarse.where_due(k, correct)
        drift, beta = self._drift(context, at), solver.momentum(k)
        context.launch(kernels.pressure.update.tangent, at, *known, drift_dot=drift, beta=beta)
        context.launch(kernels.velocity.pull_tangent, new, *known)
        context.launch(kernels.velocity.velocity.tangent, new, *known)

    def _drift(self, context: StepContext, at: dict[str, wp.array]) -> wp.array:
        drift_dot, y_dot = self._around["drift_dot"], self._own["y_dot"]
        return drift_dot if self._bodies is None else self._bodies.drifted(context, drift_dot, at["y"], y_dot)

    def pressures(self, rounds: Sequence[int]) -> NDArray:
        return self._over_time(self._solver.iterates[rounds[0]]["k"], self._own["k_dot"].numpy())

    def stresses(self, rounds: Sequence[int]) -> NDArray:
        solver = self._solver
        context, known = solver.context(solver.parameters), (solver.iterates[rounds[0]], *self._known)
        change = solver.mean_stress.tangent(context, self.dot, *known)
        return self._over_time(solver.mean_stress.impulses(context, *known), change)

    def _over_time(self, impulses: wp.array, change: NDArray) -> NDArray:
        particles = self._solver.layout.particles
        dt, dt_dot = (of.parameters["time_step"].numpy().repeat(particles) for of in (self._solver, self.dot))
        found: NDArray = change / dt - impulses.numpy() * dt_dot / dt**2
        return found


class ProjectionAdjoint(ParticleAdjoint):
    density: SurroundingsAdjoint

    def __init__(self, solver: ProjectionSteps, steps: int):
        super().__init__(solver, steps)
        self._solver: ProjectionSteps = solver
        layout, precision = solver.layout, solver.layout.precision
        vectors = dict.fromkeys(("x_now", "x_moved", "u", "kick", "kick_before"), precision.vector)
        numbers = dict.fromkeys(("k", "k_before", "y", "c", "d", "q", "n_now"), precision.real)
        own = layout.arrays("_bar", **vectors, **numbers, A=precision.matrix)
        shared = {"v_new": "u", "delta": "x_moved", "k_out": "k"}
        self._own: dict[str, wp.array] = {
            **own,
            **{f"{name}_bar": own[f"{other}_bar"] for name, other in shared.items()},
            **layout.arrays(f=precision.vector, S=precision.six, T=precision.six),
            "v_star_bar": self.bar.fields["v"],
        }
        self.bar = replace(self.bar, kick=own["kick_before_bar"])
        self._around = self.density.around
        self._known = self._own, *self.bar.named, self._around, solver.known
        self._faces = FaceShares(solver.system)
        self._m_unused, self._bodies = solver.numbers(), None
        self._drift_bar: dict[str, wp.array] = {}
        if solver.bodies is not None:
            (part,) = (part for part in self._parts if isinstance(part, FreeSolidsAdjoint))
            self._bodies = BodiesAdjoint(solver.bodies, part.bodies, self.bar, self._around)
            self._drift_bar = {"drift_bar": self._bodies.drift_bar}
        self._coarse = CoarseAdjoint(solver.coarse, self._bodies, self.bar, self._faces, self._known)

    def from_within(self, counts: Counts, within: WithinBar, state_bar: State, parameters: Parameters) -> None:
        state_bar.clear()
        self.step(counts, state_bar, parameters, within)

    def _press(self, context: StepContext, k: wp.array, within: WithinBar) -> None:
        solver, own = self._solver, self._own
        pressed = pressed_kernels(solver.layout.precision).adjoint
        context.launch(pressed, *self._known, impulse=k, p_bar=within.p, impulse_bar=own["k_bar"])
        if within.stress is not None:
            own["q_bar"].zero_()
            q = solver.mean_stress.impulses(context, {"k": k}, solver.known)
            context.launch(pressed, *self._known, impulse=q, p_bar=within.stress, impulse_bar=own["q_bar"])
            at = {"k": k, "T": solver.known["T"], "q_bar": own["q_bar"]}
            solver.mean_stress.adjoint(context, self.bar, at, *self._known)

    def _begin(self, context: StepContext, state_bar: State) -> None:
        solver, own = self._solver, self._own
        free_bar = self.unsort(context, state_bar)
        scene = {"x_scene": free_bar.positions, "v_scene": free_bar.velocities}
        scene |= {"m_scene": state_bar["reference_density"], "m": self._m_unused}
        context.launch(solver.integration.sort, scene, x=own["x_now_bar"], v=own["u_bar"])
        kept = (own[f"{name}_bar"] for name in ("x_moved", "c", "y", "A"))
        clear((*self.bar.fields.arrays(), *kept))
        self.density.begin()
        wp.copy(own["k_bar"], self.carried_bar[IMPULSE])
        wp.copy(own["kick_bar"], self.carried_bar[KICK])
        if self._bodies is not None:
            self._bodies.begin()

    def step(self, counts: Counts, state_bar: State, parameters: Parameters, within: WithinBar | None = None) -> None:
        solver, kernels, own, known = self._solver, self._solver.kernels, self._own, self._known
        context, (iterations, repairs) = solver.context(parameters), counts
        self._begin(context, state_bar)
        if within is not None:
            self._press(context, solver.iterates[iterations]["k"], within)
        end, last = solver.end_of(iterations), solver.repaired[repairs]
        if solver.sides is not None:
            solver.sides.adjoint(context, self.bar, last["x_now"], own["x_now_bar"])
        if solver.following is not None:
            context.launch(solver.following.adjoint, end, last, *known)
        for k in reversed(range(repairs)):
            self._mend(context, k)
        add(own["x_now_bar"], own["x_moved_bar"])
        context.launch(kernels.moving.adjoint, end, *known)
        context.launch(kernels.shift.adjoint, end, *known)
        if self._bodies is not None:
            self._bodies.settle(context, solver.iterates[iterations]["y"], own["y_bar"])
        self._coarse.begin()
        for k in reversed(range(iterations)):
            self._iterate(context, k, moves=k == iterations - 1)
        self._coarse.finish(context)
        context.launch(kernels.beginning.adjoint, *known)
        if self._bodies is not None:
            self._bodies.finish(context)
        context.launch(kernels.velocity.time_adjoint, *known, acceleration=solver.accelerations[-1])
        self.predict(context, within)
        if self._bodies is not None:
            self._bodies.release(context, solver.carried[IMPULSE], own["k_before_bar"])
        self.mix(context, state_bar)
        self.sort(context, state_bar, **{IMPULSE: own["k_before_bar"], KICK: own["kick_before_bar"]})

    def _mend(self, context: StepContext, k: int) -> None:
        solver, kernels, own, known = self._solver, self._solver.kernels.repair, self._own, self._known
        at, new, (begin, move) = solver.repaired[k], solver.repaired[k + 1], kernels.move.adjoint
        context.launch(begin, new, *known)
        changes = {"c_in": at["c"], "c_out": new["c"], "omega": solver.repair_relaxations[k]}
        context.launch(move, changes, at, *known)
        context.launch(kernels.measure.adjoint, at, *known)
        self._faces.add(context, self.bar, *known, u=own["f"], spread=new["c"])
        self._faces.add(context, self.bar, *known, x=at["x_now"], weighted=own["n_now_bar"])
        densities = partial(solid_kernel, solver.discretisation, "projection", repair_term)
        self.bar.solids.add(context.launch, densities, *known, x=at["x_now"])

    def _iterate(self, context: StepContext, k: int, moves: bool) -> None:
        """``moves`` is true if the shift uses the velocity gradients of the iteration."""
        solver, own, known = self._solver, self._own, self._known
        velocity, pressure = solver.kernels.velocity, solver.kernels.pressure
        (clamp, divergence, whole), more = pressure.update.adjoint, dict[str, wp.array]()
        old, at, new = solver.iterates[k], solver.corrected[k], solver.iterates[k + 1]

        def correct() -> None:
            self._coarse.correct(context, k, self._drift_bar, old, at)
            wp.copy(own["f"], own["u_bar"])
            self._diverge(context, divergence, old, {})
            add(own["f"], own["u_bar"])

        context.launch(velocity.own_adjoint, new, *known)
        context.launch(velocity.velocity.adjoint, new, *known)
        self._faces.add(context, self.bar, *known, u=own["f"], spread=new["y"])
        context.launch(clamp, self._drift_bar, at, *known, beta=solver.momentum(k))
        if moves:
            context.launch(pressure.whole_adjoint, *known)
            more = {"S": own["A_bar"]}
        self._diverge(context, whole if moves else divergence, at, more)
        solver.coarse.where_due(k, correct)

    def _diverge(self, context: StepContext, kernel: wp.Kernel, at: Named, more: Named) -> None:
        own, known = self._own, self._known
        context.launch(kernel, more, at, *known)
        self._faces.add(context, self.bar, *known, u=at["u"], spread=own["d_bar"])
        if self._bodies is not None:
            self._bodies.drifted(context, self._around["drift_bar"], at["y"], own["y_bar"])


class Projection(ProjectionSteps):
    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return ProjectionTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return ProjectionAdjoint(self, steps)


class Maker:
    batches = True

    def __init__(self, table: ProjectionSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Without pressure, make PCISPH, which takes equal steps."""
        system, table, batch = particle_system(setting), self._table, setting.batch
        if not setting.scene.forces.pressure:
            return Pcisph(system, None)
        if batch is not None and table.tolerance is not None:
            raise InputError(f"batch is {batch}, but must be left out, as solver.tolerance applies to a single scene.")
        scene, discrete = setting.scene, setting.discrete
        grid, lattice = coarse_grid(scene, discrete, system.layout.particles), discrete.lattice
        constants = lattice_constants(discrete.kernel, scene.discretisation.spacing, lattice.support, scene.dimension)
        return Projection(system, table, constants, grid, endless(discrete))
