"""Pictures to aim at: latte art drawn at any resolution, and PNG and other files read and written.

A picture is (rows, columns, 3) red, green and blue, linear light from 0 to 1, float64, its first row at the top. A
resolution is (columns, rows), as in a scene, or one number for a square.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.files import write_atomically
from cortado.srgb import from_srgb, to_srgb

Picture = NDArray[np.float64]
Resolution = int | tuple[int, int]
Colour = tuple[float, float, float]
Shape = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]
"""Whether the points x, y are inside; a shape fills -1 to 1 from its bottom to its top."""

MILK: Colour = (0.96, 0.93, 0.86)
COFFEE: Colour = (0.30, 0.16, 0.08)
WHITE: Colour = (1.0, 1.0, 1.0)
SAMPLES = 6
"""Points along either side of a pixel that tell how much of it a shape covers."""


def heart(
    resolution: Resolution,
    *,
    cup: float | None = None,
    size: float = 0.6,
    milk: Colour = MILK,
    coffee: Colour = COFFEE,
    background: Colour = WHITE,
) -> Picture:
    """A heart, its tip down.

    Args:
        resolution: columns and rows of pixels, or one number for both.
        cup: radius of a round cup in the middle, relative to half of the shorter side of the picture; outside it
            is the background. None: coffee everywhere.
        size: of the shape, relative to the cup or, without one, to the shorter side of the picture.
        milk, coffee, background: red, green and blue, linear, from 0 to 1.
    """
    return _drawn(_in_heart, resolution, cup, size, (milk, coffee, background))


def rosetta(
    resolution: Resolution,
    *,
    cup: float | None = None,
    size: float = 0.75,
    milk: Colour = MILK,
    coffee: Colour = COFFEE,
    background: Colour = WHITE,
) -> Picture:
    """A rosetta: layers of milk like the leaves of a fern, drawn together by a stem, a small heart on top.

    The arguments are those of `heart`.
    """
    return _drawn(_in_rosetta, resolution, cup, size, (milk, coffee, background))


def read_picture(path: str | Path, resolution: Resolution | None = None) -> Picture:
    """The picture of a file that Pillow can read, transparent parts on white.

    Args:
        resolution: columns and rows wanted: the largest part in the middle with their proportions is resampled,
            in linear light. None keeps the pixels as they are.

    Raises:
        InputError: there is no such file, or no picture in it.
    """
    from PIL import Image, ImageOps

    try:
        with Image.open(path) as file:
            if file.mode.startswith(("I", "F")):
                raise InputError(f"The picture {path} has more than 8 bits for a colour; save it with 8.")
            picture = ImageOps.exif_transpose(file).convert("RGBA")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as problem:  # whatever Pillow raises
        raise InputError(f"The picture {path} cannot be read: {problem}.") from problem
    opaque = Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture)
    linear = from_srgb(np.asarray(opaque)[..., :3])
    return linear if resolution is None else _resampled(linear, *_columns_and_rows(resolution))


def write_picture(path: str | Path, image: ArrayLike) -> Path:
    """Writes a linear image (rows, columns, 3) as a PNG with 8 bits of sRGB, clipped to 0..1, and returns its path.

    Raises:
        InputError: another shape, values that are not finite, or a file that cannot be written.
    """
    from PIL import Image

    content = BytesIO()
    Image.fromarray(to_srgb(image)).save(content, format="PNG")
    write_atomically(Path(path), content.getvalue())
    return Path(path)


def _drawn(
    shape: Shape, resolution: Resolution, cup: float | None, size: float, colours: tuple[Colour, Colour, Colour]
) -> Picture:
    for name, value in (("cup", cup), ("size", size)):
        if value is not None and not 0.0 < value < np.inf:
            raise InputError(f"{name} is {value}, but must be a positive number.")
    columns, rows = _columns_and_rows(resolution)
    milk, coffee, background = (np.array(colour, dtype=float) for colour in colours)
    scale = size * (1.0 if cup is None else cup)
    picture = _mixed(_coverage(lambda x, y: shape(x / scale, y / scale), columns, rows), milk, coffee)
    if cup is None:
        return picture
    return _mixed(_coverage(lambda x, y: x**2 + y**2 < cup**2, columns, rows), picture, background)


def _mixed(share: Picture, inside: Picture, outside: Picture) -> Picture:
    return share * inside + (1.0 - share) * outside


def _coverage(shape: Shape, columns: int, rows: int) -> Picture:
    """(rows, columns, 1) share of every pixel that is inside; the shorter side goes from -1 to 1, y upwards."""
    half = 0.5 * min(columns, rows)
    covered = np.zeros((rows, columns, 1))
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for down in offsets:
        y = (0.5 * rows - np.arange(rows) - down)[:, None] / half
        for right in offsets:
            x = (np.arange(columns) + right - 0.5 * columns)[None, :] / half
            covered[..., 0] += shape(x, y)
    return covered / SAMPLES**2


def _in_heart(x: Any, y: Any) -> Any:
    """The sextic (x^2 + y^2 - 1)^3 = x^2 y^3, which goes from y = -1 to 1.2367, moved and shrunk."""
    x, y = 1.1183 * x, 1.1183 * y + 0.1183
    return (x**2 + y**2 - 1.0) ** 3 < x**2 * y**3


def _in_rosetta(x: Any, y: Any) -> Any:
    """Six layers, all bent in the same way so that coffee of the same width stays between them, a stem and a heart."""
    x = np.abs(x)
    inside = _in_heart(x / 0.31, (y - 0.69) / 0.31) | ((x < 0.02) & (np.abs(y + 0.2) < 0.8))
    height = y - (x**0.75 - 0.55 * x**2)  # of the point of the stem where the layer through x, y leaves it
    for k in np.linspace(0.0, 1.0, 6):
        reach = 0.55 - 0.13 * k + 0.95 * k * (1.0 - k)
        along = np.minimum(x / reach, 1.0)
        inside |= np.abs(height + 0.86 - k) < 0.1 * along**0.35 * np.sqrt(1.0 - along**5)
    return inside


def _columns_and_rows(resolution: Resolution) -> tuple[int, int]:
    columns, rows = (resolution, resolution) if isinstance(resolution, int) else resolution
    if min(columns, rows) < 1:
        raise InputError(f"resolution is {resolution}, but must be positive numbers of columns and rows.")
    return columns, rows


def _resampled(linear: Picture, columns: int, rows: int) -> Picture:
    """(rows, columns, 3) from the largest part in the middle that has these proportions."""
    from PIL import Image

    height, width = linear.shape[:2]
    if (height, width) == (rows, columns):
        return linear
    scale = min(width / columns, height / rows)
    left, top = 0.5 * (width - scale * columns), 0.5 * (height - scale * rows)
    box = (left, top, width - left, height - top)
    channels = [Image.fromarray(linear[..., k].astype(np.float32)) for k in range(3)]
    small = [channel.resize((columns, rows), Image.Resampling.BILINEAR, box=box) for channel in channels]
    return np.stack([np.asarray(channel, dtype=np.float64) for channel in small], axis=-1)
