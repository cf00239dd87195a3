"""States, derivatives and parameters of time steps, as NumPy arrays or on the device."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from math import prod
from typing import Any, NoReturn

import numpy as np
import warp as wp

from cortado.arrays import as_numbers
from cortado.calls import FixedDict
from cortado.device.launching import CapturedGraph, KernelLauncher, launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.particles.state import Entry, Parameters, State
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import one_for_each, shapes_of_fields
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.parameters import Axis, Role
from cortado.scene.restart import RestartState

OfLost = Mapping[int, float]
"""Derivative for each lost scene: 0 or NaN, by scene number."""


def of_lost(rollout: Rollout, given: State, times: np.ndarray, parameters: Parameters | None = None) -> OfLost:
    """Return the derivative for each lost scene. The derivative is 0 if all ``given`` derivatives of the scene are 0,
    and otherwise NaN."""
    found = {}
    for b in rollout.lost:
        own = [array.numpy() for array in given.member(b).arrays()]
        own += [] if parameters is None else [array.numpy()[b] for array in parameters.arrays()]
        found[b] = np.nan if times[b] or any(array.any() for array in own) else 0.0
    return found


def without_lost(lost: OfLost, found: Arrays) -> Arrays:
    for b, number in lost.items():
        for array in found.values():
            array[b] = number
    return found


States = RestartState | tuple[RestartState, ...]
"""A restart state, or a tuple with a restart state for each scene of a batch."""
Given = RestartState | Sequence[RestartState] | None
"""A restart state, or a sequence with a restart state for each scene of a batch. None means the initial state."""


class HostStates:
    def __init__(self, simulation: Simulated):
        self._simulation = simulation

    def begin(self, space: ParameterSpace, rollout: Rollout, state: Any, values: Arrays, varied: set[str]) -> None:
        """Set the first state and the parameters of a rollout. Raises `InputError` for a state of a different
        simulation."""
        states = one_for_each(state, self._simulation.batch)
        space.check_restarts(states, values)
        space.begin(rollout, values, varied, states)

    def state(self, rollout: Rollout, state: State, steps: int, begun: Any = None) -> Any:
        """Return the state of a rollout after ``steps`` steps as read-only restart states. Lost scenes get NaN."""
        found = self.states(state, scenes_after(rollout, steps), rollout.lost)
        self._simulation.judged_states.update(found)
        return found[0] if self._simulation.batch is None else found

    def states(
        self, state: State, scenes: Sequence[RestartState], lost: Container[int] = ()
    ) -> tuple[RestartState, ...]:
        """Copy a device state to read-only restart states, with NaN for ``lost`` scenes. The clocks and origins are
        copied from ``scenes``."""
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
        """Write derivatives by field name to a device state, and return the derivative with respect to time. Fields
        without a given derivative get 0. Raises `InputError` for arrays of wrong shape or type."""
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
        for scene in [array] if self._simulation.batch is None else array:
            lost = self._simulation.batch is not None and np.isnan(scene).all()
            if not lost and not np.isfinite(scene).all():
                raise InputError(f"{what} has a value that is not finite, but all values must be finite.")

    def read(self, state: State, lost: OfLost) -> dict[str, Any]:
        """Return derivatives by field name in float64. Derivatives of lost scenes are replaced by the values in
        ``lost``."""
        found = {name: array.astype(np.float64) for name, array in state.numpy(self._simulation.dimension).items()}
        return without_lost(lost, found)


def require_fields(what: str, given: Values, state: State) -> Values:
    """Return the derivatives by field name without ``time``. Raises `InputError` for unknown names or wrong types."""
    if not isinstance(given, Mapping):
        raise InputError(f"{what} is {shown(given)}, but must be a table of arrays by name, {{'positions': ...}}.")
    known = (*state.names, STATE_TIME)
    for name in given:
        if name not in known:
            raise InputError(f"{what} has {shown(name)}, but must have only {', '.join(known)} in this scene.")
    return {name: value for name, value in given.items() if name != STATE_TIME}


def time_of(what: str, given: Values, state: State) -> np.ndarray:
    """Return the derivative with respect to the time of a state, () or (batch,). A missing derivative is 0."""
    members = () if state.batch is None else (state.batch,)
    found = as_numbers(f"{what} {STATE_TIME}", given.get(STATE_TIME, np.zeros(members)))
    if found.shape != members:
        raise InputError(f"{what} {STATE_TIME} has shape {found.shape}, but must be {members}.")
    return found


def scenes_after(rollout: Rollout, steps: int) -> list[RestartState]:
    """Return the clock and the origin of each scene after ``steps`` steps, as restart states without fields."""
    made, found = dict[tuple[int, float, int], RestartState](), []
    for clock, size, origin in zip(rollout.clocks, rollout.time_steps.tolist(), rollout.origins, strict=True):
        key = id(clock), size, id(origin)
        if key not in made:
            made[key] = RestartState({}, clock.after(steps, size), origin)
        found.append(made[key])
    return found


@dataclass(frozen=True, eq=False, repr=False)
class DeviceState:
    """A state in arrays on the device, or the states of all scenes of a batch. `Simulation.on_device` returns a
    `DeviceState`, and so do steps from a `DeviceState`.

    ``state["positions"]`` is a read-only Warp array. ``torch.from_dlpack`` and ``jax.dlpack.from_dlpack`` share its
    memory. Arrays of a device state have the precision of the simulation. Vectors on the device have three components
    in 2-D, too.
    """

    arrays: State
    scenes: tuple[RestartState, ...]
    """Clock and origin of each scene, as restart states without fields."""

    def __getitem__(self, name: str) -> wp.array:
        """Return a field by name. Vectors have the shape (n, 3), mass fractions (n, phases), and scalars (n,). A batch
        adds a first axis for the scenes."""
        if name not in self.arrays.names:
            raise InputError(f"state has no {shown(name)}, but has {', '.join(self.arrays.names)}.")
        return self.arrays.numbers(name)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {self[name].shape}" for name in self.arrays.names)
        return f"DeviceState({shapes}, {self.arrays.positions.device})"

    def __reduce__(self) -> NoReturn:
        raise InputError("A state on the device cannot be pickled or copied: use simulation.on_host(state).")


class DeviceStates(HostStates):
    """Converts between states on the device (`DeviceState`, DLPack arrays) and the states of a rollout."""

    def begin(self, space: ParameterSpace, rollout: Rollout, state: Any, values: Arrays, varied: set[str]) -> None:
        self._require_taken(state)
        space.begin(rollout, values, varied, state.scenes, lambda first: first.assign(state.arrays))
        rollout.step_sizes.begin_at(rollout.initial)

    def follow(self, rollout: Rollout, state: DeviceState) -> None:
        self._require_taken(state)
        rollout.begin_evaluation()
        rollout.goes_on, rollout.clocks = True, [scene.clock for scene in state.scenes]
        rollout.initial.assign(state.arrays)
        rollout.step_sizes.begin_at(rollout.initial)

    def state(self, rollout: Rollout, state: State, steps: int, begun: Any = None) -> DeviceState:
        """Copy the state of a rollout after ``steps`` steps to a `DeviceState`."""
        scenes = scenes_after(rollout, steps)
        self._simulation.judged_states.update(scenes)
        shares = isinstance(begun, DeviceState) and not rollout.lost
        own = _without_lost(dict.fromkeys(rollout.lost, np.nan), state.copy(begun.arrays if shares else None))
        return DeviceState(own, tuple(scenes))

    def write(self, what: str, given: Values, to: State) -> np.ndarray:
        fields = require_fields(what, given, to)
        to.clear()
        copy_to(to, what, fields)
        return time_of(what, given, to)

    def read(self, state: State, lost: OfLost) -> dict[str, Any]:
        own = _without_lost(lost, state.copy())
        return {name: own.numbers(name) for name in own.names}

    def replaced(self, space: ParameterSpace, state: DeviceState, fields: Values) -> DeviceState:
        """Replace ``fields`` of a device state, and check the new state on the host."""
        given = require_fields("state", fields, state.arrays)
        copy_to(state.arrays, "state", given)
        densities = np.array([scene.origin.rest_density for scene in state.scenes if scene.origin])
        values = {"rest_density": densities[0] if self._simulation.batch is None else densities}
        space.check_restarts(self.states(state.arrays, state.scenes), values)
        vectors = {field.name for field in state.arrays.fields if field.entry is Entry.VECTOR}
        for name in vectors.intersection(given) if self._simulation.dimension == 2 else ():
            if state[name].numpy()[..., 2].any():
                raise InputError(
                    f"state {name} has a third component other than 0, but vectors are in the plane in 2-D."
                )
        return state

    def on_host(self, state: DeviceState) -> States:
        self._require_own(state)
        found = self.states(state.arrays, state.scenes)
        judged = zip(found, state.scenes, strict=True)
        self._simulation.judged_states.update(one for one, scene in judged if scene in self._simulation.judged_states)
        return found[0] if self._simulation.batch is None else found

    def _require_taken(self, state: DeviceState) -> None:
        self._require_own(state)
        if not all(scene in self._simulation.judged_states for scene in set(state.scenes)):
            advice = "any simulation of the same scene takes simulation.on_host(state)"
            raise InputError(f"state is of another simulation, but must be of this simulation: {advice}.")

    def _require_own(self, state: DeviceState) -> None:
        own, found = self._simulation.initial, state.arrays
        if (found.batch, found.names) != (own.batch, own.names) or any(
            (found[name].device, found[name].dtype, found[name].shape)
            != (own[name].device, own[name].dtype, own[name].shape)
            for name in own.names
        ):
            raise InputError(
                "state is of a simulation with other arrays, but must be of one with the same scene, device, "
                "precision and batch."
            )


def copy_to(state: State, what: str, given: Mapping[str, Any]) -> None:
    """Copy DLPack arrays to fields of a state. Raises `InputError` for a wrong shape, type or device."""
    for name, value in given.items():
        own, array = state.numbers(name), _taken(f"{what} {name}", value)
        if (array.device, array.dtype, array.shape) != (own.device, own.dtype, own.shape):
            found, wanted = (f"a {a.dtype.__name__} array {a.shape} on {a.device}" for a in (array, own))
            raise InputError(f"{what} {name} is {found}, but must be {wanted}.")
        wp.copy(own, array)


def _taken(what: str, value: Any) -> wp.array:
    if isinstance(value, wp.array):
        return value
    if not hasattr(value, "__dlpack__"):
        raise InputError(f"{what} is {shown(value)}, but must be an array with DLPack, such as a torch.Tensor.")
    try:  # NumPy refuses DLPack for read-only arrays
        return wp.array(value, device="cpu") if isinstance(value, np.ndarray) else wp.from_dlpack(value)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{what} cannot be read as a DLPack array: {error}") from error


def _without_lost(lost: OfLost, state: State) -> State:
    for b, number in lost.items():
        for array in state.member(b).arrays() if state.batch is not None else state.arrays():
            array.fill_(number)
    return state


def flat_of(arrays: Sequence[Any]) -> wp.array | None:
    """Return a flat Warp array in the memory of ``arrays``. Return None if ``arrays`` are not contiguous in memory."""
    first = arrays[0] if arrays else None
    if not isinstance(first, wp.array) or not all(array.size for array in arrays):
        return None
    end = first.ptr
    for array in arrays:
        if not isinstance(array, wp.array) or (array.ptr, array.dtype) != (end, first.dtype) or not array.is_contiguous:
            return None
        end += array.capacity
    return wp.array(ptr=first.ptr, dtype=first.dtype, shape=sum(a.size for a in arrays), device=first.device)


class Packed:
    """The fields of a state on a GPU, one after the other in a flat array. Fields of kind `Entry.DOUBLE` are
    left out."""

    def __init__(self, state: State, dimension: int):
        narrow, doubles = state.narrow(dimension), {f.name for f in state.fields if f.entry is Entry.DOUBLE}
        own = {name: array for name, array in narrow.items() if name not in doubles}
        first, ends = next(iter(own.values())), np.cumsum([0, *(array.size for array in own.values())]).tolist()
        self.flat = wp.empty(ends[-1], dtype=first.dtype, device=first.device)
        parts = [self.flat[begin:end] for begin, end in pairwise(ends)]
        self.views = {name: part.reshape(own[name].shape) for name, part in zip(own, parts, strict=True)}
        launch = KernelLauncher(1, first.device, record_tape=False)
        self.read = CapturedGraph(partial(_copy_all, self.views, own), launch)
        self.write = CapturedGraph(partial(_copy_all, own, self.views), launch)


def _copy_all(to: Mapping[str, wp.array], given: Mapping[str, wp.array]) -> None:
    for name, array in to.items():
        wp.copy(array, given[name])


class DeviceRows:
    """Parameters over time as Warp arrays on the device, in the simulation's precision. A parameter with one number has
    the shape (1,).

    The values of parameters on the device are not checked. A value may be infinite, or may move a solid too far in a
    time step.
    """

    def __init__(self, simulation: Simulated, space: ParameterSpace):
        self._simulation, self._space = simulation, space
        self._spread, self._fold = _kernels(simulation.precision)

    def split(self, given: Values | None, what: str = "parameter") -> tuple[Values, dict[str, wp.array]]:
        """Split parameters by name into values for the host and Warp arrays on the device. Raises `InputError` for an
        array of wrong shape, type or device."""
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
        parameter = None if self._simulation.scene.solver.chooses else self._simulation.known.get(name)
        return parameter is not None and parameter.axis is Axis.STEP and parameter.role is Role.RUN

    def stand_ins(self, rows: Mapping[str, wp.array]) -> Arrays:
        return {name: np.full(self._space.shapes(name)[0], np.nan) for name in rows}

    def write(self, rows: Mapping[str, wp.array], parameters: Parameters) -> None:
        for name, array in rows.items():
            numbers, given = parameters.to_write(name), self._in_three(name, array)
            if given.shape[:2] == numbers.shape[:2]:  # third components are 0
                wp.copy(numbers[:, :, : given.shape[2]] if given.shape != numbers.shape else numbers, given)
            else:
                launch(self._spread, numbers.shape, numbers.device, given=given, rows=numbers)

    def adjoints(self, rows: Mapping[str, wp.array], found: Parameters, lost: OfLost) -> dict[str, wp.array]:
        """Return the adjoints of the parameters on the device. The adjoints ``found`` are summed over the scenes and
        time steps that share a value."""
        adjoints = {}
        for name, array in rows.items():
            bars, shape = found.numbers(name), self._in_three(name, array).shape
            of_steps = self._folded(bars, (bars.shape[0], *shape[1:]))
            for member, number in lost.items():
                of_steps[member].fill_(number)
            adjoints[name] = self._folded(of_steps, shape).reshape(array.shape)
        return adjoints

    def _folded(self, bars: wp.array, shape: tuple[int, ...]) -> wp.array:
        sums = wp.empty(shape, dtype=bars.dtype, device=bars.device)
        launch(self._fold, shape, bars.device, bars=bars, sums=sums)
        return sums

    def _in_three(self, name: str, array: wp.array) -> wp.array:
        """Reshape a parameter to (members, steps, k). Constant axes have length 1."""
        each = prod(self._space.shapes(name)[0])
        of_each = array.ndim == self._simulation.known[name].rank + 2  # otherwise all scenes share the rows
        members = len(array) if of_each else 1
        return array.contiguous().reshape((members, array.size // (members * each), each))


@cache
def _kernels(precision: Precision) -> tuple[Any, Any]:
    real = precision.real
    module = kernel_module(f"device_rows_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def spread(given: wp.array3d(dtype=real), rows: wp.array3d(dtype=real)):
        b, n, c = wp.tid()
        rows[b, n, c] = real(0.0)
        if c < given.shape[2]:
            rows[b, n, c] = given[b % given.shape[0], n % given.shape[1], c]

    @wp.kernel(module=module, enable_backward=False)
    def fold(bars: wp.array3d(dtype=real), sums: wp.array3d(dtype=real)):
        b, n, c = wp.tid()
        found = real(0.0)
        for member in range(b, bars.shape[0], sums.shape[0]):
            for step in range(n, bars.shape[1], sums.shape[1]):
                found += bars[member, step, c]
        sums[b, n, c] = found

    return spread, fold
