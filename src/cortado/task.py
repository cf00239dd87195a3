"""What ``cortado optimise`` reads: a scene with the tables [problem] and [optimise]."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cortado.errors import Phrase, SceneError
from cortado.optimisers import LBFGS, Adam, GradientDescent, Optimiser
from cortado.problem import NAMES
from cortado.scene import Scene, read_toml, scene_from_dict
from cortado.scene_kinds import MISSING, Choice, Count, Kind, Quantity, wrong
from cortado.scene_tables import Table, sentences

OPTIMISERS: dict[str, Callable[[float], Optimiser]] = {
    "adam": Adam,
    "gradient_descent": GradientDescent,
    "lbfgs": lambda scale: LBFGS(scale=scale),
}
"""By the names in a file; each is made from the learning rate (for L-BFGS the size of its first step)."""


@dataclass(frozen=True)
class Values(Kind):
    """Parameters by name: a number, or a list, of lists, of numbers."""

    wanted = f"a table of at least one parameter out of {', '.join(NAMES)}"

    def check(self, value: Any) -> dict[str, np.ndarray]:
        if not isinstance(value, Mapping) or not value:
            raise wrong((), value, self.wanted)
        return {name: self._array(name, entry) for name, entry in value.items()}

    def _array(self, name: str, value: Any) -> np.ndarray:
        if name not in NAMES:
            raise wrong((name,), Phrase("unknown"), f"one of {', '.join(NAMES)}")
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if isinstance(value, (str, bool)) or not np.isfinite(array).all():
            raise wrong((name,), value, "a number, or a list of numbers")
        return array


class ProblemTable(Table):
    """[problem]: a number of steps, and a target that a run with hidden parameters makes."""

    steps: Annotated[int, Count(1, 10_000_000)]
    """Time steps."""
    target: Annotated[dict[str, Any], Values()]
    """Hidden parameters: the target is where their run ends."""


class CheckTable(Table):
    """[optimise.check]: what the run has to reach."""

    loss_reduction: Annotated[float, Quantity(least=1.0)] = 1.0
    """First loss / best loss."""
    parameter_error: Annotated[float, Quantity(above=0.0)] = 1e50
    """Largest relative distance (L2) of a found parameter from the hidden one."""


class OptimiseTable(Table):
    """[optimise]: from where, how and how long."""

    start: Annotated[dict[str, Any], Values()]
    """Parameters to begin with; these are optimised."""
    optimiser: Annotated[str, Choice(tuple(OPTIMISERS))] = "adam"
    """Name of the algorithm."""
    learning_rate: Annotated[float, Quantity(above=0.0)]
    """In units of the parameters; for L-BFGS the size of its first step."""
    iterations: Annotated[int, Count(1, 10_000_000)]
    """Updates at most."""
    check: CheckTable = CheckTable()
    """What the run has to reach."""

    def algorithm(self) -> Optimiser:
        """The optimiser as an object."""
        return OPTIMISERS[self.optimiser](self.learning_rate)


class TaskTables(Table):
    """The two tables of a task."""

    problem: ProblemTable
    optimise: OptimiseTable


@dataclass(frozen=True)
class Task:
    """A scene, what is asked of it, and how to find it."""

    scene: Scene
    problem: ProblemTable
    optimise: OptimiseTable


def load_task(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Task:
    """Read a task from a TOML file; raises `SceneError` in one sentence."""
    file = os.fspath(path)
    data = read_toml(path, overrides)
    scene = scene_from_dict(data, file)
    try:
        with sentences():
            tables = TaskTables.model_validate({key: data[key] for key in TaskTables.model_fields if key in data})
        for name in tables.optimise.start:
            if name not in tables.problem.target:
                raise SceneError(None, f"problem.target.{name}", MISSING, "given, as optimise.start has it")
    except SceneError as error:
        raise error.in_file(file) from None
    return Task(scene, tables.problem, tables.optimise)
