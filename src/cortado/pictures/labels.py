"""Words on pictures, and pictures side by side."""

from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points
from cortado.files.srgb import from_srgb

FINER = 3
"""How many times finer than pixels lines are drawn, for smooth edges."""
Text = tuple[tuple[int, int], str, str]
"""Where words are, (column, row), the words, and which point of them is there, by Pillow's two letters."""
SMALL, SMALLEST = 11, 7
"""Pixels of the letters of a word on a small picture, and of one that is too long for it."""
INK = from_srgb(np.array([43, 42, 40], dtype=np.uint8))


def labelled(image: Points, text: str, below: str = "") -> Points:
    """A picture (rows, columns, 3), linear, on which a word is then written on the left, at its top, and another one at
    its bottom, in smaller letters where the first would be too long."""
    rows, columns = image.shape[:2]
    size = max(round(0.042 * rows), SMALL)
    left, top = round(0.9 * size), round(0.7 * size)
    size = max(min(size, int(size * (columns - 2 * left) / max(length_of(text, size), 1.0))), SMALLEST)
    return written(image, [((left, top), text, "la"), ((left, rows - top), below, "ld")], size)


def written(image: Points, texts: Sequence[Text], size: int) -> Points:
    """A picture (rows, columns, 3), linear, on which texts are then written, in letters that are so many pixels high;
    it is not copied, which takes longer than to write."""
    where, cover = _covered(image.shape[:2], tuple(texts), size)
    image[where] = image[where] * (1.0 - cover) + INK * cover
    return image


def length_of(text: str, size: int) -> float:
    """How many pixels a text is wide, in letters that are so many pixels high."""
    return float(_font(size).getlength(text))


@lru_cache(maxsize=32)
def _covered(shape: tuple[int, int], texts: tuple[Text, ...], size: int) -> tuple[tuple[slice, slice], Points]:
    """The part of a picture of a shape that texts are on, and how much of each of its pixels they cover: the same in
    all frames of a film."""
    from PIL import Image, ImageDraw

    mask = Image.new("L", shape[::-1])
    for place, text, anchor in texts:
        ImageDraw.Draw(mask).text(place, text, fill=255, font=_font(size), anchor=anchor)
    left, upper, right, lower = mask.getbbox() or (0, 0, 0, 0)
    where = slice(upper, lower), slice(left, right)
    return where, (np.asarray(mask)[where] / 255.0)[..., None]


def lined(image: Points, lines: Sequence[Points], colour: Points, width: int) -> Points:
    """A picture (rows, columns, 3), linear, with lines of a linear colour (3,) on it, through points (k, 2), columns
    and rows; ``width`` in pixels."""
    from PIL import Image, ImageDraw

    rows, columns = image.shape[:2]
    mask = Image.new("L", (FINER * columns, FINER * rows))
    for line in lines:
        points = [tuple(point) for point in (FINER * np.asarray(line)).tolist()]
        ImageDraw.Draw(mask).line(points, fill=255, width=FINER * width, joint="curve")
    cover = (np.asarray(mask.resize((columns, rows), Image.Resampling.BOX)) / 255.0)[..., None]
    return image * (1.0 - cover) + colour * cover


def side_by_side(images: Sequence[Points], across: int, names: Sequence[str] = ()) -> Points:
    """Pictures of one size in rows of so many, a thin light line between them, each with its name on it if it has one;
    the end of the last row may be empty."""
    rows, columns = images[0].shape[:2]
    down = -(-len(images) // across)
    page = np.ones((down * rows, across * columns, 3), images[0].dtype)
    for k, image in enumerate(images):
        row, column = divmod(k, across)
        panel = page[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
        panel[:] = image
        if names:
            labelled(panel, names[k])
    page[[row * rows for row in range(1, down)]] = 1.0
    page[:, [column * columns for column in range(1, across)]] = 1.0
    return page


@cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
