"""What ``cortado optimise`` reads: a scene with the tables [problem] and [optimise]."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, SceneError, Words
from cortado.optimisation.inverse.tables import OptimiseTable, ProblemTable, TaskTables
from cortado.optimisation.transforms import TimeInterpolation
from cortado.scene.fields import MISSING
from cortado.scene.fluid_particles import fluid_particles
from cortado.scene.parameter_values import SUM_TOLERANCE, Arrays, Known, is_too_small
from cortado.scene.parameters import Axis, Parameter, Range, Role, offered
from cortado.scene.scene import Scene, scene_from_dict
from cortado.scene.tables import sentences
from cortado.scene.toml import read_toml
from cortado.solvers.makers import known_in


@dataclass(frozen=True)
class Task:
    """An inverse problem: a scene, a target, and how it is searched. Parameters over time have a row for each step."""

    scene: Scene
    problem: ProblemTable
    optimise: OptimiseTable
    true_parameters: Arrays
    """Those of the run that made the target; none where the target is a picture."""
    start: dict[str, Any]
    """Parameters with which the search starts; arrays, or the word "random"."""
    known: Known
    """The parameters of the scene."""
    folder: Path = Path()
    """The folder of the task's file; paths in the task are relative to it."""


def load_task(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Task:
    """Read a task from a TOML file; raises `SceneError` in one sentence."""
    file = os.fspath(path)
    data = read_toml(path, overrides, ("fit", "dataset"))
    scene = scene_from_dict(data, file)
    if not any(key in data for key in TaskTables.model_fields):
        raise SceneError(file, "problem", MISSING, "a table; a scene without one is run by cortado run")
    if "fit" in data:
        others = "solved by cortado fit, as its target was measured"
        raise SceneError(file, "fit", Words("given"), others if "optimise" not in data else "left out of a search")
    if scene.solver.chooses:
        wanted = "a number of seconds in a task, whose runs are compared step by step"
        raise SceneError(file, "solver.time_step", "auto", wanted)
    known = _known(scene, file)
    names = (*offered(scene), *(p.name for p in known.own if p.role is not Role.CLOCK))
    try:
        with sentences(TaskTables):
            given = {key: data[key] for key in TaskTables.model_fields if key in data}
            tables = TaskTables.model_validate(given, context={"names": names})
        problem, optimise = tables.problem, tables.optimise
        if problem.measured:
            raise SceneError(
                None, "problem.measured", Words("given"), "left out: measured data is fitted by cortado fit"
            )
        true, steps = problem.target or {}, problem.steps
        scene = scene.lasting(steps=steps)
        for name in optimise.start:
            if problem.picture is None and name not in true:
                raise SceneError(None, f"problem.target.{name}", MISSING, "given, as optimise.start has it")
        true = _resolved("problem.target", true, scene, steps, known)
        start = _resolved("optimise.start", optimise.start, scene, steps, known)
        _check_options(problem, optimise, start, known)
        for name, pair in (optimise.bounds or {}).items():
            _check_bounds(name, pair, optimise, start, scene, known)
    except SceneError as error:
        raise error.in_file(file) from None
    return Task(scene, problem, optimise, true, start, known, Path(file).parent)


def _known(scene: Scene, file: str) -> Known:
    """The parameters of a scene; raises `SceneError`."""
    try:
        return known_in(scene)
    except InputError as error:
        raise SceneError(file, "", sentence=f"cannot be a task: {error}") from None


def _resolved(table: str, values: Mapping[str, Any], scene: Scene, steps: int, known: Known) -> dict[str, Any]:
    """Values with a row for each step where they change over time; raises `SceneError` for one that does not fit."""
    found = {}
    for name, array in values.items():
        field = f"{table}.{name}"
        parameter = known[name]
        if not parameter.present(scene):
            raise SceneError(None, field, Words("given"), f"left out, as the scene {parameter.absent}")
        for view, other in known.views.items():
            if name == other and view in values:
                raise SceneError(None, field, Words("given"), f"left out, as {view} is given in its place")
        if isinstance(array, str):
            found[name] = array
            continue
        shapes = _shapes(known[name], scene, steps)
        if known.has_rows(name, array) and 2 <= len(array) <= steps and array.shape[1:] == shapes[0]:
            array = TimeInterpolation(steps, len(array)).parameter(array)
        if array.shape not in shapes:
            wanted = _in_words(shapes)
            if name in known.over_time and steps > 1:
                wanted = f"{_in_words(shapes[:1])}, or 2 to {steps} rows of it"
            raise SceneError(None, field, Words(_in_words([array.shape])), wanted)
        _check_range(parameter, field, array)
        found[name] = array
    return found


def _check_range(parameter: Parameter, field: str, array: np.ndarray) -> None:
    allowed = parameter.range
    if is_too_small(array, allowed):
        raise SceneError(None, field, float(array.min()), allowed.value)
    if allowed is Range.FRACTIONS:
        row = int(np.abs(array.sum(axis=1) - 1.0).argmax())
        if abs(array[row].sum() - 1.0) > SUM_TOLERANCE:
            raise SceneError(None, f"{field}[{row}]", array[row].tolist(), "fractions that add up to 1")
        if (array < 0.0).any():
            raise SceneError(None, field, float(array.min()), "at least 0")


def _check_options(problem: ProblemTable, optimise: OptimiseTable, start: Mapping[str, Any], known: Known) -> None:
    """Raises `SceneError` for an option that does not fit the others, so that none is silently ignored."""
    over_time = [name for name in known.over_time if name in start and known.has_rows(name, start[name])]
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
    spread = optimise.gradient.spread
    for name in sorted(set(start) ^ set(spread or start)):
        wanted, found = ("given, as it is searched", MISSING) if name in start else ("left out", Words("given"))
        raise SceneError(None, f"optimise.gradient.spread.{name}", found, wanted)
    given = optimise.check.model_fields_set
    for table, values in (("problem.target", problem.target or {}), ("optimise.start", start)):
        if problem.loss != "image" and "colours" in values:
            raise SceneError(None, f"{table}.colours", Words("given"), "left out, as positions are compared")
    if problem.loss != "image" and len(optimise.extinction_schedule) > 1:
        wanted = "left out, as positions are compared"
        raise SceneError(None, "optimise.extinction_schedule", list(optimise.extinction_schedule), wanted)
    if problem.loss != "image" and "psnr" in given:
        raise SceneError(None, "optimise.check.psnr", optimise.check.psnr, "left out, as positions are compared")
    if problem.picture is not None and "parameter_error" in given:
        wanted = "left out, as the target is a picture, not a run with true parameters"
        raise SceneError(None, "optimise.check.parameter_error", optimise.check.parameter_error, wanted)


def _check_bounds(
    name: str, pair: np.ndarray, optimise: OptimiseTable, start: Mapping[str, Any], scene: Scene, known: Known
) -> None:
    """Raises `SceneError` for bounds that do not fit the start."""
    field = f"optimise.bounds.{name}"
    if name not in start:
        raise SceneError(None, field, Words("given"), "left out, as optimise.start lacks it")
    if name == "mass_fractions":
        raise SceneError(None, field, Words("given"), "left out, as fractions stay from 0 to 1 by themselves")
    value = start[name]
    if pair.ndim == 0 or len(pair) != 2:
        wanted = "two entries, the lower and the upper bound"
        raise SceneError(None, field, Words(_in_words([pair.shape])), wanted)
    if (pair[0] > pair[1]).any():
        raise SceneError(None, field, pair.tolist(), "two entries, the lower one not above the upper one")
    if name in optimise.logarithmic and (pair <= 0.0).any():
        raise SceneError(None, field, pair.tolist(), "greater than 0, as the parameter is changed by factors")
    _check_range(known[name], field, pair)
    shape = _shapes(known[name], scene, 0)[0] if isinstance(value, str) else value.shape
    if optimise.knots is not None and known.has_rows(name, value):
        shape = (optimise.knots, *shape[1:])
    try:
        np.broadcast_to(pair[0], shape)
    except ValueError:
        each = " or ".join(["a number", *(f"of shape {shape[k:]}" for k in reversed(range(len(shape))))])
        wanted = f"two entries, the lower and the upper bound, each {each}"
        raise SceneError(None, field, Words(_in_words([pair.shape])), wanted) from None
    comparable = not isinstance(value, str) and pair[0].shape in ((), value.shape, value.shape[1:])
    if comparable and ((value < pair[0]) | (value > pair[1])).any():
        raise SceneError(None, f"optimise.start.{name}", value.tolist(), f"within {field}, {pair.tolist()}")


def _shapes(parameter: Parameter, scene: Scene, steps: int) -> list[tuple[int, ...]]:
    """The shapes that a parameter may have; () is a number. The scene is cut into particles, which may take a second,
    only where the parameter has a value for each of them."""
    particles = len(fluid_particles(scene).positions) if parameter.axis is Axis.PARTICLE else 0
    return parameter.shapes(steps, len(scene.phase), (particles, scene.dimension))


def _in_words(shapes: Sequence[tuple[int, ...]]) -> str:
    return f"of shape {' or '.join(map(str, shapes))}" if all(shapes) else "a number"
