"""Volume and inertia of a solid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.solids.solid import Solid


@dataclass(frozen=True)
class Mass:
    """Of a solid with a density of 1."""

    volume: float
    """[m^d]"""
    inertia: NDArray[np.float64]
    """(3, 3) about the centroid [m^(d + 2)]; in 2-D only that about z."""

    @classmethod
    def of(cls, solid: Solid) -> "Mass":
        """By its moments, in the plane or in space."""
        moments = solid.moments()
        about = np.trace(moments.second) * np.eye(3)
        if len(moments.centre) == 2:
            return cls(moments.volume, np.diag([0.0, 0.0, about[2, 2]]))
        return cls(moments.volume, about - moments.second)

    def in_volumes(self, unit: float) -> "Mass":
        """The same in volumes of so many [m^d]."""
        return Mass(self.volume / unit, self.inertia / unit)
