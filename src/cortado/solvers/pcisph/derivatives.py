"""Tangent and adjoint of a recorded PCISPH step: the report's Algorithm 2, put right, and its transpose."""

import warp as wp

from cortado.device.arrays import Fields
from cortado.device.launching import Named
from cortado.device.state import Parameters, State
from cortado.solvers.pcisph.frozen_pressure import frozen_force_adjoint
from cortado.solvers.pcisph.steps import PcisphSteps
from cortado.solvers.solver import Counts
from cortado.sph.emitter import EmitterAdjoint
from cortado.sph.mixture import MixtureAdjoint, MixtureTangent
from cortado.sph.parts import Adjoints, Shares, StepContext, Tangents


def _scratch(solver: PcisphSteps, vectors: int, scalars: int) -> tuple[list[wp.array], list[wp.array]]:
    """Arrays (n,) of vectors and of scalars that a derivative works in, all 0."""
    precision, particles = solver.discretisation.precision, solver.search.particles
    device = solver.search.device
    return (
        [wp.zeros(particles, dtype=precision.vector, device=device) for _ in range(vectors)],
        [wp.zeros(particles, dtype=precision.real, device=device) for _ in range(scalars)],
    )


class PcisphAdjoint:
    """Reverse mode, one step at a time, of a run with some parameters; every neighbour sum is a gather, so that no
    atomics are needed.

    With a frozen geometry accelerations do not depend on x(t): v' does on v alone, x' = x + dt v' on both.
    """

    def __init__(self, solver: PcisphSteps, steps: int, frozen_geometry: bool = False):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver, self._frozen = solver, frozen_geometry
        kernels, mixture = solver.kernels, solver.mixture
        self._force = frozen_force_adjoint(solver.discretisation) if frozen_geometry else kernels.force.adjoint
        names = ["time_step", *mixture.shares, *(name for force in solver.forces for name in force.shares)]
        self.bar = Adjoints(
            Fields.zeros(particles, precision, device),
            solver.new_parameters(steps),
            Shares(names, particles, mixture.phases.count, precision, device),
        )
        """Adjoints; those of the parameters are complete after `collect`."""
        vectors, scalars = _scratch(solver, 2, 4)
        self._push_bar, self._acceleration_bar = vectors
        self._p_bar, self._y_bar, self._r, self._t_bar = scalars
        self._mixture = MixtureAdjoint(mixture)
        self._emitter = EmitterAdjoint(solver.emitter) if solver.emitter else None

    def begin(self) -> None:
        """Forget the adjoints of the parameters of an earlier way back."""
        self.bar.shares.clear()
        self.bar.parameters.clear()

    def collect(self) -> Parameters:
        """The adjoints of the parameters, of all steps since `begin`."""
        self.bar.shares.collect(self.bar.parameters)
        return self.bar.parameters

    def step(self, counts: Counts, state_bar: State, parameters: Parameters) -> None:
        """Replace the adjoint of the replayed step's result by that of its state; adjoints of the parameters are added
        to ``bar``."""
        (iterations,) = counts
        solver, b, it, kernels, bar = (
            self._solver,
            self.bar.fields,
            self._solver.iterates,
            self._solver.kernels,
            self.bar,
        )
        context, known, push_bar = solver.context(parameters), self.bar.named, self._push_bar
        pressure_bar = {"y_bar": self._y_bar, "p_bar": self._p_bar}
        free_bar = state_bar
        if self._emitter:
            self._emitter.step(context, state_bar, bar.parameters)
            free_bar = self._emitter.free
        context.launch(
            kernels.integration.begin_adjoint,
            *known,
            v_star=it.v_star[iterations],
            x_scene_bar=free_bar.positions,
            v_scene_bar=free_bar.velocities,
            push_bar=push_bar,
            **pressure_bar,
        )
        for k in reversed(range(iterations)):
            context.launch(
                self._force,
                *known,
                stiffness=solver.lattice.stiffness,
                y=solver.pressure_relaxation,
                p_in=it.p[k],
                p_out=it.p[k + 1],
                c=it.c[k],
                push_bar=push_bar,
                r=self._r,
                **pressure_bar,
            )
            predicted = {"x_star": it.x_star[k], "v_star": it.v_star[k]}
            context.launch(kernels.pressure.adjoint, *known, r=self._r, push_bar=push_bar, **predicted)
        context.launch(kernels.integration.acceleration_adjoint, *known, acceleration_bar=self._acceleration_bar)
        for force in reversed(solver.forces):
            force.adjoint(context, self._acceleration_bar, bar)
        if solver.mixture.phases.count > 1:
            factors = {"t": solver.contrast, "y": solver.pressure_relaxation, "y_bar": self._y_bar}
            context.launch(kernels.contrast.factor_adjoint, **factors, t_bar=self._t_bar)
            context.launch(kernels.contrast.adjoint, *known, t_bar=self._t_bar)
        if not self._frozen:
            context.launch(kernels.walls.adjoint, *known, y=solver.wall_relaxation, y_bar=self._y_bar)
        self._mixture.step(context, bar, state_bar.mass_fractions)
        context.launch(kernels.integration.collect_masses, *known, m_scene_bar=state_bar["reference_density"])
        order, v_scene = solver.search.order, state_bar.velocities
        if self._frozen:
            unsorted = {"x_scene": push_bar, "v_scene": v_scene}
            solver.launch(kernels.integration.unsort, order=order, x=b["x"], v=b["v"], **unsorted)
            if free_bar is not state_bar:
                wp.copy(state_bar.positions, free_bar.positions)  # not b.x, to which others have added
            return
        context.launch(kernels.density.adjoint, *known)
        unsorted = {"x_scene": state_bar.positions, "v_scene": v_scene}
        solver.launch(kernels.integration.unsort, order=order, x=b["x"], v=b["v"], **unsorted)


class PcisphTangent:
    """Forward mode, one step at a time, of a run along tangents of its parameters."""

    def __init__(self, solver: PcisphSteps, parameters_dot: Parameters):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver = solver
        self._dot = Tangents(Fields.zeros(particles, precision, device), parameters_dot)
        vectors, scalars = _scratch(solver, len(solver.forces) + 3, 6)
        self._x_star_dot, self._v_star_dot, *self._accelerations_dot = vectors
        self._zero_pressure, *self._p_dot, self._c_dot, self._y_dot, self._wall_y_dot = scalars
        self._mixture = MixtureTangent(solver.mixture)

    def step(self, counts: Counts, state_dot: State, parameters: Parameters) -> None:
        """Replace the tangent of the replayed step's state by that of its result."""
        (iterations,) = counts
        solver, dot, it, kernels = self._solver, self._dot, self._solver.iterates, self._solver.kernels
        context, known, order, d = solver.context(parameters), self._dot.named, solver.search.order, self._dot.fields
        solver.launch(
            kernels.integration.sort,
            order=order,
            x_scene=state_dot.positions,
            v_scene=state_dot.velocities,
            m_scene=state_dot["reference_density"],
            x=d["x"],
            v=d["v"],
            m=d["m"],
        )
        context.launch(kernels.density.tangent, *known)
        self._mixture.step(context, dot, state_dot.mass_fractions)
        self._yields(known, context)
        for t, force in enumerate(solver.forces):
            force.tangent(context, dot, self._accelerations_dot[t], self._accelerations_dot[t + 1])
        accelerations = {"acceleration": solver.accelerations[-1], "acceleration_dot": self._accelerations_dot[-1]}
        predicted = {"x_star_dot": self._x_star_dot, "v_star_dot": self._v_star_dot}
        context.launch(kernels.integration.predict_tangent, *known, **accelerations, v_star=it.v_star[0], **predicted)
        p_dot_before = self._zero_pressure
        for k in range(iterations):
            p_dot, c_dot = self._p_dot[k % 2], self._c_dot
            context.launch(
                kernels.pressure.tangent,
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
            context.launch(kernels.force.tangent, *known, **accelerations, **forces, **predicted)
            p_dot_before = p_dot
        solver.launch(
            kernels.integration.unsort,
            order=order,
            x=self._x_star_dot,
            v=self._v_star_dot,
            x_scene=state_dot.positions,
            v_scene=state_dot.velocities,
        )
        self._mixture.result(context, state_dot.mass_fractions)
        if solver.emitter:
            solver.emitter.tangent(context, dot.parameters, state_dot)

    def _yields(self, known: tuple[Named, ...], context: StepContext) -> None:
        """The tangent of what delta is multiplied with."""
        solver, kernels = self._solver, self._solver.kernels
        several = solver.mixture.phases.count > 1
        y_dot = self._wall_y_dot if several else self._y_dot
        context.launch(kernels.walls.tangent, *known, y=solver.wall_relaxation, y_dot=y_dot)
        if several:
            factors = {"t": solver.contrast, "y": solver.pressure_relaxation, "wall_y_dot": y_dot, "y_dot": self._y_dot}
            context.launch(kernels.contrast.tangent, *known, **factors)
