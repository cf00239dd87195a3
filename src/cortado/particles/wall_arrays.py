"""Wall particles as a search for neighbours is given them, in float64."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WallArrays:
    """Wall particles, in any order."""

    positions: np.ndarray
    """(b, 3) [m]; of solids that move in their own frames"""
    weights: np.ndarray
    """(b,) what each counts for in the density, a fluid particle being 1 [-]"""
    grips: np.ndarray
    """(b,) the same of those without slip, and 0 of those along which fluid slips freely"""
    feet: np.ndarray
    """(b, 3) from each to the surface [m]"""
    slides: np.ndarray
    """(b, 3) how fast their surface slides along the solid [m/s]"""
    solid: np.ndarray
    """(b,) the number of the solid whose each is: of those that move from 0 on, of those at rest from -2 on
    downwards; -1 of the container's"""

    def some(self, which: np.ndarray) -> "WallArrays":
        """Those that are chosen."""
        return WallArrays(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.weights)
