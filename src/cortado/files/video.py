"""Linear images as a video that every browser plays: H.264 in an mp4."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.files.atomic import write_atomically
from cortado.files.srgb import to_srgb

MOST_FRAMES = 120
"""Frames of a report's video."""
QUALITY = "18"
"""Constant rate factor of x264: 0 loses nothing, 51 nearly everything; at 18 the eye sees no difference."""


def write_video(path: str | Path, frames: Iterable[ArrayLike], frames_per_second: float = 25) -> Path:
    """Writes a video and returns its path. The file appears whole, when the last frame is in it.

    Args:
        path: ends in .mp4.
        frames: linear images (rows, columns, 3) of one size, taken one at a time; an odd side is made even by
            repeating the last row or column.
        frames_per_second: one frame of a simulation may last longer or shorter than in life.

    Raises:
        InputError: PyAV is missing, there are no frames or frames of several sizes, or the file cannot be written.
    """
    av = pyav()
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"The video {path} must end in .mp4.")
    if not 0.0 < frames_per_second < np.inf:
        raise InputError(f"frames_per_second is {frames_per_second}, but must be a positive number.")
    images = _even_images(frames)
    first = next(images, None)
    if first is None:
        raise InputError(f"The video {path} has no frames; give one at least.")
    content = BytesIO()
    with av.open(content, "w", format="mp4") as container:
        rate = Fraction(frames_per_second).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": QUALITY})
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        _describe_colours(stream.codec_context)
        container.mux(stream.encode(_frame(av, first)))
        for image in images:
            container.mux(stream.encode(_frame(av, image)))
        container.mux(stream.encode())
    write_atomically(path, content.getvalue())
    return path


def pyav() -> Any:
    """The library; raises `InputError` where it is missing."""
    try:
        import av
    except ModuleNotFoundError as problem:
        raise InputError("Videos need PyAV, which is not installed: pip install 'cortado-sph[video]'.") from problem
    return av


def _even_images(frames: Iterable[ArrayLike]) -> Iterator[NDArray[np.uint8]]:
    """(rows, columns, 3) sRGB, both sides even, as yuv420p has one colour for two by two pixels"""
    shape = None
    for k, frame in enumerate(frames):
        image = to_srgb(frame)
        shape = shape or image.shape
        if image.shape != shape:
            raise InputError(f"Frame {k} of the video has shape {image.shape}, but those before it {shape}.")
        rows, columns = shape[:2]
        yield np.pad(image, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")


def _frame(av: Any, image: NDArray[np.uint8]) -> Any:
    """The image as luma and chroma of ITU-R BT.709, which `_describe_colours` tells the player."""
    frame = av.VideoFrame.from_ndarray(image, format="rgb24")
    return frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")


def _describe_colours(context: Any) -> None:
    """Primaries and matrix of BT.709, curve of sRGB, 16 to 235: the numbers of ITU-T H.273."""
    context.color_primaries, context.colorspace, context.color_trc, context.color_range = 1, 1, 13, 1
