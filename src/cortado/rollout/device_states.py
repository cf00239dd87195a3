"""States that stay on the device, whose arrays other programs take and give by DLPack, and derivatives with respect to
them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import warp as wp

from cortado.errors import InputError, shown
from cortado.particles.fields import Entry
from cortado.particles.state import State
from cortado.rollout.host_states import HostStates, States, clocks_after, require_fields, time_of
from cortado.rollout.parameter_space import ParameterSpace
from cortado.rollout.residual import OfLost
from cortado.rollout.rollout import Rollout
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.restart import RestartState


@dataclass(frozen=True, eq=False, repr=False)
class DeviceState:
    """A state, or those of all scenes of a batch, that stay on the device: `Simulation.on_device` makes one, and steps
    from it lead to others, each with arrays of its own.

    ``state["positions"]`` is a Warp array whose memory ``torch.from_dlpack``, ``jax.dlpack.from_dlpack`` and their like
    share; nobody may write to it. It has the precision of the simulation, and vectors have three components in 2-D too.
    """

    arrays: State
    """All fields."""
    scenes: tuple[RestartState, ...]
    """The clock and the origin of each scene of a batch, without fields."""

    def __getitem__(self, name: str) -> wp.array:
        """A field by name: vectors (n, 3), fractions (n, phases), numbers (n,), in a batch (batch, n, ...)."""
        if name not in self.arrays.names:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.arrays.names)}.")
        return self.arrays.numbers(name)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {self[name].shape}" for name in self.arrays.names)
        return f"DeviceState({shapes}, {self.arrays.positions.device})"

    def __reduce__(self) -> NoReturn:
        raise InputError("A state on the device can be neither pickled nor copied, but simulation.on_host(state) can.")


class DeviceStates(HostStates):
    """Takes states as a `DeviceState` and derivatives as arrays that speak DLPack, and gives them so."""

    def begin(self, space: ParameterSpace, rollout: Rollout, state: Any, values: Arrays, varied: set[str]) -> None:
        """As `HostStates.begin`."""
        self._require_own(state)
        self._require_judged(state)
        space.check_restarts(state.scenes, values)
        space.begin(rollout, values, varied, state.scenes, state.arrays)
        rollout.step_sizes.begin_at(rollout.initial)

    def follow(self, rollout: Rollout, state: DeviceState) -> None:
        """Give a rollout a first state, and leave its parameters as they are."""
        self._require_own(state)
        self._require_judged(state)
        rollout.begin_evaluation()
        rollout.goes_on, rollout.clocks = True, [scene.clock for scene in state.scenes]
        rollout.initial.assign(state.arrays)
        rollout.step_sizes.begin_at(rollout.initial)

    def state(self, rollout: Rollout, state: State, steps: int) -> DeviceState:
        """As `HostStates.state`, in arrays of its own."""
        made: dict[tuple[int, int], RestartState] = {}
        """One for all scenes of a clock and an origin: a batch has hundreds."""
        keys = []
        for clock, origin in zip(clocks_after(rollout, steps), rollout.origins, strict=True):
            keys.append((id(clock), id(origin)))
            if keys[-1] not in made:
                made[keys[-1]] = RestartState({}, clock, origin)
        self._simulation.judged_states.update(made.values())
        own = _without_lost(dict.fromkeys(rollout.lost, np.nan), state.copy())
        return DeviceState(own, tuple(made[key] for key in keys))

    def write(self, what: str, given: Values, to: State) -> np.ndarray:
        """As `HostStates.write`."""
        fields = require_fields(what, given, to)
        to.clear()
        copy_to(to, what, fields)
        return time_of(what, given, to)

    def read(self, state: State, lost: OfLost) -> dict[str, Any]:
        """As `HostStates.read`, in the precision of the simulation."""
        own = _without_lost(lost, state.copy())
        return {name: own.numbers(name) for name in own.names}

    def replaced(self, space: ParameterSpace, state: DeviceState, fields: Values) -> DeviceState:
        """A state, whose arrays are overwritten, with other fields: it is judged on the host as any state is."""
        given = require_fields("state", fields, state.arrays)
        copy_to(state.arrays, "state", given)
        densities = np.array([scene.origin.rest_density for scene in state.scenes if scene.origin])
        values = {"rest_density": densities[0] if self._simulation.batch is None else densities}
        space.check_restarts(self.states(state.arrays, state.scenes), values)
        self._require_plane(state, given)
        return state

    def on_host(self, state: DeviceState) -> States:
        """As NumPy arrays, which nobody can change."""
        self._require_own(state)
        found = self.states(state.arrays, state.scenes)
        judged = zip(found, state.scenes, strict=True)
        self._simulation.judged_states.update(one for one, scene in judged if scene in self._simulation.judged_states)
        return found[0] if self._simulation.batch is None else found

    def _require_plane(self, state: DeviceState, names: Iterable[str]) -> None:
        """Vectors of a scene in 2-D lie in its plane."""
        vectors = {field.name for field in state.arrays.fields if field.entry is Entry.VECTOR}
        for name in vectors.intersection(names) if self._simulation.dimension == 2 else ():
            if state[name].numpy()[..., 2].any():
                raise InputError(f"state {name} has a third component other than 0, but must have 0 there in 2-D.")

    def _require_judged(self, state: DeviceState) -> None:
        """Arrays on the device are not looked at: they are those of a step of this simulation."""
        if not all(scene in self._simulation.judged_states for scene in set(state.scenes)):
            advice = "simulation.on_host(state) is taken by any of the same scene"
            raise InputError(f"state is of another simulation, but must be of this one: {advice}.")

    def _require_own(self, state: DeviceState) -> None:
        own, found = self._simulation.initial, state.arrays
        if (found.batch, found.names) != (own.batch, own.names) or any(
            (found[name].device, found[name].dtype, found[name].shape)
            != (own[name].device, own[name].dtype, own[name].shape)
            for name in own.names
        ):
            raise InputError(
                "state is of a simulation with other arrays, but must be of this one: the same scene, device, "
                "precision and batch."
            )


def copy_to(state: State, what: str, given: Mapping[str, Any]) -> None:
    """Copy arrays that speak DLPack to fields of a state; raises `InputError` for arrays of another shape, type or
    device."""
    for name, value in given.items():
        own, array = state.numbers(name), _taken(f"{what} {name}", value)
        if (array.device, array.dtype, array.shape) != (own.device, own.dtype, own.shape):
            found, wanted = (f"a {a.dtype.__name__} array {a.shape} on {a.device}" for a in (array, own))
            raise InputError(f"{what} {name} is {found}, but must be {wanted}.")
        wp.copy(own, array)


def _taken(what: str, value: Any) -> wp.array:
    """An array of another program, in its own memory."""
    if isinstance(value, wp.array):
        return value
    if not hasattr(value, "__dlpack__"):
        raise InputError(f"{what} is {shown(value)}, but must be an array that speaks DLPack, such as a torch.Tensor.")
    try:  # NumPy gives nothing that is read-only by DLPack
        return wp.array(value, device="cpu") if isinstance(value, np.ndarray) else wp.from_dlpack(value)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{what} cannot be taken: {error}") from error


def _without_lost(lost: OfLost, state: State) -> State:
    """A state, or derivatives of one, without numbers for scenes that were lost."""
    for b, number in lost.items():
        for array in state.member(b).arrays() if state.batch is not None else state.arrays():
            array.fill_(number)
    return state
