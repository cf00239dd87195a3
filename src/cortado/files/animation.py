"""Linear images as an animated WebP, which pages of text show moving without a player."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from io import BytesIO
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.files.atomic import write_atomically
from cortado.files.srgb import to_srgb
from cortado.files.video import writing

SUFFIX = ".webp"
QUALITY = 80
"""Of lossy WebP, from 0 to 100."""
REST = 1.5
"""Seconds that the last frame is shown before the first one comes again."""


class MovingPicture(Protocol):
    """What grows by a frame at a time."""

    frames: int
    """How many it has."""

    def add(self, image: ArrayLike, time: float) -> None:
        """One more frame, a linear image (rows, columns, 3), shown from a time [s] on."""


class Animation:
    """The frames of an animated WebP, in memory until all of them are there."""

    def __init__(self) -> None:
        self._images: list[NDArray[np.uint8]] = []
        self._times: list[float] = []
        self.frames = 0
        """How many it has."""

    def add(self, image: ArrayLike, time: float) -> None:
        """See `MovingPicture`."""
        self._images.append(to_srgb(image))
        self._times.append(time)
        self.frames += 1

    def encoded(self) -> bytes:
        """The file, which repeats for ever."""
        from PIL import Image

        first, *others = [Image.fromarray(pixels) for pixels in self._images]
        durations = [*np.diff(self._times), REST]
        content, milliseconds = BytesIO(), [max(round(1e3 * float(seconds)), 1) for seconds in durations]
        own = {"duration": milliseconds, "loop": 0, "quality": QUALITY, "method": 4}
        first.save(content, format="WEBP", save_all=True, append_images=others, **own)
        return content.getvalue()


def moving_picture(
    path: Path, frames_per_second: float, note: str = "", count: int = 0
) -> AbstractContextManager[MovingPicture]:
    """An animation of a path that ends in .webp, and else a video: see `writing` of `cortado.files.video`."""
    return _animating(path) if path.suffix.lower() == SUFFIX else writing(path, frames_per_second, note, count)


@contextmanager
def _animating(path: Path) -> Iterator[Animation]:
    """An animation that appears under its path when the block ends. Where it is interrupted, the frames so far
    appear."""
    animation = Animation()
    try:
        yield animation
    except KeyboardInterrupt:
        if animation.frames:
            write_atomically(path, animation.encoded())
        raise
    if not animation.frames:
        raise InputError(f"The animation {path} has no frames; give one at least.")
    write_atomically(path, animation.encoded())
