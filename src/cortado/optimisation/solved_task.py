"""Plots, pictures and films of a solved task, and readers of scenes with measured data for ``cortado fit``."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, SceneError
from cortado.files.terminal import announce
from cortado.losses import Snapshot
from cortado.optimisation import task_tables as tables
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.observations import Observation, SensorSeries, Tracks, Video
from cortado.optimisation.optimise import Result
from cortado.optimisation.task_files import GIVEN, Setup, Task, read_tables
from cortado.optimisation.transforms import TimeInterpolation
from cortado.pictures.film import FilmedRun, Page, film, is_out, those
from cortado.pictures.image_files import open_picture, read_frames, resized, warn_of_cropping, write_picture
from cortado.pictures.pages import Figures
from cortado.pictures.painter import colours_of, painter, side_by_side
from cortado.pictures.plots import images, loss_curve, panels, particles
from cortado.pictures.shown_solids import solid_outline
from cortado.pictures.tracing.space import State
from cortado.runs.frames import pace_of
from cortado.runs.probes import sensors_of
from cortado.runs.sensor import measured_columns
from cortado.scene.appearance import Picture
from cortado.scene.emitter_table import OF_OPENINGS
from cortado.scene.parameter_values import Arrays, Tilt
from cortado.scene.parameters import Axis
from cortado.scene.scene import Scene, read_toml, scene_from_dict
from cortado.scene.tables import MISSING, Table
from cortado.simulation import Simulation

MOST_CURVES = 12
"""Greatest number of components for which each parameter gets a separate plot."""
TITLES = ("first guess", "found", "target")
IMAGES = 6
EVALUATIONS = (1, 5, 20, 100)
"""Numbers of the evaluations for which pictures are shown. The start has number 0."""
Run = Mapping[int, Snapshot]


@dataclass(frozen=True)
class TaskFigures:
    found: Figures = field(default_factory=list)
    compared: Figures = field(default_factory=list)
    parameters: Figures = field(default_factory=list)
    search: Figures = field(default_factory=list)

    def __add__(self, other: "TaskFigures") -> "TaskFigures":
        return TaskFigures(**{name: figures + getattr(other, name) for name, figures in vars(self).items()})


@dataclass(frozen=True)
class KnotValues:
    """Values of a parameter over time at k knots. The unit is the unit of the parameter."""

    times: np.ndarray
    """Times of the knots (k,) [s]."""
    start: np.ndarray
    """Values (k, d) or (k,) at the start of the search."""
    estimate: np.ndarray
    true: np.ndarray | None
    """Knot values (k, d) or (k,) that approximate the true parameter best. None if the target is a picture."""

    def for_machines(self) -> dict[str, np.ndarray]:
        known = {} if self.true is None else {"true": self.true}
        return {"times": self.times, "estimate": self.estimate, **known}


def knot_values(made: Setup, coordinates: Arrays, estimate: Mapping[str, np.ndarray]) -> dict[str, KnotValues]:
    step = float(estimate.get("time_step", made.task.scene.solver.time_step))
    found = {}
    for name, bijector in made.search.coordinates.items():
        if isinstance(bijector, TimeInterpolation):
            true = made.task.true_parameters.get(name)
            if true is not None:
                rank = made.task.known[name].rank
                course = np.broadcast_to(true, (bijector.steps, *np.shape(true)[np.ndim(true) - rank :]))
                true = bijector.coordinate(course)
                if (largest := np.abs(true).max()) > 0.0:  # without round-off, and without -0
                    true = np.round(true, 11 - int(np.floor(np.log10(largest)))) + 0.0
            times = (bijector.places + made.task.known[name].moment) * step
            found[name] = KnotValues(times, made.start[name], coordinates[name], true)
    return found


def task_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    scene, simulation, found = made.task.scene, made.problem.simulation, TaskFigures()
    losses = [record.loss for record in result.history]
    label = "loss [m²]" if made.renderer is None else "loss"
    found.search.append(("The loss.", loss_curve(losses, folder / "loss.png", label=label)))
    last, target = max(made.targets.items())

    def end(u: dict[str, np.ndarray]) -> Snapshot:
        return made.problem.states(made.search.parameters(u), [last])[last]

    if made.renderer is None:
        shown = [*(end(u).positions for u in (made.start, result.parameters)), target]
        several = len(scene.phase) > 1
        colours = [colours_of(scene, simulation.mass_fractions, simulation.particles)] * len(shown) if several else None
        ends, lines = scene.container.extent(), [solid_outline(scene)] * len(shown)
        path = particles(shown, TITLES, folder / "particles.png", colours=colours, container=ends, lines=lines)
        found.compared.append(("Where the fluid ends: with the first guess, as found, and the target.", path))
    else:
        shown = [*(made.image(end(u)) for u in (made.start, result.parameters)), target]
        path = images(shown, TITLES, folder / "images.png")
        found.compared.append(("The last image: with the first guess, as found, and the target.", path))
        evaluations = np.unique(np.linspace(0, len(result.history) - 1, IMAGES).astype(int))
        shown = [made.image(end(result.history[k].parameters)) for k in evaluations]
        path = images(shown, [f"evaluation {k}" for k in evaluations], folder / "progress.png")
        found.search.append(("The last image during the optimisation.", path))
    for name in result.parameters:
        found.parameters.extend(_parameter(made, result, name, folder))
    return found


def _parameter(made: Setup, result: Result, name: str, folder: Path) -> Figures:
    estimate, true = made.search.parameters(result.parameters)[name], made.task.true_parameters.get(name)
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


def shaded_figures(made: Setup, result: Result, folder: Path) -> TaskFigures:
    picture, device = made.task.scene.picture or Picture(), made.problem.simulation.device
    steps = np.unique(np.linspace(0, made.problem.steps, max(picture.searched_frames, 2)).astype(int)).tolist()

    def found(u: dict[str, np.ndarray]) -> Run:
        return made.problem.states(made.search.parameters(u), steps)

    runs = {"first guess": found(made.start), "found": found(result.parameters)}
    if made.task.problem.picture is None:
        runs["target"] = made.problem.states(made.task.true_parameters, steps)
    still, moving = (partial(_page, made, one, device=device) for one in (picture, picture.for_films))
    write_picture(folder / "found.png", still(list(runs), list(runs.values())).image(steps[-1]))
    compared: Figures = [(f"The end of the run: {', '.join(runs)}.", folder / "found.png")]
    shown = [k for k in EVALUATIONS if k < len(result.history)] or [0]
    searched = [f"evaluation {k}" for k in shown], [found(result.history[k].parameters) for k in shown]
    write_picture(folder / "search.png", still(*searched).image(steps[-1]))
    search: Figures = [("The end of the run as the search went on.", folder / "search.png")]
    if picture.film_frames == 0 or len(steps) < 2:
        return TaskFigures(compared=compared, search=search)
    pair = {name: runs[name] for name in (("found", "target") if "target" in runs else ("first guess", "found"))}
    pace = replace(pace_of(float(made.task.scene.solver.time_step) * np.asarray(steps), picture), of_search=True)
    motion = film(folder / "found.mp4", moving(list(pair), list(pair.values())), steps, pace)
    announce(str(motion))
    sought = film(folder / "search.mp4", moving(*searched), steps, pace)
    search.insert(0, (f"The search in motion, {pace.in_words}.", sought.path))
    found_figures: Figures = [(f"The run, {pace.in_words}: {' and '.join(pair)}.", motion.path)]
    return TaskFigures(found=found_figures, compared=compared, search=search)


def _page(made: Setup, picture: Picture, names: Sequence[str], runs: Sequence[Run], device: Any) -> Page:
    scene, across, half = made.task.scene, len(runs) if len(runs) < 4 else 2, len(runs) > 1
    size = {"width": picture.width // (1 + half), "height": picture.height // (1 + (len(runs) > across))}
    panel = picture.model_copy(update=size)
    places = [run[step].positions for run in runs for step in run]
    artist = painter(scene.model_copy(update={"picture": panel}), places, device)
    filmed = [FilmedRun(artist, partial(_state, made, run)) for run in runs]
    return Page(filmed, partial(side_by_side, across=across, names=names))


def _state(made: Setup, run: Run, step: int) -> State:
    state = run[step]
    colours = colours_of(made.task.scene, state.mass_fractions, len(state.positions), state.colours)
    others = {name: state.state[name].numpy() for name in state.state.names if name.endswith(OF_OPENINGS)}
    out = those(is_out(made.task.scene, others, len(colours)))
    fractions = None if state.mass_fractions is None else state.mass_fractions[out]
    return State(state.positions[out], colours[out], fractions=fractions)


class ExperimentTables(Table):
    problem: tables.ProblemTable


@dataclass(frozen=True)
class MeasuredScene:
    file: str
    scene: Scene
    problem: tables.ProblemTable

    def experiment(self, device: str, precision: str) -> Experiment:
        simulation, folder = Simulation(self.scene, device, precision), Path(self.file).parent
        last = self.problem.steps * float(self.scene.solver.time_step)
        kinds: dict[str, Any] = {"video": _video, "sensor": _series, "tracks": _tracks}
        found = dict[str, Observation]()
        for k, table in enumerate(self.problem.measured):
            try:
                found[table.name] = kinds[table.kind](table, simulation, folder, last)
            except InputError as error:
                raise InputError(f"{self.file}: problem.measured[{k}] ({table.name}): {error}") from None
        return Experiment(simulation, found, self.problem.steps)


@dataclass(frozen=True)
class FitTask:
    experiments: tuple[MeasuredScene, ...]
    fit: tables.FitTable

    @property
    def scene(self) -> Scene:
        return self.experiments[0].scene


def load_fit(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> FitTask:
    file = os.fspath(path)
    data = read_toml(path, overrides, ("optimise", "dataset"))
    if "fit" not in data:
        raise SceneError(file, "fit", MISSING, "a table; use cortado optimise for a task with [optimise]")
    if "optimise" in data:
        raise SceneError(file, "optimise", GIVEN, "left out; use [fit] to describe the search of a fit")
    first, read = _read(data, file, tables.FitTables)
    others = []
    for name in first.problem.also:  # in which a table [fit] is ignored
        path = os.fspath(Path(file).parent / name)
        other, _ = _read(read_toml(path), path, ExperimentTables)
        if other.problem.also:
            wanted = "left out, as another file lists this file"
            raise SceneError(path, "problem.also", list(other.problem.also), wanted)
        others.append(other)
    return FitTask((first, *others), read.fit)


def _read(data: dict[str, Any], file: str, model: type[Table]) -> tuple[MeasuredScene, Any]:
    scene = scene_from_dict(data, file)
    _, found = read_tables(data, scene, file, model)
    if not found.problem.measured:
        raise SceneError(file, "problem.measured", MISSING, "a list of tables, each written [[problem.measured]]")
    return MeasuredScene(file, scene.lasting(steps=found.problem.steps), found.problem), found


def _video(table: tables.VideoTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    renderer = simulation.renderer()
    rows, columns, _ = renderer.shape
    times, frames = read_frames(folder / table.file, (columns, rows), table.crop, table.frame_rate, table.every)
    chosen = _within(times + table.start, last)
    mask = None
    if table.mask is not None:
        picture = open_picture(folder / table.mask)
        cropped = picture if table.crop is None else picture.crop(table.crop)
        warn_of_cropping(f"The mask {folder / table.mask} has", cropped.size, (columns, rows))
        mask = resized(cropped, (columns, rows)).mean(axis=2) > 0.5  # brightness
    return Video(renderer, times[chosen], frames[chosen], mask, table.noise, table.calibrate, table.start)


def _series(table: tables.SensorSeriesTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    sensors = sensors_of(simulation.scene)
    if table.sensor not in sensors:
        raise InputError(f"sensor is {table.sensor!r}, but must be one of {', '.join(sensors) or 'a [[sensor]]'}.")
    sensor, path = sensors[table.sensor], folder / table.file
    known = sensor.columns(simulation.dimension)
    data = _with(measured_columns(path, known, table.sensor, sensors), ("time",), path)
    falls = np.flatnonzero(np.diff(data["time"]) <= 0.0)
    if len(falls):
        before, after = data["time"][falls[0] : falls[0] + 2]
        raise InputError(f"{path} has the time {after:g} s after {before:g} s, but times must rise from line to line.")
    names = [name for name in data if name != "time"]
    for name in names:
        if name not in known:
            raise InputError(f"{path} has the column {name!r}, but the known columns are {', '.join(known)}.")
    times = data["time"]
    chosen = _within(times + table.start, last)
    values = np.stack([data[name] for name in names], axis=1) if names else np.zeros((len(times), 0))
    clock = table.calibrate, table.start
    return SensorSeries(sensor, times[chosen], values[chosen], simulation.dimension, names, table.noise, *clock)


def _tracks(table: tables.TracksTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    path, axes = folder / table.file, ["x", "y", "z"][: simulation.dimension]
    data = _with(measured_columns(path, dict.fromkeys(axes, "m")), ("time", "tracer", *axes), path)
    each, which = np.unique(data["time"] + table.start, return_inverse=True)
    begins = np.diff(each, prepend=-np.inf) > 1e-9 * max(last, 1e-300)
    times, when = each[begins], np.cumsum(begins)[which] - 1
    tracers, who = np.unique(data["tracer"], return_inverse=True)
    once, often = np.unique(np.stack([when, who]), axis=1, return_counts=True)
    if (often > 1).any():
        k, tracer = once[:, int(np.argmax(often > 1))]
        found = f"{often.max()} lines for tracer {tracers[tracer]:g} at {times[k] - table.start:g} s"
        raise InputError(f"{path} has {found}, but must have one line: give each tracer its own number.")
    places = np.full((len(times), len(tracers), len(axes)), np.nan)
    places[when, who] = np.stack([data[axis] for axis in axes], axis=1)
    begin = int(np.argmin(np.abs(times)))
    missing = tracers[np.isnan(places[begin]).any(axis=1)]
    if abs(times[begin]) > 1e-9 * max(last, 1e-300) or len(missing):
        lacking = f" of tracer {missing[0]:g}" if len(missing) else ""
        raise InputError(f"{path} lacks the position{lacking} at the start of the run, time {-table.start:g} s.")
    chosen = _within(times, last) & (times > 0.0)
    clock = table.calibrate, table.start
    return Tracks(simulation, places[begin], times[chosen] - table.start, places[chosen], table.noise, *clock)


def _within(times: np.ndarray, last: float) -> np.ndarray:
    return (times >= -1e-12) & (times <= last * (1.0 + 1e-9))


def _with(data: dict[str, np.ndarray], wanted: tuple[str, ...], path: Path) -> dict[str, np.ndarray]:
    for name in wanted:
        if name not in data:
            raise InputError(f"{path} has the columns {', '.join(data)}, but must have the column {name}.")
        if name in ("time", "tracer") and not np.isfinite(data[name]).all():
            line = int(np.argmin(np.isfinite(data[name]))) + 2
            raise InputError(f"{path}: line {line} has the {name} {data[name][line - 2]:g}, but must have a number.")
    return data
