"""``cortado picture``: a shaded picture, or a film, of a run that is there."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cortado.errors import InputError
from cortado.files.interruption import keeping
from cortado.pictures.film import film, lacking
from cortado.pictures.image_files import write_picture
from cortado.pictures.pace import pace_of
from cortado.runs.colouring import coloured_by
from cortado.runs.picture_settings import shown_as
from cortado.runs.run_folder import RunFolder
from cortado.runs.run_pictures import run_page
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene
from cortado.simulation import Simulation


def picture_settings(lines: int | None, colour: str | None) -> dict[str, Any]:
    """Keys of [picture] that are given by options, as those of `Trajectory.film`."""
    given = {"lines": lines, "colour": colour}
    return {name: value for name, value in given.items() if value is not None}


def camera_override(camera: str | None) -> list[str]:
    """What ``--camera`` replaces in a scene, before ``--set`` does, which may add to it."""
    kind, _, solid = (camera or "").partition(":")
    keys = {"kind": kind, **({"solid": solid} if solid else {})}
    path = ", ".join(f"{name} = {json.dumps(value)}" for name, value in keys.items())
    return [f"picture.camera_path={{{path}}}"] if camera else []


def scene_of_run(folder: RunFolder, overrides: list[str]) -> Scene:
    """The scene of a run that is there, with other keys of [picture]."""
    for override in overrides:
        if not override.startswith("picture."):
            raise InputError(f"--set is {override}, but must begin with picture., as the run is there already.")
    folder.require_meshes()
    return folder.read_scene(overrides)


def draw_run(
    run: Path,
    frame: int,
    as_film: bool,
    out: Path | None,
    overrides: list[str],
    device: str,
    settings: Mapping[str, Any],
) -> str:
    """Draw one recorded frame of a run, counted from the end where it is negative, or a film of all; returns a sentence
    that says where it is."""
    folder = RunFolder.open(run)
    scene = shown_as(scene_of_run(folder, overrides), settings)
    if not folder.trajectory.exists():
        raise InputError(f"{folder.path} has no trajectory; the pictures of a search are in {folder.figures}.")
    trajectory = Trajectory.load(folder.trajectory)
    missing = lacking(scene)
    if missing:
        raise InputError(missing)
    page = run_page(scene, trajectory, device, coloured_by(scene, trajectory, lambda: Simulation(scene, device)))
    if as_film and (scene.picture or Picture()).film_frames == 0:
        raise InputError("--film is given, but picture.film_frames is 0, which is no film: leave out one of them.")
    if as_film:
        path = out or folder.figures / "film.mp4"
        further = "" if path.suffix == ".webp" else ", and the same command goes on with it"
        with keeping(lambda: f"what is drawn is in {path}{further}"):
            made = film(path, page, range(len(trajectory)), pace_of(trajectory.times, scene.picture or Picture()))
        return f"The film is in {path}: {made.pace}."
    if frame not in range(-len(trajectory), len(trajectory)):
        raise InputError(f"--frame is {frame}, but the run has {len(trajectory)} frames, from 0.")
    path = out or folder.figures / "picture.png"
    write_picture(path, page.image(frame))
    return f"The picture is in {path}."
