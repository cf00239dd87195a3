"""Steps of a simulation as a function of a state and of parameters."""

import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from cortado.device.state import State
from cortado.device.threads import Turn, in_turn
from cortado.errors import CortadoWarning
from cortado.fixed import FixedDict
from cortado.outcome import trouble
from cortado.parameters.restarts import one_for_each
from cortado.parameters.scene_parameters import Simulated
from cortado.parameters.space import ParameterSpace
from cortado.parameters.values import Arrays, Values
from cortado.restart import Clock, RestartState
from cortado.rollout import Rollout
from cortado.solvers.solver import Solver

States = RestartState | tuple[RestartState, ...]
"""Of a batch one for each scene."""
Given = RestartState | Sequence[RestartState] | None
"""A state to go on from, of a batch one for each scene; None for the scene's first."""


class Steppable(Simulated, Protocol):
    """A simulation as its steps see it."""

    solver: Solver


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
        values, states = self._checked(parameters), one_for_each(state, self._simulation.batch)
        self._space.check_restarts(states, values)
        self._space.begin(self._rollout, values, states=states)
        return self._forward(keep=False)

    def _checked(self, parameters: Values | None) -> Arrays:
        return self._space.checked({} if parameters is None else parameters)

    def _forward(self, keep: bool) -> States:
        """Take the steps; ``keep`` checkpoints for a way back. Warnings and errors as of `Simulation.run`."""
        rollout = self._rollout
        last = rollout.forward(keep=keep)
        for sentence in trouble(rollout, self._simulation.scene):
            warnings.warn(sentence, CortadoWarning, stacklevel=6)
        return self._states(last, rollout.steps)

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
            self._simulation.own_states.add(state)
        return state

    def _clock(self, member: int, steps: int) -> Clock:
        """After so many steps."""
        clock = self._rollout.clocks[member]
        time = clock.times(np.array(steps), float(self._rollout.time_steps[member]))
        return Clock(clock.steps + steps, float(time))
