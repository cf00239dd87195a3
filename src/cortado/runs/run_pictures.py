"""Shaded pictures, a film and a view of one run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cortado.discretise.shapes import Points, corners
from cortado.files.progress import announce
from cortado.pictures.film import film
from cortado.pictures.grid import LEAST
from cortado.pictures.image_files import write_picture
from cortado.pictures.pace import pace_of
from cortado.pictures.page import Page, alone
from cortado.pictures.plane_stage import PlaneStage
from cortado.pictures.scale import Scale
from cortado.pictures.scene_view import scene_view
from cortado.pictures.stage import Stage
from cortado.runs.marks import common_rate
from cortado.runs.report import Figures
from cortado.runs.shown_run import ShownRun
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene


def run_pictures(
    scene: Scene, trajectory: Trajectory, folder: Path, device: Any, values: NDArray | None = None
) -> Figures:
    """Draw the first and the last state of a run, and a film of it, into a folder; (caption, path) of each. ``values``
    as those of `run_page`."""
    page, last = run_page(scene, trajectory, device, values), len(trajectory) - 1
    stills: Figures = []
    for k, name, words in ((0, "first", "at the start"), (last, "last", "at the end")):
        path = folder / f"{name}.png"
        write_picture(path, page.image(k))
        stills.append((f"The fluid {words}, t = {trajectory.times[k]:.4g} s.", path))
    picture = scene.picture or Picture()
    if picture.film_frames == 0 or not last:
        return stills
    pace = pace_of(trajectory.due, picture, common_rate([trajectory.marks]))
    made = film(folder / "film.mp4", page, range(last + 1), pace)
    announce(str(made))
    return [(f"The run, {made.pace.in_words}.", made.path), *stills]


def run_page(
    scene: Scene, trajectory: Trajectory, device: Any, values: NDArray | None = None, unit: str | None = None
) -> Page:
    """The frames of a run by their number. ``values`` (frames, n): what the scene colours its particles by; ``unit``
    of what all scenes do not have."""
    run, picture = ShownRun(scene, trajectory, values), scene.picture or Picture()
    if values is None:
        return Page([run.panel(run.stage, device, None)], fingerprint=run.fingerprint)
    scale = Scale.of(picture.colour, values, unit)
    stage, composed = _with_scale(run.stage, scale)
    return Page([run.panel(stage, device, scale)], lambda images: composed(alone(images)), run.fingerprint)


def _with_scale(stage: PlaneStage | Stage, scale: Scale) -> tuple[PlaneStage | Stage, Callable[[Points], Points]]:
    """Where a picture has a scale at its right edge: on it, or beside a narrower one if it would cover what is
    shown."""
    free = stage.picture.width - scale.columns(stage.picture.height)
    is_covered = stage.on_screen(corners(*stage.ends))[:, 0].max() > free
    if not is_covered or free < LEAST:
        return stage, scale.on
    return stage.framed(stage.ends, stage.picture.model_copy(update={"width": free})), scale.beside


def trajectory_view(scene: Scene, trajectory: Trajectory) -> str:
    """HTML that shows a run; see `scene_view`."""
    return scene_view(scene, {scene.name: list(trajectory)}, trajectory.times)
