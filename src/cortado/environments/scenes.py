"""Step many scenes of one task together, and save and restore their states."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.calls import counted
from cortado.device.launching import LEAST_PART, launch
from cortado.device.threads import MOST_CORES, WARP, in_parallel, usable_cores
from cortado.environments.kernels import environment_kernels
from cortado.environments.task import Task, checked_scene, split
from cortado.environments.terms import StepEnd
from cortado.errors import DivergedError, InputError, MassWarning, shown, unwarned
from cortado.losses.loss import SnapshotBatch
from cortado.particles.state import State
from cortado.rollout.device_states import DeviceState
from cortado.rollout.stepper import Stepper
from cortado.runs.probes import warn_of_places
from cortado.runs.quantity_values import Moment, row_of
from cortado.runs.sensor import Sensor, checked_sensors, value_of
from cortado.scene.motions import AXES, angular_velocity_name, position_name, velocity_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

JITTER = 0.02
LANES = 1
"""Number of threads per particle. A fixed number makes results bitwise equal for all batch sizes."""
SEEN = 32
MOST_PARTS = 16
"""Greatest number of parts of a batch. A larger batch is computed whole, with all cores but without graphs."""


@dataclass(frozen=True, eq=False)
class Start:
    positions: NDArray
    """Positions (n, d) [m]."""
    goal: NDArray


@dataclass(frozen=True, eq=False, repr=False)
class EnvState:
    """The saved state of an environment or a batch, returned by `save` and accepted by `restore`.

    The saved state shares device arrays with the environment. No step overwrites the arrays of a saved state. A pickled
    state contains NumPy arrays.
    """

    kind: str
    """Text on scenes, task, size, precision and observation. `restore` requires equal texts."""
    scene: Scene
    fields: Mapping[str, Any]
    """Fields of the fluid by name (scenes * n,), as Warp or NumPy arrays."""
    clocks: tuple[RestartState, ...]
    step_number: NDArray
    """Number of environment steps in the episode of each scene (scenes,)."""
    starts: tuple[Start, ...]
    driven: tuple[NDArray, ...]
    """Driven components and commands of each actuator (scenes, 2, a)."""
    lost: frozenset[int]
    over: NDArray
    """Mask (scenes,) of ended episodes."""
    observations: NDArray
    """Last observation of each scene (scenes, k)."""
    generators: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.step_number)

    @WARP
    def __getitem__(self, numbers: int | Iterable[int]) -> "EnvState":
        """Return the state of a batch that consists of the chosen scenes. A number may occur several times: ``state[[0]
        * 8]`` is a batch of eight copies of scene 0, with equal random generators."""
        chosen = list(numbers) if isinstance(numbers, Iterable) else [numbers]
        if not chosen or any(not isinstance(b, (int, np.integer)) or not 0 <= b < len(self) for b in chosen):
            raise InputError(f"numbers are {shown(numbers)}, but must be scene numbers from 0 to {len(self) - 1}.")
        arrays: Any = {name: getattr(self, name)[chosen] for name in ("step_number", "over", "observations")}
        for name in ("clocks", "starts", "generators"):
            arrays[name] = tuple(getattr(self, name)[b] for b in chosen)
        fields = {}
        for name, array in self.fields.items():
            n = len(array) // len(self)
            fields[name] = _joined([array[b * n : (b + 1) * n] for b in chosen])
        return replace(
            self,
            kind=self.kind.replace(counted(len(self), "scene"), counted(len(chosen), "scene"), 1),
            fields=fields,
            driven=tuple(one[chosen] for one in self.driven),
            lost=frozenset(k for k, b in enumerate(chosen) if b in self.lost),
            **arrays,
        )

    def __repr__(self) -> str:
        return f"EnvState({self.kind}, after steps {self.step_number.tolist()})"

    @WARP
    def __getstate__(self) -> dict[str, Any]:
        fields = {name: a if isinstance(a, np.ndarray) else a.numpy() for name, a in self.fields.items()}
        return {**vars(self), "fields": fields}


@WARP
def _joined(parts: list[Any]) -> Any:
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    whole, begin = wp.empty(sum(map(len, parts)), dtype=parts[0].dtype, device=parts[0].device), 0
    for part in parts:
        wp.copy(whole, part, dest_offset=begin)
        begin += len(part)
    return whole


def parts_of(simulation: Simulation) -> int:
    scenes, cores = simulation.batch or 1, min(usable_cores(), MOST_CORES)
    together = (2 * LEAST_PART - 1) // simulation.particles
    if not simulation.device.is_cpu or cores == 1 or not together or scenes <= together:
        return 1
    parts = -(-scenes // together)
    if parts > cores:
        parts = -(-parts // cores) * cores
    return parts if parts <= min(scenes, MOST_PARTS) else 1


class SideBySide:
    """A stepper that splits a batch into parts, because only small launches on a CPU are captured as graphs. Results
    with and without the split are bitwise equal."""

    def __init__(self, simulation: Simulation, make: Callable[[int], Simulation], parts: int, steps: int):
        scenes = simulation.batch or 1
        self._ranges = list(pairwise(scenes * k // parts for k in range(parts + 1)))
        self._simulations = [simulation] if parts == 1 else [make(last - first) for first, last in self._ranges]
        self.steppers = [Stepper(one, steps) for one in self._simulations]

    @property
    def lost(self) -> dict[int, DivergedError]:
        each = zip(self._ranges, self.steppers, strict=True)
        return {first + b: error for (first, _), one in each for b, error in one.rollout.lost.items()}

    def begin(self, rows: Arrays) -> None:
        for (first, last), one, simulation in zip(self._ranges, self.steppers, self._simulations, strict=True):
            one.advance(simulation.on_device(), {name: row[first:last] for name, row in rows.items()})

    def follow(self, state: DeviceState, rows: Arrays) -> DeviceState:
        if len(self.steppers) == 1:
            return self.steppers[0].follow(state, rows)
        found: dict[int, DeviceState] = {}

        def take(k: int) -> None:
            first, last = self._ranges[k]
            scenes = state.scenes[first:last]
            self._simulations[k].judged_states.update(scenes)
            own = {name: row[first:last] for name, row in rows.items()}
            whole, arrays = state.arrays, {}
            for name in whole.names:
                size = len(whole[name]) // len(state.scenes)
                arrays[name] = whole[name][first * size : last * size]
            found[k] = self.steppers[k].follow(DeviceState(State(whole.fields, arrays, last - first), scenes), own)

        in_parallel(take, range(len(self.steppers)), min(usable_cores(), MOST_CORES, len(self.steppers)))
        parts, like = [found[k] for k in range(len(self.steppers))], state.arrays
        joined = {name: _joined([one.arrays[name] for one in parts]) for name in like.names}
        return DeviceState(State(like.fields, joined, like.batch), tuple(one for part in parts for one in part.scenes))


class Scenes:
    """A batch of scenes of one task. Each scene has a separate episode."""

    def __init__(
        self, task: Task, scenes: int, device: str, precision: str, seen: int, sensors: Mapping[str, Sensor] | None
    ):
        self._sensors = checked_sensors(sensors, {"particles", "goal", "progress", *task.free_solids, *task.driven})
        self.task = task
        with unwarned(MassWarning):  # rewards are fractions of the fluid, whatever its mass
            make = partial(Simulation, checked_scene(task), device, precision, lanes=LANES)
            self.simulation = make(batch=scenes)
            parts = 1 if self._sensors else parts_of(self.simulation)  # sensors read the step of a whole
            self._steps = SideBySide(self.simulation, lambda count: make(batch=count), parts, task.substeps)
        warn_of_places(self.simulation, self._sensors)
        self._domain = self.simulation.lattice.domain
        self.reward = replace(task.reward(self.simulation), domain=self._domain)
        self._first = self.simulation.on_device()
        n, free = self.simulation.particles, self.simulation.free_particles or self.simulation.particles
        if not isinstance(seen, int) or not 0 <= seen <= n:
            raise InputError(f"particles is {shown(seen)}, but must be from 0 to {n}, the scene's particles.")
        self._seen = np.linspace(0, n - 1, seen).astype(int)
        self._jitters = (np.arange(n) < free)[:, None] * JITTER * task.spacing
        self.state: DeviceState = self._first
        self.step_number = np.zeros(scenes, dtype=int)
        self.goal = np.zeros((scenes, len(task.goals[0])))
        self._now = [one.at_rest(scenes) for one in task.actuators]
        self.starts: list[Start] = [Start(self.simulation.positions, self.goal[b]) for b in range(scenes)]
        self._lost: set[int] = set()
        """Numbers of diverged scenes, whose states are meaningless."""
        self._given = task, scenes, device, precision, seen, sensors
        still = {name: np.repeat(row, task.substeps, axis=1) for name, row in self._driven.items()}
        with unwarned():  # see `advance`
            self._steps.begin(still)

    def __len__(self) -> int:
        return len(self.step_number)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._given, self.save())

    @cached_property
    def kind(self) -> str:
        seen = counted(max(one.stop for one in self.layout.values()), "observed number")
        of = f"the task {self.task.name}, {self.task.size}, in {self.simulation.precision.name} with {seen}"
        return f"{counted(len(self), 'scene')} of {of}"

    @cached_property
    def single(self) -> Simulation:
        with unwarned(MassWarning):
            return Simulation(self.task.scene, self.simulation.device.alias, self.simulation.precision.name)

    def save(self, over: NDArray | None = None, observations: NDArray | None = None, generators: Any = ()) -> EnvState:
        arrays, none = self.state.arrays, np.zeros(len(self))
        return EnvState(
            kind=self.kind,
            scene=self.simulation.scene,
            fields={name: arrays[name] for name in arrays.names},
            clocks=self.state.scenes,
            step_number=self.step_number.copy(),
            starts=tuple(self.starts),
            driven=tuple(now.copy() for now in self._now),
            lost=frozenset(self._lost),
            over=none.astype(bool) if over is None else over.copy(),
            observations=none[:, None] if observations is None else observations.copy(),
            generators=tuple(generators),
        )

    @WARP
    def taken(self, saved: EnvState) -> DeviceState:
        if not isinstance(saved, EnvState):
            raise InputError(f"state is {shown(saved)}, but must be an EnvState, as save returns.")
        own = self.simulation.scene
        if saved.kind != self.kind or (saved.scene is not own and saved.scene != own):
            other = saved.kind if saved.kind != self.kind else f"another scene than that of {self.kind}"
            raise InputError(f"state is of {other}, but must be of {self.kind}, with the same scene.")
        arrays = self._first.arrays.copy()
        for name in arrays.names:
            arrays[name].assign(saved.fields[name])
        self.simulation.judged_states.update(saved.clocks)
        return DeviceState(arrays, saved.clocks)

    def restore(self, saved: EnvState) -> None:
        self.state = self.taken(saved)
        self.step_number, self.starts, self._lost = saved.step_number.copy(), list(saved.starts), set(saved.lost)
        self.goal = np.stack([start.goal for start in saved.starts])
        self._now = [now.copy() for now in saved.driven]

    def drawn(self, generator: np.random.Generator) -> Start:
        noise = generator.standard_normal(self.simulation.positions.shape)
        return Start(self.simulation.positions + self._jitters * noise, generator.uniform(*self.task.goals))

    @WARP
    def begin(self, starts: Mapping[int, Start]) -> None:
        if not starts:
            return
        arrays, first = self.state.arrays.copy(), self._first.arrays
        if len(starts) == len(self):
            arrays.assign(first)
            arrays.set({"positions": np.stack([starts[b].positions for b in range(len(self))])})
        for b, start in starts.items():
            if len(starts) < len(self):
                own = arrays.member(b)
                own.assign(first.member(b))
                own.set({"positions": start.positions})
            self.starts[b], self.goal[b], self.step_number[b] = start, start.goal, 0
            self._lost.discard(b)
            for now in self._now:
                now[b] = 0.0
        scenes = [self._first.scenes[b] if b in starts else scene for b, scene in enumerate(self.state.scenes)]
        self.state = DeviceState(arrays, tuple(scenes))

    def step(self, actions: NDArray) -> tuple[NDArray, dict[int, str]]:
        """Step all scenes with actions (scenes, a). Return rewards (scenes,), and errors of diverged scenes."""
        self.advance(actions)
        rewards = self.reward.values(StepEnd(self.state.arrays, self.goal, self.step_number, self._domain))
        lost = {}
        for b, error in self._steps.lost.items():
            lost[b] = f"The episode ended in its step {self.step_number[b]}: {error}"
            # As if every step that is left had the least reward: to end early is never worth it.
            rewards[b] = self.task.lowest * max(self.task.horizon - self.step_number[b] + 1, 1)
        self._lost = set(lost)
        return rewards, lost

    def advance(self, actions: NDArray) -> None:
        task, rows = self.task, {}
        for k, (one, u) in enumerate(zip(task.actuators, split(task.actuators, actions), strict=True)):
            self._now[k], rows[one.parameter] = one.advance(self._now[k], u, task.substeps, task.time_step)
        with unwarned():  # of a loose pressure, and of lost scenes, which `step` reports
            self.state = self._steps.follow(self.state, rows)
        self.step_number += 1

    @property
    def parts(self) -> dict[str, NDArray]:
        """Return the observed arrays by name, with a first axis for the scenes. See `docs/environments.md`."""
        state, task = self.state.arrays, self.task
        found: dict[str, NDArray] = {"particles": self._particles(state)}
        found |= {one.parameter: own for one, own in zip(task.actuators, self._now, strict=True)}
        for name in task.free_solids:  # position, cosine and sine of the angle, velocity and angular velocity
            fields = position_name(name), f"{name}.{AXES[0]}", velocity_name(name)
            place, axis, velocity = (state[field].numpy()[:, :2] for field in fields)
            rate = state[angular_velocity_name(name)].numpy()[:, None]
            found[name] = np.concatenate([self._domain.wrapped(place), axis + [1.0, 0.0], velocity, rate], axis=1)
        found |= {"goal": self.goal, "progress": self.step_number[:, None] / task.horizon}
        return found | self._read(state) if self._sensors else found

    @property
    def _driven(self) -> dict[str, NDArray]:
        """Return the current values of the parameters that actuators drive (scenes, 1, ...), by name."""
        each = zip(self.task.actuators, self._now, strict=True)
        return {one.parameter: one.value(now[:, None, 0]) for one, now in each}

    def observed(self) -> NDArray[np.float32]:
        """Return all observations (scenes, k) as float32. Observations of diverged scenes are meaningless."""
        flat = [np.reshape(part, (len(self), -1)) for part in self.parts.values()]
        return np.concatenate(flat, axis=1, dtype=np.float32, casting="same_kind")

    @cached_property
    def layout(self) -> dict[str, slice]:
        ends = np.cumsum([0, *(part[0].size for part in self.parts.values())]).tolist()
        return {name: slice(*ends[k : k + 2]) for k, name in enumerate(self.parts)}

    @WARP
    def _particles(self, state: State) -> NDArray[np.float32]:
        x, dimension = state.positions, self.simulation.dimension
        shape = len(self), len(self._seen), 2, dimension
        if not len(self._seen):
            return np.zeros(shape, dtype=np.float32)
        seen = wp.empty(shape, dtype=wp.float32, device=x.device)
        chosen = wp.array(self._seen, dtype=wp.int32, device=x.device)
        threads, kernel = (*shape[:2], dimension), environment_kernels(self.simulation.precision).sample
        own = {"per": self.simulation.particles, "chosen": chosen, "x": x, "v": state.velocities, "seen": seen}
        period = zip(("origin", "period", "frequency"), self._domain.vectors(x.dtype), strict=True)
        launch(kernel, threads, x.device, **dict(period), **own)
        return seen.numpy()

    def _read(self, state: State) -> dict[str, NDArray]:
        if self._lost:  # so that all are numbers
            state = state.copy()
            for b in self._lost:
                state.member(b).assign(self._first.arrays.member(b))
        simulation, rollout = self.simulation, self._steps.steppers[0].rollout
        parameters = row_of(rollout, rollout.parameters.written, rollout.steps)
        for name, at_rest in self._driven.items():  # where an episode begins; after a step what is driven goes on
            begins = np.reshape(self.step_number == 0, (-1, *(1,) * (at_rest.ndim - 1)))
            parameters[name] = np.where(begins, at_rest, parameters[name])
        moment = Moment(state, parameters, rollout.substeps, rollout.steps, simulation.evaluator)
        colours = np.zeros((len(self), len(simulation.scene.phase), 3))
        end = SnapshotBatch(state, simulation.dimension, colours, moment)
        return {name: np.array([value_of(sensor, one) for one in end]) for name, sensor in self._sensors.items()}


def _made_again(given: tuple[Any, ...], saved: EnvState) -> Scenes:
    scenes = Scenes(*given)
    scenes.restore(saved)
    return scenes
