"""Least squares for the places of particles that are free, in float64."""

import numpy as np

from cortado.discretise.calibration import SLACK
from cortado.discretise.packing.around import PointsAround, Which
from cortado.discretise.packing.linearised import ListedPairs
from cortado.discretise.shapes import Points

HIGHEST, AIM, LOWEST = 0.5 * SLACK, (-6e-3, -1e-3), -9e-3
"""Of a packed particle's density beside that of the lattice, relative. It is not above, or pressure would drive the
particles apart in the first step."""
ROUNDS = 6
"""Of least squares, until those that move are chosen anew."""
SKIN = 0.6
"""[spacings] beyond the support up to which pairs are kept for the rounds to come."""
NEAR = 0.9
"""[spacings]: pairs of particles that are nearer push each other apart."""
PUSH = 0.1
"""What a pair that is too near by a spacing counts, beside a density that is wrong by its whole."""
FARTHEST = 0.15
"""[spacings] that a particle moves in a round at most, as the equations are linear only nearby."""
DAMPING, MOST_INNER_ROUNDS = 0.02, 20
"""Of the linear least squares: among solutions that are nearly as good, the one that moves particles least."""


def density_errors(around: PointsAround, sums: Points, stays: Which) -> Points:
    """(n,) by how much densities are above that of the lattice, relative, given sums of kernels (n,) [1 / m^d]; 0 for
    particles that stay where it is below."""
    errors = around.volume * sums - (1.0 - SLACK)
    return np.where(stays, np.maximum(errors, 0.0), errors)


class Relaxation:
    """Particles, the first of the points around, of which some are ``free`` (n,) to move."""

    def __init__(self, around: PointsAround, stays: Which, free: Which):
        self._around, self._stays, self._free = around, stays, free
        self._pairs = ListedPairs(around, stays, free)

    def relaxed(self) -> Points:
        """Particles (n, d) [m] after `ROUNDS` of least squares for those that are free, or fewer."""
        spacing, places = self._around.lattice.spacing, self._around.in_space[: len(self._free)]
        first, dimension = places.copy(), self._around.points.shape[1]
        for _ in range(ROUNDS):
            moves = self._solved()
            sizes = np.linalg.norm(moves, axis=1, keepdims=True)
            places += spacing * moves * np.minimum(1.0, FARTHEST / np.maximum(sizes, FARTHEST))
            if np.abs(places - first).max() > 0.5 * (SKIN - FARTHEST) * spacing:
                break
        return places[:, :dimension].copy()

    def _solved(self) -> Points:
        """(n, 3) moves [spacings]."""
        from scipy.sparse.linalg import LinearOperator, lsmr

        spacing, count = self._around.lattice.spacing, len(self._free)
        equations = self._pairs.linearised(NEAR * spacing)
        errors = density_errors(self._around, equations.sums, self._stays)
        counted = (~self._stays | (errors > HIGHEST)).astype(np.float64)
        unit, held = spacing * self._around.volume * counted, ~self._free
        gaps = NEAR - equations.distances / spacing
        wanted = np.concatenate([counted * (np.clip(errors, *AIM) - errors), PUSH * gaps])

        def multiply(moves: Points) -> Points:
            changes, approaches = equations.multiply(moves.reshape(-1, 3))
            return np.concatenate([unit * changes, PUSH * approaches])

        def multiply_back(wrong: Points) -> Points:
            moves = equations.multiply_back(unit * wrong[:count], PUSH * wrong[count:])
            moves[held] = 0.0
            return moves.ravel()

        product = LinearOperator((len(wanted), 3 * count), multiply, multiply_back, dtype=np.float64)
        found = lsmr(product, wanted, damp=DAMPING, maxiter=MOST_INNER_ROUNDS, atol=1e-3, btol=1e-3)[0]
        return np.asarray(found.reshape(-1, 3))
