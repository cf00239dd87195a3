"""What every wall particle counts for in the density, by least squares, in float64."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cortado.discretise.calibration import lattice_offsets
from cortado.discretise.pairs import apart, pairs_within
from cortado.discretise.room import Room
from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import SmoothingKernel
from cortado.discretise.walls.places import Places

if TYPE_CHECKING:
    from scipy.sparse import csr_array

STIFFNESS = 3e-3
"""How much a weight resists a change, relative, beside an error of the density: where densities leave a weight open it
stays that of a flat wall."""
UNEVEN_STIFFNESS = 0.06
"""The same where particles are not on a lattice. With 0.003 some of them have no weight, and fluid passes there."""
LEAST, ROUNDS = 0.6, 4
"""Of a weight over that of a flat wall, where particles are not on a lattice; rounds in which weights that would be
less are set to it, and the others found anew."""
BALANCE = 0.02
"""What the push of a uniform pressure counts beside an error of the density. Densities alone hardly say how steep two
layers are: round a cup they would make them so shallow that fluid passes. At 0.1 corners would be too dense."""
RAISED = 3.0
"""In spacings: how far along the first axis of a place, away from a solid, one looks how much room there is."""
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

    def missing(self, places: Places, room: Room) -> Points:
        """(n, 1 + d) the part of the lattice's `sums` that lies outside of a room, for a lattice at each of the
        places.

        A lattice point is outside by as much as its cell is.
        """
        dimension = places.points.shape[1]
        offsets = lattice_offsets(self.spacing, self.support, dimension)
        cells = places.points[:, None] + offsets @ places.axes
        raised = places.points + RAISED * self.spacing * places.axes[:, 0]
        furthest = (RAISED + 0.5) * self.spacing + self.support
        empty = -room.distance(raised, furthest)  # the radius of a ball around each that nothing is in
        open_cells = np.linalg.norm(cells - raised[:, None], axis=2) <= empty[:, None] - 0.5 * self.spacing
        shares = np.ones(open_cells.shape)
        shares[~open_cells] = room.cell_shares(cells[~open_cells], self.spacing)
        found = (1.0 - shares) @ self.sums(-offsets)
        found[:, 1:] = (found[:, None, 1:] @ places.axes)[:, 0]
        return np.asarray(found)


@dataclass(frozen=True)
class WallSurface:
    """The walls of a room, whose weights are sought."""

    walls: Points
    """(b, d) wall particles [m]"""
    flat: Points
    """(b,) their weights in a flat wall [-], or those that are known"""
    lattice: RestLattice
    """The lattice of the fluid at rest."""
    room: Room
    """Where fluid may be."""
    lower: Points
    """(d,) where the period begins [m]"""
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""
    fit: "Fit"
    """`even_changes`, or `uneven_changes` where particles are on no lattice."""
    known: int = 0
    """How many of the wall particles, the last ones, have weights that are known."""

    def weights(self, places: Places) -> Points:
        """(b,) [-] what wall particles count for in the density, a fluid particle being 1.

        With them the lattice has the rest density at all places, and a uniform pressure pushes no particle less than a
        spacing from a wall, as nearly as can be, in the sense of least squares: along faces, edges and corners, in a
        cup, and across the seam of a period. Against the push, as in `wall_layers`, the wall's part in the gradient is
        twice that of the fluid that is missing.
        """
        from scipy.sparse import vstack

        sought, changes = len(self.walls) - self.known, np.zeros(len(self.walls))
        if not sought or not len(places.points):
            return self.flat.copy()
        chunks = range(0, len(places.points), CHUNK)
        demands = [self._demands(places.some(slice(start, start + CHUNK))) for start in chunks]
        sums = vstack([part for part, _ in demands]).tocsr()
        left = np.concatenate([part for _, part in demands]) - sums.sum(axis=1)
        own = sums[:, :sought]
        seen = np.diff(own.indptr) > 0
        changes[:sought] = self.fit(own[seen], left[seen])
        return np.asarray(self.flat * (1.0 + changes), dtype=np.float64)

    def _demands(self, places: Places) -> tuple["csr_array", Points]:
        """A matrix (m, b) that gives, with the weights of the walls over their flat ones, what is wanted, (m,)."""
        from scipy.sparse import coo_array, vstack

        place, wall, _ = pairs_within(places.points, self.walls, self.lattice.support, self.lower, self.lengths)
        separations = apart(places.points[place] - self.walls[wall], self.lengths)
        shape, indices = (len(places.points), len(self.walls)), (place.astype(np.int32), wall.astype(np.int32))
        seen = self.flat[wall, None] * self.lattice.sums(separations)
        densities, *gradients = (coo_array((part, indices), shape=shape).tocsr() for part in seen.T)
        missing = self.lattice.missing(places, self.room)
        near = ~self.room.contains(places.points, -self.lattice.spacing)
        sums = vstack([densities, *(BALANCE * gradient[near] for gradient in gradients)]).tocsr()
        return sums, np.concatenate([missing[:, 0], 2.0 * BALANCE * missing[near, 1:].T.ravel()])


Fit = Callable[["csr_array", Points], Points]
"""Of changes (b,) of weights, relative to those of a flat wall, given a matrix (m, b) and what it is to make of them,
(m,)."""


def even_changes(sums: "csr_array", wanted: Points) -> Points:
    """Those of particles on lattices, whose weights are at least 0."""
    from scipy.optimize import lsq_linear
    from scipy.sparse import eye_array, vstack

    count = sums.shape[1]
    system = vstack([sums, STIFFNESS * eye_array(count)]).tocsr()
    right = np.concatenate([wanted, np.zeros(count)])
    return np.asarray(lsq_linear(system, right, bounds=(-1.0, np.inf), lsq_solver="lsmr", tol=1e-10).x)


def uneven_changes(sums: "csr_array", wanted: Points) -> Points:
    """Those of particles that are about evenly spaced, whose weights are at least `LEAST` of those of a flat wall."""
    from scipy.sparse.linalg import lsmr

    changes, free = np.zeros(sums.shape[1]), np.ones(sums.shape[1], dtype=bool)
    for _ in range(ROUNDS):
        some = sums[:, free]
        held = wanted - sums[:, ~free] @ changes[~free]
        changes[free] = lsmr(some, held, damp=UNEVEN_STIFFNESS, atol=1e-6, btol=1e-6)[0]
        if (changes[free] >= LEAST - 1.0).all():
            break
        free &= changes >= LEAST - 1.0
        changes[~free] = LEAST - 1.0
    return np.maximum(changes, LEAST - 1.0)
