"""States of steps, and derivatives with respect to them, as NumPy arrays or on the device: there other programs take
and give them by DLPack, and parameters over time may stay there, too."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import prod
from typing import Any, NoReturn

import numpy as np
import warp as wp

from cortado.arrays import as_numbers
from cortado.calls import FixedDict
from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.particles.state import Entry, Parameters, State, components
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import one_for_each, shapes_of_fields
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.parameters import Axis, Role
from cortado.scene.restart import Clock, RestartState

OfLost = Mapping[int, float]
"""By the numbers of the scenes of a batch that were lost what derivatives of them are: 0 where only zeros were given,
else NaN."""


def of_lost(rollout: Rollout, given: State, times: np.ndarray, parameters: Parameters | None = None) -> OfLost:
    """Of derivatives that are linear in those that were ``given`` of a state and its time, (batch,), and of
    parameters."""
    found = {}
    for b in rollout.lost:
        own = [array.numpy() for array in given.member(b).arrays()]
        own += [] if parameters is None else [array.numpy()[b] for array in parameters.arrays()]
        found[b] = np.nan if times[b] or any(array.any() for array in own) else 0.0
    return found


def without_lost(lost: OfLost, found: Arrays) -> Arrays:
    """Derivatives, of a batch with a first axis for the scenes, without numbers for scenes that were lost."""
    for b, number in lost.items():
        for array in found.values():
            array[b] = number
    return found


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
        fields, shapes = require_fields(what, given, to), shapes_of_fields(self._simulation, to.batch)
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


def require_fields(what: str, given: Values, state: State) -> Values:
    """A table of derivatives with respect to fields of a state, without that of its time, which is none.

    Raises `InputError` for anything but a table, and for names that are not fields of the state."""
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
        """Give a rollout a state on the device to begin at; see `HostStates.begin`."""
        self._require_taken(state)
        space.check_restarts(state.scenes, values)
        space.begin(rollout, values, varied, state.scenes, state.arrays)
        rollout.step_sizes.begin_at(rollout.initial)

    def follow(self, rollout: Rollout, state: DeviceState) -> None:
        """Give a rollout a first state, and leave its parameters as they are."""
        self._require_taken(state)
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
        """Write derivatives of fields that are on the device; see `HostStates.write`."""
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
        vectors = {field.name for field in state.arrays.fields if field.entry is Entry.VECTOR}
        for name in vectors.intersection(given) if self._simulation.dimension == 2 else ():
            if state[name].numpy()[..., 2].any():
                raise InputError(f"state {name} has a third component other than 0, but must have 0 there in 2-D.")
        return state

    def on_host(self, state: DeviceState) -> States:
        """As NumPy arrays, which nobody can change."""
        self._require_own(state)
        found = self.states(state.arrays, state.scenes)
        judged = zip(found, state.scenes, strict=True)
        self._simulation.judged_states.update(one for one, scene in judged if scene in self._simulation.judged_states)
        return found[0] if self._simulation.batch is None else found

    def _require_taken(self, state: DeviceState) -> None:
        """Arrays on the device are not looked at: they are those of a step of this simulation."""
        self._require_own(state)
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


class DeviceRows:
    """Those of one simulation over a number of steps.

    They are Warp arrays in the simulation's precision and on its device, of the shapes that a parameter may have, (1,)
    in the place of (). Nobody looks at them: neither whether they are finite, nor how far a solid goes in a step.
    """

    def __init__(self, simulation: Simulated, space: ParameterSpace):
        self._simulation, self._space = simulation, space
        self._spread, self._fold = _kernels(simulation.precision)

    def split(self, given: Values | None, what: str = "parameter") -> tuple[Values, dict[str, wp.array]]:
        """Parameters by name as those to be looked at and those that stay where they are; raises `InputError` for an
        array of another shape, type or device."""
        if not isinstance(given, Mapping):
            return {} if given is None else given, {}
        rows = {name: array for name, array in given.items() if isinstance(array, wp.array) and self.takes(name)}
        for name, array in rows.items():
            own, shapes = self._simulation.initial.positions, self._space.shapes(name)
            real, shape = self._simulation.precision.real, () if array.shape == (1,) else array.shape
            if not {array.shape, shape}.intersection(shapes) or array.dtype is not real or array.device != own.device:
                found = f"a {array.dtype.__name__} array {array.shape} on {array.device}"
                wanted = f"{real.__name__} of shape {' or '.join(map(str, shapes))} on {own.device}"
                raise InputError(f"{what} {name} is {found}, but must be {wanted}.")
        return {name: value for name, value in given.items() if name not in rows}, rows

    def takes(self, name: str) -> bool:
        """Whether a parameter may stay on the device: one over time that steps depend on as it is, unless their length
        is chosen by it."""
        parameter = None if self._simulation.scene.solver.chooses else self._simulation.known.get(name)
        return parameter is not None and parameter.axis is Axis.STEP and parameter.role is Role.RUN

    def stand_ins(self, rows: Mapping[str, wp.array]) -> Arrays:
        """What stands for them on the host, by name: values that are no numbers, until `write` overwrites them."""
        return {name: np.full(self._space.shapes(name)[0], np.nan) for name in rows}

    def write(self, rows: Mapping[str, wp.array], parameters: Parameters) -> None:
        """Write them to the parameters of a rollout, or tangents to those of tangents."""
        for name, array in rows.items():
            own = wp.empty_like(parameters[name])
            numbers = _numbers(own)
            arguments = {"given": self._in_three(name, array), "rows": numbers}
            launch(self._spread, numbers.shape, numbers.device, **arguments)
            parameters.set({name: own})

    def adjoints(self, rows: Mapping[str, wp.array], found: Parameters, lost: OfLost) -> dict[str, wp.array]:
        """From the adjoints of the parameters to those of the rows, in their shapes, without numbers where scenes of a
        batch were ``lost``."""
        adjoints = {}
        for name, array in rows.items():
            bars, shape = _numbers(found[name]), self._in_three(name, array).shape
            of_steps = self._folded(bars, (bars.shape[0], *shape[1:]))
            for member, number in lost.items():
                of_steps[member].fill_(number)
            adjoints[name] = self._folded(of_steps, shape).reshape(array.shape)
        return adjoints

    def _folded(self, bars: wp.array, shape: tuple[int, ...]) -> wp.array:
        """What several entries of an axis share is added up."""
        sums = wp.empty(shape, dtype=bars.dtype, device=bars.device)
        launch(self._fold, shape, bars.device, bars=bars, sums=sums)
        return sums

    def _in_three(self, name: str, array: wp.array) -> wp.array:
        """With an axis each for scenes and for steps, of 1 where they share rows, and for components."""
        each = prod(self._space.shapes(name)[0])
        of_each = array.ndim == self._simulation.known[name].rank + 2  # else all scenes of a batch share them
        members = len(array) if of_each else 1
        return array.contiguous().reshape((members, array.size // (members * each), each))


def _numbers(array: wp.array) -> wp.array:
    """The memory of a parameter over time, (members, steps) vectors or numbers, as numbers (members, steps, k)."""
    return components(array, (*array.shape, wp.types.type_size(array.dtype)))


@cache
def _kernels(precision: Precision) -> tuple[Any, Any]:
    """What writes rows to all scenes and steps, and the transpose."""
    real = precision.real
    module = kernel_module(f"device_rows_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        given: wp.array3d(dtype=real),
        # out
        rows: wp.array3d(dtype=real),
    ):
        b, n, c = wp.tid()
        rows[b, n, c] = real(0.0)
        if c < given.shape[2]:
            rows[b, n, c] = given[b % given.shape[0], n % given.shape[1], c]

    @wp.kernel(module=module, enable_backward=False)
    def fold(
        bars: wp.array3d(dtype=real),
        # out
        sums: wp.array3d(dtype=real),
    ):
        b, n, c = wp.tid()
        found = real(0.0)
        for member in range(b, bars.shape[0], sums.shape[0]):
            for step in range(n, bars.shape[1], sums.shape[1]):
                found += bars[member, step, c]
        sums[b, n, c] = found

    return spread, fold
