"""What every wall particle of a container counts for in the density, by least squares, in float64."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cortado.discretise.calibration import lattice_offsets
from cortado.discretise.pairs import apart, pairs_within
from cortado.discretise.region import Region
from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import SmoothingKernel
from cortado.discretise.walls.places import Places

if TYPE_CHECKING:
    from scipy.sparse import csr_array

STIFFNESS = 3e-3
"""How much a weight resists a change, relative, beside an error of the density: where densities leave a weight open it
stays that of a flat wall."""
BALANCE = 0.02
"""What the push of a uniform pressure counts beside an error of the density. Densities alone hardly say how steep two
layers are: round a cup they would make them so shallow that fluid passes. At 0.1 corners would be too dense."""
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

    def sums(self, separations: np.ndarray) -> np.ndarray:
        """(m, 1 + d) W, and the gradient of W times the spacing, beside the sum of W over the lattice, at separations
        (m, d) [m]."""
        dimension = separations.shape[1]
        offsets = lattice_offsets(self.spacing, self.support, dimension)
        total = self.kernel.weight(np.linalg.norm(offsets, axis=1), dimension, self.support).sum()
        weights = self.kernel.weight(np.linalg.norm(separations, axis=1), dimension, self.support)
        gradients = self.kernel.gradient(separations, self.support)
        return np.asarray(np.column_stack([weights, self.spacing * gradients]) / total)

    def missing(self, places: Places, region: Region) -> Points:
        """(n, 1 + d) the part of the lattice's `sums` that lies outside of a region, for a lattice at each of the
        places.

        A lattice point is outside by as much as its cell is.
        """
        dimension = places.points.shape[1]
        offsets = lattice_offsets(self.spacing, self.support, dimension)
        cells = places.points[:, None] + offsets @ places.axes
        shares = region.cell_shares(cells.reshape(-1, dimension), self.spacing).reshape(-1, len(offsets))
        found = (1.0 - shares) @ self.sums(-offsets)
        found[:, 1:] = (found[:, None, 1:] @ places.axes)[:, 0]
        return np.asarray(found)


@dataclass(frozen=True)
class WallSurface:
    """The walls of a container, whose weights are sought."""

    walls: Points
    """(b, d) wall particles [m]"""
    flat: Points
    """(b,) their weights in a flat wall [-]"""
    lattice: RestLattice
    """The lattice of the fluid at rest."""
    region: Region
    """Where fluid may be."""
    lower: Points
    """(d,) where the period begins [m]"""
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    def weights(self, places: Places) -> Points:
        """(b,) [-] what wall particles count for in the density, a fluid particle being 1.

        With them the lattice has the rest density at all places, and a uniform pressure pushes no particle less than a
        spacing from a wall, as nearly as can be, in the sense of least squares: along faces, edges and corners, in a
        cup, and across the seam of a period. Against the push, as in `wall_layers`, the wall's part in the gradient is
        twice that of the fluid that is missing.
        """
        from scipy.optimize import lsq_linear
        from scipy.sparse import eye_array, vstack

        count = len(self.walls)
        if not count:
            return np.zeros(0)
        chunks = range(0, len(places.points), CHUNK)
        demands = [self._demands(places.some(slice(start, start + CHUNK))) for start in chunks]
        sums = vstack([*(part for part, _ in demands), STIFFNESS * eye_array(count)]).tocsr()
        wanted = np.concatenate([*(part for _, part in demands), STIFFNESS * np.ones(count)])
        changes = lsq_linear(sums, wanted - sums.sum(axis=1), bounds=(-1.0, np.inf), lsq_solver="lsmr", tol=1e-10).x
        return np.asarray(self.flat * (1.0 + changes), dtype=np.float64)

    def _demands(self, places: Places) -> tuple["csr_array", Points]:
        """A matrix (m, b) that gives, with the weights of the walls over their flat ones, what is wanted, (m,)."""
        from scipy.sparse import coo_array, vstack

        place, wall, _ = pairs_within(places.points, self.walls, self.lattice.support, self.lower, self.lengths)
        separations = apart(places.points[place] - self.walls[wall], self.lengths)
        shape, indices = (len(places.points), len(self.walls)), (place.astype(np.int32), wall.astype(np.int32))
        seen = self.flat[wall, None] * self.lattice.sums(separations)
        densities, *gradients = (coo_array((part, indices), shape=shape).tocsr() for part in seen.T)
        missing = self.lattice.missing(places, self.region)
        near = ~self.region.contains(places.points, -self.lattice.spacing)
        sums = vstack([densities, *(BALANCE * gradient[near] for gradient in gradients)]).tocsr()
        return sums, np.concatenate([missing[:, 0], 2.0 * BALANCE * missing[near, 1:].T.ravel()])
