"""Gymnasium environments that simulate fluids. `docs/environments.md` describes them.

Importing this package registers the environments for ``gymnasium.make("cortado/Carry-v0")`` and ``gymnasium.make_vec``.
"""

from typing import TYPE_CHECKING, Any

from cortado.calls import face
from cortado.environments.catalogue import TASKS
from cortado.environments.fluid_env import FluidEnv, FluidVectorEnv, Twin, gymnasium
from cortado.environments.scenes import EnvState
from cortado.environments.task import Task
from cortado.lazy import getter

__all__ = ["EnvState", "FluidEnv", "FluidVectorEnv", "Task", "Twin", "make_vec"]


def make_vec(task: str | Task, num_envs: int = 1, **settings: Any) -> FluidVectorEnv:
    """Make a batch of ``num_envs`` environments of a task, such as "Carry". ``settings`` are further arguments of
    `FluidVectorEnv`."""
    return FluidVectorEnv(task, num_envs, **settings)


for _name, _task in TASKS.items():
    gymnasium.register(
        f"cortado/{_name}-v0",
        entry_point="cortado.environments.fluid_env:FluidEnv",
        vector_entry_point="cortado.environments.fluid_env:FluidVectorEnv",
        max_episode_steps=_task.horizon,
        kwargs={"task": _name},
    )

__dir__ = face(globals())
if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
