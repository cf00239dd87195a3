"""The vector environment of Stable-Baselines3."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import face
from cortado.environments.fluid_env import FluidVectorEnv, Observation, Twin
from cortado.environments.scenes import EnvState
from cortado.environments.task import Task
from cortado.errors import InputError, LibraryMissingError, shown

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    raise LibraryMissingError("Stable-Baselines3", "stable-baselines3", "environments.stable_baselines") from error

__all__ = ["StableBaselinesVecEnv"]


class OneOfBatch:
    """One environment of a batch, for `get_attr`, `set_attr` and `env_method`."""

    def __init__(self, envs: FluidVectorEnv, number: int):
        self._envs, self._number = envs, number
        self.render_mode, self.spec, self.layout = envs.render_mode, envs.spec, envs.layout
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space

    @property
    def goal(self) -> NDArray[np.float64]:
        return self._envs.scenes.goal[self._number].copy()

    @property
    def step_number(self) -> int:
        return int(self._envs.scenes.step_number[self._number])

    def twin(self, actions: int | None = None) -> Twin:
        return self._envs.twin(self._number, actions)

    def save(self) -> EnvState:
        return self._envs.save()[self._number]


class StableBaselinesVecEnv(VecEnv):
    """A batch of environments of one task as a `VecEnv` of Stable-Baselines3. `docs/environments.md` describes it.

    When the episode of environment b ends, a new episode begins in the same step. The last observation of the ended
    episode is in ``infos[b]["terminal_observation"]``. ``infos[b]["TimeLimit.truncated"]`` is True unless the episode
    diverged.
    """

    def __init__(self, task: str | Task, num_envs: int = 1, **settings: Any):
        """Make a batch of ``num_envs`` environments of a task, such as "Carry". ``settings`` are further arguments of
        `FluidVectorEnv`."""
        if "autoreset_mode" in settings:
            raise InputError("autoreset_mode is given, but must be left out, as Stable-Baselines3 has only one mode.")
        self.envs = FluidVectorEnv(task, num_envs, **settings, autoreset_mode="SameStep")
        """The batch as a Gymnasium vector environment."""
        self._each = [OneOfBatch(self.envs, number) for number in range(num_envs)]
        self._actions: NDArray | None = None
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> Observation:
        """Begin all episodes. The seeds from `seed` and the options from `set_options` are used only once."""
        options = self._options[0]
        if any(one is not options and one != options for one in self._options):
            raise InputError("options differ from environment to environment, but must be the same for a whole batch.")
        seen, _ = self.envs.reset(seed=None if set(self._seeds) == {None} else self._seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_async(self, actions: NDArray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all episodes by the stored actions. Return observations, rewards, ended episodes, and infos."""
        if self._actions is None:
            raise InputError("step_wait is called without actions, but must come after step_async(actions).")
        actions, self._actions = self._actions, None
        seen, rewards, terminated, truncated, found = self.envs.step(actions)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(one)} for one in truncated]
        for b in np.flatnonzero(terminated | truncated).tolist():
            infos[b]["terminal_observation"] = found["final_obs"][b]
            if terminated[b]:
                infos[b]["diverged"] = found["diverged"][b]
        return seen, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return a picture (rows, columns, 3) of each scene, or None without ``render_mode``."""
        return list(self.envs.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of each environment, such as ``goal``, ``step_number`` or ``layout``."""
        return [getattr(one, attr_name) for one in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set a new attribute on each environment. Raises `InputError` for attributes of the whole batch."""
        if attr_name not in vars(self._each[0]) and hasattr(self._each[0], attr_name):
            raise InputError(f"{attr_name} cannot be set, as it belongs to the batch; make another environment.")
        for one in self._chosen(indices):
            setattr(one, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: Any, indices: int | Iterable[int] | None = None, **named: Any
    ) -> list[Any]:
        """Call the method ``twin`` or ``save`` of each environment."""
        return [getattr(one, method_name)(*arguments, **named) for one in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each environment, because the environments of a batch have no wrappers."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: int | Iterable[int] | None) -> list[OneOfBatch]:
        numbers = list(self._get_indices(indices))
        if any(not isinstance(b, (int, np.integer)) or not -self.num_envs <= b < self.num_envs for b in numbers):
            raise InputError(f"indices is {shown(indices)}, but must be whole numbers below {self.num_envs}.")
        return [self._each[b] for b in numbers]


__dir__ = face(globals())
