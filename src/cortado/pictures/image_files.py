"""Draw target pictures of latte art, read and write picture files, and read video frames.

A picture is a float64 array (rows, columns, 3) of linear red, green and blue from 0 to 1, with the top row first. A
resolution is (columns, rows), or one number for a square.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.calls import public
from cortado.device.threads import require
from cortado.errors import InputError, warn
from cortado.files.disk import as_path, reason, regular_file, write_atomically
from cortado.files.image_encoding import from_srgb, png
from cortado.pictures.video_files import pyav
from cortado.render.cameras import check_resolution, positive, vector

Picture = NDArray[np.float64]
Resolution = int | tuple[int, int]
Colour = tuple[float, float, float]
Shape = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]
"""A function that tests whether points x, y are inside a shape. The shape extends from y = -1 to y = 1."""
MILK: Colour = (0.96, 0.93, 0.86)
COFFEE: Colour = (0.30, 0.16, 0.08)
WHITE: Colour = (1.0, 1.0, 1.0)
FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP")
MOST_BYTES = 2**28
"""Greatest size of a picture file [bytes]."""
MOST_PIXELS = 2**26
PIXELS_AT_ONCE = 2**20
LIGHT = from_srgb(np.arange(256, dtype=np.uint8))
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


@public
def heart(
    resolution: Resolution,
    *,
    cup: float | None = None,
    size: float = 0.6,
    milk: Colour = MILK,
    coffee: Colour = COFFEE,
    background: Colour = WHITE,
) -> Picture:
    """Draw a heart with the tip at the bottom.

    Args:
        resolution: columns and rows of pixels, or one number for a square.
        cup: radius of a round cup in the middle, relative to half of the shorter side of the picture. The background
            surrounds the cup. By default the whole picture is filled with coffee.
        size: size of the shape, relative to the cup or, without a cup, to the shorter side of the picture.
        milk, coffee, background: red, green and blue, linear, from 0 to 1.

    Example: ``target = cortado.pictures.heart((128, 128), cup=0.9)  # (128, 128, 3)``
    """
    return _drawn(_in_heart, resolution, cup, size, [milk, coffee, background])


@public
def rosetta(
    resolution: Resolution,
    *,
    cup: float | None = None,
    size: float = 0.75,
    milk: Colour = MILK,
    coffee: Colour = COFFEE,
    background: Colour = WHITE,
) -> Picture:
    """Draw a rosetta: layers of milk like fern leaves, pulled together along a stem, with a small heart on top.

    The arguments ``resolution``, ``cup``, ``size``, ``milk``, ``coffee`` and ``background`` are as in `heart`.

    Example: ``target = cortado.pictures.rosetta((128, 128), cup=0.9)  # (128, 128, 3)``
    """
    return _drawn(_in_rosetta, resolution, cup, size, [milk, coffee, background])


@public
def read_picture(path: str | Path, resolution: Resolution | None = None) -> Picture:
    """Read the picture at ``path``, in one of the `FORMATS`. Transparent parts are shown on white.

    Args:
        resolution: wanted columns and rows. The largest central part with this aspect ratio is resampled in linear
            light. None keeps the original pixels.

    Raises:
        InputError: the file is missing, is not a picture, or has too many pixels.

    Example: ``target = cortado.pictures.read_picture("target.png", (64, 48))  # (48, 64, 3)``
    """
    shape = None if resolution is None else _columns_and_rows(resolution)
    picture = open_picture(path, 2**24 if resolution is None else MOST_PIXELS)
    if shape is None:
        return _whole(picture)
    warn_of_cropping(f"The picture {path} has", picture.size, shape)
    return resized(picture, shape)


def resized(picture: Any, resolution: tuple[int, int]) -> Picture:
    """Crop a Pillow picture to the aspect ratio of ``resolution``, and resample the picture in linear light."""
    from PIL import Image

    if resolution == picture.size:
        return _whole(picture)
    box = _middle(picture.size, resolution)
    small, light = np.empty((*resolution[::-1], 3)), LIGHT.astype(np.float32)
    for k in range(3):
        channel = Image.new("F", picture.size)
        for first, band in _bands(picture):
            channel.paste(Image.fromarray(light[np.asarray(band.getchannel(k))]), (0, first))
        small[..., k] = np.asarray(channel.resize(resolution, Image.Resampling.BILINEAR, box=box))
    return small


def open_picture(path: str | Path, most: int = MOST_PIXELS) -> Any:
    """Open a picture file of at most ``most`` pixels with Pillow. Raises `InputError` as `read_picture` does."""
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        regular_file(as_path("path", path), MOST_BYTES)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of large pictures, which are judged here
            with Image.open(path, formats=FORMATS) as file:
                if file.width * file.height > most:
                    raise _too_many(path, f"{file.width} x {file.height} pixels", most)
                if file.mode.startswith(("I", "F")):
                    raise InputError(f"The picture {path} has more than 8 bits per colour; save it with 8 bits.")
                file.load()
                ImageOps.exif_transpose(file, in_place=True)
                return file.copy()
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise _too_many(path, "very many pixels", most) from None
    except UnidentifiedImageError:
        raise InputError(f"The picture {path} cannot be read: the format is none of {', '.join(FORMATS)}.") from None
    except Exception as problem:  # of many types, where a file is damaged
        raise InputError(f"The picture {path} cannot be read: {reason(problem)}.") from problem


def warn_of_cropping(found: str, size: tuple[int, int], shape: tuple[int, int]) -> None:
    """Warn if a crop to the aspect ratio of ``shape`` keeps less than 99 % of a picture of ``size``."""
    left, top, right, bottom = _middle(size, shape)
    share = (right - left) * (bottom - top) / (size[0] * size[1])
    if share < 0.99:
        found = f"{found} {size[0]} x {size[1]} pixels, but {shape[0]} x {shape[1]} are wanted"
        warn(f"{found}: only the middle is used, {share:.0%} of the pixels.")


def _middle(size: tuple[int, int], shape: tuple[int, int]) -> tuple[float, float, float, float]:
    (width, height), (columns, rows) = size, shape
    scale = min(width / columns, height / rows)
    left, top = 0.5 * (width - scale * columns), 0.5 * (height - scale * rows)
    return left, top, width - left, height - top


def _too_many(path: str | Path, found: str, most: int) -> InputError:
    return InputError(f"The picture {path} has {found}, but must have at most {most}; save a smaller picture.")


@public
def write_picture(path: str | Path, image: ArrayLike) -> Path:
    """Write a linear ``image`` (rows, columns, 3) to a PNG file at ``path`` with 8 bits of sRGB. Clip values to 0..1.
    Return the path.

    Raises:
        InputError: the image has a wrong shape, is an array of integers, or has values that are not finite or look like
            0..255; the name does not end in .png; or the file cannot be written.

    Example: ``cortado.pictures.write_picture("last.png", simulation.renderer().render(trajectory[-1]))``
    """
    if Path(as_path("path", path)).suffix.lower() != ".png":
        raise InputError(f"path is {str(path)!r}, but must be the name of a PNG file, such as picture.png.")
    write_atomically(Path(path), png(image))
    return Path(path)


def _drawn(shape: Shape, resolution: Resolution, cup: float | None, size: float, colours: list[Colour]) -> Picture:
    for name, value in (("cup", 1.0 if cup is None else cup), ("size", size)):
        positive(name, value)
    columns, rows = _columns_and_rows(resolution)
    require({"a picture": 100.0 * columns * rows}, "take a smaller resolution")  # bytes
    milk, coffee, background = (np.array(vector("A colour", colour)) for colour in colours)
    scale = size * (1.0 if cup is None else cup)
    share = _coverage(lambda x, y: shape(x / scale, y / scale), columns, rows)
    picture: Picture = share * milk + (1.0 - share) * coffee
    if cup is not None:
        share = _coverage(lambda x, y: x**2 + y**2 < cup**2, columns, rows)
        picture = share * picture + (1.0 - share) * background
    return picture


def _coverage(shape: Shape, columns: int, rows: int) -> Picture:
    """Return the fraction (rows, columns, 1) of each pixel that is inside the shape."""
    half, samples = 0.5 * min(columns, rows), 6  # along the side of a pixel
    covered = np.zeros((rows, columns, 1))
    offsets = (np.arange(samples) + 0.5) / samples
    for down in offsets:
        y = (0.5 * rows - np.arange(rows) - down)[:, None] / half
        for right in offsets:
            x = (np.arange(columns) + right - 0.5 * columns)[None, :] / half
            covered[..., 0] += shape(x, y)
    return covered / samples**2


def _in_heart(x: Any, y: Any) -> Any:
    """Test whether points x, y are inside the heart curve (x^2 + y^2 - 1)^3 = x^2 y^3, shifted and scaled."""
    x, y = 1.1183 * x, 1.1183 * y + 0.1183
    return (x**2 + y**2 - 1.0) ** 3 < x**2 * y**3


def _in_rosetta(x: Any, y: Any) -> Any:
    x = np.abs(x)
    inside = _in_heart(x / 0.31, (y - 0.69) / 0.31) | ((x < 0.02) & (np.abs(y + 0.2) < 0.8))
    height = y - (x**0.75 - 0.55 * x**2)  # of the point of the stem where the layer through x, y leaves it
    for k in np.linspace(0.0, 1.0, 6):
        reach = 0.55 - 0.13 * k + 0.95 * k * (1.0 - k)
        along = np.minimum(x / reach, 1.0)
        inside |= np.abs(height + 0.86 - k) < 0.1 * along**0.35 * np.sqrt(1.0 - along**5)
    return inside


def _columns_and_rows(resolution: Resolution) -> tuple[int, int]:
    found = (resolution, resolution) if isinstance(resolution, int) else resolution
    check_resolution(found)
    return found


def _bands(picture: Any) -> Iterator[tuple[int, Any]]:
    from PIL import Image

    height = max(PIXELS_AT_ONCE // picture.width, 1)
    for top in range(0, picture.height, height):
        band = picture.crop((0, top, picture.width, min(top + height, picture.height)))
        if picture.has_transparency_data:
            band = band.convert("RGBA")
            band = Image.alpha_composite(Image.new("RGBA", band.size, "white"), band)
        yield top, band.convert("RGB")


def _whole(picture: Any) -> Picture:
    linear = np.empty((picture.height, picture.width, 3))
    for top, band in _bands(picture):
        linear[top : top + band.height] = LIGHT[np.asarray(band)]
    return linear


def read_frames(
    path: str | Path,
    resolution: tuple[int, int],
    crop: tuple[int, ...] | None = None,
    frame_rate: float | None = None,
    every: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Read frames of a video, and return their times and pictures. Times (frames,) [s] begin at the first frame.
    Pictures (frames, rows, columns, 3) are linear light from 0 to 1.

    Args:
        path: a video, or a folder of pictures, which are read in the order of their names.
        resolution: wanted columns and rows. The largest central part with this aspect ratio is resampled.
        crop: left, top, right and bottom of the used part of each frame, in pixels of the frame as players show it. By
            default the whole frame is used.
        frame_rate: frames per second, needed for a folder. The default is the frame rate of the video.
        every: read only every ``every``-th frame.

    Raises:
        InputError: the file is missing or has no frames, or PyAV is missing.
    """
    folder, times, frames = Path(path), list[float](), list[np.ndarray]()
    if folder.is_dir():
        if frame_rate is None:
            raise InputError(f"{path} is a folder of frames, but frame_rate is missing: give the frames per second.")
        names = sorted(one for one in folder.iterdir() if one.suffix.lower() in ENDINGS)
        pictures: Iterator[tuple[float, Any]] = ((0.0, open_picture(name)) for name in names)
    else:
        pictures = _decoded(path)
    for number, (time, picture) in enumerate(pictures):
        if number % every:
            continue
        left, top, right, bottom = crop or (0, 0, *picture.size)
        if not (0 <= left < right <= picture.width and 0 <= top < bottom <= picture.height):
            wanted = f"lie within the frames of {path}, which have {picture.width} x {picture.height} pixels"
            raise InputError(f"crop is {[left, top, right, bottom]}, but must {wanted}.")
        cropped = picture.crop((left, top, right, bottom)) if crop else picture
        if not frames:
            warn_of_cropping(f"The frames of {path} have", cropped.size, resolution)
        times.append(time if frame_rate is None else number / frame_rate)
        frames.append(resized(cropped, resolution))
    if not frames:
        raise InputError(f"{path} has no frames; pictures in a folder must end in {', '.join(ENDINGS)}.")
    return np.array(times) - times[0], np.stack(frames)


def _decoded(path: str | Path) -> Iterator[tuple[float, Any]]:
    av = pyav()
    try:
        regular_file(path, 2**33)
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield float(frame.time or 0.0), _upright(frame)
    except (OSError, av.FFmpegError, IndexError) as problem:
        wanted = f"a video, or a folder of pictures ({', '.join(FORMATS)})"
        raise InputError(f"{path} cannot be read as {wanted}: {reason(problem)}.") from None


def _upright(frame: Any) -> Any:
    """Return the picture of a frame as players show it, turned and mirrored (ISO/IEC 14496-12, 8.3.2)."""
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
