"""Colours that stand for numbers, with the scale that says which."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.files.srgb import from_srgb
from cortado.pictures.labels import labelled
from cortado.scene.quantities import QUANTITIES

PALETTE = "cividis"
OUTERMOST = (0.5, 99.5)
"""Percentiles at the ends of the scale, so that a few particles do not darken all the others."""


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
        return cls(name, QUANTITIES[name].unit if unit is None else unit, float(least), float(greatest))

    def colours(self, values: NDArray) -> Points:
        """(n, 3) linear, of numbers (n,)."""
        return _colours(np.clip((values - self.least) / (self.greatest - self.least or 1.0), 0.0, 1.0))

    def beside(self, image: Points) -> Points:
        """A picture (rows, columns, 3) with the colours along its lower edge, and words at its top that say what they
        are."""
        rows, columns = image.shape[:2]
        height, margin = max(rows // 60, 3), max(rows // 40, 4)
        words = f"{self.name.replace('_', ' ')} from {self.least:.3g} to {self.greatest:.3g} {self.unit}"
        told = labelled(image, words)
        told[rows - margin - height : rows - margin, margin : columns - margin] = _colours(
            np.linspace(0.0, 1.0, columns - 2 * margin)
        )
        return told


def _colours(shares: NDArray) -> Points:
    """(n, 3) linear, of numbers from 0 to 1."""
    from matplotlib import colormaps

    return from_srgb((255.0 * colormaps[PALETTE](shares)[..., :3]).round().astype(np.uint8))
