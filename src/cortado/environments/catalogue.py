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


def task_of(task: str | Task, size: str | None) -> Task:
    """A task by its name, in a size, "small" if left out, or one of your own; raises `InputError` where there is none
    of that name or size, and for a size of your own task."""
    if isinstance(task, Task):
        if size is not None:
            raise InputError(f"size is {shown(size)}, but must be left out, as the task is one of your own.")
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise InputError(f"task is {shown(task)}, but must be one of {', '.join(TASKS)}, or a Task.")
    return TASKS[task]("small" if size is None else size)
