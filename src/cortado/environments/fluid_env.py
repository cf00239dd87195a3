"""One environment of Gymnasium's."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.environments.catalogue import task_of
from cortado.environments.gym import gymnasium
from cortado.environments.scenes import SEEN, Scenes
from cortado.environments.spaces import (
    METADATA,
    checked_actions,
    checked_render_mode,
    pictures,
    require_options,
    spaces,
)
from cortado.environments.task import Task
from cortado.environments.twin import Twin
from cortado.errors import InputError
from cortado.fixed import Staying
from cortado.runs.sensors.sensor import Sensor

Observation = NDArray[np.float32]
Info = dict[str, Any]


class FluidEnv(Staying, gymnasium.Env[Observation, NDArray]):
    """One scene. `gymnasium.make("cortado/Carry-v0")` makes it; see `docs/environments.md`."""

    metadata = METADATA
    instead = "but gymnasium.make makes the same one elsewhere, and reset with the same seed begins the same episode"

    def __init__(
        self,
        task: str | Task,
        size: str | None = None,
        device: str = "cpu",
        precision: str = "float32",
        particles: int = SEEN,
        sensors: Mapping[str, Sensor] | None = None,
        render_mode: str | None = None,
    ):
        """``task``: its name, such as "Carry", in the ``size`` "small", if left out, or "large"; or a `Task` of
        your own.
        ``particles``: how many are observed; ``sensors`` by name, such as those of `cortado.sensors`, are observed as
        well; ``device`` and ``precision`` as those of `Simulation`; ``render_mode`` None or "rgb_array"."""
        self.render_mode = checked_render_mode(render_mode)
        self.scenes = Scenes(task_of(task, size), 1, device, precision, particles, sensors)
        self.observation_space, actions = spaces(self.scenes)
        self.action_space, self._shape = actions, actions.shape
        self._over = "before the first one"
        self._closed = False

    @property
    def layout(self) -> dict[str, slice]:
        """Where in an observation each of its parts is, by name."""
        return self.scenes.layout

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode; the same seed has the same bits. Raises `InputError` for ``options``, of which there are
        none."""
        if self._closed:
            raise InputError("reset is called after close(), but must come before it.")
        require_options(options)
        super().reset(seed=seed)
        self.scenes.begin({0: self.scenes.drawn(self.np_random)})
        self._over = ""
        self._observation = self.scenes.observed()[0]
        return self._observation.copy(), {}

    def step(self, action: NDArray) -> tuple[Observation, float, bool, bool, Info]:
        """An action beyond -1 to 1 is cut off there. An episode is truncated after as many steps as its task has, or as
        `gymnasium.make` was given as ``max_episode_steps``. Where the simulation diverges, the episode is terminated,
        ``info["diverged"]`` says how in a sentence, and the observation is the last one before.

        Raises `InputError` for an action of another shape or that is not finite, and where no episode is going on."""
        if self._over:
            raise InputError(f"step is called {self._over}, but must come after reset().")
        actions = checked_actions("action", action, self._shape)
        rewards, lost = self.scenes.step(actions[None])
        if not lost:
            self._observation = self.scenes.observed()[0]
        truncated = not lost and self.spec is None and bool(self.scenes.step_number[0] >= self.scenes.task.horizon)
        self._over = "after the end of an episode" if lost or truncated else ""
        info = {"diverged": lost[0]} if lost else {}
        return self._observation.copy(), float(rewards[0]), bool(lost), truncated, info

    def close(self) -> None:
        """No episode goes on, or begins, from now on."""
        self._closed, self._over = True, "after close()"

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (rows, columns, 3) of the scene."""
        return pictures(self.scenes)[0] if self.render_mode else None

    def twin(self, actions: int | None = None) -> Twin:
        """The present episode from its beginning as a differentiable function of so many ``actions``, by default as
        many as an episode has."""
        return Twin(self.scenes, 0, actions)
