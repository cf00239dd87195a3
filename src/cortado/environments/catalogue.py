"""All tasks, by name."""

from cortado.environments.task import Task
from cortado.environments.tasks.carry import Carry
from cortado.environments.tasks.latte import Latte
from cortado.environments.tasks.pour import Pour
from cortado.environments.tasks.raft import Raft
from cortado.environments.tasks.splash import Splash
from cortado.environments.tasks.stir import Stir
from cortado.errors import InputError, shown

TASKS: dict[str, type[Task]] = {one.name: one for one in (Carry, Latte, Pour, Raft, Splash, Stir)}


def task_named(name: str, size: str) -> Task:
    """A task; raises `InputError` where there is none of that name or size."""
    if name not in TASKS:
        raise InputError(f"task is {shown(name)}, but must be one of {', '.join(TASKS)}.")
    return TASKS[name](size)
