"""All tasks, by name and size."""

from cortado import InputError

from .carry import Carry
from .carry_cup import CarryCup
from .latte import Latte, LatteDense
from .mix import Mix
from .pour_jug import PourJug
from .splash import Splash, SplashProjection
from .steer_raft import SteerRaft
from .stir_milk import StirMilk
from .task import Task

TASKS: dict[str, type[Task]] = {
    one.name: one
    for one in (Carry, CarryCup, Splash, SplashProjection, Latte, LatteDense, Mix, PourJug, SteerRaft, StirMilk)
}
SIZES = ("small", "large")


def task(name: str, size: str) -> Task:
    """A task; raises `InputError` where there is none of that name or size."""
    if name not in TASKS or size not in SIZES:
        raise InputError(f"The task is {name} {size}, but must be one of {', '.join(TASKS)}, small or large.")
    return TASKS[name].small() if size == "small" else TASKS[name].large()
