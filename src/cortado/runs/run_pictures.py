"""Shaded pictures, a film and a view of one run."""

from pathlib import Path
from typing import Any

from cortado.discretise.shapes import Points
from cortado.pictures.film import film
from cortado.pictures.image_files import write_picture
from cortado.pictures.page import Page, alone
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.scale import Scale
from cortado.pictures.scene_view import scene_view
from cortado.pictures.scenery import State
from cortado.runs.moving_painter import MovingPainter
from cortado.runs.report import Figures
from cortado.runs.solid_motion import moved
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene


def run_pictures(
    scene: Scene, trajectory: Trajectory, folder: Path, device: Any, values: Points | None = None
) -> Figures:
    """Draw the first and the last state of a run, and a film of it, into a folder; (caption, path) of each. ``values``
    as those of `run_page`."""
    page = run_page(scene, trajectory, device, values)
    last, asked = len(trajectory) - 1, (scene.picture or Picture()).film_frames
    stills: Figures = []
    for k, name, words in ((0, "first", "at the start"), (last, "last", "at the end")):
        path = folder / f"{name}.png"
        write_picture(path, page.image(k))
        stills.append((f"The fluid {words}, t = {trajectory.times[k]:.4g} s.", path))
    if asked == 0 or not last:
        return stills
    return [("The run.", film(folder / "film.mp4", page, range(last + 1), asked)), *stills]


def run_page(scene: Scene, trajectory: Trajectory, device: Any, values: Points | None = None) -> Page:
    """The frames of a run by their number; all are taken from one place. ``values`` (frames, n): what the scene colours
    its particles by."""
    name = (scene.picture or Picture()).colour_by
    scale = None if name is None or values is None else Scale.of(name, values)
    moving = MovingPainter(scene, trajectory, device) if moved(scene, trajectory.others) else None

    def state(k: int) -> State:
        if moving is not None:
            moving.frame = k
        frame = trajectory[k]
        if scale is not None and values is not None:
            return frame.positions, scale.colours(values[k])
        return frame.positions, colours_of(scene, frame.mass_fractions, trajectory.particles)

    draws = moving or painter(scene, trajectory.positions, device)
    return Page(draws, [state]) if scale is None else Page(draws, [state], lambda images: scale.beside(alone(images)))


def trajectory_view(scene: Scene, trajectory: Trajectory) -> str:
    """HTML that shows a run; see `scene_view`."""
    return scene_view(scene, {scene.name: list(trajectory)}, trajectory.times)
