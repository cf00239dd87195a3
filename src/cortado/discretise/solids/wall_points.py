"""Wall particles whose weights are sought, in float64."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.solid import Which


@dataclass(frozen=True)
class WallPoints:
    """Wall particles whose weights are not known yet."""

    positions: Points
    """(b, d) [m]"""
    flat: Points
    """(b,) what each would count for in the density if its wall were flat [-]"""
    feet: Points
    """(b, d) from each to the nearest point of its surface [m]"""

    @classmethod
    def joined(cls, parts: Sequence["WallPoints"]) -> "WallPoints":
        """One behind the other."""
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in ("positions", "flat", "feet")))

    def some(self, which: Which) -> "WallPoints":
        """Some of them."""
        return WallPoints(self.positions[which], self.flat[which], self.feet[which])

    def __len__(self) -> int:
        return len(self.positions)
