"""Pictures that change over a run, of one or of several side by side, and films of them."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.files.image_encoding import moving_picture
from cortado.files.terminal import track
from cortado.pictures.plane import PlanePainter, PlaneStage
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.space import SpacePainter, State
from cortado.pictures.tracing.steady import WINDOW
from cortado.runs.pace import Film, Pace
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene

Ahead = Callable[[Iterator[Points]], Iterator[Points]]
Around = tuple[tuple[int, ...], tuple[int, ...]]
"""Numbers of the frames that a film shows before and after one, nearest first."""
ALONE: Around = (), ()
Panel = Callable[[int, Around], Points]
"""From a frame, a number, and those around it to a picture (rows, columns, 3), linear from 0 to 1."""


def alone(images: list[Points]) -> Points:
    """The one picture that there is."""
    (image,) = images
    return image


@dataclass(frozen=True)
class Page:
    """What is seen at each frame: the picture of one panel, or those of several put together."""

    panels: Sequence[Panel]
    composed: Callable[[list[Points]], Points] = alone
    """From the pictures of the panels to the page."""
    fingerprint: str = ""
    """A checksum of all that its pictures are made of; nothing where that is not known."""
    notes: str = ""
    """What somebody who sees it should know, in a sentence; nothing if there is nothing to say."""

    def image(self, frame: int) -> Points:
        """(rows, columns, 3), linear from 0 to 1."""
        return self.composed([panel(frame, ALONE) for panel in self.panels])

    def images(
        self, frames: Sequence[int], ahead: Ahead = iter, begin: int = 0, window: int = WINDOW
    ) -> Iterator[Points]:
        """Those of a film of so many frames in their order, from one of them on, each given so many before and after
        it; ``ahead``: from the pictures that they are made of to the same."""
        shown = range(begin, len(frames))
        drawn = ahead(panel(frames[n], _around(frames, n, window)) for n in shown for panel in self.panels)
        return (self.composed(list(islice(drawn, len(self.panels)))) for _ in shown)


def _around(frames: Sequence[int], n: int, window: int) -> Around:
    return tuple(frames[max(n - window, 0) : n][::-1]), tuple(frames[n + 1 : n + 1 + window])


class FilmedRun:
    """A `Panel`: pictures of the states of one run, of which fluid at rest does not flicker in 3-D."""

    def __init__(self, artist: PlanePainter | SpacePainter, state: Callable[[int], State]):
        """``state``: that of a frame, by its number."""
        self._artist, self._state, self._stills = artist, state, dict[int, Any]()

    def __call__(self, frame: int, around: Around) -> Points:
        """The picture of a frame."""
        artist, state = self._artist, self._state(frame)
        if not any(around) or isinstance(artist, PlanePainter):
            return artist.image(*state)
        known = self._stills
        self._stills = {k: known[k] if k in known else artist.still(self._state(k)) for k in {frame, *sum(around, ())}}
        own = self._stills[frame]
        if own is None:
            return artist.image(*state)
        before, after = ([self._stills[k] for k in side if self._stills[k] is not None] for side in around)
        return artist.steady_image(state, own, before, after)


MOST = 9
"""Pictures; in more of them one sees nothing."""
LEAST = 64
"""Pixels of each picture, along either side."""
AIR = 1.25
"""How much higher a picture is, at least, than what it shows would be if it were as wide as the picture."""


def framed_together(stages: Sequence[PlaneStage | Stage], spare: int = 0) -> tuple[list[PlaneStage | Stage], int]:
    """Stages of one dimension, each in its part of a page as wide as the first one's picture but for some ``spare``
    columns and no higher, all in the same scale, seen by a camera that sees all that any of them shows; and how many go
    into a row. Raises `InputError` where parts are too small."""
    whole, count = stages[0].picture, len(stages)
    page = whole.model_copy(update={"width": max(whole.width - spare, 1)})
    lower, upper = (np.array(ends) for ends in zip(*(stage.ends for stage in stages), strict=True))
    ends = lower.min(axis=0), upper.max(axis=0)
    shown = stages[0].framed(ends, page).seen_size
    across = in_a_row(count, shown, page)
    width, height = page.width // across, page.height // -(-count // across)
    size = {"width": width, "height": min(height, round(AIR * width * shown[1] / shown[0]))}
    if min(size.values()) < LEAST:
        found = f"{count} pictures of {size['width']} x {size['height']} pixels fit into {page.width} x {page.height}"
        raise InputError(f"{found}, but each must have {LEAST} x {LEAST}: ask for more lines, or for fewer runs.")
    return [stage.framed(ends, stage.picture.model_copy(update=size)) for stage in stages], across


def in_a_row(count: int, size: Points, page: Picture) -> int:
    """How many of ``count`` pictures go into a row of a page, so that something as wide and high as ``size`` (2,) is
    large in them, and few places are empty."""

    def gain(across: int) -> float:
        down = -(-count // across)
        scale = min(page.width / across / size[0], page.height / down / size[1])
        return float(scale * count / (across * down))

    return max(range(1, count + 1), key=gain)


SLOW = 0.1
"""Seconds of the run in a second of a film below which fluid at rest is not averaged: it swims slowly enough to be
seen."""


def lacking(scene: Scene) -> str | None:
    """A sentence about the package that shaded pictures of a scene need and that is not there; None where nothing is
    missing."""
    picture = scene.picture or Picture()
    needed = {"av": "PyAV"} if picture.film_frames != 0 else {}
    missing = [name for module, name in needed.items() if find_spec(module) is None]
    if not missing:
        return None
    verb = "which is" if len(missing) == 1 else "which are"
    return f"Shaded pictures need {' and '.join(missing)}, {verb} not installed: pip install av."


def film(path: Path, page: Page, frames: Sequence[int], pace: Pace) -> Film:
    """Write a film of those of the frames that a pace chooses. Where it is interrupted, what is drawn is kept, and the
    next call of the same film goes on after it."""
    shown = [frames[k] for k in pace.frames]
    note = page.fingerprint and f"{page.fingerprint} {len(shown)} {pace.speed}"
    with moving_picture(path, pace.frames_per_second, note, len(shown)) as video:
        there = video.frames
        with track(len(shown) - there, "film") as advance:
            window = 0 if pace.speed is not None and pace.speed < SLOW else WINDOW
            images = page.images(shown, partial(_ahead, len(page.panels)), there, window)
            for image, time in zip(images, pace.times[there:], strict=True):
                video.add(image, time)
                advance()
    return Film(path, pace, page.notes)


def _ahead(count: int, images: Iterator[Points]) -> Iterator[Points]:
    """The same images, of which so many are drawn while those before are used."""
    painter = ThreadPoolExecutor(1, thread_name_prefix="cortado-film")
    try:
        coming = deque(painter.submit(next, images, None) for _ in range(count))
        while True:
            with WARP.lent():  # the painter needs it
                image = coming.popleft().result()
            if image is None:
                return
            coming.append(painter.submit(next, images, None))
            yield image
    finally:
        with WARP.lent():
            painter.shutdown(cancel_futures=True)
