"""A picture that a notebook shows."""

from typing import Self

import numpy as np

from cortado.discretise.shapes import Points
from cortado.pictures.image_files import png


class ShadedPicture(np.ndarray):
    """(rows, columns, 3) linear from 0 to 1: an array, which a notebook shows as what it is a picture of."""

    @classmethod
    def of(cls, image: Points) -> Self:
        """The same numbers."""
        return np.asarray(image).view(cls)

    def _repr_png_(self) -> bytes | None:
        """None of what is no picture any more, such as a row of one."""
        return png(self) if self.ndim == 3 and self.shape[2] == 3 else None
