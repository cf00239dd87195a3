"""Shaded pictures and a film of one run."""

import time
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import CortadoWarning
from cortado.io.pictures import write_picture
from cortado.io.progress import track
from cortado.io.terminal import note
from cortado.io.trajectory import Trajectory
from cortado.io.video import write_video
from cortado.lattice.shapes import Points
from cortado.scene.picture import MOST_FRAMES, Picture
from cortado.scene.scene import Scene
from cortado.shading.page import Page, alone
from cortado.shading.painter import colours_of, painter
from cortado.shading.scale import Scale
from cortado.shading.scenery import State
from cortado.words import counted

SECONDS = 40.0
"""[s] that a film may take to draw, about, where its scene does not say how many frames it has."""
LEAST_FRAMES = 16
"""Of such a film, however long they take."""
ALONE = 0.25
"""The part of the time of a picture of a large fluid that is not shared by processes, about."""
SHORTEST, SLOWEST, QUICKEST = 4.0, 6.0, 25.0
"""[s] that a film lasts if it can, and its frames per second at least and at most."""
Figures = list[tuple[str, str | Path]]
"""(caption, path) of each picture or film"""


def lacking(scene: Scene) -> str | None:
    """A sentence about the package that shaded pictures of a scene need and that is not there; None where nothing is
    missing."""
    picture = scene.picture or Picture()
    needed = {"av": "PyAV"} if picture.most_frames else {}
    if scene.dimension == 3 and picture.surface == "liquid":
        needed["pysplashsurf"] = "pysplashsurf"
    missing = [name for module, name in needed.items() if find_spec(module) is None]
    if not missing:
        return None
    verb = "which is" if len(missing) == 1 else "which are"
    return f"Shaded pictures need {' and '.join(missing)}, {verb} not installed: pip install 'cortado-sph[pictures]'."


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
    name, draws = (scene.picture or Picture()).colour_by, painter(scene, trajectory.positions, device)
    if name is not None and values is not None:
        scale = Scale.of(name, values)
        return Page(
            draws,
            [lambda k: (trajectory.positions[k], scale.colours(values[k]))],
            lambda images: scale.beside(alone(images)),
        )

    def state(k: int) -> State:
        frame = trajectory[k]
        return frame.positions, colours_of(scene, frame.mass_fractions, trajectory.particles)

    return Page(draws, [state])


def film(path: Path, page: Page, frames: Sequence[int], asked: int | None = None) -> Path:
    """Write a film of so many of these frames, evenly chosen; where none are asked for of so many as are drawn in
    `SECONDS`. Says how many are left out; returns its path."""
    count = _in_time(path, page, frames) if asked is None else _there(path, len(frames), asked)
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]
    rate = float(np.clip(len(chosen) / SHORTEST, SLOWEST, QUICKEST))
    with track(len(chosen), "film") as advance:

        def told(image: Points) -> Points:
            advance()
            return image

        return write_video(path, map(told, page.images(chosen)), rate)


def _there(path: Path, most: int, asked: int) -> int:
    """How many frames a film has of those that are asked for, with a warning where that is not all."""
    if most < asked:
        found = f"{path.name} has {counted(most, 'frame')} of the {asked} that picture.film_frames asks for"
        advice = "a smaller --record-every or more steps give more"
        warnings.warn(f"{found}, as the run has no more; {advice}.", CortadoWarning, stacklevel=4)
    return min(asked, most)


def _in_time(path: Path, page: Page, frames: Sequence[int]) -> int:
    """How many frames are drawn in `SECONDS`, about."""
    begun = time.monotonic()
    page.image(frames[len(frames) // 2])
    each = (time.monotonic() - begun) * (ALONE + (1.0 - ALONE) / page.painter.at_once)
    most = min(MOST_FRAMES, len(frames))
    count = min(most, max(int(SECONDS / max(each, 1e-6)), LEAST_FRAMES))
    if count < most:
        found = f"{path.name} has {count} of {most} frames, as all of them would take about {most * each:.0f} s"
        note(f"{found}; picture.film_frames={most} draws them.")
    return count
