"""Base classes of layers, which are differentiable functions of named arrays, and converters of states and parameters.

If a layer computes several evaluations together, a parameter has one value for all evaluations or one for each.
"""

import warnings
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from typing import Any, TypeVar

import numpy as np
import warp as wp

from cortado.calls import counted
from cortado.errors import CortadoWarning, DivergedError, InputError
from cortado.particles.state import Entry, State
from cortado.rollout.device_states import DeviceState, HostStates, OfLost, Packed, flat_of, scenes_after
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.rollout import Rollout
from cortado.rollout.run_checks import check_clock, origin_of, shapes_of_fields
from cortado.scene.parameter_values import Arrays
from cortado.scene.restart import Clock, Origin, RestartState
from cortado.simulation import Simulation

STATE, PARAMETER = "state ", "parameter "
"""Prefixes of the names of arrays, for fields of a state and for parameters."""
POSITIONS = (STATE + "positions", "positions")
LAST_STEP = "time_step"
"""Name of the array with the length of the previous time step [s], for scenes with adaptive time steps."""
KEPT = 2
Array = Any
"""A Warp or NumPy array of numbers. A scalar has the shape () or (1,)."""
Named = Mapping[str, Array]
Shapes = Mapping[str, tuple[int, ...]]
K = TypeVar("K")
V = TypeVar("V")


class Layer(ABC):
    """A differentiable function of named arrays in one precision. A layer does not modify its arguments."""

    real: type
    device: Any
    """Device of the arrays named in `on_device`. The remaining arrays are on the host."""
    on_device: frozenset[str] = frozenset()
    kept_bytes: int = 0
    unmapped: str = ""
    """Name of the layer in the error message of `many`. The name is empty if `many` is available."""

    def __init__(self) -> None:
        self._batched: dict[int, Layer] = {}

    @abstractmethod
    def check(self, given: Shapes) -> None:
        """Raise `InputError` for arrays with wrong names or shapes."""

    @abstractmethod
    def outputs(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the layer's results by name."""

    @abstractmethod
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        """Return the results of the layer. If ``keep`` is true, also return a residual: data for `pull` and `push`. The
        next call of the layer may overwrite the returned Warp arrays."""

    @abstractmethod
    def pull(self, residual: Any, bars: Named) -> Named:
        """Compute the vector-Jacobian product: return the adjoints of all arguments, given the adjoints of the results.
        Missing adjoints count as 0."""

    @abstractmethod
    def push(self, residual: Any, dots: Named) -> Named:
        """Compute the Jacobian-vector product: return the tangents of the results, given the tangents of the arguments.
        Missing tangents count as 0."""

    def check_mapped(self) -> None:
        if self.unmapped:
            raise InputError(
                f"{self.unmapped} cannot be mapped over a further axis: use a single jax.vmap or torch.vmap."
            )

    def many(self, size: int) -> "Layer":
        """Return a layer that computes ``size`` evaluations of this layer. Arrays are stacked along a first axis."""
        return OneByOne(self, size)

    def batched(self, size: int) -> "Layer":
        self.check_mapped()
        return kept_or_made(self._batched, size, self.many, KEPT)


@dataclass(frozen=True)
class Lost:
    """The residual of a diverged evaluation. ``given`` contains the shapes of the arguments, and ``why`` is the error
    message."""

    given: Shapes
    why: str

    def along(self, of: Named, shapes: Shapes) -> Named:
        """Return derivatives with the given ``shapes``. Derivatives are 0 if all arrays in the dictionary ``of`` are 0.
        Otherwise the derivatives are NaN."""
        number = np.nan if any(on_host(array).any() for array in of.values()) else 0.0
        return {name: np.full(shape, number) for name, shape in shapes.items()}


class OneByOne(Layer):
    def __init__(self, layer: Layer, size: int):
        super().__init__()
        self._layer, self._size = layer, size
        self.real, self.device, self.on_device = layer.real, layer.device, layer.on_device
        self.kept_bytes, self.unmapped = size * layer.kept_bytes, f"{counted(size, 'evaluation')} at once"

    def check(self, given: Shapes) -> None:
        self._layer.check({name: shape[1:] for name, shape in given.items()})

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return {name: (self._size, *shape) for name, shape in self._layer.outputs().items()}

    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        found = [(copied(one), residual) for one, residual in (self._evaluated(own, keep) for own in self._each(given))]
        lost = {number: one for number, (_, one) in enumerate(found) if isinstance(one, Lost)}
        if lost:
            first, one = next(iter(lost.items()))
            said = f"{len(lost)} of {counted(self._size, 'evaluation')} were lost. First evaluation {first}: {one.why}"
            warnings.warn(said, CortadoWarning, stacklevel=2)
        return stacked([one for one, _ in found]), [residual for _, residual in found] if keep else None

    def _evaluated(self, given: Named, keep: bool) -> tuple[Named, Any]:
        """Compute one of several evaluations. The results are NaN if positions are NaN or a particle is lost."""
        shapes = {name: np.shape(array) for name, array in given.items()}
        positions = next((array for name, array in given.items() if name in POSITIONS), np.zeros(1))
        lost = Lost(shapes, "its particles had been lost in steps before it.")
        if not np.isnan(on_host(positions)).all():
            try:
                return self._layer.evaluate(given, keep)
            except DivergedError as error:
                lost = Lost(shapes, str(error))
        return {name: np.full(shape, np.nan, self.real) for name, shape in self._layer.outputs().items()}, lost

    def pull(self, residual: Any, bars: Named) -> Named:
        layer, each = self._layer, zip(residual, self._each(bars), strict=True)
        found = (own.along(one, own.given) if isinstance(own, Lost) else layer.pull(own, one) for own, one in each)
        return stacked(found)

    def push(self, residual: Any, dots: Named) -> Named:
        layer, each = self._layer, zip(residual, self._each(dots), strict=True)
        made = layer.outputs()
        found = (own.along(one, made) if isinstance(own, Lost) else layer.push(own, one) for own, one in each)
        return stacked(found)

    def _each(self, given: Named) -> list[dict[str, Array]]:
        return [rows(given, number) for number in range(self._size)]


def kept_or_made(kept: dict[K, V], key: K, make: Callable[[K], V], most: int) -> V:
    """Return the cached value of a key, or make the value. The cache has at most ``most`` values."""
    found = kept.pop(key, None) or make(key)
    kept[key] = found  # as the last used value
    while len(kept) > most:
        kept.pop(next(iter(kept)))
    return found


def on_host(array: Array) -> np.ndarray:
    return array.numpy() if isinstance(array, wp.array) else np.asarray(array)


def fill(view: Array, array: Array) -> None:
    """Copy an array to a ``view`` of the same size, on a GPU without the host if possible."""
    if isinstance(view, np.ndarray):
        view[...] = on_host(array).reshape(view.shape)
    elif (
        isinstance(array, wp.array)
        and array.dtype == view.dtype
        and (view.is_contiguous or array.device == view.device)
    ):
        wp.copy(view, array.reshape(view.shape))
    else:
        view.assign(on_host(array).reshape(view.shape))


def part(given: Mapping[str, Any], kind: str) -> dict[str, Any]:
    return {name.removeprefix(kind): array for name, array in given.items() if name.startswith(kind)}


def named(kind: str, found: Mapping[str, Any]) -> dict[str, Any]:
    return {kind + name: array for name, array in found.items()}


def rows(given: Named, chosen: int | np.ndarray) -> dict[str, Array]:
    return {name: _rows(array, chosen) for name, array in given.items()}


def stacked(found: Iterable[Named]) -> dict[str, Array]:
    """Stack the arrays of several dictionaries by name, along a new first axis. Each dictionary is copied immediately,
    because the next evaluation of a layer may overwrite the arrays."""
    tables = [copied(table) for table in found]
    return {name: _stack([table[name] for table in tables]) for name in tables[0]}


def copied(found: Named) -> Named:
    return {name: wp.clone(array) if isinstance(array, wp.array) else array for name, array in found.items()}


def _rows(array: Array, chosen: int | np.ndarray) -> Array:
    if not isinstance(array, wp.array):
        return np.asarray(array[chosen])
    if isinstance(chosen, np.ndarray):
        return _stack([_rows(array, int(one)) for one in chosen])
    return array[chosen] if array.ndim > 1 else array[chosen : chosen + 1]


def _stack(arrays: list[Array]) -> Array:
    first = arrays[0]
    if not isinstance(first, wp.array):
        return np.stack(arrays)
    shape = (len(arrays), *first.shape) if first.ndim > 1 or len(first) > 1 else (len(arrays),)
    whole = wp.empty(shape, dtype=first.dtype, device=first.device)
    for own, array in enumerate(arrays):
        wp.copy(_rows(whole, own), array)
    return whole


class NamedStates(HostStates):
    """A converter between states of a simulation and named arrays. Derivatives of states are converted too.

    The arrays have the names and shapes of the fields of a `RestartState`, and a ``time`` [s]. In a batch the first
    axis is the scene. On a GPU, the converter checks no states and derivatives, in order to avoid copies to the host.
    """

    def __init__(self, simulation: Simulation):
        super().__init__(simulation)
        self._simulation: Simulation = simulation
        self._space, self._is_cpu = ParameterSpace(simulation, 0), bool(simulation.device.is_cpu)
        self._all_packed = dict[State, Packed]()
        self._last: tuple[dict[str, bytes], tuple[RestartState, ...]] | None = None
        """Bytes of the last returned state by array name, and the restart states of its scenes. Used on a CPU only."""
        self._known: OrderedDict[bytes | int, tuple[Origin, ...]] = OrderedDict()

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        simulation = self._simulation
        members = () if simulation.batch is None else (simulation.batch,)
        last = {LAST_STEP: members} if simulation.scene.solver.chooses else {}
        return {**shapes_of_fields(simulation, simulation.batch), STATE_TIME: members, **last}

    @property
    def fields(self) -> tuple[str, ...]:
        """Return the names of the arrays that are on the device."""
        return self._simulation.initial.names

    def begin(self, space: ParameterSpace, rollout: Rollout, state: Named, values: Arrays, varied: set[str]) -> None:
        """Set the initial state and the checked parameters of a rollout. Raises `InputError` if the state does not suit
        the scene."""
        scenes = self._judged(state, values)
        space.begin(rollout, values, varied, scenes, lambda first: self._copy_to(first, state))

    def state(self, rollout: Rollout, state: State, steps: int, begun: Any = None) -> Named:
        """Return the state of a rollout after ``steps`` steps as named arrays. Arrays of lost scenes contain NaN. On a
        GPU, the next call overwrites the returned arrays."""
        found = self._returned(self.read(state, dict.fromkeys(rollout.lost, np.nan)), scenes_after(rollout, steps))
        if not self._is_cpu:
            self._later.numpy()[:] = np.ravel(found[STATE_TIME])
            found[STATE_TIME] = self._later
        return found

    def arrays(self, state: DeviceState) -> Named:
        """Return a state on the device as named arrays. On a GPU, the next reading overwrites the arrays."""
        judged = all(scene.origin and scene in self._simulation.judged_states for scene in state.scenes)
        return self._returned(self.read(state.arrays, {}), state.scenes, judged)

    def restart_states(self, given: Named, values: Arrays) -> tuple[RestartState, ...]:
        """Return the restart states of all scenes, given the parameter ``values`` of the next steps. Raises
        `InputError` if a state does not suit the scene."""
        judged = self._judged(given, values)
        found = tuple(self._states(given, [one.clock for one in judged], [one.origin for one in judged]))
        self._simulation.judged_states.update(found)
        return found

    def write(self, what: str, given: Named, to: State) -> np.ndarray:
        to.clear()
        self._copy_to(to, given)
        return self._numbers(given, STATE_TIME).reshape(self.shapes[STATE_TIME])

    def read(self, state: State, lost: OfLost) -> dict[str, Any]:
        views, packed = state.narrow(self._simulation.dimension), self._packed(state)
        if packed is None:
            found = {name: array.copy() for name, array in views.items()}
        else:
            packed.read()
            found = {name: packed.views[name] if name in packed.views else a.numpy() for name, a in views.items()}
        for b, number in lost.items():
            for array in found.values():
                member = array[b]
                member.fill(number) if isinstance(member, np.ndarray) else member.fill_(number)
        return found

    def _packed(self, state: State) -> Packed | None:
        if self._is_cpu:
            return None
        return kept_or_made(self._all_packed, state, lambda own: Packed(own, self._simulation.dimension), 8)

    def _copy_to(self, state: State, given: Named) -> None:
        views, packed = state.narrow(self._simulation.dimension), self._packed(state)
        if packed is not None and all(name in given for name in packed.views):
            flat = flat_of([given[name] for name in packed.views])
            if flat is not None and (flat.dtype, flat.device) == (packed.flat.dtype, packed.flat.device):
                wp.copy(packed.flat, flat)
                packed.write()
                views = {name: own for name, own in views.items() if name not in packed.views}
        for name, own in views.items():
            if name in given:
                fill(own, given[name])

    def _returned(
        self, fields: dict[str, Array], scenes: Sequence[RestartState], judged: bool = True
    ) -> dict[str, Array]:
        """Add the clocks of all scenes to the fields of a state. On a CPU, remember a ``judged`` state as valid."""
        members, found = self.shapes[STATE_TIME], dict(fields)
        found[STATE_TIME] = np.array([scene.clock.time for scene in scenes]).reshape(members)
        if LAST_STEP in self.shapes:
            found[LAST_STEP] = np.array([scene.clock.time_step for scene in scenes]).reshape(members)
        if self._is_cpu and judged:
            self._remember_last()
            self._last = self._bytes(found), tuple(scenes)
        return found

    def _remember_last(self) -> None:
        if self._last is not None:
            numbers, scenes = self._last
            self._remember(self._hash(numbers), tuple(scene.origin for scene in scenes if scene.origin))

    def _follows(self, given: Named, values: Arrays) -> tuple[RestartState, ...]:
        """Return the scenes of the last returned state if ``given`` is the same state. Otherwise return an
        empty tuple."""
        if self._last is None or not values.keys().isdisjoint(("time_step", "rest_density")):
            return ()
        numbers, scenes = self._last
        return scenes if self._bytes(given) == numbers else ()

    def _bytes(self, given: Named) -> dict[str, bytes]:
        real = self._simulation.precision.numpy
        return {name: np.asarray(given[name], dtype=real).tobytes() for name in self.shapes}

    def _judged(self, given: Named, values: Arrays) -> tuple[RestartState, ...]:
        """Check a state, and return restart states of all scenes without fields."""
        if scenes := self._follows(given, values):
            self._simulation.judged_states.update(scenes)
            return scenes
        self._remember_last()
        solver = self._simulation.scene.solver
        times, sizes = (self._numbers(given, name) for name in (STATE_TIME, LAST_STEP))
        steps = np.full(times.shape, values.get("time_step", 1.0 if solver.chooses else solver.time_step))
        clocks = [self._clock(*own) for own in zip(times.tolist(), steps.tolist(), sizes.tolist(), strict=True)]
        for clock in clocks:
            check_clock(clock)
        scenes = tuple(map(RestartState, repeat({}), clocks, self._origins(given, clocks, values)))
        self._simulation.judged_states.update(scenes)
        return scenes

    def _origins(self, given: Named, clocks: list[Clock], values: Arrays) -> tuple[Origin, ...]:
        own = {name: values[name] for name in ("rest_density",) if name in values}
        key = self._hash(self._bytes(given)) if self._is_cpu else np.asarray(own.get("rest_density", ())).tobytes()
        if key not in self._known:
            if self._is_cpu:
                self._space.check_restarts(self._states(given, clocks, [None] * len(clocks)), own)
            densities = self._simulation.parameters()["rest_density"]
            each = (np.atleast_1d(one.get("rest_density", densities)) for one in self._space.members(own))
            self._remember(key, tuple(origin_of(self._simulation, density) for density in each))
        return self._known[key]

    def _states(self, given: Named, clocks: Sequence[Clock], origins: Sequence[Origin | None]) -> list[RestartState]:
        real, batch = self._simulation.precision.numpy, self._simulation.batch
        kinds = {f.name: np.float64 if f.entry is Entry.DOUBLE else real for f in self._simulation.initial.fields}
        arrays: dict[str, np.ndarray] = {name: on_host(given[name]).astype(kind) for name, kind in kinds.items()}
        each = [arrays] if batch is None else [{name: array[b] for name, array in arrays.items()} for b in range(batch)]
        return [RestartState(*own).fixed() for own in zip(each, clocks, origins, strict=True)]

    def _numbers(self, given: Named, name: str) -> np.ndarray:
        members, array = self._simulation.batch or 1, given.get(name)
        if isinstance(array, wp.array) and array.device.is_cuda and array.dtype == self._pinned.dtype:
            wp.copy(self._pinned, array)
            wp.synchronize_stream(array.device)
            array = self._pinned
        return np.zeros(members) if array is None else on_host(array).astype(np.float64).reshape(members)

    @cached_property
    def _pinned(self) -> wp.array:
        members, real = self._simulation.batch or 1, self._simulation.precision.real
        return wp.empty(members, dtype=real, device="cpu", pinned=True)

    @cached_property
    def _later(self) -> wp.array:
        """Times of the last returned state. The next call waits for the device before overwriting the times."""
        return wp.empty_like(self._pinned, pinned=True)

    def _clock(self, time: float, step: float, last: float) -> Clock:
        """Return the clock of a state at a rounded ``time`` [s]. If the time is a multiple of ``step``, the clock
        counts time steps, so that later times are bitwise equal to the times of an uninterrupted run."""
        if self._simulation.scene.solver.chooses:
            return Clock(0, time, last)
        steps = round(time / step) if np.isfinite(time) and time >= 0.0 else 0
        room = 2.0 * float(np.finfo(self._simulation.precision.numpy).eps)
        return Clock(steps, steps * step) if abs(time - steps * step) <= room * time else Clock(0, time)

    def _remember(self, key: bytes | int, origins: tuple[Origin, ...]) -> None:
        self._known[key] = origins
        while len(self._known) > 256:
            self._known.popitem(last=False)

    def _hash(self, numbers: Mapping[str, bytes]) -> int:
        return hash(tuple(numbers[name] for name in self.fields))


def check_state(given: Shapes, wanted: Shapes) -> None:
    if not given:
        raise InputError(f"state is left out, but must have {', '.join(wanted)} in this scene.")
    if given.keys() != wanted.keys():
        raise InputError(f"state has {', '.join(given)}, but must have {', '.join(wanted)} in this scene.")
    for name, shape in wanted.items():
        if given[name] != shape:
            raise InputError(f"state {name} has shape {given[name]}, but must be {shape}.")


def named_states(simulation: Simulation) -> NamedStates:
    found: NamedStates = simulation.__dict__.get("_named_states") or NamedStates(simulation)
    simulation.__dict__["_named_states"] = found
    return found
