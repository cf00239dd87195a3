"""What every wall particle of a container counts for in the density, by least squares, in float64."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import coo_array, identity, vstack

from cortado.calibration import lattice_offsets
from cortado.pairs import pairs_within
from cortado.region import Region
from cortado.shapes import Points
from cortado.smoothing import SmoothingKernel
from cortado.walls.places import Places

STIFFNESS = 3e-3
"""How much a weight resists a change, relative, beside an error of the density: where densities leave a weight open it
stays that of a flat wall."""
CHUNK = 4096
"""How many places are looked at at a time: bounds the memory."""


@dataclass(frozen=True)
class RestLattice:
    """The lattice of the fluid at rest, under a smoothing kernel."""

    kernel: SmoothingKernel
    spacing: float
    """[m]"""
    support: float
    """[m]"""

    def weights(self, distances: np.ndarray, dimension: int) -> np.ndarray:
        """W at distances [m], any shape, beside the sum of W over the lattice."""
        offsets = lattice_offsets(self.spacing, self.support, dimension)
        total = self.kernel.weight(np.linalg.norm(offsets, axis=1), dimension, self.support).sum()
        return self.kernel.weight(distances, dimension, self.support) / total

    def missing(self, places: Places, region: Region) -> Points:
        """(n,) the part of the lattice's sum of W that lies outside of a region, for a lattice at each of the places.

        A lattice point is outside by as much as its cell is.
        """
        dimension = places.points.shape[1]
        offsets = lattice_offsets(self.spacing, self.support, dimension)
        weights = self.weights(np.linalg.norm(offsets, axis=1), dimension)
        found = np.zeros(len(places.points))
        for start in range(0, len(found), CHUNK):
            some = slice(start, start + CHUNK)
            cells = places.points[some, None] + offsets @ places.axes[some]
            shares = region.cell_shares(cells.reshape(-1, dimension), self.spacing)
            found[some] = (1.0 - shares).reshape(-1, len(offsets)) @ weights
        return found


def wall_weights(
    walls: Points,
    flat: Points,
    lattice: RestLattice,
    places: Places,
    region: Region,
    lower: Points,
    lengths: Points,
) -> Points:
    """(b,) [-] what wall particles count for in the density, a fluid particle being 1.

    With them the lattice has the rest density at all places beside the walls, as nearly as can be, in the sense of
    least squares: along faces, edges and corners, in a cup, and across the seam of a period.

    Args:
        walls: (b, d) wall particles [m].
        flat: (b,) their weights in a flat wall.
        lattice: the lattice of the fluid at rest.
        places: where the fluid may rest beside the walls.
        region: where fluid may be.
        lower: (d,) where the period begins [m].
        lengths: (d,) the lengths of the period [m], 0 for axes without one.
    """
    if not len(walls):
        return np.zeros(0)
    place, wall, distances = pairs_within(places.points, walls, lattice.support, lower, lengths)
    seen = flat[wall] * lattice.weights(distances, walls.shape[1])
    sums = coo_array((seen, (place, wall)), shape=(len(places.points), len(walls))).tocsr()
    errors = lattice.missing(places, region) - sums.sum(axis=1)
    resisted = vstack([sums, STIFFNESS * identity(len(walls))]).tocsr()
    wanted = np.concatenate([errors, np.zeros(len(walls))])
    changes = lsq_linear(resisted, wanted, bounds=(-1.0, np.inf), lsq_solver="lsmr", tol=1e-10).x
    return np.asarray(flat * (1.0 + changes), dtype=np.float64)
