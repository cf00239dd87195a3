"""Linear images as a video that every browser plays: H.264 in an mp4."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.files.atomic import sentences, unfinished
from cortado.files.interruption import held
from cortado.files.srgb import to_srgb

QUALITY = "18"
"""Constant rate factor of x264: 0 loses nothing, 51 nearly everything; at 18 the eye sees no difference."""
BITS = 1.2e6
"""A second at most of 1920 x 1080 pixels, over some seconds: 9.6 MB in the first minute."""
THREADS = 8
"""Of the encoder, each at a frame of its own while others are drawn; however many cores there are, as the file depends
on it."""
HELPERS = 4
"""Threads that convert the parts of a frame."""
TICKS = 90_000
"""Of a second, in which times of frames are counted."""


class Video:
    """A video that grows by a frame at a time; see `writing`."""

    def __init__(self, container: Any, frames_per_second: float):
        self._container, self._rate, self._colours = container, frames_per_second, _Colours()
        self._helpers = ThreadPoolExecutor(HELPERS, thread_name_prefix="cortado-video")
        self._stream: Any = None
        self._shape: tuple[int, ...] | None = None
        self.frames = 0
        """How many it has."""

    def add(self, image: ArrayLike, time: float) -> None:
        """One more frame, shown from a time [s] on: a linear image (rows, columns, 3), of which the last row or column
        is repeated where a side is odd."""
        pixels = to_srgb(image, self._helpers.map)
        self._shape = self._shape or pixels.shape
        if pixels.shape != self._shape:
            found = f"Frame {self.frames} of the video has shape {pixels.shape}"
            raise InputError(f"{found}, but those before it {self._shape}.")
        even = _even(pixels)
        frame, stream = self._colours.frame(even), self._stream_of(even.shape[1], even.shape[0])
        frame.pts, frame.duration, frame.time_base = round(time * TICKS), round(TICKS / self._rate), stream.time_base
        with held():
            self._container.mux(stream.encode(frame))
            self.frames += 1

    def copy(self, other: Any) -> None:
        """The frames of a video that was written here, which is open, as they are, before others are added."""
        from av.bitstream import BitStreamFilterContext

        source = other.streams.video[0]
        own, plain = self._stream_of(source.width, source.height), BitStreamFilterContext("h264_mp4toannexb", source)
        for packet in other.demux(source):
            for part in plain.filter(None if packet.dts is None else packet):
                part.stream = own
                self._container.mux(part)
        self.frames = source.frames

    def finish(self) -> None:
        """Write what the encoder still holds."""
        self._helpers.shutdown()
        if self._stream is not None:
            self._container.mux(self._stream.encode())

    def _stream_of(self, width: int, height: int) -> Any:
        """The stream, made for the first frame. No frame depends on a later one, so that others can follow a copy."""
        if self._stream is None:
            most = BITS * (width * height / (1920 * 1080)) ** 0.75
            options = {"crf": QUALITY, "bf": "0", "maxrate": f"{most:.0f}", "bufsize": f"{4.0 * most:.0f}"}
            rate = Fraction(self._rate).limit_denominator(1001)
            self._stream = self._container.add_stream("libx264", rate=rate, options=options)
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            context = self._stream.codec_context
            self._stream.time_base = context.time_base = Fraction(1, TICKS)
            context.thread_count, context.thread_type = THREADS, "FRAME"
            _describe_colours(context)
        return self._stream


@contextmanager
def writing(path: str | Path, frames_per_second: float = 25.0, note: str = "", count: int = 0) -> Iterator[Video]:
    """A video that appears under its path when the block ends. Where it is interrupted, the frames so far appear, and
    the next call with the same ``note`` and ``count`` begins with them.

    Args:
        path: ends in .mp4.
        frames_per_second: about; each frame has a time of its own.
        note: what the video is made of, which is written into it.
        count: how many frames it will have.

    Raises:
        InputError: PyAV is missing, there are no frames or frames of several sizes, or the file cannot be written.
        ComputationError: the disk is full.
    """
    av, path = pyav(), Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"The film {path} must end in .mp4, or in .webp.")
    if not 0.0 < frames_per_second < np.inf:
        raise InputError(f"frames_per_second is {frames_per_second}, but must be a positive number.")
    temporary = unfinished(path)
    with sentences(path):
        try:
            with open(temporary, "xb") as file:
                container = av.open(file, "w", format="mp4", options={"movflags": "+faststart"})
                container.metadata["comment"] = note
                video = Video(container, frames_per_second)
                _begin(av, video, path, note, count)
                try:
                    yield video
                except KeyboardInterrupt:
                    if video.frames:
                        _end(video, container, file)
                        os.replace(temporary, path)
                    raise
                if not video.frames:
                    raise InputError(f"The video {path} has no frames; give one at least.")
                _end(video, container, file)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def write_video(path: str | Path, frames: Iterable[ArrayLike], frames_per_second: float = 25.0) -> Path:
    """Write a video of linear images (rows, columns, 3) of one size, taken one at a time, and return its path; errors
    as of `writing`."""
    with writing(path, frames_per_second) as video:
        for k, frame in enumerate(frames):
            video.add(frame, k / frames_per_second)
    return Path(path)


def _begin(av: Any, video: Video, path: Path, note: str, count: int) -> None:
    """With the frames of one that was interrupted, if it is there."""
    if not note or not path.is_file():
        return
    try:
        former = av.open(str(path))
    except (av.error.FFmpegError, OSError):
        return  # it is no video
    with former:
        ours = former.metadata.get("comment") == note and len(former.streams.video) == 1
        if ours and 0 < former.streams.video[0].frames < count:
            video.copy(former)


def _end(video: Video, container: Any, file: Any) -> None:
    with held():
        video.finish()
        container.close()
        file.flush()
        os.fsync(file.fileno())


def pyav() -> Any:
    """The library; raises `InputError` where it is missing."""
    try:
        import av
    except ModuleNotFoundError as problem:
        raise InputError("Videos need PyAV, which is not installed: pip install av.") from problem
    return av


def _even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """With even sides, as yuv420p has a colour for 2 x 2 pixels."""
    rows, columns = (side % 2 for side in pixels.shape[:2])
    return np.pad(pixels, ((0, rows), (0, columns), (0, 0)), mode="edge") if rows or columns else pixels


class _Colours:
    """From pixels to luma and chroma of ITU-R BT.709, which `_describe_colours` tells the player."""

    def __init__(self) -> None:
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()

    def frame(self, image: NDArray[np.uint8]) -> Any:
        """Of an image with even sides."""
        from av import VideoFrame

        colours: dict[str, Any] = {"format": "yuv420p", "dst_colorspace": "ITU709", "dst_color_range": "MPEG"}
        return self._reformatter.reformat(VideoFrame.from_ndarray(image, format="rgb24"), **colours, threads=HELPERS)


def _describe_colours(context: Any) -> None:
    """Primaries and matrix of BT.709, curve of sRGB, 16 to 235: the numbers of ITU-T H.273."""
    context.color_primaries, context.colorspace, context.color_trc, context.color_range = 1, 1, 13, 1
