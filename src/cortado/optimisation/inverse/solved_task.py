"""What a solved task shows: what was found at knots in time, plots, shaded pictures, and films."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cortado.device.modules import compile_meanwhile
from cortado.files.image_encoding import write_video
from cortado.files.terminal import announce
from cortado.losses import Snapshot
from cortado.optimisation.inverse.task import Setup, Task
from cortado.optimisation.optimise import Result
from cortado.optimisation.transforms import TimeInterpolation
from cortado.pictures.film import FilmedRun, Page, film, is_out, those
from cortado.pictures.image_files import write_picture
from cortado.pictures.pages import Figures
from cortado.pictures.painter import colours_of, painter, side_by_side
from cortado.pictures.plots import images, loss_curve, panels, particles
from cortado.pictures.shown_solids import solid_outline
from cortado.pictures.tracing.space import State
from cortado.runs.frames import Pace, pace_of
from cortado.scene.appearance import Picture
from cortado.scene.parameter_values import Arrays, Tilt
from cortado.scene.parameters import Axis
from cortado.scene.scene import Scene

MOST_CURVES = 12
"""Most components of a parameter that gets a picture of its own."""
TITLES = ("first guess", "found", "target")
IMAGES = 6
"""Number of images that show the course of the optimisation."""
EVALUATIONS = (1, 5, 20, 100)
"""Evaluations whose runs are shown, as far as the search went; 0 is the first guess."""
Run = Mapping[int, Snapshot]
"""States by the number of steps before them."""


@dataclass(frozen=True)
class TaskFigures:
    """Pictures and films of a solved task, with (caption, path) of each."""

    found: Figures = field(default_factory=list)
    """The run with the found parameters, in motion."""
    compared: Figures = field(default_factory=list)
    """Before, found and target."""
    parameters: Figures = field(default_factory=list)
    """Found parameters against the hidden ones."""
    search: Figures = field(default_factory=list)
    """How the search went."""

    def __add__(self, other: "TaskFigures") -> "TaskFigures":
        """Return these figures followed by another task's."""
        return TaskFigures(**{name: figures + getattr(other, name) for name, figures in vars(self).items()})


@dataclass(frozen=True)
class KnotValues:
    """The values of one parameter at knots in time, between which it changes along a straight line."""

    times: np.ndarray
    """(k,) [s] A step has the value of its middle, so the first knot is half a step after the start of the run; that of
    where something is is a step after it."""
    start: np.ndarray
    """(k, d), or (k,) of numbers, in the unit of the parameter, as the search started."""
    estimate: np.ndarray
    """(k, d) in the unit of the parameter."""
    true: np.ndarray | None
    """(k, d) the course with these knots that is nearest to the true one; None where a picture is the target."""

    def for_machines(self) -> dict[str, np.ndarray]:
        """Return the arrays by name; without the true values where there are none."""
        known = {} if self.true is None else {"true": self.true}
        return {"times": self.times, "estimate": self.estimate, **known}


def knot_values(made: Setup, coordinates: Arrays, estimate: Mapping[str, np.ndarray]) -> dict[str, KnotValues]:
    """Return by name the parameters that were searched as values at knots in time, which ``coordinates`` has."""
    step = float(estimate.get("time_step", made.task.scene.solver.time_step))
    found = {}
    for name, bijector in made.search.coordinates.items():
        if isinstance(bijector, TimeInterpolation):
            true = made.true_parameter(name)
            if true is not None:
                rank = made.task.known[name].rank
                course = np.broadcast_to(true, (bijector.steps, *np.shape(true)[np.ndim(true) - rank :]))
                true = _without_round_off(bijector.coordinate(course))
            times = (bijector.places + made.task.known[name].moment) * step
            found[name] = KnotValues(times, made.start[name], coordinates[name], true)
    return found


def _without_round_off(values: np.ndarray) -> np.ndarray:
    """Round values to twelve digits of the largest: a user's numbers come back from the course as they were written."""
    largest = np.abs(values).max()
    return np.round(values, 11 - int(np.floor(np.log10(largest)))) + 0.0 if largest > 0.0 else values  # no -0


def task_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    """Draw plots and pictures of a solved task into a folder."""
    losses = [record.loss for record in result.history]
    label = "loss [m²]" if made.renderer is None else "loss"
    figures = TaskFigures(search=[("The loss.", loss_curve(losses, folder / "loss.png", label=label))])
    if made.renderer is None:
        figures += TaskFigures(compared=[_particles(made, result, folder)])
    else:
        figures += _images(made, result, folder)
    for name in result.parameters:
        figures += TaskFigures(parameters=_parameter(made, result, name, folder))
    return figures


def _particles(made: Setup, result: Result, folder: Path) -> tuple[str, Path]:
    scene, simulation = made.task.scene, made.problem.simulation
    before, after = (made.problem.end(made.search.parameters(u)).positions for u in (made.start, result.parameters))
    shown = [before, after, made.targets[made.problem.steps]]
    several = len(scene.phase) > 1
    colours = [colours_of(scene, simulation.mass_fractions, simulation.particles)] * len(shown) if several else None
    ends, lines = scene.container.extent(), [solid_outline(scene)] * len(shown)
    path = particles(shown, TITLES, folder / "particles.png", colours=colours, container=ends, lines=lines)
    return "Where the fluid ends: with the first guess, as found, and the target.", path


def _images(made: Setup, result: Result, folder: Path) -> TaskFigures:
    last, target = max(made.targets.items())

    def image(u: dict[str, np.ndarray]) -> np.ndarray:
        return made.image(made.problem.states(made.search.parameters(u), [last])[last])

    path = images([image(made.start), image(result.parameters), target], TITLES, folder / "images.png")
    compared: Figures = [("The last image: with the first guess, as found, and the target.", path)]
    evaluations = np.unique(np.linspace(0, len(result.history) - 1, IMAGES).astype(int))
    shown = [image(result.history[k].parameters) for k in evaluations]
    path = images(shown, [f"evaluation {k}" for k in evaluations], folder / "progress.png")
    search: Figures = [("The last image during the optimisation.", path)]
    steps, picture = made.problem.steps, made.task.scene.picture or Picture()
    if steps > 0 and picture.film_frames != 0 and find_spec("av"):
        numbers = np.unique(np.linspace(0, steps, max(picture.searched_frames, 2)).astype(int)).tolist()
        states = made.problem.states(made.search.parameters(result.parameters), numbers)
        pace = step_pace(made.task.scene, numbers)
        moving = (made.image(states[numbers[k]]) for k in pace.frames)
        path = write_video(folder / "estimate.mp4", moving, pace.frames_per_second)
        compared.append((f"The run with the parameters that were found, {pace.in_words}.", path))
    return TaskFigures(compared=compared, search=search)


def _parameter(made: Setup, result: Result, name: str, folder: Path) -> Figures:
    """Draw the estimate of a parameter over the evaluations, or the last estimate of one that changes over time."""
    estimate, true = made.search.parameters(result.parameters)[name], made.true_parameter(name)
    path, first = folder / f"{name}.png", np.asarray(made.search.parameters(made.start)[name])
    names = component_names(made.task, name, estimate)
    if name in made.task.known.over_time and np.ndim(estimate) == 2:
        x, found, x_label, words = np.arange(len(estimate)), np.asarray(estimate), "step", "over time"
    elif true is None or max(np.size(estimate), true.size) > MOST_CURVES:
        return []
    else:
        shape = np.broadcast_shapes(np.shape(estimate), true.shape)
        values = [made.search.parameters(record.parameters)[name] for record in result.history]
        found = np.array([np.broadcast_to(value, shape).ravel() for value in values])
        true, first = (np.broadcast_to(value, shape).ravel() for value in (true, first))
        x, x_label, words = np.arange(len(found)), "evaluation", "during the optimisation"
        names = names if len(names) == found.shape[1] else [str(k) for k in range(found.shape[1])]
    label, unit = name.replace("_", " "), made.task.known[name].unit
    panels(x, found, path, names=names, title=label, x_label=x_label, unit=unit, true=true, start=first)
    hidden = "" if true is None else ", and its hidden value"
    return [(f"The parameter {label} {words}{hidden}.", path)]


def component_names(task: Task, name: str, value: np.ndarray) -> list[str]:
    """Name the components of a parameter, of one over time those of a row: its axes, its phases, or numbers."""
    scene, parameter, last = task.scene, task.known[name], np.shape(value)[-1:]
    count = int(np.prod(np.shape(value))) if parameter.axis is not Axis.STEP else int(np.prod(last))
    label = name.replace("_", " ")
    if count == 1:
        return [label]
    if name == "tilt":
        return [f"{label} towards {axis}" for axis in Tilt(scene.forces.gravity).towards]
    if parameter.axis is Axis.STEP:
        return [f"{label} {axis}" for axis in "xyz"[:count]]
    if parameter.axis is Axis.PHASE and count == len(scene.phase):
        return [f"{label} of {phase.name}" for phase in scene.phase]
    if name == "colours":
        return [f"{hue} of {phase.name}" for phase in scene.phase for hue in ("red", "green", "blue")]
    return [f"{label} {k}" for k in range(count)]


def begin_shaded(made: Setup) -> None:
    """Compile the renderer of shaded pictures while the search goes on, which leaves a core to spare."""
    simulation = made.problem.simulation
    artist = painter(made.task.scene, simulation.positions, simulation.device)
    compile_meanwhile(artist, simulation.device)


def shaded_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    """Draw shaded pictures and films of a solved task into a folder."""
    picture, device = made.task.scene.picture or Picture(), made.problem.simulation.device
    steps = np.unique(np.linspace(0, made.problem.steps, max(picture.searched_frames, 2)).astype(int)).tolist()

    def run(parameters: Mapping[str, Any]) -> Run:
        return made.problem.states(dict(parameters), steps)

    def found(u: dict[str, np.ndarray]) -> Run:
        return run(made.search.parameters(u))

    before, after = found(made.start), found(result.parameters)
    runs = {"first guess": before, "found": after}
    if made.task.problem.picture is None:  # else there is a picture to aim at, and no run
        runs["target"] = run(made.task.true_parameters)
    page = partial(_page, made, device=device)
    three = page(list(runs), list(runs.values()))
    write_picture(folder / "found.png", three.image(steps[-1]))
    compared: Figures = [(f"The end of the run: {', '.join(runs)}.", folder / "found.png")]
    shown = [k for k in EVALUATIONS if k < len(result.history)] or [0]
    searched = page([f"evaluation {k}" for k in shown], [found(result.history[k].parameters) for k in shown])
    write_picture(folder / "search.png", searched.image(steps[-1]))
    search: Figures = [("The end of the run as the search went on.", folder / "search.png")]
    if picture.film_frames == 0 or len(steps) < 2:
        return TaskFigures(compared=compared, search=search)
    pair = {name: runs[name] for name in (("found", "target") if "target" in runs else ("first guess", "found"))}
    two = page(list(pair), list(pair.values()))
    pace = step_pace(made.task.scene, steps)
    motion = film(folder / "found.mp4", two, steps, pace)
    announce(str(motion))
    sought = film(folder / "search.mp4", searched, steps, pace)
    search.insert(0, (f"The search in motion, {pace.in_words}.", sought.path))
    found_figures: Figures = [(f"The run, {pace.in_words}: {' and '.join(pair)}.", motion.path)]
    return TaskFigures(found=found_figures, compared=compared, search=search)


def step_pace(scene: Scene, steps: Sequence[int]) -> Pace:
    """Return the pace of films whose frames are the states after these numbers of steps."""
    if scene.solver.chooses:
        return Pace.unknown(len(steps))
    pace = pace_of(float(scene.solver.time_step) * np.asarray(steps), scene.picture or Picture())
    return replace(pace, of_search=True)


def _page(made: Setup, names: Sequence[str], runs: Sequence[Run], device: Any) -> Page:
    """Lay out the pictures of runs after a number of steps, side by side, each with its name."""
    scene, across = made.task.scene, len(runs) if len(runs) < 4 else 2
    picture, half = scene.picture or Picture(), len(runs) > 1
    size = {"width": picture.width // (1 + half), "height": picture.height // (1 + (len(runs) > across))}
    panel = picture.model_copy(update=size)
    places = [run[step].positions for run in runs for step in run]
    artist = painter(scene.model_copy(update={"picture": panel}), places, device)

    filmed = [FilmedRun(artist, partial(_state, made, run)) for run in runs]
    return Page(filmed, partial(side_by_side, across=across, names=names))


def _state(made: Setup, run: Run, step: int) -> State:
    state = run[step]
    colours = colours_of(made.task.scene, state.mass_fractions, len(state.positions), state.colours)
    emitted = state.state["emitted"].numpy() if "emitted" in state.state.names else None
    out = those(is_out(made.task.scene, emitted, len(colours)))
    fractions = None if state.mass_fractions is None else state.mass_fractions[out]
    return State(state.positions[out], colours[out], fractions=fractions)
