"""States of steps as NumPy arrays, and derivatives with respect to them."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cortado.arrays import as_numbers
from cortado.errors import InputError, shown
from cortado.fixed import FixedDict
from cortado.particles.state import State
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.residual import OfLost, without_lost
from cortado.rollout.restarts import one_for_each
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.restart import Clock, RestartState

States = RestartState | tuple[RestartState, ...]
"""Of a batch one for each scene."""
Given = RestartState | Sequence[RestartState] | None
"""A state to go on from, of a batch one for each scene; None for the scene's first."""


class HostStates:
    """Takes states as a `RestartState`, of a batch one for each scene, and derivatives as NumPy arrays, and gives
    them so, derivatives in float64."""

    def __init__(self, simulation: Simulated):
        self._simulation = simulation

    def begin(self, space: ParameterSpace, rollout: Rollout, state: Any, values: Arrays, varied: set[str]) -> None:
        """Give a rollout a state to begin at and checked parameters; raises `InputError` for a state of another
        simulation."""
        states = one_for_each(state, self._simulation.batch)
        space.check_restarts(states, values)
        space.begin(rollout, values, varied, states)

    def state(self, rollout: Rollout, state: State, steps: int) -> Any:
        """A state of the rollout, after so many steps, which nobody can change; of a scene that is lost it has no
        numbers, with which the scene may go on."""
        scenes = zip(clocks_after(rollout, steps), rollout.origins, strict=True)
        found = self.states(state, [RestartState({}, clock, origin) for clock, origin in scenes], rollout.lost)
        self._simulation.judged_states.update(found)
        return found[0] if self._simulation.batch is None else found

    def states(
        self, state: State, scenes: Sequence[RestartState], lost: Container[int] = ()
    ) -> tuple[RestartState, ...]:
        """The states of all scenes, with clocks and origins of ``scenes``."""
        fields, batch = state.numpy(self._simulation.dimension), self._simulation.batch
        found = []
        for b, scene in enumerate(scenes):
            own = {name: array if batch is None else array[b].copy() for name, array in fields.items()}
            for array in own.values():
                if b in lost:
                    array[:] = np.nan
                array.setflags(write=False)
            found.append(replace(scene, fields=FixedDict(own)))
        return tuple(found)

    def write(self, what: str, given: Values, to: State) -> np.ndarray:
        """Write derivatives of a state's fields, 0 for those that are left out, and return that of its time; raises
        `InputError`."""
        fields, shapes = require_fields(what, given, to), self.shapes()
        arrays = {name: as_numbers(f"{what} {name}", value) for name, value in fields.items()}
        for name, array in arrays.items():
            if array.shape != shapes[name]:
                raise InputError(f"{what} {name} has shape {array.shape}, but must be {shapes[name]}.")
            self._require_finite(f"{what} {name}", array)
        to.clear()
        to.set(arrays)
        times = time_of(what, given, to)
        self._require_finite(f"{what} {STATE_TIME}", times)
        return times

    def _require_finite(self, what: str, array: np.ndarray) -> None:
        """But for scenes of a batch that have no numbers at all, as those that are lost."""
        for scene in [array] if self._simulation.batch is None else array:
            lost = self._simulation.batch is not None and np.isnan(scene).all()
            if not lost and not np.isfinite(scene).all():
                raise InputError(f"{what} has a value that is not finite, but must be numbers.")

    def read(self, state: State, lost: OfLost) -> dict[str, Any]:
        """Derivatives of a state's fields, by name."""
        found = {name: array.astype(np.float64) for name, array in state.numpy(self._simulation.dimension).items()}
        return without_lost(lost, found)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the fields of a state, by name; of a batch with a first axis for the scenes."""
        simulation = self._simulation
        sizes = len(simulation.positions), simulation.dimension, len(simulation.scene.phase)
        members = () if simulation.batch is None else (simulation.batch,)
        return {field.name: (*members, *field.shape(*sizes)) for field in simulation.initial.fields}


def require_fields(what: str, given: Values, state: State) -> Values:
    """Derivatives of a state but that of its time; raises `InputError` for anything but a table of its fields."""
    if not isinstance(given, Mapping):
        raise InputError(f"{what} is {shown(given)}, but must be a table of arrays by name, {{'positions': ...}}.")
    known = (*state.names, STATE_TIME)
    for name in given:
        if name not in known:
            raise InputError(f"{what} has {shown(name)}, but must have only {', '.join(known)} in this scene.")
    return {name: value for name, value in given.items() if name != STATE_TIME}


def time_of(what: str, given: Values, state: State) -> np.ndarray:
    """The derivative of a state's time, () or (batch,)."""
    members = () if state.batch is None else (state.batch,)
    found = as_numbers(f"{what} {STATE_TIME}", given.get(STATE_TIME, np.zeros(members)))
    if found.shape != members:
        raise InputError(f"{what} {STATE_TIME} has shape {found.shape}, but must be {members}.")
    return found


def clocks_after(rollout: Rollout, steps: int) -> list[Clock]:
    """Of each scene of a rollout, after so many steps. Scenes with one clock keep having one."""
    made: dict[tuple[int, float], Clock] = {}
    for clock, size in zip(rollout.clocks, rollout.time_steps.tolist(), strict=True):
        if (id(clock), size) not in made:
            made[id(clock), size] = clock.after(steps, size)
    each = zip(rollout.clocks, rollout.time_steps.tolist(), strict=True)
    return [made[id(clock), size] for clock, size in each]
