"""What ``cortado optimise`` reads: a scene with the tables [problem] and [optimise]."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cortado.controls import NAMES, STATES
from cortado.errors import Phrase, SceneError
from cortado.optimisers import LBFGS, Adam, GradientDescent, Optimiser
from cortado.sampling import fluid_particles
from cortado.scene import Scene, read_toml, scene_from_dict
from cortado.scene_kinds import MISSING, Choice, Count, Kind, Quantity, as_number, wrong
from cortado.scene_tables import Table, sentences

OPTIMISERS: dict[str, Callable[[float], Optimiser]] = {
    "adam": Adam,
    "gradient_descent": GradientDescent,
    "lbfgs": lambda scale: LBFGS(scale=scale),
}
"""By the names in a file; each is made from the learning rate (for L-BFGS the size of its first step)."""
POSITIVE = ("rest_density", "time_step")
"""Parameters that must be greater than 0."""


@dataclass(frozen=True)
class Values(Kind):
    """Parameters by name: a number, or a list, of lists, of numbers."""

    wanted = f"a table of at least one parameter out of {', '.join(NAMES)}"

    def check(self, value: Any) -> dict[str, np.ndarray]:
        if not isinstance(value, Mapping) or not value:
            raise wrong((), Phrase("empty") if value == {} else value, self.wanted)
        return {name: self._array(name, entry) for name, entry in value.items()}

    def _array(self, name: str, value: Any) -> np.ndarray:
        if name not in NAMES:
            raise wrong((name,), Phrase("unknown"), f"one of {', '.join(NAMES)}")
        wanted = "made of finite numbers: one, a list of them, or a list of lists of one length"
        if not _is_numeric(value):
            raise wrong((name,), value, wanted)
        try:
            return np.array(value, dtype=np.float64)
        except ValueError:
            raise wrong((name,), value, wanted) from None


def _is_numeric(value: Any) -> bool:
    """Whether there is a finite number, or nothing else in a list that is not empty."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


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
        _check_shapes("problem.target", tables.problem.target, scene, tables.problem.steps)
        _check_shapes("optimise.start", tables.optimise.start, scene, tables.problem.steps)
    except SceneError as error:
        raise error.in_file(file) from None
    return Task(scene, tables.problem, tables.optimise)


def _check_shapes(table: str, values: Mapping[str, np.ndarray], scene: Scene, steps: int) -> None:
    """Raise `SceneError` for a parameter that does not fit the scene."""
    for name, array in values.items():
        shapes = _shapes(name, scene, steps)
        if array.shape not in shapes:
            raise SceneError(None, f"{table}.{name}", Phrase(_in_words([array.shape])), _in_words(shapes))
        if name in POSITIVE and array <= 0.0:
            raise SceneError(None, f"{table}.{name}", float(array), "greater than 0")


def _shapes(name: str, scene: Scene, steps: int) -> list[tuple[int, ...]]:
    """The shapes that a parameter may have; () is a number."""
    if name == "gravity":
        return [(scene.dimension,), (steps, scene.dimension)]
    return [fluid_particles(scene).positions.shape] if name in STATES else [()]


def _in_words(shapes: Sequence[tuple[int, ...]]) -> str:
    return f"of shape {' or '.join(map(str, shapes))}" if all(shapes) else "a number"
