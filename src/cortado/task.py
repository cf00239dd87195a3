"""What ``cortado optimise`` reads: a scene with the tables [problem] and [optimise]."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from cortado.controls import NAMES, NOT_NEGATIVE, OF_EMITTER, POSITIVE, SUM_TOLERANCE, Arrays, parameter_shapes
from cortado.errors import Phrase, SceneError
from cortado.image_losses import ImageLoss, Pyramid, SquaredDifference
from cortado.optimisers import LBFGS, Adam, GradientDescent, Optimiser
from cortado.particles import TABLES
from cortado.reparametrisation import Knots
from cortado.sampling import fluid_particles
from cortado.scene import Scene, read_toml, scene_from_dict
from cortado.scene_kinds import MISSING, Choice, Count, Kind, Quantity, Text, as_number, as_sequence, wrong
from cortado.scene_tables import Table, sentences

OPTIMISERS: dict[str, Callable[[float], Optimiser]] = {
    "adam": Adam,
    "gradient_descent": GradientDescent,
    "lbfgs": lambda scale: LBFGS(scale=scale),
}
"""By the names in a file; each is made from the learning rate (for L-BFGS the size of its first step)."""
DISTANCES: dict[str, ImageLoss] = {"squared_difference": SquaredDifference(), "pyramid": Pyramid()}
RANDOM = "random"
CAN_BE_RANDOM = ("initial_positions", "mass_fractions")


@dataclass(frozen=True)
class Values(Kind):
    """Parameters by name: a number, or a list, of lists, of numbers."""

    random: bool = False
    """Whether `CAN_BE_RANDOM` may be the word "random"."""

    wanted = f"a table of at least one parameter out of {', '.join(NAMES)}"

    def check(self, value: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping) or not value:
            raise wrong((), Phrase("empty") if value == {} else value, self.wanted)
        return {name: self._array(name, entry) for name, entry in value.items()}

    def _array(self, name: str, value: Any) -> Any:
        if name not in NAMES:
            raise wrong((name,), Phrase("unknown"), f"one of {', '.join(NAMES)}")
        if self.random and name in CAN_BE_RANDOM and value == RANDOM:
            return value
        wanted = "made of finite numbers: one, a list of them, or a list of lists of one length"
        if not _is_numeric(value):
            raise wrong((name,), value, wanted)
        try:
            return np.array(value, dtype=np.float64)
        except ValueError:
            raise wrong((name,), value, wanted) from None


@dataclass(frozen=True)
class Names(Kind):
    """A list of parameters."""

    wanted = f"a list of parameters out of {', '.join(NAMES)}"

    def check(self, value: Any) -> tuple[str, ...]:
        if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) and name in NAMES for name in value):
            raise wrong((), value, self.wanted)
        return tuple(value)


@dataclass(frozen=True)
class Shares(Kind):
    """Numbers that grow to 1."""

    wanted = "a list of numbers greater than 0, each greater than the one before, the last of them 1"

    def check(self, value: Any) -> tuple[float, ...]:
        numbers = [as_number(entry) for entry in as_sequence(value) or ()]
        shares = [number for number in numbers if number is not None and number > 0.0]
        growing = all(a < b for a, b in pairwise(shares))
        if not shares or len(shares) < len(numbers) or not growing or shares[-1] != 1.0:
            raise wrong((), value, self.wanted)
        return tuple(shares)


def _is_numeric(value: Any) -> bool:
    """Whether there is a finite number, or nothing else in a list that is not empty."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


class ProblemTable(Table):
    """[problem]: a number of steps, and a target: what a run with hidden parameters makes, or a picture."""

    steps: Annotated[int, Count(0, 10_000_000)]
    """Time steps; 0 for a loss of the first state."""
    loss: Annotated[str, Choice(("positions", "image"))] = "positions"
    """What is compared: where the particles are, or how they look."""
    distance: Annotated[str, Choice(tuple(DISTANCES))] = "squared_difference"
    """How images are compared."""
    frames: Annotated[int, Count(1, 10_000)] = 1
    """How many states are compared, evenly spaced up to the last one."""
    target: Annotated[dict[str, Any] | None, Values()] = None
    """Hidden parameters: the target is what their run makes."""
    picture: Annotated[str | None, Text()] = None
    """"heart", "rosetta", or a file with a picture, beside the task's own."""

    @model_validator(mode="after")
    def _check_target(self) -> Self:
        if self.picture is None and self.target is None:
            raise wrong(("target",), MISSING, f"{Values.wanted}, as there is no picture")
        if self.picture is not None and self.target is not None:
            raise wrong(("picture",), self.picture, "left out, as there is a target")
        if self.picture is not None and self.loss != "image":
            raise wrong(("loss",), self.loss, '"image", as there is a picture')
        if self.picture is not None and self.frames > 1:
            raise wrong(("frames",), self.frames, "1, as there is a picture, which is one")
        if self.loss != "image" and "distance" in self.model_fields_set:
            raise wrong(("distance",), self.distance, "left out, as positions are compared")
        if self.frames > max(self.steps, 1):
            raise wrong(("frames",), self.frames, f"at most {max(self.steps, 1)}, as there are {self.steps} steps")
        return self

    @property
    def compared(self) -> list[int]:
        """The numbers of the states that are compared."""
        return [round(self.steps * (k + 1) / self.frames) for k in range(self.frames)]


class CheckTable(Table):
    """[optimise.check]: what the run has to reach."""

    loss_reduction: Annotated[float, Quantity(least=1.0)] = 1.0
    """First loss / best loss."""
    parameter_error: Annotated[float, Quantity(above=0.0)] = 1e50
    """Largest relative distance (L2) of a found parameter from the hidden one."""
    psnr: Annotated[float, Quantity("dB", least=0.0)] = 0.0
    """Peak signal-to-noise ratio of the found image to the target."""


class OptimiseTable(Table):
    """[optimise]: from where, how and how long."""

    start: Annotated[dict[str, Any], Values(random=True)]
    """Parameters to begin with; these are optimised."""
    knots: Annotated[int | None, Count(2, 10_000_000)] = None
    """Parameters over time are interpolated between so many free values; None: every step has its own."""
    logarithmic: Annotated[tuple[str, ...], Names()] = ()
    """Parameters that are changed by factors."""
    bounds: Annotated[dict[str, Any] | None, Values()] = None
    """By name: two entries, the lower and the upper bound."""
    extinctions: Annotated[tuple[float, ...], Shares()] = (1.0,)
    """Of one search after the other, each from where the last one ended, relative to the scene's: through thinner fluid
    a picture tells how much there is, and particles that hide behind each other have to part."""
    optimiser: Annotated[str, Choice(tuple(OPTIMISERS))] = "adam"
    """Name of the algorithm."""
    learning_rate: Annotated[float, Quantity(above=0.0)]
    """In units of the parameters; for L-BFGS the size of its first step."""
    iterations: Annotated[int, Count(1, 10_000_000)]
    """Updates at most, of each search."""
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
    """A scene, what is asked of it, and how to find it. Parameters over time have a row for each step."""

    scene: Scene
    problem: ProblemTable
    optimise: OptimiseTable
    hidden: Arrays
    """Parameters that made the target; none for a picture."""
    start: dict[str, Any]
    """Parameters to begin with; arrays, or the word "random"."""
    folder: Path = Path()
    """Where its other files are looked for."""


def load_task(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Task:
    """Read a task from a TOML file; raises `SceneError` in one sentence."""
    file = os.fspath(path)
    data = read_toml(path, overrides)
    scene = scene_from_dict(data, file)
    try:
        with sentences():
            tables = TaskTables.model_validate({key: data[key] for key in TaskTables.model_fields if key in data})
        problem, optimise = tables.problem, tables.optimise
        hidden, steps = problem.target or {}, problem.steps
        for name in optimise.start:
            if problem.picture is None and name not in hidden:
                raise SceneError(None, f"problem.target.{name}", MISSING, "given, as optimise.start has it")
        hidden = _resolved("problem.target", hidden, scene, steps)
        start = _resolved("optimise.start", optimise.start, scene, steps)
        _check_options(problem, optimise, start)
        for name, pair in (optimise.bounds or {}).items():
            _check_bounds(name, pair, optimise, start, scene)
    except SceneError as error:
        raise error.in_file(file) from None
    return Task(scene, problem, optimise, hidden, start, Path(file).parent)


def _resolved(table: str, values: Mapping[str, Any], scene: Scene, steps: int) -> dict[str, Any]:
    """Values with a row for each step where they change over time; raises `SceneError` for one that does not fit."""
    found = {}
    for name, array in values.items():
        field = f"{table}.{name}"
        if name in OF_EMITTER and scene.emitter is None:
            raise SceneError(None, field, Phrase("given"), "left out, as the scene has no emitter")
        if isinstance(array, str):
            found[name] = array
            continue
        shapes = _shapes(name, scene, steps)
        if name in TABLES and array.ndim == 2 and 2 <= len(array) <= steps and array.shape[1:] == shapes[0]:
            array = Knots(steps, len(array)).parameter(array)
        if array.shape not in shapes:
            wanted = _in_words(shapes)
            if name in TABLES and steps > 1:
                wanted = f"{_in_words(shapes[:1])}, or 2 to {steps} rows of it"
            raise SceneError(None, field, Phrase(_in_words([array.shape])), wanted)
        _check_range(name, field, array)
        found[name] = array
    return found


def _check_range(name: str, field: str, array: np.ndarray) -> None:
    if name in POSITIVE and (array <= 0.0).any():
        raise SceneError(None, field, float(array.min()), "greater than 0")
    if name in NOT_NEGATIVE and (array < 0.0).any():
        raise SceneError(None, field, float(array.min()), "at least 0")
    if name == "mass_fractions":
        row = int(np.abs(array.sum(axis=1) - 1.0).argmax())
        if abs(array[row].sum() - 1.0) > SUM_TOLERANCE:
            raise SceneError(None, f"{field}[{row}]", array[row].tolist(), "fractions that add up to 1")
        if (array < 0.0).any():
            raise SceneError(None, field, float(array.min()), "at least 0")


def _check_options(problem: ProblemTable, optimise: OptimiseTable, start: Mapping[str, Any]) -> None:
    """Raises `SceneError` for an option that does not fit the others; none is silently left unused."""
    over_time = [name for name in TABLES if name in start and start[name].ndim == 2]
    if optimise.knots is not None and not over_time:
        raise SceneError(None, "optimise.knots", optimise.knots, "left out, as nothing that is optimised has rows")
    if optimise.knots is not None and optimise.knots > problem.steps:
        raise SceneError(None, "optimise.knots", optimise.knots, f"at most the number of steps, {problem.steps}")
    for name in optimise.logarithmic:
        if name not in start:
            raise SceneError(None, "optimise.logarithmic", name, "made of parameters that optimise.start has")
        if name == "mass_fractions" or (optimise.knots is not None and name in over_time):
            wanted = "made of other parameters: mass fractions and knots have coordinates of their own"
            raise SceneError(None, "optimise.logarithmic", name, wanted)
        if not isinstance(start[name], str) and (start[name] <= 0.0).any():
            raise SceneError(None, f"optimise.start.{name}", float(start[name].min()), "greater than 0")
    given = optimise.check.model_fields_set
    if problem.loss != "image" and len(optimise.extinctions) > 1:
        wanted = "left out, as positions are compared"
        raise SceneError(None, "optimise.extinctions", list(optimise.extinctions), wanted)
    if problem.loss != "image" and "psnr" in given:
        raise SceneError(None, "optimise.check.psnr", optimise.check.psnr, "left out, as positions are compared")
    if problem.picture is not None and "parameter_error" in given:
        wanted = "left out, as the target is a picture and no parameter is hidden"
        raise SceneError(None, "optimise.check.parameter_error", optimise.check.parameter_error, wanted)


def _check_bounds(name: str, pair: np.ndarray, optimise: OptimiseTable, start: Mapping[str, Any], scene: Scene) -> None:
    """Raises `SceneError` for bounds that do not fit the start."""
    field = f"optimise.bounds.{name}"
    if name not in start:
        raise SceneError(None, field, Phrase("given"), "left out, as optimise.start lacks it")
    if name == "mass_fractions":
        raise SceneError(None, field, Phrase("given"), "left out, as fractions stay from 0 to 1 by themselves")
    value = start[name]
    if pair.ndim == 0 or len(pair) != 2:
        wanted = "two entries, the lower and the upper bound"
        raise SceneError(None, field, Phrase(_in_words([pair.shape])), wanted)
    if (pair[0] > pair[1]).any():
        raise SceneError(None, field, pair.tolist(), "two entries, the lower one not above the upper one")
    if name in optimise.logarithmic and (pair <= 0.0).any():
        raise SceneError(None, field, pair.tolist(), "greater than 0, as the parameter is changed by factors")
    _check_range(name, field, pair)
    shape = _shapes(name, scene, 0)[0] if isinstance(value, str) else value.shape
    if optimise.knots is not None and name in TABLES and len(shape) == 2:
        shape = (optimise.knots, shape[1])
    try:
        np.broadcast_to(pair[0], shape)
    except ValueError:
        each = " or ".join(["a number", *(f"of shape {shape[k:]}" for k in reversed(range(len(shape))))])
        wanted = f"two entries, the lower and the upper bound, each {each}"
        raise SceneError(None, field, Phrase(_in_words([pair.shape])), wanted) from None
    comparable = not isinstance(value, str) and pair[0].shape in ((), value.shape, value.shape[1:])
    if comparable and ((value < pair[0]) | (value > pair[1])).any():
        raise SceneError(None, f"optimise.start.{name}", value.tolist(), f"within {field}, {pair.tolist()}")


def _shapes(name: str, scene: Scene, steps: int) -> list[tuple[int, ...]]:
    """The shapes that a parameter may have; () is a number."""
    return parameter_shapes(name, steps, len(scene.phase), fluid_particles(scene).positions.shape)


def _in_words(shapes: Sequence[tuple[int, ...]]) -> str:
    return f"of shape {' or '.join(map(str, shapes))}" if all(shapes) else "a number"
