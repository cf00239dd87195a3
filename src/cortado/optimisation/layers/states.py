"""States as named arrays of numbers, as other programs hold them: whole, and judged when they come back."""

from collections import OrderedDict
from hashlib import blake2b

import numpy as np
import warp as wp

from cortado.errors import InputError
from cortado.optimisation.layers.layer import Array, Named, Shapes, on_host
from cortado.particles.fields import Entry
from cortado.particles.state import State
from cortado.rollout.device_states import DeviceState, DeviceStates
from cortado.rollout.host_states import Given
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.restarts import check_clock, origin_of
from cortado.scene.parameter_values import Arrays
from cortado.scene.restart import Clock, Origin, RestartState
from cortado.simulation import Simulation

LAST_STEP = "time_step"
"""The length of the step that led to a state, which a scene has that chooses it [s]."""
MOST_KNOWN = 256
"""Checksums of states that are remembered."""


class NamedStates:
    """Makes states of one simulation from named arrays, and named arrays from its states.

    They have the names and shapes of the fields of a `RestartState`, of a batch with a first axis for the scenes, and a
    ``time`` [s]. All are of the simulation's precision.
    """

    def __init__(self, simulation: Simulation):
        self._simulation, self._place = simulation, DeviceStates(simulation)
        self._space = ParameterSpace(simulation, 0)
        self._known: OrderedDict[bytes, tuple[Origin, ...]] = OrderedDict()
        """States that were judged, or that steps led to, by checksum: whose particles they are of."""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of all arrays, by name."""
        simulation = self._simulation
        members = () if simulation.batch is None else (simulation.batch,)
        last = {LAST_STEP: members} if simulation.scene.solver.chooses else {}
        return {**self._place.shapes(), STATE_TIME: members, **last}

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of those that are on the device."""
        return self._simulation.initial.names

    def state(self, given: Named, parameters: Arrays) -> DeviceState:
        """A state of the simulation, in arrays of its own. ``parameters`` are those of the steps that follow.

        Raises `InputError` for one that does not make sense in this scene. On a GPU, where it would have to be read,
        it is not looked at, as derivatives are not.
        """
        arrays = self.written({name: given[name] for name in self.fields})
        times, sizes = (self._numbers(given, name) for name in (STATE_TIME, LAST_STEP))
        solver = self._simulation.scene.solver
        own = parameters.get("time_step", 1.0 if solver.chooses else solver.time_step)
        steps = np.broadcast_to(np.float64(own), times.shape)
        clocks = [self._clock(*own) for own in zip(times.tolist(), steps.tolist(), sizes.tolist(), strict=True)]
        for clock in clocks:
            check_clock(clock)
        origins = self._judged(arrays, clocks, parameters)
        scenes = tuple(RestartState({}, *own) for own in zip(clocks, origins, strict=True))
        self._simulation.judged_states.update(scenes)
        return DeviceState(arrays, scenes)

    def arrays(self, state: DeviceState) -> dict[str, Array]:
        """What `state` takes, of a state that steps led to."""
        members = self.shapes[STATE_TIME]
        clocks = [scene.clock for scene in state.scenes]
        found: dict[str, Array] = self.read(state.arrays)
        found[STATE_TIME] = np.reshape([clock.time for clock in clocks], members)
        if LAST_STEP in self.shapes:
            found[LAST_STEP] = np.reshape([clock.time_step for clock in clocks], members)
        if all(scene in self._simulation.judged_states and scene.origin for scene in state.scenes):
            self._remember(state.arrays, tuple(scene.origin for scene in state.scenes if scene.origin))
        return found

    def of(self, state: Given | DeviceState, parameters: Arrays) -> dict[str, Array]:
        """The same of a state on the host, or of the first one of a run with these parameters."""
        return self.arrays(self._simulation.on_device(state, parameters=parameters))

    def written(self, given: Named) -> State:
        """Fields, or derivatives with respect to them, as Cortado has them, 0 where they are left out."""
        state = self._simulation.solver.new_state()
        for name, array in given.items():
            own = self._narrow(name, state.numbers(name))
            if not isinstance(array, np.ndarray) and array.dtype == own.dtype and array.device == own.device:
                wp.copy(own, array.reshape(own.shape))
            else:
                own.assign(on_host(array).reshape(own.shape))
        return state

    def read(self, state: State) -> dict[str, Array]:
        """The other way round."""
        return self.narrowed({name: state.numbers(name) for name in self.fields})

    def narrowed(self, found: Named) -> dict[str, Array]:
        """Of fields whose vectors have three components those with as many as the scene has."""
        each = {field.name: field.entry for field in self._simulation.initial.fields}
        narrow = {name: self._narrow(name, found[name]) for name in each}
        wide = {name for name, entry in each.items() if entry is Entry.DOUBLE}
        return {name: on_host(array) if name in wide else array.contiguous() for name, array in narrow.items()}

    def _narrow(self, name: str, whole: wp.array) -> wp.array:
        """A view of a field that is numbers, of vectors of those components that the scene has."""
        field = next(field for field in self._simulation.initial.fields if field.name == name)
        if field.entry is not Entry.VECTOR or self._simulation.dimension == 3:
            return whole
        return whole[:, :, :2] if whole.ndim == 3 else whole[:, :2]

    def _numbers(self, given: Named, name: str) -> np.ndarray:
        """(members,) in float64."""
        members = self._simulation.batch or 1
        return on_host(given[name]).astype(np.float64).reshape(members) if name in given else np.zeros(members)

    def _clock(self, time: float, step: float, last: float) -> Clock:
        """Of a state at a time, which may have been rounded. Where it is that of a whole number of steps, it counts
        them, so that the times of later steps have the bits of one run."""
        if self._simulation.scene.solver.chooses:
            return Clock(0, time, last)
        steps = round(time / step) if np.isfinite(time) and time >= 0.0 else 0
        room = 2.0 * float(np.finfo(self._simulation.precision.numpy).eps)
        return Clock(steps, steps * step) if abs(time - steps * step) <= room * time else Clock(0, time)

    def _judged(self, arrays: State, clocks: list[Clock], parameters: Arrays) -> tuple[Origin, ...]:
        """Of which particles the scenes of a state are."""
        known = self._known.get(_checksum(arrays)) if self._simulation.device.is_cpu else None
        if known is not None:
            return known
        own = {name: parameters[name] for name in ("rest_density",) if name in parameters}
        members = self._space.members(own)
        if self._simulation.device.is_cpu:
            unknown = [RestartState({}, clock) for clock in clocks]
            self._space.check_restarts(self._place.states(arrays, unknown), own)
        densities = self._simulation.parameters()["rest_density"]
        origins = (origin_of(self._simulation, np.atleast_1d(one.get("rest_density", densities))) for one in members)
        found = tuple(origins)
        self._remember(arrays, found)
        return found

    def _remember(self, arrays: State, origins: tuple[Origin, ...]) -> None:
        if self._simulation.device.is_cpu:
            self._known[_checksum(arrays)] = origins
            while len(self._known) > MOST_KNOWN:
                self._known.popitem(last=False)


def check_state(given: Shapes, wanted: Shapes) -> None:
    """Raises `InputError` for arrays of other names or shapes than those of a state."""
    if not given:
        raise InputError(f"state is left out, but must have {', '.join(wanted)} in this scene.")
    if given.keys() != wanted.keys():
        raise InputError(f"state has {', '.join(given)}, but must have {', '.join(wanted)} in this scene.")
    for name, shape in wanted.items():
        if given[name] != shape:
            raise InputError(f"state {name} has shape {given[name]}, but must be {shape}.")


def named_states(simulation: Simulation) -> NamedStates:
    """What makes the states of a simulation for all of its layers."""
    found: NamedStates = simulation.__dict__.get("_named_states") or NamedStates(simulation)
    simulation.__dict__["_named_states"] = found
    return found


def _checksum(arrays: State) -> bytes:
    found = blake2b(digest_size=16)
    for array in arrays.arrays():
        found.update(array.numpy().data)
    return found.digest()
