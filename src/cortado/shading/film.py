"""Shaded pictures and a film of one run."""

import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cortado.io.pictures import write_picture
from cortado.io.progress import track
from cortado.io.trajectory import Trajectory
from cortado.io.video import write_video
from cortado.lattice.shapes import Points
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene
from cortado.shading.page import Page
from cortado.shading.painter import colours_of, painter
from cortado.shading.scenery import State

SECONDS = 40.0
"""[s] that a film may take to draw, about; it has fewer frames where one takes long."""
LEAST_FRAMES = 16
"""Of a film, however long they take."""
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
    needed = {"av": "PyAV"} if picture.film_frames else {}
    if scene.dimension == 3 and picture.surface == "liquid":
        needed["pysplashsurf"] = "pysplashsurf"
    missing = [name for module, name in needed.items() if find_spec(module) is None]
    if not missing:
        return None
    verb = "which is" if len(missing) == 1 else "which are"
    return f"Shaded pictures need {' and '.join(missing)}, {verb} not installed: pip install 'cortado-sph[pictures]'."


def run_pictures(scene: Scene, trajectory: Trajectory, folder: Path, device: Any) -> Figures:
    """Draw the first and the last state of a run, and a film of it, into a folder; (caption, path) of each."""
    page = run_page(scene, trajectory, device)
    last, most = len(trajectory) - 1, (scene.picture or Picture()).film_frames
    stills: Figures = []
    for k, name, words in ((0, "first", "at the start"), (last, "last", "at the end")):
        path = folder / f"{name}.png"
        write_picture(path, page.image(k))
        stills.append((f"The fluid {words}, t = {trajectory.times[k]:.4g} s.", path))
    if not most or not last:
        return stills
    return [("The run.", film(folder / "film.mp4", page, range(last + 1), most)), *stills]


def run_page(scene: Scene, trajectory: Trajectory, device: Any) -> Page:
    """The frames of a run by their number; all are taken from one place."""

    def state(k: int) -> State:
        frame = trajectory[k]
        return frame.positions, colours_of(scene, frame.mass_fractions, trajectory.particles)

    return Page(painter(scene, trajectory.positions, device), [state])


def film(path: Path, page: Page, frames: Sequence[int], most: int) -> Path:
    """Write a film of so many of these frames at most, evenly chosen, as are drawn in `SECONDS`; returns its path."""
    begun = time.monotonic()
    page.image(frames[len(frames) // 2])
    each = (time.monotonic() - begun) * (ALONE + (1.0 - ALONE) / page.painter.at_once)
    count = min(most, len(frames), max(int(SECONDS / max(each, 1e-6)), LEAST_FRAMES))
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]
    rate = float(np.clip(len(chosen) / SHORTEST, SLOWEST, QUICKEST))
    with track(len(chosen), "film") as advance:

        def told(image: Points) -> Points:
            advance()
            return image

        return write_video(path, map(told, page.images(chosen)), rate)
