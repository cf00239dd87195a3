"""Many scenes of one task in one launch: what steps them, rewards them, begins their episodes, and observes them."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import launch
from cortado.device.threads import WARP
from cortado.environments.kernels import environment_kernels
from cortado.environments.task import JITTER, Task, split
from cortado.errors import CortadoWarning, InputError, shown
from cortado.losses.loss import SnapshotBatch
from cortado.particles.state import State
from cortado.rollout.device_states import DeviceState
from cortado.rollout.stepper import Stepper
from cortado.runs.probes import warn_of_places
from cortado.runs.quantity_values import Moment, row_of
from cortado.runs.sensor import Sensor, checked_sensor, value_of
from cortado.scene.motions import AXES, angular_velocity_name, position_name, velocity_name
from cortado.simulation import Simulation

LANES = 1
"""What is fastest for the large batches that environments are made for, and the same in small ones, so that a scene has
the same bits in all."""
SEEN = 32
"""Particles that are observed, if not said otherwise."""


@dataclass(frozen=True, eq=False)
class Start:
    """How the episode of a scene begins."""

    positions: NDArray
    """(n, d) of the particles [m]"""
    goal: NDArray
    """(g,)"""


class Scenes:
    """Scenes that are stepped together, each in an episode of its own."""

    def __init__(
        self,
        task: Task,
        scenes: int,
        device: str,
        precision: str,
        seen: int,
        sensors: Mapping[str, Sensor] | None = None,
    ):
        """``seen``: how many particles are observed, at most all."""
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
        """The start of an episode: noise on the first positions, and a goal."""
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
        """Step all scenes with actions (scenes, a) from -1 to 1; returns the rewards (scenes,), and what happened to
        scenes that diverged, by their number. Such a scene has to begin anew before the next step."""
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
        """The steps of the simulation in a step of the environment."""
        task, rows = self.task, {}
        for k, (one, u) in enumerate(zip(task.actuators, split(task.actuators, actions), strict=True)):
            self._now[k], rows[one.parameter] = one.advance(self._now[k], u, task.substeps, task.time_step)
        with warnings.catch_warnings():  # of a loose pressure, and of lost scenes, which are told of otherwise
            warnings.simplefilter("ignore", CortadoWarning)
            self.state = self._stepper.follow(self.state, rows)
        self.step_number += 1

    @property
    def parts(self) -> dict[str, NDArray]:
        """What is observed of each scene, by name, with a first axis for the scenes: see `docs/environments.md`."""
        arrays, task = self.state.arrays, self.task
        now = {one.parameter: own for one, own in zip(task.actuators, self._now, strict=True)}
        free = {name: self._free(arrays, name) for name in task.free_solids}
        share = self.step_number[:, None] / task.horizon
        found = {"particles": self._particles(arrays), **now, **free, "goal": self.goal, "progress": share}
        return {**found, **self._read(arrays)}

    @property
    def _driven(self) -> dict[str, NDArray]:
        """The parameters that actions drive, as they are (scenes, 1, ...)."""
        each = zip(self.task.actuators, self._now, strict=True)
        return {one.parameter: one.value(now[:, None, 0]) for one, now in each}

    def observed(self) -> NDArray[np.float32]:
        """(scenes, k) all of that; of scenes that have diverged it means nothing."""
        flat = [np.reshape(part, (len(self), -1)) for part in self.parts.values()]
        return np.concatenate(flat, axis=1, dtype=np.float32, casting="same_kind")

    @property
    def layout(self) -> dict[str, slice]:
        """Where in an observation each of its parts is."""
        ends = np.cumsum([0, *(part[0].size for part in self.parts.values())]).tolist()
        return {name: slice(*ends[k : k + 2]) for k, name in enumerate(self.parts)}

    @WARP
    def _particles(self, state: State) -> NDArray[np.float32]:
        """(scenes, seen, 2, d)"""
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
        """(scenes, k) of each sensor. Parameters are those of the last step, but for those that actions drive."""
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
        """(scenes, 7) of a free body the place, the cosine and the sine of its turn, the velocity and the rate."""
        fields = position_name(name), f"{name}.{AXES[0]}", velocity_name(name)
        place, axis, velocity = (state[field].numpy()[:, :2] for field in fields)
        rate = state[angular_velocity_name(name)].numpy()[:, None]
        place = self._domain.wrapped(place)
        return np.concatenate([place, axis + [1.0, 0.0], velocity, rate], axis=1)


def checked_sensors(given: Mapping[str, Sensor] | None, taken: set[str]) -> dict[str, Sensor]:
    """Sensors by names that are not ``taken``; raises `InputError` for anything else."""
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
