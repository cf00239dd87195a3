"""Many environments of one task in one launch."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import whole_number
from cortado.environments.catalogue import task_of
from cortado.environments.fluid_env import Info, Observation
from cortado.environments.gym import AutoresetMode, VectorEnv, batch_space, np_random
from cortado.environments.scenes import SEEN, Scenes, Start
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
from cortado.errors import InputError, shown
from cortado.fixed import Staying
from cortado.runs.sensors.sensor import Sensor


class FluidVectorEnv(Staying, VectorEnv):
    """Scenes of one task as a batch (`docs/batches.md`): each has the bits of the single environment with its seed."""

    instead = "but make_vec makes the same one elsewhere, and reset with the same seed begins the same episodes"

    def __init__(
        self,
        task: str | Task,
        num_envs: int = 1,
        size: str | None = None,
        device: str = "cpu",
        precision: str = "float32",
        particles: int = SEEN,
        sensors: Mapping[str, Sensor] | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
    ):
        """``num_envs``: scenes in the batch; ``autoreset_mode`` as that of `gymnasium.vector.SyncVectorEnv`;
        ``max_episode_steps``: after how many steps an episode is truncated, by default the horizon of the task. Others
        as of `FluidEnv`."""
        self.num_envs, self.render_mode = whole_number("num_envs", num_envs, 1), checked_render_mode(render_mode)
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            wanted = ", ".join(f'"{mode.value}"' for mode in AutoresetMode)
            raise InputError(f"autoreset_mode is {shown(autoreset_mode)}, but must be one of {wanted}.") from None
        self.scenes = Scenes(task_of(task, size), self.num_envs, device, precision, particles, sensors)
        self.single_observation_space, actions = spaces(self.scenes)
        self.single_action_space, self._shape = actions, (num_envs, *actions.shape)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {**METADATA, "autoreset_mode": self._mode}
        most = self.scenes.task.horizon if max_episode_steps is None else max_episode_steps
        self._horizon = whole_number("max_episode_steps", most, 1)
        self._generators: list[np.random.Generator] = [np_random()[0] for _ in range(num_envs)]
        self._over = np.ones(num_envs, dtype=bool)
        """(num_envs,) whose episodes are over."""
        self._observations = self.scenes.observed()

    @property
    def layout(self) -> dict[str, slice]:
        """Where in an observation each of its parts is, by name."""
        return self.scenes.layout

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin episodes: all of them, or those of ``options={"reset_mask": (num_envs,) bool}``. A number as ``seed``
        gives environment b the seed + b."""
        require_options(options, "reset_mask")
        if self.closed:
            raise InputError("reset is called after close(), but must come before it.")
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            wanted = f"an array ({self.num_envs},) of bool that is not False throughout"
            raise InputError(f"reset_mask is {shown(mask)}, but must be {wanted}.")
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + b for b in range(self.num_envs)]
        elif isinstance(seed, (list, tuple, np.ndarray)):
            seeds = list(seed)
        else:
            raise InputError(f"seed is {shown(seed)}, but must be a whole number, or a list of them.")
        if len(seeds) != self.num_envs:
            raise InputError(f"seed has {len(seeds)} numbers, but must have {self.num_envs}, one for each environment.")
        for b, own in enumerate(seeds):
            if mask[b] and own is not None:
                self._generators[b] = np_random(own)[0]
        self._begin(mask)
        self._observe(mask)
        return self._observations.copy(), {}

    def step(self, actions: NDArray) -> tuple[Observation, NDArray, NDArray, NDArray, Info]:
        """As that of `FluidEnv`, for all. An episode that is over begins anew as the autoreset mode says: in the next
        step, in the place of its action; in the same step, with what it ended with in ``infos["final_obs"]`` and
        ``infos["final_info"]``; or only by `reset`."""
        if self.closed:
            raise InputError("step is called after close(), but must come before it.")
        actions = checked_actions("actions", actions, self._shape)
        if self._over.any() and self._mode is not AutoresetMode.NEXT_STEP:
            found = f"step is called after the end of the episode of environment {self._over.argmax()}"
            raise InputError(f"{found}, but must come after reset().")
        anew, rewards, lost = self._over, np.zeros(self.num_envs), dict[int, str]()
        begun = self._begin(anew)
        if not anew.all():
            rewards, lost = self.scenes.step(np.where(anew[:, None], 0.0, actions))
            lost = {b: sentence for b, sentence in lost.items() if not anew[b]}
            rewards[anew] = 0.0
            self.scenes.begin(begun)  # these do not take this step
        terminated = np.isin(np.arange(self.num_envs), list(lost))
        self._observe(~terminated)
        truncated = ~terminated & (self.scenes.step_number >= self._horizon)
        self._over, infos = terminated | truncated, Info()
        for b, sentence in lost.items():
            infos = self._add_info(infos, {"diverged": sentence}, b)
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            over = self._over
            for b in np.flatnonzero(over).tolist():
                final = {"diverged": lost[b]} if b in lost else {}
                infos = self._add_info(infos, {"final_obs": self._observations[b], "final_info": final}, b)
            self._begin(over)
            self._observe(over)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture (rows, columns, 3) of each scene."""
        return tuple(pictures(self.scenes)) if self.render_mode else None

    def twin(self, number: int, actions: int | None = None) -> Twin:
        """As that of `FluidEnv`, of the environment with a number."""
        return Twin(self.scenes, number, actions)

    def _begin(self, which: NDArray) -> dict[int, Start]:
        """Begin new episodes of some environments, (num_envs,) bool."""
        starts = {b: self.scenes.drawn(self._generators[b]) for b in np.flatnonzero(which).tolist()}
        self.scenes.begin(starts)
        self._over = self._over & ~which
        return starts

    def _observe(self, which: NDArray) -> None:
        """Observe some environments; of others the last observation stays."""
        self._observations = np.where(which[:, None], self.scenes.observed(), self._observations)
