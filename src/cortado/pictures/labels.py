"""Words, lines and scales of colours on pictures, and pictures side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.files.image_encoding import from_srgb
from cortado.scene.quantity_names import QUANTITIES

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


PALETTE = "cividis"
OUTERMOST = (0.5, 99.5)
"""Percentiles at the ends of the scale, so that a few particles do not darken all the others."""


UNITS = {"age": "s", **{name: quantity.unit for name, quantity in QUANTITIES.items()}}
"""Of what all scenes have, by its name."""


@dataclass(frozen=True)
class Scale:
    """The numbers of a quantity from one end of the colours to the other."""

    name: str
    unit: str
    least: float
    greatest: float

    @classmethod
    def of(cls, name: str, values: NDArray, unit: str | None = None) -> "Scale":
        """That of numbers, such as those of all frames of a film; ``unit`` of what is no quantity that all scenes
        have."""
        least, greatest = np.percentile(values, OUTERMOST)
        return cls(name, UNITS.get(name, "") if unit is None else unit, float(least), float(greatest))

    def colours(self, values: NDArray) -> Points:
        """(n, 3) linear, of numbers (n,)."""
        return _colours(np.clip((values - self.least) / (self.greatest - self.least or 1.0), 0.0, 1.0))

    def columns(self, rows: int) -> int:
        """How many pixels of the width of a picture that is so many rows high it takes."""
        size = _size_of_letters(rows)
        return ceil(max(self._wide(size), *(length_of(text, size) for text in self._heads))) + size

    def beside(self, image: Points) -> Points:
        """A picture (rows, columns, 3), with the scale in columns of its own at its right edge."""
        rows = image.shape[0]
        edge = np.pad(image[:, -1], ((reach := rows // 16, reach), (0, 0)), mode="edge")
        smooth = np.lib.stride_tricks.sliding_window_view(edge, 2 * reach + 1, axis=0).mean(axis=-1)
        return self.on(np.concatenate([image, np.repeat(smooth[:, None], self.columns(rows), axis=1)], axis=1))

    def on(self, image: Points) -> Points:
        """A picture (rows, columns, 3) with the scale on its right edge: its colours with numbers beside them, the
        greatest on top, and its name and unit above."""
        rows, columns = image.shape[:2]
        size = _size_of_letters(rows)
        top, bottom, right = round(0.34 * rows), round(0.70 * rows), columns - size // 2
        left = right - ceil(self._wide(size))
        found, bar = np.array(image), _colours(np.linspace(1.0, 0.0, bottom - top))
        found[top:bottom, left : left + size // 2] = bar[:, None]
        texts = [((right, top - 3 * size // (1 + k)), text, "rm") for k, text in enumerate(self._heads)]
        for number in self._ticks():
            row = bottom - 1 - round((number - self.least) / (self.greatest - self.least) * (bottom - top - 1))
            found[row, left + size // 2 : left + 3 * size // 4] = INK
            texts.append(((left + size, row), f"{number:.4g}", "lm"))
        return written(found, texts, size)

    @property
    def _heads(self) -> tuple[str, str]:
        """What stands above it."""
        return self.name.replace("_", " "), f"[{self.unit}]"

    def _wide(self, size: int) -> float:
        """Pixels of its colours with the numbers beside them."""
        return size + max((length_of(f"{number:.4g}", size) for number in self._ticks()), default=0.0)

    def _ticks(self) -> list[float]:
        """Round numbers that are told."""
        from matplotlib.ticker import MaxNLocator

        if not self.greatest > self.least:
            return []
        found = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]).tick_values(self.least, self.greatest)
        return [float(number) for number in found if self.least <= number <= self.greatest]


def _colours(shares: NDArray) -> Points:
    """(n, 3) linear, of numbers from 0 to 1."""
    found: Points = _palette()[np.minimum((len(_palette()) * shares).astype(int), len(_palette()) - 1)]
    return found


def _size_of_letters(rows: int) -> int:
    """Pixels of the letters on a picture that is so many rows high."""
    return max(round(0.026 * rows), 9)


@cache
def _palette() -> Points:
    """(256, 3) the colours, linear."""
    from matplotlib import colormaps

    palette = colormaps[PALETTE]
    return from_srgb((255.0 * palette(np.arange(palette.N))[:, :3]).round().astype(np.uint8))
