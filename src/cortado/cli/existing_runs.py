"""The commands ``cortado picture`` and ``cortado export`` for existing runs, and user-defined quantities of runs."""

import csv
import json
import os
import runpy
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import CortadoError, InputError, shown
from cortado.files.terminal import keeping
from cortado.pictures.export_formats import export
from cortado.pictures.film import ShownRun, coloured_by, film
from cortado.pictures.image_files import write_picture
from cortado.pictures.pages import add_to_report
from cortado.pictures.run_pictures import device_of, run_page
from cortado.pictures.several_runs import labels, runs_page, shown_alike
from cortado.runs.frames import common_rate, pace_of
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

SWEEP = "sweep.csv"


def named_runs(folders: Sequence[Path]) -> list[RunFolder]:
    """Return the runs in the folders, with all runs of a sweep. Raises `InputError` for a folder without a run."""
    if not folders:
        raise InputError("RUN is missing, but must be the folder of a run, or of a sweep.")
    found: list[RunFolder] = []
    for folder in folders:
        inner, order = sorted(one.parent for one in folder.glob("*/environment.json")), list[str]()
        with (
            suppress(OSError, ValueError, KeyError, csv.Error),
            open(folder / SWEEP, newline="", encoding="utf-8") as file,
        ):
            order = [row["folder"] for row in csv.DictReader(file)]
        inner.sort(key=lambda one: order.index(one.name) if one.name in order else len(order))
        found += [RunFolder.open(one) for one in inner or [folder]]
    return found


class OwnQuantity:
    def __init__(self, where: str):
        """``where`` is FILE.py:FUNCTION."""
        file, _, name = where.rpartition(":")
        if not file.endswith(".py") or not name.isidentifier():
            raise InputError(f"--quantity is {shown(where)}, but must be FILE.py:FUNCTION.")
        try:
            function = runpy.run_path(str(Path(file))).get(name)
        except Exception as problem:
            raise InputError(f"--quantity {where} cannot be read: {_told(problem)}.") from problem
        if not callable(function):
            raise InputError(f"{file} has no function {name}, which --quantity names.")
        self.where, self.name, self._function = where, name, function

    def __call__(self, trajectory: Trajectory) -> float:
        try:
            found = self._function(trajectory)
            value = np.asarray(found, dtype=np.float64)
        except CortadoError:
            raise
        except Exception as problem:
            raise InputError(f"--quantity {self.where} failed: {_told(problem)}.") from problem
        if value.ndim:
            raise InputError(f"--quantity {self.where} returned {shown(found)}, but must return a number.")
        return float(value)


def _told(problem: Exception) -> str:
    return " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".")


def camera_override(camera: str | None) -> list[str]:
    """Convert ``--camera`` to an override. The camera's override must come before the overrides of ``--set``."""
    kind, _, solid = (camera or "").partition(":")
    keys = {"kind": kind, **({"solid": solid} if solid else {})}
    path = ", ".join(f"{name} = {json.dumps(value)}" for name, value in keys.items())
    return [f"picture.camera_path={{{path}}}"] if camera else []


def scene_of_run(folder: RunFolder, overrides: list[str]) -> Scene:
    for override in overrides:
        if not override.startswith("picture."):
            wanted = "must begin with picture., as the run has been computed already"
            raise InputError(f"--set is {override}, but {wanted}.")
    folder.require_files()
    return folder.read_scene(overrides)


def draw_runs(
    runs: Sequence[Path],
    frame: int,
    as_film: bool,
    out: Path | None,
    overrides: list[str],
    device_name: str,
    settings: Mapping[str, Any],
) -> str:
    folders, device = named_runs(runs), device_of(device_name)
    look = scene_of_run(folders[0], overrides)
    others = [scene_of_run(folder, []) for folder in folders[1:]]
    trajectories = [_trajectory(folder) for folder in folders]
    scenes = shown_alike([look, *others], trajectories, settings)
    each = [
        ShownRun(scene, trajectory, coloured_by(scene, trajectory, partial(Simulation, scene, device_name)))
        for scene, trajectory in zip(scenes, trajectories, strict=True)
    ]
    picture = scenes[0].picture or Picture()
    if as_film and picture.film_frames == 0:
        raise InputError("--film is given, but picture.film_frames is 0, which is no film: leave out one of them.")
    if len(each) == 1:
        page, times = run_page(each[0], device), trajectories[0].due
        place, name = folders[0].figures, "film" if as_film else "picture"
    else:
        names = [folder.path.name for folder in folders]
        numbers = [f"run {k}" for k in range(1, len(names) + 1)]
        page, times = runs_page(each, labels(scenes, names if len(set(names)) == len(names) else numbers), device)
        place, name = Path(os.path.commonpath([folder.path.parent for folder in folders])), "side_by_side"
    if as_film:
        path = out or place / f"{name}.mp4"
        further = "" if path.suffix == ".webp" else ", and the same command goes on with it"
        with keeping(lambda: f"what is drawn is in {path}{further}"):
            pace = pace_of(times, picture, common_rate(run.marks for run in trajectories))
            made = film(path, page, range(len(times)), pace)
        if path.parent == folders[0].figures:
            add_to_report(folders[0], f"A film, {made.in_words}.", path)
        return f"The film is in {path}: {made.in_words}."
    if frame not in range(-len(times), len(times)):
        of = "the run has" if len(each) == 1 else "together the runs have"
        raise InputError(f"--frame is {frame}, but {of} {len(times)} frames, numbered from 0.")
    path = out or place / f"{name}.png"
    write_picture(path, page.image(frame % len(times)))
    if path.parent == folders[0].figures:
        add_to_report(folders[0], f"The fluid at {times[frame]:.4g} s.", path)
    return f"The picture is in {path}{f': {page.notes}' if page.notes else ''}."


def _trajectory(folder: RunFolder) -> Trajectory:
    if not folder.trajectory.exists():
        found = f"{folder.path} has no trajectory, but must be the folder of a run of a scene"
        raise InputError(f"{found}; the pictures of a search are in {folder.figures}.")
    return Trajectory.load(folder.trajectory)


def export_run(run: Path, to: str, out: Path | None, every: int, overrides: list[str]) -> str:
    folder = RunFolder.open(run)
    trajectory, scene = _trajectory(folder)[::every], scene_of_run(folder, overrides)
    found = export(trajectory, folder.path / to if out is None else out, to, scene, lambda: Simulation(scene))
    return f"The run is in {found}."
