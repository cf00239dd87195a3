"""Write films of linear images as H.264 videos (mp4) or as animated WebPs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.files.disk import sentences, unfinished, write_atomically
from cortado.files.image_encoding import to_srgb
from cortado.files.terminal import held

VIDEO_QUALITY = "18"
BITS = 1.2e6
THREADS = 8
"""Number of encoder threads, on which the bytes of a video file depend."""
HELPERS = 4
TICKS = 90_000


class Video:
    def __init__(self, container: Any, frames_per_second: float):
        from av.video.reformatter import VideoReformatter

        self._container, self._rate, self._reformatter = container, frames_per_second, VideoReformatter()
        self._helpers = ThreadPoolExecutor(HELPERS, thread_name_prefix="cortado-video")
        self._stream: Any = None
        self._shape: tuple[int, ...] | None = None
        self.frames = 0

    def add(self, image: ArrayLike, time: float) -> None:
        """Add a frame from ``time`` [s] on. If the number of rows or columns is odd, the last one is repeated."""
        from av import VideoFrame

        pixels = to_srgb(image, self._helpers.map)
        self._shape = self._shape or pixels.shape
        if pixels.shape != self._shape:
            found = f"Frame {self.frames} of the video has shape {pixels.shape}"
            raise InputError(f"{found}, but must have the shape {self._shape} of the first frame.")
        rows, columns = (side % 2 for side in pixels.shape[:2])
        if rows or columns:  # yuv420p has a colour for 2 x 2 pixels
            pixels = np.pad(pixels, ((0, rows), (0, columns), (0, 0)), mode="edge")
        stream = self._stream_of(pixels.shape[1], pixels.shape[0])
        colours: dict[str, Any] = {"format": "yuv420p", "dst_colorspace": "ITU709", "dst_color_range": "MPEG"}
        whole = VideoFrame.from_ndarray(pixels, format="rgb24")
        frame = self._reformatter.reformat(whole, **colours, threads=HELPERS)
        frame.pts, frame.duration, frame.time_base = round(time * TICKS), round(TICKS / self._rate), stream.time_base
        with held():
            self._container.mux(stream.encode(frame))
            self.frames += 1

    def copy(self, other: Any) -> None:
        """Copy the frames of an open video. `copy` must precede `add`."""
        from av.bitstream import BitStreamFilterContext

        source = other.streams.video[0]
        own, plain = self._stream_of(source.width, source.height), BitStreamFilterContext("h264_mp4toannexb", source)
        for packet in other.demux(source):
            for part in plain.filter(None if packet.dts is None else packet):
                part.stream = own
                self._container.mux(part)
        self.frames = source.frames

    def finish(self) -> None:
        self._helpers.shutdown()
        if self._stream is not None:
            self._container.mux(self._stream.encode())

    def _stream_of(self, width: int, height: int) -> Any:
        """Return the video stream. No frame depends on later frames, because `copy` appends frames."""
        if self._stream is None:
            most = BITS * (width * height / (1920 * 1080)) ** 0.75
            options = {"crf": VIDEO_QUALITY, "bf": "0", "maxrate": f"{most:.0f}", "bufsize": f"{4.0 * most:.0f}"}
            rate = Fraction(self._rate).limit_denominator(1001)
            self._stream = self._container.add_stream("libx264", rate=rate, options=options)
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            context = self._stream.codec_context
            self._stream.time_base = context.time_base = Fraction(1, TICKS)
            context.thread_count, context.thread_type = THREADS, "FRAME"
            # Primaries and matrix of BT.709, curve of sRGB, 16 to 235: the numbers of ITU-T H.273.
            context.color_primaries, context.colorspace, context.color_trc, context.color_range = 1, 1, 13, 1
        return self._stream


@contextmanager
def writing(path: str | Path, frames_per_second: float = 25.0, note: str = "", count: int = 0) -> Iterator[Video]:
    """Open a video, which appears under its path at the end of the ``with`` block. After an interruption, a call with
    the same ``note`` and ``count`` continues after the finished frames.

    ``count`` is the number of frames of the complete video. ``note`` is a text about the content, stored in the file.
    ``frames_per_second`` is approximate: the file stores the exact time of each frame."""
    av, path = pyav(), Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"The name of the film {path} must end in .mp4 or .webp.")
    if not 0.0 < frames_per_second < np.inf:
        raise InputError(f"frames_per_second is {frames_per_second}, but must be a positive number.")
    temporary = unfinished(path)
    with sentences(path):
        try:
            with open(temporary, "xb") as file:
                container = av.open(file, "w", format="mp4", options={"movflags": "+faststart"})
                container.metadata["comment"] = note
                video = Video(container, frames_per_second)
                _copy_interrupted(av, video, path, note, count)
                try:
                    yield video
                except KeyboardInterrupt:
                    if video.frames:
                        _end(video, container, file)
                        os.replace(temporary, path)
                    raise
                if not video.frames:
                    raise InputError(f"The video {path} has no frames; add at least one.")
                _end(video, container, file)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def write_video(path: str | Path, frames: Iterable[ArrayLike], frames_per_second: float = 25.0) -> Path:
    """Write a video of linear images (rows, columns, 3) of the same size."""
    with writing(path, frames_per_second) as video:
        for k, frame in enumerate(frames):
            video.add(frame, k / frames_per_second)
    return Path(path)


def _copy_interrupted(av: Any, video: Video, path: Path, note: str, count: int) -> None:
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
    try:
        import av
    except ModuleNotFoundError as problem:
        raise InputError("Videos need PyAV, which is not installed: pip install av.") from problem
    return av


# ---- animations --------------------------------------------------------------------------------------------------

ANIMATION_QUALITY = 80
REST = 1.5


class Animation:
    def __init__(self) -> None:
        self._images: list[NDArray[np.uint8]] = []
        self._times: list[float] = []
        self.frames = 0

    def add(self, image: ArrayLike, time: float) -> None:
        """Add a linear image (rows, columns, 3) that is shown from ``time`` [s] on."""
        self._images.append(to_srgb(image))
        self._times.append(time)
        self.frames += 1

    def encoded(self) -> bytes:
        """Return the WebP file, which loops forever."""
        from PIL import Image

        first, *others = [Image.fromarray(pixels) for pixels in self._images]
        durations = [*np.diff(self._times), REST]
        content, milliseconds = BytesIO(), [max(round(1e3 * float(seconds)), 1) for seconds in durations]
        own = {"duration": milliseconds, "loop": 0, "quality": ANIMATION_QUALITY, "method": 4}
        first.save(content, format="WEBP", save_all=True, append_images=others, **own)
        return content.getvalue()


@contextmanager
def moving_picture(path: Path, frames_per_second: float, note: str = "", count: int = 0) -> Iterator[Video | Animation]:
    """Open an animated WebP for a path that ends in .webp, or else a video. The animation is written at the end of the
    ``with`` block, even after an interruption."""
    if path.suffix.lower() != ".webp":
        with writing(path, frames_per_second, note, count) as video:
            yield video
        return
    animation = Animation()
    try:
        yield animation
    except KeyboardInterrupt:
        if animation.frames:
            write_atomically(path, animation.encoded())
        raise
    if not animation.frames:
        raise InputError(f"The animation {path} has no frames; add at least one.")
    write_atomically(path, animation.encoded())
