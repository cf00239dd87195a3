"""Films of shaded pictures."""

import time
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from cortado.discretise.shapes import Points
from cortado.errors import CortadoWarning
from cortado.files.progress import track
from cortado.files.terminal import note
from cortado.files.video import write_video
from cortado.pictures.page import Page
from cortado.scene.picture import MOST_FRAMES, Picture
from cortado.scene.scene import Scene
from cortado.words import counted

SECONDS = 40.0
"""[s] that a film may take to draw, about, where its scene does not say how many frames it has."""
LEAST_FRAMES = 16
"""Of such a film, however long they take."""
ALONE = 0.25
"""The part of the time of a picture of a large fluid that is not shared by processes, about."""
SHORTEST, SLOWEST, QUICKEST = 4.0, 6.0, 25.0
"""[s] that a film lasts if it can, and its frames per second at least and at most."""


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
