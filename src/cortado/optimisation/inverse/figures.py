"""The pictures of a solved task: particles or images, parameters against those that were hidden, the loss, a video."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from cortado.files.image_encoding import write_video
from cortado.optimisation.inverse.setup import Setup
from cortado.optimisation.inverse.shaded import step_pace
from cortado.optimisation.inverse.task import Task
from cortado.optimisation.inverse.task_figures import TaskFigures
from cortado.optimisation.optimise import Result
from cortado.pictures.painter import colours_of
from cortado.pictures.plots import images, loss_curve, panels, particles
from cortado.pictures.report import Figures
from cortado.pictures.shown_solids import solid_outline
from cortado.scene.appearance import Picture
from cortado.scene.parameter_values import Tilt
from cortado.scene.parameters import Axis

MOST_CURVES = 12
"""Parameters with more components get no picture of their own."""
TITLES = ("first guess", "found", "target")
IMAGES = 6
"""Images that show the course of the optimisation."""


def task_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    """Draw them into a folder."""
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
    """The estimate of a parameter over the evaluations; of one that changes over time, the last estimate over time."""
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
    """Of the numbers of a parameter, of one over time those of a row: its axes, its phases, or else counted."""
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
