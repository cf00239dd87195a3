"""Films of shaded pictures."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.files.animation import moving_picture
from cortado.files.progress import track
from cortado.pictures.page import Page
from cortado.pictures.steady import WINDOW
from cortado.runs.film import Film, Pace
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene

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
