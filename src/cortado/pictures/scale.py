"""Colours that stand for numbers, with the scale that says which."""

from dataclasses import dataclass
from functools import cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.files.srgb import from_srgb
from cortado.pictures.labels import INK, length_of, written
from cortado.scene.quantities import QUANTITIES

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
