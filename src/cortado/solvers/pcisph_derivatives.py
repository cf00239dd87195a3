"""Tangent and adjoint of a recorded PCISPH step: the report's Algorithm 2, put right, and its transpose."""

import warp as wp

from cortado.launching import vector_sum
from cortado.particles import Fields, Parameters, State
from cortado.solvers.forces import Adjoints
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
    """Reverse mode, one step at a time; every neighbour sum is a gather, so that no atomics are needed."""

    def __init__(self, solver: Pcisph):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver = solver
        self._bar = Fields.zeros(particles, precision, device)
        vectors, scalars = _scratch(solver, 3, 3)
        self._push_bar, self._acceleration_bar, self._scalars_bar = vectors
        self._p_bar, self._y_bar, self._r = scalars
        self._sum = vector_sum(particles, precision, device)

    def clear(self) -> None:
        """Forget the scalars' adjoints of the steps so far."""
        self._scalars_bar.zero_()

    def scalars(self) -> wp.array:
        """(1,) vector: adjoints of (rest density, viscosity, time step) of all steps since `clear`."""
        return self._sum(self._scalars_bar)

    def step(
        self, iterations: int, new_state_bar: State, state_bar: State, parameters: Parameters, bar: Parameters
    ) -> None:
        """From the adjoint of the recorded step's result to that of its state; may be the same arrays."""
        solver, b, f = self._solver, self._bar, self._solver.fields
        kernels = solver.kernels
        s, it, launch = solver.moment(parameters).surroundings, solver.iterates, solver.launch
        rest_density, time_step, order = parameters.rest_density, parameters.time_step, solver.search.order
        launch(
            kernels.integration.begin_adjoint,
            [order, time_step, f.v, it.v_star[iterations], new_state_bar.positions, new_state_bar.velocities],
            [self._scalars_bar, b.x, b.v, self._push_bar, b.rho, self._y_bar, self._p_bar],
        )
        for k in reversed(range(iterations)):
            launch(
                kernels.force.adjoint,
                [s, solver.lattice.stiffness, rest_density, time_step, f.x, f.rho, solver.wall_yield]
                + [it.p[k], it.p[k + 1], it.c[k], self._push_bar],
                [b.x, b.rho, self._y_bar, self._p_bar, self._scalars_bar, self._r],
            )
            launch(
                kernels.pressure.adjoint,
                [s, rest_density, time_step, f.v, it.x_star[k], it.v_star[k], self._r],
                [b.x, b.v, self._scalars_bar, self._push_bar],
            )
        launch(kernels.integration.acceleration_adjoint, [time_step, b.v], [self._acceleration_bar])
        moment, adjoints = solver.moment(parameters), Adjoints(b, bar, self._scalars_bar)
        for term in reversed(solver.terms):
            term.adjoint(moment, self._acceleration_bar, adjoints)
        launch(kernels.walls.adjoint, [s, f.x, solver.wall_yield, self._y_bar], [b.x])
        launch(kernels.density.adjoint, [s, rest_density, f.x, f.rho, b.rho], [b.x, self._scalars_bar])
        launch(kernels.integration.unsort, [order, b.x, b.v], [state_bar.positions, state_bar.velocities])


class PcisphTangent:
    """Forward mode, one step at a time."""

    def __init__(self, solver: Pcisph):
        precision, particles, device = solver.discretisation.precision, solver.search.particles, solver.search.device
        self._solver = solver
        self._dot = Fields.zeros(particles, precision, device)
        vectors, scalars = _scratch(solver, len(solver.terms) + 3, 5)
        self._x_star_dot, self._v_star_dot, *self._accelerations_dot = vectors
        self._zero_pressure, *self._p_dot, self._c_dot, self._y_dot = scalars

    def step(
        self, iterations: int, state_dot: State, new_state_dot: State, parameters: Parameters, dot: Parameters
    ) -> None:
        """From the tangent of the recorded step's state to that of its result; may be the same arrays."""
        solver, d, f = self._solver, self._dot, self._solver.fields
        kernels = solver.kernels
        s, it, launch = solver.moment(parameters).surroundings, solver.iterates, solver.launch
        rest_density, time_step, order = parameters.rest_density, parameters.time_step, solver.search.order
        acceleration, acceleration_dot = solver.accelerations[-1], self._accelerations_dot[-1]
        launch(kernels.integration.sort, [order, state_dot.positions, state_dot.velocities], [d.x, d.v])
        launch(kernels.density.tangent, [s, rest_density, dot.rest_density, f.x, d.x, f.rho], [d.rho])
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
                [s, solver.lattice.stiffness, rest_density, dot.rest_density, time_step, dot.time_step]
                + [f.rho, d.rho, solver.wall_yield, self._y_dot, it.x_star[k], self._x_star_dot]
                + [it.p[k], p_dot_before, it.p[k + 1]],
                [p_dot, self._c_dot],
            )
            launch(
                kernels.force.tangent,
                [s, rest_density, dot.rest_density, time_step, dot.time_step, f.x, d.x, f.v, d.v]
                + [acceleration, acceleration_dot, it.c[k], self._c_dot, it.v_star[k + 1]],
                [self._x_star_dot, self._v_star_dot],
            )
            p_dot_before = p_dot
        launch(
            kernels.integration.unsort,
            [order, self._x_star_dot, self._v_star_dot],
            [new_state_dot.positions, new_state_dot.velocities],
        )
