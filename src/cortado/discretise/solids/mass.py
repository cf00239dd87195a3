"""Volume and inertia of a solid, by points of a lattice inside it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.solids.solid import Solid

POINTS = {2: 400, 3: 80}
"""Of the lattice along the longest side, in 2 and 3 dimensions."""


@dataclass(frozen=True)
class Mass:
    """Of a solid with a density of 1."""

    volume: float
    """[m^d]"""
    inertia: NDArray[np.float64]
    """(3, 3) about the centroid [m^(d + 2)]; in 2-D only that about z."""

    @classmethod
    def of(cls, solid: Solid) -> "Mass":
        """Each point counts for the part of its cell that is inside, as a flat surface at its distance would cut it."""
        lower, upper = solid.extent()
        dimension = len(lower)
        step = float((upper - lower).max()) / POINTS[dimension]
        sides = [
            lo + step * (np.arange(int(np.ceil((hi - lo) / step)) + 1)) for lo, hi in zip(lower, upper, strict=True)
        ]
        points = np.stack([axis.ravel() for axis in np.meshgrid(*sides, indexing="ij")], axis=-1)
        parts = np.clip(0.5 - solid.distance(points) / step, 0.0, 1.0) * step**dimension
        volume = float(parts.sum())
        middle = parts @ points / volume
        x = np.zeros((len(points), 3))
        x[:, :dimension] = points - middle
        second = np.einsum("n,ni,nj->ij", parts, x, x)
        inertia = np.trace(second) * np.eye(3) - second
        return cls(volume, inertia if dimension == 3 else np.diag([0.0, 0.0, inertia[2, 2]]))

    def in_volumes(self, unit: float) -> "Mass":
        """The same in volumes of so many [m^d]."""
        return Mass(self.volume / unit, self.inertia / unit)
