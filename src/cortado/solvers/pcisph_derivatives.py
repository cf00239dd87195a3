"""Tangent and adjoint of a recorded PCISPH step: the report's Algorithm 2, put right, and its transpose."""

from typing import Any

import warp as wp

from cortado.launching import add, sum_of
from cortado.particles import Fields, Parameters, State
from cortado.physics.frozen_pressure import frozen_force_adjoint
from cortado.solvers.emitter import EmitterAdjoint
from cortado.solvers.forces import Adjoints
from cortado.solvers.mixture import MixtureAdjoint, MixtureTangent
from cortado.solvers.pcisph import Pcisph


def _scratch(solver: Pcisph, vectors: int, scalars: int) -> tuple[list[wp.array], list[wp.array]]:
    """Arrays (n,) of vectors and of scalars that a derivative works in, all 0."""
    precision, particles = solver.discretisation.precision, solver.search.particles
    device = solver.search.device
    return (
        [wp.zeros(particles, dtype=precision.vector, device=device) for _ in range(vectors)],
        [wp.zeros(particles, dtype=precision.real, device=device) for _ in range(scalars)],
    )


class PcisphAdjoint:
    """Reverse mode, one step at a time; every neighbour sum is a gather, so that no atomics are needed.

    With frozen positions accelerations do not depend on x(t): v' does on v alone, x' = x + dt v' on both.
    """

    def __init__(self, solver: Pcisph, frozen_positions: bool = False):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver, self._frozen = solver, frozen_positions
        self._frozen_force = frozen_force_adjoint(solver.discretisation) if frozen_positions else None
        self._bar = Fields.zeros(particles, precision, device)
        vectors, scalars = _scratch(solver, 3, 4)
        self._push_bar, self._acceleration_bar, self._scalars_bar = vectors
        self._p_bar, self._y_bar, self._r, self._t_bar = scalars
        self._sum = sum_of(precision.vector, particles, device)
        self._mixture = MixtureAdjoint(solver.mixture)
        self._emitter = EmitterAdjoint(solver.emitter) if solver.emitter else None

    def clear(self) -> None:
        """Forget what was kept particle by particle of the steps so far."""
        self._scalars_bar.zero_()
        self._mixture.clear()
        if self._emitter:
            self._emitter.clear()

    def collect(self, bar: Parameters) -> None:
        """Add to ``bar`` the adjoints that were kept particle by particle since `clear`, and forget them."""
        self._mixture.collect(bar)
        totals = self._sum(self._scalars_bar).view(bar.time_step.dtype).flatten()
        for k, total in enumerate((bar.time_step, bar.mobility, bar.interface_width)):
            add(totals[k : k + 1], total)
        if self._emitter:
            self._emitter.collect(bar)
        self.clear()

    def step(
        self, iterations: int, new_state_bar: State, state_bar: State, parameters: Parameters, bar: Parameters
    ) -> None:
        """From the adjoint of the recorded step's result to that of its state, which may be the same arrays. Adjoints
        of gravity, masses and the nozzle are added to ``bar``; the others are kept for `collect`."""
        solver, b, f = self._solver, self._bar, self._solver.fields
        kernels = solver.kernels
        s, it, launch = solver.moment(parameters).surroundings, solver.iterates, solver.launch
        time_step, order = parameters.time_step, solver.search.order
        free_bar = new_state_bar
        if self._emitter:
            self._emitter.step(parameters, solver.step_number, new_state_bar, bar)
            free_bar = self._emitter.free
        launch(
            kernels.integration.begin_adjoint,
            [order, time_step, f.m, f.v, it.v_star[iterations], free_bar.positions, free_bar.velocities],
            [self._scalars_bar, b.x, b.v, b.n, b.m, b.rho_0, b.mu, self._push_bar, self._y_bar, self._p_bar],
        )
        of_geometry = [] if self._frozen else [b.x, b.n]
        force: Any = self._frozen_force if self._frozen else kernels.force.adjoint
        for k in reversed(range(iterations)):
            launch(
                force,
                [s, solver.lattice.stiffness, time_step, f.x, f.n, f.m, f.rho_0, solver.pressure_yield]
                + [it.p[k], it.p[k + 1], it.c[k], self._push_bar],
                [*of_geometry, b.m, b.rho_0, self._y_bar, self._p_bar, self._scalars_bar, self._r],
            )
            launch(
                kernels.pressure.adjoint,
                [s, time_step, f.m, f.v, it.x_star[k], it.v_star[k], self._r],
                [b.x, b.v, self._scalars_bar, self._push_bar],
            )
        launch(kernels.integration.acceleration_adjoint, [time_step, b.v], [self._acceleration_bar])
        moment, adjoints = solver.moment(parameters), Adjoints(b, bar)
        for term in reversed(solver.terms):
            term.adjoint(moment, self._acceleration_bar, adjoints)
        if solver.mixture.phases.count > 1:
            t, y = solver.contrast, solver.pressure_yield
            launch(kernels.contrast.factor_adjoint, [s, t, y], [self._y_bar, self._t_bar])
            launch(kernels.contrast.adjoint, [s, f.x, f.m, self._t_bar], [b.x, b.m])
        if not self._frozen:
            launch(kernels.walls.adjoint, [s, f.x, solver.wall_yield, self._y_bar], [b.x])
        self._mixture.step(
            s, f, b, parameters, self._scalars_bar, new_state_bar.mass_fractions, state_bar.mass_fractions
        )
        launch(kernels.integration.collect_masses, [order, b.m], [bar.masses])
        if self._frozen:
            launch(kernels.integration.unsort, [order, b.x, b.v], [self._push_bar, state_bar.velocities])
            if free_bar is not state_bar:
                wp.copy(state_bar.positions, free_bar.positions)  # not b.x, to which others have added
            return
        launch(kernels.density.adjoint, [s, f.x, b.n], [b.x])
        launch(kernels.integration.unsort, [order, b.x, b.v], [state_bar.positions, state_bar.velocities])


class PcisphTangent:
    """Forward mode, one step at a time."""

    def __init__(self, solver: Pcisph):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver = solver
        self._dot = Fields.zeros(particles, precision, device)
        vectors, scalars = _scratch(solver, len(solver.terms) + 3, 6)
        self._x_star_dot, self._v_star_dot, *self._accelerations_dot = vectors
        self._zero_pressure, *self._p_dot, self._c_dot, self._y_dot, self._wall_y_dot = scalars
        self._mixture = MixtureTangent(solver.mixture)

    def step(
        self, iterations: int, state_dot: State, new_state_dot: State, parameters: Parameters, dot: Parameters
    ) -> None:
        """From the tangent of the recorded step's state to that of its result; may be the same arrays."""
        solver, d, f = self._solver, self._dot, self._solver.fields
        kernels = solver.kernels
        s, it, launch = solver.moment(parameters).surroundings, solver.iterates, solver.launch
        time_step, order = parameters.time_step, solver.search.order
        acceleration, acceleration_dot = solver.accelerations[-1], self._accelerations_dot[-1]
        launch(
            kernels.integration.sort, [order, state_dot.positions, state_dot.velocities, dot.masses], [d.x, d.v, d.m]
        )
        launch(kernels.density.tangent, [s, f.x, d.x], [d.n])
        self._mixture.step(s, f, d, parameters, dot, state_dot.mass_fractions)
        if solver.mixture.phases.count > 1:
            t, y = solver.contrast, solver.pressure_yield
            launch(kernels.walls.tangent, [s, f.x, d.x, solver.wall_yield], [self._wall_y_dot])
            launch(kernels.contrast.tangent, [s, f.x, d.x, f.m, d.m, t, y, self._wall_y_dot], [self._y_dot])
        else:
            launch(kernels.walls.tangent, [s, f.x, d.x, solver.wall_yield], [self._y_dot])
        for t, term in enumerate(solver.terms):
            before, after = self._accelerations_dot[t], self._accelerations_dot[t + 1]
            term.tangent(solver.moment(parameters), d, dot, before, after)
        launch(
            kernels.integration.predict_tangent,
            [time_step, dot.time_step, d.x, d.v, acceleration, acceleration_dot, it.v_star[0]],
            [self._x_star_dot, self._v_star_dot],
        )
        p_dot_before = self._zero_pressure
        for k in range(iterations):
            p_dot = self._p_dot[k % 2]
            launch(
                kernels.pressure.tangent,
                [s, solver.lattice.stiffness, time_step, dot.time_step, f.n, d.n, f.m, d.m, f.rho_0, d.rho_0]
                + [solver.pressure_yield, self._y_dot, it.x_star[k], self._x_star_dot]
                + [it.p[k], p_dot_before, it.p[k + 1]],
                [p_dot, self._c_dot],
            )
            launch(
                kernels.force.tangent,
                [s, time_step, dot.time_step, f.m, d.m, f.x, d.x, f.v, d.v]
                + [acceleration, acceleration_dot, it.c[k], self._c_dot, it.v_star[k + 1]],
                [self._x_star_dot, self._v_star_dot],
            )
            p_dot_before = p_dot
        launch(
            kernels.integration.unsort,
            [order, self._x_star_dot, self._v_star_dot],
            [new_state_dot.positions, new_state_dot.velocities],
        )
        self._mixture.result(new_state_dot.mass_fractions)
        if solver.emitter:
            solver.emitter.tangent(parameters, dot, solver.step_number, new_state_dot)
