"""Read, describe and set up a task of ``cortado optimise``: a scene with the tables [problem] and [optimise]."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import counted
from cortado.errors import DivergedError, InputError, SceneError, Words
from cortado.losses import FinalPositions, Frames, Image, Loss, Snapshot
from cortado.optimisation.task_tables import DISTANCES, OptimiseTable, ProblemTable, TaskTables
from cortado.optimisation.transforms import Bijector, Logarithm, Softmax, TimeInterpolation, Transformed
from cortado.pictures.image_files import heart, read_picture, rosetta
from cortado.problem import Problem
from cortado.render.renderer import Renderer, scene_renderer
from cortado.scene.fluid_particles import fluid_particles
from cortado.scene.parameter_values import SUM_TOLERANCE, Arrays, Known, is_too_small
from cortado.scene.parameters import Axis, Parameter, Range, Role, offered
from cortado.scene.scene import Scene, read_toml, scene_from_dict
from cortado.scene.shape_tables import CylinderContainer
from cortado.scene.tables import MISSING, Table, sentences
from cortado.simulation import Simulation
from cortado.solvers.build import known_in

_ALGORITHMS = {"adam": "Adam", "lbfgs": "L-BFGS", "line_search": "a line search"}
DRAWN = {"heart": heart, "rosetta": rosetta}
GIVEN = Words("given")


@dataclass(frozen=True)
class Task:
    scene: Scene
    problem: ProblemTable
    optimise: OptimiseTable
    true_parameters: Arrays
    """Parameters of the run that made the target. Empty if the target is a picture."""
    start: dict[str, Any]
    known: Known
    folder: Path = Path()
    """Folder to which paths in the task are relative."""


def load_task(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Task:
    file = os.fspath(path)
    data = read_toml(path, overrides, ("fit", "dataset"))
    scene = scene_from_dict(data, file)
    if not any(key in data for key in TaskTables.model_fields):
        raise SceneError(file, "problem", MISSING, "a table; use cortado run for a scene without [problem]")
    if "fit" in data:
        others = "solved by cortado fit, as its target was measured"
        raise SceneError(file, "fit", GIVEN, others if "optimise" not in data else "left out, as [optimise] is given")
    if scene.solver.chooses:
        wanted = "a number of seconds in a task, whose runs are compared step by step"
        raise SceneError(file, "solver.time_step", "auto", wanted)
    known, tables = read_tables(data, scene, file, TaskTables)
    problem, optimise = tables.problem, tables.optimise
    try:
        if problem.measured:
            raise SceneError(None, "problem.measured", GIVEN, "left out; use cortado fit for measured data")
        true, steps = problem.target or {}, problem.steps
        scene = scene.lasting(steps=steps)
        for name in optimise.start:
            if problem.picture is None and name not in true:
                raise SceneError(None, f"problem.target.{name}", MISSING, "given, as in optimise.start")
        true = _resolved("problem.target", true, scene, steps, known)
        start = _resolved("optimise.start", optimise.start, scene, steps, known)
        _check_options(problem, optimise, start, known)
        for name, pair in (optimise.bounds or {}).items():
            _check_bounds(name, pair, optimise, start, scene, known)
    except SceneError as error:
        raise error.in_file(file) from None
    return Task(scene, problem, optimise, true, start, known, Path(file).parent)


def read_tables(data: Mapping[str, Any], scene: Scene, file: str, model: type[Table]) -> tuple[Known, Any]:
    try:
        known = known_in(scene)
        names = (*offered(scene), *(p.name for p in known.own if p.role is not Role.CLOCK))
        with sentences(model):
            given = {key: data[key] for key in model.model_fields if key in data}
            return known, model.model_validate(given, context={"names": names})
    except SceneError as error:
        raise error.in_file(file) from None
    except InputError as error:
        raise SceneError(file, "", sentence=f"does not describe a task: {error}") from None


def _resolved(table: str, values: Mapping[str, Any], scene: Scene, steps: int, known: Known) -> dict[str, Any]:
    """Check the values of each named parameter, and interpolate values that are given at knots to all time steps."""
    found = {}
    for name, array in values.items():
        field, parameter = f"{table}.{name}", known[name]
        if not parameter.present(scene):
            raise SceneError(None, field, GIVEN, f"left out, as the scene {parameter.absent}")
        for view, other in known.views.items():
            if name == other and view in values:
                raise SceneError(None, field, GIVEN, f"left out, as {view} is given")
        if isinstance(array, str):
            found[name] = array
            continue
        shapes = _shapes(parameter, scene, steps)
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
    if is_too_small(array, parameter.range):
        raise SceneError(None, field, float(array.min()), parameter.range.value)
    if parameter.range is Range.FRACTIONS:
        row = int(np.abs(array.sum(axis=1) - 1.0).argmax())
        if abs(array[row].sum() - 1.0) > SUM_TOLERANCE:
            raise SceneError(None, f"{field}[{row}]", array[row].tolist(), "fractions that add up to 1")
        if (array < 0.0).any():
            raise SceneError(None, field, float(array.min()), "at least 0")


def _check_options(problem: ProblemTable, optimise: OptimiseTable, start: Mapping[str, Any], known: Known) -> None:
    over_time = [name for name in known.over_time if name in start and known.has_rows(name, start[name])]
    if optimise.knots is not None and not over_time:
        raise SceneError(None, "optimise.knots", optimise.knots, "left out, as no searched parameter has rows")
    if optimise.knots is not None and optimise.knots > problem.steps:
        raise SceneError(None, "optimise.knots", optimise.knots, f"at most the number of steps, {problem.steps}")
    for name in optimise.logarithmic:
        if name not in start:
            raise SceneError(None, "optimise.logarithmic", name, "a list of parameters in optimise.start")
        if name == "mass_fractions" or (optimise.knots is not None and name in over_time):
            wanted = "made of other parameters: mass fractions and knots have coordinates of their own"
            raise SceneError(None, "optimise.logarithmic", name, wanted)
        if not isinstance(start[name], str) and (start[name] <= 0.0).any():
            raise SceneError(None, f"optimise.start.{name}", float(start[name].min()), "greater than 0")
    spread = optimise.gradient.spread
    for name in sorted(set(start) ^ set(spread or start)):
        wanted, found = ("given, as it is searched", MISSING) if name in start else ("left out", GIVEN)
        raise SceneError(None, f"optimise.gradient.spread.{name}", found, wanted)
    check, factors = optimise.check, list(optimise.extinction_schedule)
    of_images: dict[str, tuple[bool, Any]] = {
        "problem.target.colours": ("colours" in (problem.target or {}), GIVEN),
        "optimise.start.colours": ("colours" in start, GIVEN),
        "optimise.extinction_schedule": (len(factors) > 1, factors),
        "optimise.check.psnr": ("psnr" in check.model_fields_set, check.psnr),
    }
    for field, (is_given, value) in of_images.items():
        if problem.loss != "image" and is_given:
            raise SceneError(None, field, value, 'left out, as problem.loss is not "image"')
    if problem.picture is not None and "parameter_error" in check.model_fields_set:
        wanted = "left out, as the target is a picture, not a run with true parameters"
        raise SceneError(None, "optimise.check.parameter_error", check.parameter_error, wanted)


def _check_bounds(
    name: str, pair: np.ndarray, optimise: OptimiseTable, start: Mapping[str, Any], scene: Scene, known: Known
) -> None:
    field = f"optimise.bounds.{name}"
    if name not in start:
        raise SceneError(None, field, GIVEN, "left out, as optimise.start has no such parameter")
    if name == "mass_fractions":
        raise SceneError(None, field, GIVEN, "left out, as a search keeps fractions from 0 to 1")
    value = start[name]
    if pair.ndim == 0 or len(pair) != 2:
        wanted = "two entries, the lower and the upper bound"
        raise SceneError(None, field, Words(_in_words([pair.shape])), wanted)
    if (pair[0] > pair[1]).any():
        raise SceneError(None, field, pair.tolist(), "two entries, with no lower bound above an upper bound")
    if name in optimise.logarithmic and (pair <= 0.0).any():
        raise SceneError(None, field, pair.tolist(), "greater than 0, as the parameter is in optimise.logarithmic")
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
    particles = len(fluid_particles(scene).positions) if parameter.axis is Axis.PARTICLE else 0
    return parameter.shapes(steps, len(scene.phase), (particles, scene.dimension))


def _in_words(shapes: Sequence[tuple[int, ...]]) -> str:
    return f"of shape {' or '.join(map(str, shapes))}" if all(shapes) else "a number"


def task_in_words(task: Task) -> list[str]:
    problem, settings = task.problem, task.optimise
    seconds = problem.steps * task.scene.solver.time_step
    compared = "images" if problem.loss == "image" else "positions of all particles"
    frames = "at the end" if problem.frames == 1 else f"at {problem.frames} times, the end among them,"
    if problem.picture is not None:
        wanted = f"look like the picture “{problem.picture}” {frames}"
    else:
        wanted = f"come to the same {compared} {frames} as a run whose {_listed(task.true_parameters)} the search "
        wanted += "does not know"
    length = f"{counted(problem.steps, 'step')} ({seconds:.4g} s)" if problem.steps else "no steps"
    question = f"Which {_listed(task.start)} makes the fluid {wanted}? A run has {length}."
    knots = f", with {settings.knots} knots in time" if settings.knots else ""
    algorithm = _ALGORITHMS.get(settings.optimiser, settings.optimiser.replace("_", " "))
    most, check = f"for {counted(settings.iterations, 'iteration')} at most{knots}", settings.check
    how = f"The search uses {algorithm} with a learning rate of {settings.learning_rate:g}, {most}."
    words = {
        "loss_reduction": f"a loss {check.loss_reduction:g} times smaller than at the start",
        "parameter_error": f"parameters within {100 * check.parameter_error:g}% of the hidden parameters",
        "psnr": f"an image within {check.psnr:g} dB of the target",
    }
    asked = [sentence for name, sentence in words.items() if name in check.model_fields_set]
    return [question, f"{how} The task requires {_listed(asked)}." if asked else how]


def _listed(words: Iterable[str]) -> str:
    *others, last = (word.replace("_", " ") for word in words)
    return f"{', '.join(others)} and {last}" if others else last


@dataclass(frozen=True)
class Setup:
    """The arguments of `cortado.optimise` for a task."""

    task: Task
    problem: Problem
    searches: tuple[Transformed, ...]
    """Successive searches, one for each factor in the extinction schedule."""
    start: Arrays
    bounds: dict[str, tuple[Any, Any]]
    """Bounds of the coordinates, by parameter name."""
    renderer: Renderer | None
    """Renderer of the compared pictures, or None if positions are compared."""
    targets: dict[int, np.ndarray]
    """Target images (rows, columns, 3) or target positions (n, d) [m], by step number."""

    @property
    def search(self) -> Transformed:
        return self.searches[-1]

    def image(self, end: Snapshot) -> np.ndarray:
        assert self.renderer is not None
        return self.renderer.render(end.state.positions, end.state.mass_fractions, end.colours)


def setup(task: Task, device: str, precision: str) -> Setup:
    simulation = Simulation(task.scene, device, precision)
    start = {name: _start(name, value, simulation) for name, value in task.start.items()}
    settings, searches = task.optimise, []
    found: dict[str, Bijector] = {name: Logarithm() for name in settings.logarithmic}
    for name, value in start.items():
        if name == "mass_fractions":
            found[name] = Softmax()
        elif task.known.has_rows(name, value) and settings.knots is not None:
            found[name] = TimeInterpolation(task.problem.steps, settings.knots)
    for factor in settings.extinction_schedule:
        renderer = scene_renderer(simulation, factor) if task.problem.loss == "image" else None
        targets = _targets(task, simulation, renderer)
        losses: dict[int, Loss] = {
            step: Image(renderer, target, DISTANCES[task.problem.distance]) if renderer else FinalPositions(target)
            for step, target in targets.items()
        }
        problem = Problem(simulation, task.problem.steps, Frames(losses))
        searches.append(Transformed(problem, found))
    with_zero = [name for name in task.start if task.known[name].range is Range.NOT_NEGATIVE]
    free = [name for name in with_zero if name not in settings.logarithmic]
    bounds: dict[str, tuple[Any, Any]] = dict.fromkeys(free, (0.0, None))
    for name, (lower, upper) in (settings.bounds or {}).items():
        bounds[name] = (np.log(lower), np.log(upper)) if name in settings.logarithmic else (lower, upper)
    coordinates = searches[-1].coordinate(start)
    for name, (lower, upper) in bounds.items():
        coordinates[name] = np.clip(coordinates[name], lower, upper)  # what is random, or a little outside by round-off
    return Setup(task, problem, tuple(searches), coordinates, bounds, renderer, targets)


def _targets(task: Task, simulation: Simulation, renderer: Renderer | None) -> dict[int, np.ndarray]:
    steps, name, scene = task.problem.compared, task.problem.picture, task.scene
    if name is not None:
        assert renderer is not None
        rows, columns, _ = renderer.shape
        if name not in DRAWN:
            return {steps[-1]: read_picture(task.folder / name, (columns, rows))}
        colours = [phase.colour for phase in scene.phase]  # the last phase draws on the first one
        background = scene.render.background if scene.render else (1.0, 1.0, 1.0)
        under = colours[0] if len(colours) > 1 else background
        cup = 1.0 if isinstance(scene.container, CylinderContainer) else None
        options: dict[str, Any] = {"milk": colours[-1], "coffee": under, "background": background}
        return {steps[-1]: DRAWN[name]((columns, rows), cup=cup, **options)}
    nothing = FinalPositions(simulation.positions)
    try:
        ends = Problem(simulation, task.problem.steps, nothing).states(task.true_parameters, steps)
    except DivergedError as error:
        run = "this is the run that makes the target, with the parameters of problem.target"
        raise error.with_advice(f"{run}; {error.advice}, or change the true parameters") from None
    except InputError as error:
        raise InputError(f"problem.target: {error}") from None
    if renderer is None:
        return {step: end.positions for step, end in ends.items()}
    return {k: renderer.render(e.state.positions, e.state.mass_fractions, e.colours) for k, e in ends.items()}


def _start(name: str, value: Any, simulation: Simulation) -> np.ndarray:
    if not isinstance(value, str):
        return np.asarray(value)
    random = np.random.default_rng(0)
    if name == "mass_fractions":
        return random.dirichlet(np.ones(len(simulation.scene.phase)), simulation.particles)
    container = simulation.scene.container
    extent = container.extent()
    if extent is None:
        raise InputError('optimise.start.initial_positions is "random", but the scene has no container to fill.')
    half = 0.5 * simulation.scene.discretisation.spacing
    lower, upper = extent[0] + half, extent[1] - half
    x = random.uniform(lower, upper, simulation.positions.shape)
    while (outside := ~container.contains(x, 0.0)).any():  # in the corners around a cylinder
        x[outside] = random.uniform(lower, upper, x[outside].shape)
    return x
