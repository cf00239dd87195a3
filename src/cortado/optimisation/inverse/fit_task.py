"""What ``cortado fit`` reads: a scene with the tables [problem], of measured data, and [fit]; and that data."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, SceneError
from cortado.files.disk import read_columns
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.observations import Observation, SensorSeries, Tracks, Video
from cortado.optimisation.inverse.tables import (
    FitTable,
    FitTables,
    MeasuredTable,
    ProblemTable,
    SensorSeriesTable,
    TracksTable,
    VideoTable,
)
from cortado.optimisation.inverse.task import GIVEN, read_tables
from cortado.pictures.image_files import open_picture, read_frames, resized, warn_of_cropping
from cortado.runs.probes import sensors_of
from cortado.scene.scene import Scene, scene_from_dict
from cortado.scene.tables import MISSING, Table
from cortado.scene.toml import read_toml
from cortado.simulation import Simulation

LIGHT = 0.5
"""Brightness above which a pixel of a mask counts."""


class ExperimentTables(Table):
    """The table [problem] of a file with one more experiment."""

    problem: ProblemTable


@dataclass(frozen=True)
class MeasuredScene:
    """A scene with the measurements of an experiment, as read from a file."""

    file: str
    scene: Scene
    problem: ProblemTable

    def experiment(self, device: str, precision: str) -> Experiment:
        """Make the experiment on a device; raise `InputError` or `SceneError` for data that do not fit or open."""
        simulation, folder = Simulation(self.scene, device, precision), Path(self.file).parent
        last = self.problem.steps * float(self.scene.solver.time_step)
        found = {}
        for k, table in enumerate(self.problem.measured):
            try:
                found[table.name] = observation(table, simulation, folder, last)
            except InputError as error:
                raise InputError(f"{self.file}: problem.measured[{k}] ({table.name}): {error}") from None
        return Experiment(simulation, found, self.problem.steps)


@dataclass(frozen=True)
class FitTask:
    """A task of `cortado fit`: measured experiments, and the parameters that are fitted to them."""

    experiments: tuple[MeasuredScene, ...]
    fit: FitTable

    @property
    def scene(self) -> Scene:
        """Return the scene of the first experiment."""
        return self.experiments[0].scene


def load_fit(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> FitTask:
    """Read a task of `cortado fit` from a TOML file; raise `SceneError` in one sentence."""
    file = os.fspath(path)
    data = read_toml(path, overrides, ("optimise", "dataset"))
    if "fit" not in data:
        raise SceneError(file, "fit", MISSING, "a table; a task with [optimise] is solved by cortado optimise")
    if "optimise" in data:
        raise SceneError(file, "optimise", GIVEN, "left out of a fit, whose search [fit] describes")
    first, tables = _read(data, file, FitTables)
    others = [_also(Path(file).parent / name) for name in first.problem.also]
    return FitTask((first, *others), tables.fit)


def _also(path: Path) -> MeasuredScene:
    """Read one more experiment from its file, which may have a table [fit] of its own that is ignored."""
    found, _ = _read(read_toml(path), os.fspath(path), ExperimentTables)
    if found.problem.also:
        raise SceneError(
            found.file, "problem.also", list(found.problem.also), "left out, as another file names this one"
        )
    return found


def _read(data: dict[str, Any], file: str, model: type[Table]) -> tuple[MeasuredScene, Any]:
    scene = scene_from_dict(data, file)
    _, tables = read_tables(data, scene, file, model)
    if not tables.problem.measured:
        raise SceneError(file, "problem.measured", MISSING, "a list of tables, each written [[problem.measured]]")
    return MeasuredScene(file, scene.lasting(steps=tables.problem.steps), tables.problem), tables


@singledispatch
def observation(table: MeasuredTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    """Make the observation that a table describes, up to the ``last`` time of the run [s]; its files are in a folder.
    Raises `InputError`."""
    raise NotImplementedError(type(table))


@observation.register
def _(table: VideoTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    renderer = simulation.renderer()
    rows, columns, _ = renderer.shape
    times, frames = read_frames(folder / table.file, (columns, rows), table.crop, table.frame_rate, table.every)
    chosen = _within(times + table.start, last)
    mask = None
    if table.mask is not None:
        picture = open_picture(folder / table.mask)
        cropped = picture if table.crop is None else picture.crop(table.crop)
        warn_of_cropping(f"The mask {folder / table.mask} has", cropped.size, (columns, rows))
        mask = resized(cropped, (columns, rows)).mean(axis=2) > LIGHT
    return Video(renderer, times[chosen], frames[chosen], mask, table.noise, table.calibrate, table.start)


@observation.register
def _(table: SensorSeriesTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    sensors = sensors_of(simulation.scene)
    if table.sensor not in sensors:
        raise InputError(f"sensor is {table.sensor!r}, but must be one of {', '.join(sensors) or 'the [[sensor]]s'}.")
    sensor, path = sensors[table.sensor], folder / table.file
    data = _with(read_columns(path), ("time",), path)
    falls = np.flatnonzero(np.diff(data["time"]) <= 0.0)
    if len(falls):
        before, after = data["time"][falls[0] : falls[0] + 2]
        raise InputError(f"{path} has the time {after:g} s after {before:g} s, but times must rise from line to line.")
    known = sensor.columns(simulation.dimension)
    names = [name for name in data if name != "time"]
    for name in names:
        if name not in known:
            raise InputError(f"{path} has the column {name!r}, but must have some of {', '.join(known)}.")
    times = data["time"]
    chosen = _within(times + table.start, last)
    values = np.stack([data[name] for name in names], axis=1) if names else np.zeros((len(times), 0))
    clock = table.calibrate, table.start
    return SensorSeries(sensor, times[chosen], values[chosen], simulation.dimension, names, table.noise, *clock)


@observation.register
def _(table: TracksTable, simulation: Simulation, folder: Path, last: float) -> Observation:
    path, axes = folder / table.file, ["x", "y", "z"][: simulation.dimension]
    data = _with(read_columns(path), ("time", "tracer", *axes), path)
    times, when = _instants(data["time"] + table.start, 1e-9 * max(last, 1e-300))
    tracers, who = np.unique(data["tracer"], return_inverse=True)
    once, often = np.unique(np.stack([when, who]), axis=1, return_counts=True)
    if (often > 1).any():
        k, tracer = once[:, int(np.argmax(often > 1))]
        found = f"{often.max()} lines for tracer {tracers[tracer]:g} at {times[k] - table.start:g} s"
        raise InputError(f"{path} has {found}, but must have one: number the tracers each for itself.")
    places = np.full((len(times), len(tracers), len(axes)), np.nan)
    places[when, who] = np.stack([data[axis] for axis in axes], axis=1)
    begin = int(np.argmin(np.abs(times)))
    missing = tracers[np.isnan(places[begin]).any(axis=1)]
    if abs(times[begin]) > 1e-9 * max(last, 1e-300) or len(missing):
        lacking = f" of tracer {missing[0]:g}" if len(missing) else ""
        raise InputError(f"{path} lacks the place{lacking} at the start of the run, time {-table.start:g} s.")
    chosen = _within(times, last) & (times > 0.0)
    clock = table.calibrate, table.start
    return Tracks(simulation, places[begin], times[chosen] - table.start, places[chosen], table.noise, *clock)


def _instants(times: np.ndarray, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times that are further apart than ``apart``, in order, and each given time's index among them."""
    each, which = np.unique(times, return_inverse=True)
    begins = np.diff(each, prepend=-np.inf) > apart
    return each[begins], np.cumsum(begins)[which] - 1


def _within(times: np.ndarray, last: float) -> np.ndarray:
    """Return a mask of the times that are within the run."""
    return (times >= -1e-12) & (times <= last * (1.0 + 1e-9))


def _with(data: dict[str, np.ndarray], wanted: tuple[str, ...], path: Path) -> dict[str, np.ndarray]:
    for name in wanted:
        if name not in data:
            raise InputError(f"{path} has the columns {', '.join(data)}, but must have {name}.")
        if name in ("time", "tracer") and not np.isfinite(data[name]).all():
            line = int(np.argmin(np.isfinite(data[name]))) + 2
            raise InputError(f"{path}: line {line} has the {name} {data[name][line - 2]:g}, but must have a number.")
    return data
