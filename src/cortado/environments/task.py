"""What an environment is about, a scene, what actions move, what a step is rewarded with, and how episodes begin; and
many scenes of it in one launch.

A `Task` is all of that; those of Cortado are in `cortado.environments.catalogue`. An `Actuator` makes of actions,
numbers between -1 and 1 that are held for a step of an environment, a parameter over time. All of it is linear in the
actions, so that derivatives with respect to them are a matrix. `Scenes` steps many scenes of one task together, rewards
them, begins their episodes, and observes them.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.arrays import as_numbers
from cortado.device.launching import launch
from cortado.device.threads import WARP
from cortado.environments.kernels import environment_kernels
from cortado.environments.terms import Reward
from cortado.errors import CortadoWarning, InputError, shown
from cortado.losses.loss import SnapshotBatch
from cortado.optimisation.transforms import Affine
from cortado.particles.state import State
from cortado.rollout.device_states import DeviceState
from cortado.rollout.stepper import Stepper
from cortado.runs.probes import warn_of_places
from cortado.runs.quantity_values import Moment, row_of
from cortado.runs.sensor import Sensor, checked_sensor, value_of
from cortado.scene.motions import AXES, angular_velocity_name, position_name, velocity_name
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

FINENESS = {"small": 1, "large": 3}
"""Factor of refinement by size: so many times more particles along each axis, and steps shorter by it."""
JITTER = 0.02
"""Standard deviation of the noise of first positions, in spacings."""


@dataclass(frozen=True)
class Actuator(ABC):
    """A driver of some components of one parameter over time. In a step of the environment its command moves linearly
    from the last one to ``greatest`` times the action, without jumps."""

    parameter: str
    """Name of the driven parameter, such as "cup.displacement"."""
    rest: tuple[float, ...]
    """Value (d,) of the parameter before any action; a single entry where it is a number."""
    axes: tuple[int, ...]
    """Indices (a,) of the driven components."""
    greatest: tuple[float, ...]
    """Commands (a,) for an action of 1."""
    is_number: bool = False
    """True if the parameter is a number at each step, as a turn in the plane is."""

    @abstractmethod
    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        """Return the driven components (..., a) after a step of the simulation."""

    def at_rest(self, members: int) -> NDArray:
        """Return the driven components and the commands before any action, (members, 2, a)."""
        return np.zeros((members, 2, len(self.axes)))

    def advance(self, now: NDArray, u: NDArray, steps: int, time_step: float) -> tuple[NDArray, NDArray]:
        """Return the components and commands (members, 2, a) after so many steps under actions ``u`` (members, a), and
        the parameter after each step, (members, steps, d) or (members, steps)."""
        driven, last = [now[:, 0]], now[:, 1]
        wanted = np.array(self.greatest) * u
        for j in range(steps):
            driven.append(self.after(driven[-1], last + (wanted - last) * ((j + 1) / steps), time_step))
        return np.stack([driven[-1], wanted], axis=1), self.value(np.stack(driven[1:], axis=1))

    def value(self, q: NDArray) -> NDArray:
        """Return the parameter, (..., d) or (...), given its driven components (..., a)."""
        found = np.tile(np.array(self.rest, dtype=np.float64), (*q.shape[:-1], 1))
        found[..., self.axes] += q
        return found[..., 0] if self.is_number else found

    def over(self, actions: int, steps: int, time_step: float) -> Affine:
        """Return the parameter as an affine function of actions (actions, a), each held for ``steps`` steps of the
        simulation."""
        a = len(self.axes)
        units = np.concatenate([np.zeros((1, actions, a)), np.eye(actions * a).reshape(-1, actions, a)])
        now, parts = self.at_rest(len(units)), []
        for k in range(actions):
            now, rows = self.advance(now, units[:, k], steps, time_step)
            parts.append(rows)
        base, *columns = np.concatenate(parts, axis=1)
        return Affine(base, np.stack([one - base for one in columns], axis=-1).reshape(*base.shape, actions, a))


@dataclass(frozen=True)
class Velocity(Actuator):
    """An actuator whose actions are velocities: q' = c, with ``greatest`` in m/s or rad/s."""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step * command


@dataclass(frozen=True)
class Position(Actuator):
    """An actuator whose actions are places, or other values, approached with a lag: q' = (c - q) / lag."""

    lag: float = 0.1
    """Time constant of the approach [s]."""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step / self.lag * (command - q)


@dataclass(frozen=True)
class Task(ABC):
    """A task of control in the plane: a scene, its actuators, rewards and goals, in a small or a large size."""

    size: str = "small"
    """"small", 100 to 200 particles for a processor, or "large", with nine times as many, for a GPU."""
    name: ClassVar[str]
    horizon: ClassVar[int]
    """Steps of the environment after which an episode is truncated."""
    repeats: ClassVar[int]
    """Steps of the small simulation in one step of the environment."""
    coarse_spacing: ClassVar[float]
    """Particle spacing of the small size [m]."""
    coarse_step: ClassVar[float]
    """Time step of the small size [s]."""
    lowest: ClassVar[float]
    """Least reward of a step, which a diverged episode gets for each step that it lacks."""
    free_solids: ClassVar[tuple[str, ...]] = ()
    """Names of the solids that the fluid moves, which are observed."""
    goal_names: ClassVar[tuple[str, ...]] = ()
    """Descriptions of the numbers of a goal, with their units."""

    def __post_init__(self) -> None:
        if self.size not in FINENESS:
            raise InputError(f'size is {shown(self.size)}, but must be "small" or "large".')

    @property
    def spacing(self) -> float:
        """Particle spacing of the scene [m]."""
        return self.coarse_spacing / FINENESS[self.size]

    @property
    def time_step(self) -> float:
        """The time step of the simulation [s]."""
        return self.coarse_step / FINENESS[self.size]

    @property
    def substeps(self) -> int:
        """Steps of the simulation in one step of the environment."""
        return self.repeats * FINENESS[self.size]

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """The scene that the environment simulates."""

    @property
    @abstractmethod
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators, in the order of the numbers of an action."""

    @property
    def driven(self) -> list[str]:
        """Names of the parameters that actions drive."""
        return [one.parameter for one in self.actuators]

    @abstractmethod
    def reward(self, simulation: Simulation) -> Reward:
        """Return the reward function of a step, given a simulation of the scene."""

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        """Lower and upper bounds (g,) within which goals of episodes are drawn."""
        return np.zeros(0), np.zeros(0)

    def scene_of(self, **tables: Any) -> Scene:
        """Make a scene from tables and the settings that all sizes of the task share."""
        common: dict[str, Any] = {
            "name": self.name,
            "discretisation": {"spacing": self.spacing},
            "solver": {"time_step": self.time_step},
        }
        return Scene(dimension=2, **{**common, **tables})


def checked_actions(what: str, given: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return actions clipped to -1 and 1; raises `InputError` for another shape and for values that are not finite."""
    array = as_numbers(what, given)
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, but must be {shape}.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} has a value that is not finite, but must be numbers from -1 to 1.")
    return np.clip(array, -1.0, 1.0)


def split(actuators: Sequence[Actuator], actions: NDArray) -> list[NDArray]:
    """Split actions (..., a) into one array for each actuator."""
    return np.split(actions, np.cumsum([len(one.axes) for one in actuators])[:-1], axis=-1)


LANES = 1
"""Lanes per particle, fastest for large batches; small ones use as many, which keeps a scene's bits equal in all."""
SEEN = 32
"""Number of observed particles by default."""


@dataclass(frozen=True, eq=False)
class Start:
    """The start of an episode of one scene: positions and a goal."""

    positions: NDArray
    """Positions (n, d) of the particles [m]."""
    goal: NDArray
    """Goal (g,) of the episode."""


class Scenes:
    """A batch of scenes of one task that are stepped together, each in an episode of its own."""

    def __init__(
        self,
        task: Task,
        scenes: int,
        device: str,
        precision: str,
        seen: int,
        sensors: Mapping[str, Sensor] | None = None,
    ):
        """Make ``scenes`` scenes; ``seen``: how many particles are observed, at most all."""
        self._sensors = checked_sensors(sensors, {"particles", "goal", "progress", *task.free_solids, *task.driven})
        self.task = task
        self.simulation = Simulation(task.scene, device, precision, batch=scenes, lanes=LANES)
        warn_of_places(self.simulation, self._sensors)
        self._domain, self._stepper = self.simulation.lattice.domain, Stepper(self.simulation, task.substeps)
        self.reward = replace(task.reward(self.simulation), domain=self._domain)
        self._first = self.simulation.on_device()
        n, free = self.simulation.particles, self.simulation.free_particles or self.simulation.particles
        if not isinstance(seen, int) or not 0 <= seen <= n:
            raise InputError(
                f"particles is {shown(seen)}, but must be a whole number from 0 to {n}, those of the scene."
            )
        self._seen = np.linspace(0, n - 1, seen).astype(int)
        self._jitters = (np.arange(n) < free)[:, None] * JITTER * task.spacing
        self.state: DeviceState = self._first
        self.step_number = np.zeros(scenes, dtype=int)
        """(scenes,) steps of the environment since each episode began."""
        self.goal = np.zeros((scenes, len(task.goals[0])))
        """(scenes, g)"""
        self._now = [one.at_rest(scenes) for one in task.actuators]
        self.starts: list[Start] = [Start(self.simulation.positions, self.goal[b]) for b in range(scenes)]
        """Of each scene's episode."""
        self._lost: set[int] = set()
        """Scenes that have diverged, and have no numbers."""
        still = {name: np.repeat(row, task.substeps, axis=1) for name, row in self._driven.items()}
        with warnings.catch_warnings():  # see `advance`
            warnings.simplefilter("ignore", CortadoWarning)
            self._stepper.advance(self._first, still)  # so that other steps can follow

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.step_number)

    def drawn(self, generator: np.random.Generator) -> Start:
        """Draw the start of an episode: first positions with noise, and a goal."""
        noise = generator.standard_normal(self.simulation.positions.shape)
        return Start(self.simulation.positions + self._jitters * noise, generator.uniform(*self.task.goals))

    @WARP
    def begin(self, starts: Mapping[int, Start]) -> None:
        """Begin episodes of some scenes, by their number."""
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
        """Step all scenes with actions (scenes, a) from -1 to 1, and return the rewards (scenes,) and, by number, a
        sentence on each scene that diverged; it has to begin anew before the next step."""
        self.advance(actions)
        rewards = self.reward.values(self.reward.at(self.state.arrays, self.goal, self.step_number))
        lost = {}
        for b, error in self._stepper.rollout.lost.items():
            lost[b] = f"The episode ended in its step {self.step_number[b]}: {error}"
            # As if every step that is left had the least reward: to end early is never worth it.
            rewards[b] = self.task.lowest * max(self.task.horizon - self.step_number[b] + 1, 1)
        self._lost = set(lost)
        return rewards, lost

    def advance(self, actions: NDArray) -> None:
        """Take the steps of the simulation that make one step of the environment."""
        task, rows = self.task, {}
        for k, (one, u) in enumerate(zip(task.actuators, split(task.actuators, actions), strict=True)):
            self._now[k], rows[one.parameter] = one.advance(self._now[k], u, task.substeps, task.time_step)
        with warnings.catch_warnings():  # of a loose pressure, and of lost scenes, which are told of otherwise
            warnings.simplefilter("ignore", CortadoWarning)
            self.state = self._stepper.follow(self.state, rows)
        self.step_number += 1

    @property
    def parts(self) -> dict[str, NDArray]:
        """Observed arrays by name, with a first axis for the scenes: see `docs/environments.md`."""
        arrays, task = self.state.arrays, self.task
        now = {one.parameter: own for one, own in zip(task.actuators, self._now, strict=True)}
        free = {name: self._free(arrays, name) for name in task.free_solids}
        share = self.step_number[:, None] / task.horizon
        found = {"particles": self._particles(arrays), **now, **free, "goal": self.goal, "progress": share}
        return {**found, **self._read(arrays)}

    @property
    def _driven(self) -> dict[str, NDArray]:
        """Present values of the parameters that actions drive, (scenes, 1, ...) by name."""
        each = zip(self.task.actuators, self._now, strict=True)
        return {one.parameter: one.value(now[:, None, 0]) for one, now in each}

    def observed(self) -> NDArray[np.float32]:
        """Return all observations (scenes, k) as float32; rows of diverged scenes are meaningless."""
        flat = [np.reshape(part, (len(self), -1)) for part in self.parts.values()]
        return np.concatenate(flat, axis=1, dtype=np.float32, casting="same_kind")

    @property
    def layout(self) -> dict[str, slice]:
        """Slices of an observation by the name of its parts."""
        ends = np.cumsum([0, *(part[0].size for part in self.parts.values())]).tolist()
        return {name: slice(*ends[k : k + 2]) for k, name in enumerate(self.parts)}

    @WARP
    def _particles(self, state: State) -> NDArray[np.float32]:
        """Return positions and velocities of the observed particles, (scenes, seen, 2, d)."""
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
        """Return the readings (scenes, k) of each sensor by name, with present driven parameters."""
        if not self._sensors:
            return {}
        if self._lost:  # so that all are numbers
            state = state.copy()
            for b in self._lost:
                state.member(b).assign(self._first.arrays.member(b))
        simulation, rollout = self.simulation, self._stepper.rollout
        row = rollout.steps - 1
        parameters = {**row_of(rollout, rollout.parameters.written, row), **self._driven}
        moment = Moment(state, parameters, rollout.substeps, row, simulation.evaluator)
        colours = np.zeros((len(self), len(simulation.scene.phase), 3))
        end = SnapshotBatch(state, simulation.dimension, colours, moment)
        return {name: np.array([value_of(sensor, one) for one in end]) for name, sensor in self._sensors.items()}

    def _free(self, state: State, name: str) -> NDArray:
        """Return for a free body (scenes, 7): place, cosine and sine of its turn, velocity and angular velocity."""
        fields = position_name(name), f"{name}.{AXES[0]}", velocity_name(name)
        place, axis, velocity = (state[field].numpy()[:, :2] for field in fields)
        rate = state[angular_velocity_name(name)].numpy()[:, None]
        place = self._domain.wrapped(place)
        return np.concatenate([place, axis + [1.0, 0.0], velocity, rate], axis=1)


def checked_sensors(given: Mapping[str, Sensor] | None, taken: set[str]) -> dict[str, Sensor]:
    """Return sensors by name; raises `InputError` for names that are ``taken`` and for anything but sensors."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"sensors is {shown(given)}, but must be a table of sensors by name, {{'gauge': sensor}}.")
    for name in given:
        if not isinstance(name, str) or name in taken:
            raise InputError(
                f"sensors has the name {shown(name)}, but must have texts other than {', '.join(sorted(taken))}."
            )
    return {name: checked_sensor(sensor) for name, sensor in given.items()}
