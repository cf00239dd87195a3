"""Quantities of a state of a solver's particles, with the derivatives of each."""

from collections.abc import Iterable, Mapping
from functools import cached_property, partial
from typing import cast

import numpy as np
from numpy.typing import NDArray

from cortado.device.threads import Turn, in_turn
from cortado.errors import InputError
from cortado.particles.arrays import Fields
from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import Rollout
from cortado.runs.quantities.formulas import Particles, Sums, formulas
from cortado.runs.quantities.moment import Moment
from cortado.scene.parameters.values import Arrays
from cortado.scene.quantities import check_quantity
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.particles import ParticleSolver
from cortado.solvers.solver import Counts, PressureAdjoint, PressureTangent, Solver
from cortado.sph.parts import StepContext
from cortado.sph.wall_slope import wall_slope_solid_kernel

OF_PRESSURE = {"pressure", "wall_force"}
"""Quantities that need the step after the state to be solved; others need its neighbours alone."""


class QuantityEvaluator:
    """Computes quantities of states, their tangents and adjoints, in the arrays of one solver, which no run may use
    meanwhile. What it is given and returns is in the scene's order, of a batch with a first axis for the scenes."""

    def __init__(self, solver: Solver, dimension: int, circulation_factor: float):
        """``circulation_factor``: that of `cortado.discretise.calibration`. Raises `InputError` for a solver that has
        no particles to look at."""
        if not isinstance(solver, ParticleSolver):
            raise InputError("The solver of this scene does not say what lies around its particles: no quantities.")
        self._solver, self._dimension = solver, dimension
        self.lattice = solver.lattice
        """Constants of the lattice of particles at rest."""
        self._formulas = formulas(solver, dimension, circulation_factor)
        self._counts: Counts = ()
        """Of the step that was solved last."""
        self._rounds: list[int] = []
        """(members,) the same of each scene."""

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the solver."""
        return self._solver.turn

    @in_turn
    def values(self, names: Iterable[str], moment: Moment) -> Arrays:
        """Quantities by name, float64."""
        wanted = [check_quantity(name) for name in names]
        at, sums = self._begin(wanted, moment, replay=False)
        return {name: self._in_scene_order(self._formulas[name].value(at, sums)) for name in wanted}

    @in_turn
    def tangents(
        self, names: Iterable[str], moment: Moment, dot: Mapping[str, NDArray], parameters_dot: Mapping[str, NDArray]
    ) -> Arrays:
        """Their tangents along that of the state, by fields, and of the parameters of the step, as `Moment` has
        them."""
        wanted, solver = [check_quantity(name) for name in names], self._solver
        at, sums = self._begin(wanted, moment, replay=True)
        state_dot, along = solver.new_state(), solver.new_parameters(1)
        state_dot.set(dot)
        along.set(parameters_dot)
        tangent, pressure_dot = self._tangent(wanted, state_dot, along)
        own = Particles.of(tangent.dot.fields, pressure_dot)
        each = {name: self._formulas[name].tangent(at, sums, own, tangent.dot.named) for name in wanted}
        return {name: self._in_scene_order(value) for name, value in each.items()}

    @in_turn
    def adjoint(self, bars: Mapping[str, NDArray], moment: Moment) -> tuple[Arrays, Arrays]:
        """From adjoints of quantities, by name, to those of the state, by fields, and of the parameters of the step, as
        `Moment` has them but with an axis for the scenes."""
        wanted, solver = [check_quantity(name) for name in bars], self._solver
        at, sums = self._begin(wanted, moment, replay=True)
        own = Particles.zeros(solver.layout.all_particles)
        for name in wanted:
            self._formulas[name].adjoint(at, sums, self._sorted(bars[name]), own)
        fields = Fields.zeros(solver.layout.all_particles, solver.discretisation.precision, solver.device)
        for name, array in own.fields.items():
            fields[name].assign(array)
        state_bar = solver.new_state()
        through = self._from_fields if OF_PRESSURE.isdisjoint(wanted) else self._from_pressure
        parameters = through(fields, own, state_bar).collect()
        found = {name: parameters[name].numpy().astype(np.float64) for name in parameters.names}
        state = state_bar.numpy(self._dimension)
        return {name: array.astype(np.float64) for name, array in state.items()}, found

    # ---- the step ------------------------------------------------------------------------------------------------

    def _begin(self, names: Iterable[str], moment: Moment, replay: bool) -> tuple[Particles, Sums]:
        """Look around the particles and, where a pressure is wanted, take the step; ``replay`` it for derivatives."""
        rollout = self._rollout
        rollout.begin_evaluation()
        rollout.initial.assign(moment.state)
        rollout.parameters.set(moment.parameters)
        rollout.substeps = moment.substeps
        if OF_PRESSURE.isdisjoint(names):
            context, pressures = self._look_around(moment.substeps), None
        else:
            context, pressures = self._solve(replay)
        return Particles.of(self._solver.fields, pressures), Sums(self._solver, context)

    def _look_around(self, substeps: int) -> StepContext:
        solver, rollout = self._solver, self._rollout
        solver.set_substeps(substeps)
        solver.reset()
        context = solver.sort(rollout.initial, rollout.parameters)
        while solver.make_room():
            context = solver.sort(rollout.initial, rollout.parameters)
        return context

    def _solve(self, replay: bool) -> tuple[StepContext, NDArray]:
        """The step, and its pressures (n,), sorted."""
        solver, rollout = self._solver, self._rollout
        rollout.forward(keep=False)
        found = solver.sorted_pressures()
        if found is None:
            raise InputError("This scene is computed without a pressure of particles, so that there is none to see.")
        pressures = found.astype(np.float64)  # a replay overwrites what was found
        self._counts = rollout.log.seek(0)
        rounds = rollout.diagnostics[solver.loops[0].iterations_name][0]
        self._rounds = [int(k) for k in np.atleast_1d(rounds)]
        if replay:
            solver.step_number.fill_(0)
            solver.replay(rollout.initial, rollout.parameters, self._counts)
        return solver.context(rollout.parameters), pressures

    # ---- derivatives ---------------------------------------------------------------------------------------------

    def _tangent(
        self, names: Iterable[str], state_dot: State, along: Parameters
    ) -> tuple[ParticleTangent | PressureTangent, NDArray | None]:
        """That of the sorted particles, and of their pressures."""
        solver, parameters = self._solver, self._rollout.parameters
        if OF_PRESSURE.isdisjoint(names):
            own = ParticleTangent(solver, along)
            own.sort(solver.context(parameters), state_dot)
            return own, None
        whole = cast(PressureTangent, solver.tangent(along))
        whole.step(self._counts, state_dot, parameters)
        return whole, np.concatenate(whole.pressures(self._rounds)).astype(np.float64)

    def _from_fields(self, fields: Fields, own: Particles, state_bar: State) -> ParticleAdjoint:
        adjoint, context = self._field_adjoint, self._solver.context(self._rollout.parameters)
        adjoint.begin()
        adjoint.bar.fields.assign(fields)
        adjoint.mix(context, state_bar)
        adjoint.sort(context, state_bar, **{f.name: adjoint.carried_bar[f.name] for f in self._solver.carried_fields})
        return adjoint

    def _from_pressure(self, fields: Fields, own: Particles, state_bar: State) -> PressureAdjoint:
        solver, adjoint = self._solver, self._pressure_adjoint
        p_bar, slope_bar = solver.numbers(), solver.vectors()
        p_bar.assign(own.p)
        adjoint.begin()
        if isinstance(adjoint, ParticleAdjoint) and solver.search.moving is not None:
            slope_bar.assign(own.slope)
            slopes = partial(wall_slope_solid_kernel, solver.discretisation)
            context = solver.context(self._rollout.parameters)
            adjoint.bar.solids.add(context.launch, slopes, *adjoint.bar.named, bar=slope_bar)
        adjoint.from_within(self._counts, fields, p_bar, state_bar, self._rollout.parameters)
        return adjoint

    @cached_property
    def _rollout(self) -> Rollout:
        """Of one step."""
        return Rollout(self._solver, 1)

    @cached_property
    def _field_adjoint(self) -> ParticleAdjoint:
        return ParticleAdjoint(self._solver, 1)

    @cached_property
    def _pressure_adjoint(self) -> PressureAdjoint:
        return cast(PressureAdjoint, self._solver.adjoint(1))

    # ---- orders --------------------------------------------------------------------------------------------------

    @property
    def _order(self) -> NDArray:
        return self._solver.search.order.numpy()[: self._solver.layout.all_particles]

    def _in_scene_order(self, values: NDArray) -> NDArray:
        found = np.empty(values.shape)
        found[self._order] = values
        batch = self._solver.layout.batch
        return found if batch is None else found.reshape(batch, -1, *found.shape[1:])

    def _sorted(self, values: NDArray) -> NDArray:
        flat = values if self._solver.layout.batch is None else values.reshape(-1, *values.shape[2:])
        return np.asarray(flat, dtype=np.float64)[self._order]
