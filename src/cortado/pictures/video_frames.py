"""Frames of a video file, or of a folder of pictures, in linear light."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.files.input_files import reason, regular_file
from cortado.files.video import pyav
from cortado.pictures.image_files import FORMATS, open_picture, resized, warn_of_cropping

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
"""Of the pictures in a folder."""
MOST_BYTES = 2**33
"""Of a video."""


def read_frames(
    path: str | Path,
    resolution: tuple[int, int],
    crop: tuple[int, ...] | None = None,
    frame_rate: float | None = None,
    every: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Times (frames,) [s] after the first frame, and frames (frames, rows, columns, 3), linear, from 0 to 1.

    Args:
        path: a video, or a folder of pictures, which are taken in the order of their names.
        resolution: columns and rows wanted: the largest part in the middle with their proportions is resampled.
        crop: left, top, right and bottom of the part of each frame that counts, in the pixels of the frame as players
            show it; all of it if left out.
        frame_rate: frames in a second, needed for a folder; what the video itself says if left out.
        every: take only every so many frames.

    Raises:
        InputError: there is no such file, or no frames in it, or PyAV is missing.
    """
    is_folder = Path(path).is_dir()
    if is_folder and frame_rate is None:
        raise InputError(f"{path} is a folder of frames, but frame_rate is missing: give the frames in a second.")
    times, frames = list[float](), list[np.ndarray]()
    for number, (time, picture) in enumerate(_pictures(Path(path)) if is_folder else _decoded(path)):
        if number % every == 0:
            cropped = _cropped(path, picture, crop)
            if not frames:
                warn_of_cropping(f"The frames of {path} have", cropped.size, resolution)
            times.append(time if frame_rate is None else number / frame_rate)
            frames.append(resized(cropped, resolution))
    if not frames:
        raise InputError(f"{path} has no frames; pictures in a folder must end in {', '.join(ENDINGS)}.")
    return np.array(times) - times[0], np.stack(frames)


def _pictures(folder: Path) -> Iterator[tuple[float, Any]]:
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in ENDINGS:
            yield 0.0, open_picture(path)


def _decoded(path: str | Path) -> Iterator[tuple[float, Any]]:
    av = pyav()
    try:
        regular_file(path, MOST_BYTES)
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield float(frame.time or 0.0), _upright(frame)
    except (OSError, av.FFmpegError, IndexError) as problem:
        wanted = f"a video, or a folder of pictures ({', '.join(FORMATS)})"
        raise InputError(f"{path} cannot be read as {wanted}: {reason(problem)}.") from None


def _upright(frame: Any) -> Any:
    """The picture of a frame as players show it: telephones note how they were held as a matrix (ISO/IEC 14496-12,
    8.3.2), which turns or mirrors what is stored; the nearest right angle counts."""
    from PIL.Image import Transpose

    picture = frame.to_image()
    given = [bytes(one) for one in frame.side_data if one.type.name == "DISPLAYMATRIX"]
    if not given:
        return picture
    (a, b, _), (c, d, _), _ = np.frombuffer(given[0], np.int32).reshape(3, 3)  # x' = a x + c y, y' = b x + d y
    if abs(b) > abs(a):
        picture, a, d = picture.transpose(Transpose.TRANSPOSE), c, b
    picture = picture.transpose(Transpose.FLIP_LEFT_RIGHT) if a < 0 else picture
    return picture.transpose(Transpose.FLIP_TOP_BOTTOM) if d < 0 else picture


def _cropped(path: str | Path, picture: Any, crop: tuple[int, ...] | None) -> Any:
    if crop is None:
        return picture
    left, top, right, bottom = crop
    if not (0 <= left < right <= picture.width and 0 <= top < bottom <= picture.height):
        size = f"{picture.width} x {picture.height}"
        raise InputError(f"crop is {list(crop)}, but must lie within the frames of {path}, which have {size} pixels.")
    return picture.crop(crop)
