"""Steps of a simulation as a function of a state and of parameters, with its derivatives."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from cortado.arrays import as_numbers
from cortado.device.memory import require
from cortado.device.state import Parameters, State
from cortado.device.threads import Turn, in_turn
from cortado.errors import CortadoWarning, InputError, shown
from cortado.fixed import FixedDict
from cortado.gradients import Exact
from cortado.outcome import trouble
from cortado.parameters.restarts import one_for_each
from cortado.parameters.scene_parameters import Simulated
from cortado.parameters.space import STATE_TIME, ParameterSpace
from cortado.parameters.values import Arrays, Values
from cortado.residual import Residual, without_lost
from cortado.restart import Clock, RestartState
from cortado.rollout import BackwardStep, Rollout
from cortado.solvers.solver import Solver

States = RestartState | tuple[RestartState, ...]
"""Of a batch one for each scene."""
Given = RestartState | Sequence[RestartState] | None
"""A state to go on from, of a batch one for each scene; None for the scene's first."""


class Steppable(Simulated, Protocol):
    """A simulation as its steps see it."""

    solver: Solver


@dataclass(frozen=True, eq=False, repr=False)
class StepResidual:
    """What `Stepper.step` leaves for `Stepper.vjp` and `Stepper.jvp`, whole: other steps may come in between."""

    evaluation: Residual
    values: Arrays
    """The parameters that were given."""


class Stepper:
    """So many steps of a simulation, as a function of the state before them and of parameters.

    Its arrays, graphs and kernels are made once and serve every call.
    """

    def __init__(self, simulation: Steppable, steps: int):
        """``steps`` may be 0."""
        self._simulation, self._space = simulation, ParameterSpace(simulation, steps)
        self._rollout = Rollout(simulation.solver, steps)

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the simulation."""
        return self._rollout.turn

    @in_turn
    def first(self, parameters: Values | None = None) -> States:
        """The state before the first step of a run with these parameters."""
        self._space.begin(self._rollout, self._checked(parameters))
        return self._states(self._rollout.initial, 0)

    @in_turn
    def advance(self, state: Given, parameters: Values | None = None) -> States:
        """The state after the steps."""
        self._begin(state, self._checked(parameters))
        return self._states(self._forward(keep=False), self._rollout.steps)

    @in_turn
    def step(
        self, state: Given, parameters: Values | None = None, along: Iterable[str] = ()
    ) -> tuple[States, StepResidual]:
        """The state after the steps, and what `vjp` and `jvp` take to differentiate them.

        Any number of residuals may be held at a time, each with states of its own. ``along`` are further parameters
        that `jvp` will be given directions of; only the mobility has to be said before, as where it is 0 nothing
        diffuses.
        """
        values = self._checked(parameters)
        self._begin(state, values, {*values, *along})
        last = self._forward(keep=True)
        return self._states(last, self._rollout.steps), StepResidual(Residual(self._rollout), values)

    @in_turn
    def vjp(self, residual: StepResidual, state_bar: Values) -> tuple[Arrays, Arrays]:
        """Reverse mode: from the adjoint of the state after the steps to those of the state before them and of the
        parameters that were given.

        The adjoint of a state is a table of arrays, those of its fields by name and in their shapes, and of its
        ``time``, a number; what is left out is 0. All that is returned is in float64, with a first axis for the scenes
        in a batch. Raises `InputError` for fields that the state does not have, or that have other shapes.
        """
        rollout, space = self._rollout, self._space
        fields, times = self._derivatives("state_bar", state_bar)
        values = self._brought_back(residual)
        self._bar.clear()
        self._bar.set(fields)
        first = rollout.backward(self._adjoint, {rollout.steps: self._bar})
        before = space.state_adjoint(rollout, values, first, self._adjoint.parameters())
        gradient = space.gradient(rollout, values, first, self._adjoint.parameters())
        before[STATE_TIME] = before[STATE_TIME] + times
        if "time_step" in gradient:  # a longer step ends later
            gradient["time_step"] = gradient["time_step"] + rollout.steps * times
        return without_lost(rollout, before), without_lost(rollout, gradient)

    @in_turn
    def jvp(self, residual: StepResidual, state_dot: Values, parameter_dots: Values | None = None) -> Arrays:
        """Forward mode: from tangents of the state before the steps and of any parameters that it does not hold to that
        of the state after them; as `vjp` takes and returns adjoints."""
        rollout, space = self._rollout, self._space
        fields, times = self._derivatives("state_dot", state_dot)
        along = space.checked({} if parameter_dots is None else parameter_dots, "direction")
        space.check_directions(along)
        values = self._brought_back(residual)
        if "mobility" in along and not rollout.substeps:
            raise InputError(
                "direction mobility is given, but must be named where the step is taken, as nothing diffuses where the "
                'mobility is 0: step(..., along=["mobility"]).'
            )
        dot, parameters_dot = self._dots
        dot.clear()
        dot.set(fields)
        space.set_direction(rollout, values, along, dot, parameters_dot, np.broadcast_to(times, len(rollout.clocks)))
        rollout.tangent(dot, parameters_dot, lambda number, state: None)
        found = {name: array.astype(np.float64) for name, array in dot.numpy(self._simulation.dimension).items()}
        later = times + rollout.steps * self._each(along.get("time_step", np.zeros(())))
        return without_lost(rollout, {**found, STATE_TIME: later})

    def _each(self, number: np.ndarray) -> np.ndarray:
        """A number as those of the scenes of a batch."""
        return number if self._simulation.batch is None else np.broadcast_to(number, self._simulation.batch)

    def _derivatives(self, what: str, given: Values) -> tuple[Arrays, np.ndarray]:
        """Derivatives of a state's fields, and of its time, as arrays in float64."""
        simulation = self._simulation
        if not isinstance(given, Mapping):
            raise InputError(f"{what} is {shown(given)}, but must be a table of arrays by name, {{'positions': ...}}.")
        sizes = len(simulation.positions), simulation.dimension, len(simulation.scene.phase)
        shapes = {field.name: field.shape(*sizes) for field in simulation.initial.fields} | {STATE_TIME: ()}
        members = () if simulation.batch is None else (simulation.batch,)
        found = {}
        for name, value in given.items():
            if name not in shapes:
                raise InputError(f"{what} has {shown(name)}, but must have only {', '.join(shapes)} in this scene.")
            found[name] = as_numbers(f"{what} {name}", value)
            if found[name].shape != (*members, *shapes[name]):
                wanted = (*members, *shapes[name])
                raise InputError(f"{what} {name} has shape {found[name].shape}, but must be {wanted}.")
        return found, found.pop(STATE_TIME, np.zeros(members))

    def _brought_back(self, residual: StepResidual) -> Arrays:
        """The parameters of a step, which is the rollout's present one again."""
        if not isinstance(residual, StepResidual) or residual.evaluation.rollout is not self._rollout:
            raise InputError(f"residual is {shown(residual)}, but must be one that this stepper's step returned.")
        residual.evaluation.bring_back()
        return residual.values

    @cached_property
    def _bar(self) -> State:
        return self._rollout.solver.new_state()

    @cached_property
    def _dots(self) -> tuple[State, Parameters]:
        return self._rollout.solver.new_state(), self._rollout.solver.new_parameters(self._rollout.steps)

    @cached_property
    def _adjoint(self) -> BackwardStep:
        solver = self._rollout.solver
        require(solver.gradient_memory(self._rollout.log), "take a larger spacing", solver.device)
        return Exact().derivative(self._rollout)

    def _begin(self, state: Given, values: Arrays, varied: Iterable[str] = ()) -> None:
        states = one_for_each(state, self._simulation.batch)
        self._space.check_restarts(states, values)
        self._space.begin(self._rollout, values, varied, states)

    def _checked(self, parameters: Values | None) -> Arrays:
        return self._space.checked({} if parameters is None else parameters)

    def _forward(self, keep: bool) -> State:
        """Take the steps; ``keep`` checkpoints for a way back. Warnings and errors as of `Simulation.run`."""
        last = self._rollout.forward(keep=keep)
        for sentence in trouble(self._rollout, self._simulation.scene):
            warnings.warn(sentence, CortadoWarning, stacklevel=6)
        return last

    def _states(self, state: State, steps: int) -> States:
        """A state of the rollout, after so many steps."""
        fields, batch = state.numpy(self._simulation.dimension), self._simulation.batch
        if batch is None:
            return self._state(0, fields, steps)
        each = [{name: array[b].copy() for name, array in fields.items()} for b in range(batch)]
        return tuple(self._state(b, own, steps) for b, own in enumerate(each))

    def _state(self, member: int, fields: Arrays, steps: int) -> RestartState:
        """That of one scene, which nobody can change; of one that is lost it has no numbers."""
        is_lost = member in self._rollout.lost
        for array in fields.values():
            if is_lost:
                array[:] = np.nan
            array.setflags(write=False)
        state = RestartState(FixedDict(fields), self._clock(member, steps), self._rollout.origins[member])
        if not is_lost:
            self._simulation.judged_states.add(state)
        return state

    def _clock(self, member: int, steps: int) -> Clock:
        """After so many steps."""
        clock = self._rollout.clocks[member]
        time = clock.times(np.array(steps), float(self._rollout.time_steps[member]))
        return Clock(clock.steps + steps, float(time))
