"""Encode linear images as 8-bit sRGB (IEC 61966-2-1), as H.264 videos in mp4, and as animated WebPs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from fractions import Fraction
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.arrays import as_numbers
from cortado.errors import InputError
from cortado.files.disk import sentences, unfinished, write_atomically
from cortado.files.terminal import held

ROWS = 32
MOST_LIGHT = 2.0
"""A larger value in a user's linear picture probably means that the picture has byte values from 0 to 255."""
STEPS = 1 << 14
"""Number of intervals of linear light from 0 to 1. Each interval contains at most one boundary between byte values."""
LIGHT = "linear light from 0 to 1, as that of cortado.pictures.read_picture"


def check_light(what: str, image: ArrayLike) -> None:
    if np.asarray(image).dtype.kind in "iu":
        raise InputError(f"{what} is made of whole numbers, but must be {LIGHT}.")
    light = as_numbers(what, image)
    furthest = light.flat[np.abs(light).argmax()]
    if abs(furthest) > MOST_LIGHT:
        raise InputError(f"{what} has a value of {furthest:g}, but must be {LIGHT}.")


def to_srgb(image: ArrayLike, each: Callable[..., Iterable[Any]] = map) -> NDArray[np.uint8]:
    """Return the sRGB bytes of a linear image (rows, columns, 3), clipped to the range from 0 to 1. ``each`` is a
    function like `map`, which may convert parts of the image in parallel."""
    light = image if isinstance(image, np.ndarray) and image.dtype == np.float32 else as_numbers("The image", image)
    if light.ndim != 3 or light.shape[2] != 3 or not light.size:
        raise InputError(f"The image has shape {light.shape}, but must be (rows, columns, 3).")
    found = np.empty(light.shape, dtype=np.uint8)

    def convert(row: int) -> None:
        found[row : row + ROWS] = srgb_bytes(light[row : row + ROWS])

    for _ in each(convert, range(0, len(light), ROWS)):
        pass
    return found


def srgb_bytes(light: NDArray[Any]) -> NDArray[np.uint8]:
    if not np.isfinite(light).all():
        raise InputError("The image has values that are not finite; check how it was computed.")
    light = np.clip(light, light.dtype.type(0.0), light.dtype.type(1.0))
    bounds, values = _steps(light.dtype)
    steps = (light.dtype.type(STEPS) * light).astype(np.uint16)
    found = values.take(steps, mode="clip")  # all are there, and unchecked
    found += light >= bounds.take(found, mode="clip")  # at most one value begins within a step
    return found


@cache
def _steps(dtype: np.dtype[Any]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Return the least linear light that gives each byte value (256,). Also return the byte value at the start of each
    interval (STEPS + 1,)."""
    middles = (np.arange(1, 257) - 0.5) / 255.0
    exact = np.where(middles <= 0.04045, middles / 12.92, ((middles + 0.055) / 1.055) ** 2.4)
    rounded = exact.astype(dtype)
    bounds = np.where(rounded < exact, np.nextafter(rounded, dtype.type(2.0)), rounded)
    return bounds, np.searchsorted(bounds, np.arange(STEPS + 1) / STEPS, side="right").astype(np.uint8)


def from_srgb(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    curved = values / 255.0
    return np.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)


def png(image: ArrayLike) -> bytes:
    """Return an 8-bit sRGB PNG file of a linear image (rows, columns, 3)."""
    from PIL import Image

    pixels, content = to_srgb(image), BytesIO()
    check_light("The image", image)
    Image.fromarray(pixels).save(content, format="PNG")
    return content.getvalue()


class ShadedPicture(np.ndarray):
    """A linear picture (rows, columns, 3) with values from 0 to 1. Notebooks show this NumPy array as a picture. Use
    `cortado.pictures.write_picture` to save it."""

    @classmethod
    def of(cls, image: ArrayLike) -> Self:
        return np.asarray(image).view(cls)

    def _repr_png_(self) -> bytes | None:
        return png(self) if self.ndim == 3 and self.shape[2] == 3 else None


VIDEO_QUALITY = "18"
BITS = 1.2e6
THREADS = 8
"""Number of encoder threads. The bytes of a file depend on this number."""
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
        """Add a frame that is shown from ``time`` [s] on. The last row or column of an odd number is repeated."""
        from av import VideoFrame

        pixels = to_srgb(image, self._helpers.map)
        self._shape = self._shape or pixels.shape
        if pixels.shape != self._shape:
            found = f"Frame {self.frames} of the video has shape {pixels.shape}"
            raise InputError(f"{found}, but those before it {self._shape}.")
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
        """Copy the frames of an open video. Call this before adding frames."""
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
        """Return the video stream. No frame depends on a later frame, so that frames can be added to a copy."""
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
    """Open a video, which appears under its path at the end of the ``with`` block. After an interruption the next call
    with the same ``note`` and ``count`` continues after the finished frames.

    ``count`` is the number of frames of the complete video. ``note`` is a text about the content, stored in the file.
    ``frames_per_second`` is approximate: the file stores the exact time of each frame."""
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
                _copy_interrupted(av, video, path, note, count)
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
        """The linear image (rows, columns, 3) is shown from ``time`` [s] on."""
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
    """Open an animated WebP if the path ends in .webp, or else a video. An animation is written at the end of the
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
        raise InputError(f"The animation {path} has no frames; give one at least.")
    write_atomically(path, animation.encoded())
