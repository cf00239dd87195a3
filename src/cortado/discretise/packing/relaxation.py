"""Least squares for the places of particles that are free, without a matrix, in float64."""

from typing import Any

import numpy as np

from cortado.discretise.calibration import SLACK
from cortado.discretise.cpu_launches import launched, shared
from cortado.discretise.packing.around import PointsAround, Which, starts_of
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
        self._around, self._stays, self._free, self._count = around, stays, free, len(stays)
        self._starts, self._listed = around.lists(around.points[: self._count], stays)

    def relaxed(self) -> Points:
        """Particles (n, d) [m] after `ROUNDS` of least squares for those that are free, or fewer."""
        spacing, places = self._around.lattice.spacing, self._around.in_space[: self._count]
        first, dimension = places.copy(), self._around.points.shape[1]
        for _ in range(ROUNDS):
            moves = self._solved()
            sizes = np.linalg.norm(moves, axis=1, keepdims=True)
            places += spacing * moves * np.minimum(1.0, FARTHEST / np.maximum(sizes, FARTHEST))
            if np.abs(places - first).max() > 0.5 * (SKIN - FARTHEST) * spacing:
                break
        return places[:, :dimension].copy()

    def _linearised(self) -> tuple[Any, Points, Points]:
        """The equations at the present places, the sums of kernels there (n,) [1 / m^d], and how far pairs are apart
        that are too near (m,) [m]."""
        around, kernels = self._around, self._around.kernels
        given = {"around": around.on_cpu, "free": self._free, "starts": self._starts, "listed": self._listed}
        given["close"] = NEAR * around.lattice.spacing
        sums = np.full(self._count, around.own_weight)
        counts, close_counts = np.empty(self._count, dtype=np.int32), np.empty(self._count, dtype=np.int32)
        launched(kernels.count_pairs, self._count, sums=sums, counts=counts, close_counts=close_counts, **given)
        starts, close_starts = (starts_of(one) for one in (counts, close_counts))
        pairs, close_pairs = starts[-1], close_starts[-1]
        arrays = {"starts": starts, "others": np.empty(pairs, dtype=np.int32), "gradients": np.empty((pairs, 3))}
        arrays |= {"close_starts": close_starts, "close_others": np.empty(close_pairs, dtype=np.int32)}
        arrays |= {"directions": np.empty((close_pairs, 3)), "own": np.empty((self._count, 3))}
        equations, distances = kernels.equations(), np.empty(close_pairs)
        for name, array in arrays.items():
            setattr(equations, name, shared(array))
        launched(kernels.linearise, self._count, equations=equations, distances=distances, **given)
        return equations, sums, distances

    def _solved(self) -> Points:
        """(n, 3) moves [spacings]."""
        from scipy.sparse.linalg import LinearOperator, lsmr

        equations, sums, distances = self._linearised()
        kernels, count, spacing = self._around.kernels, self._count, self._around.lattice.spacing
        errors = density_errors(self._around, sums, self._stays)
        counted = (~self._stays | (errors > HIGHEST)).astype(np.float64)
        unit, held = spacing * self._around.volume * counted, ~self._free
        wanted = np.concatenate([counted * (np.clip(errors, *AIM) - errors), PUSH * (NEAR - distances / spacing)])

        def multiply(moves: Points) -> Points:
            found = np.zeros(len(wanted))
            changes, approaches = found[:count], found[count:]
            moves = moves.reshape(-1, 3)
            launched(kernels.multiply, count, equations=equations, moves=moves, changes=changes, approaches=approaches)
            changes *= unit
            approaches *= PUSH
            return found

        def multiply_back(given: Points) -> Points:
            moves, changes, approaches = np.zeros((count, 3)), unit * given[:count], PUSH * given[count:]
            launched(
                kernels.multiply_back, count, equations=equations, moves=moves, changes=changes, approaches=approaches
            )
            moves[held] = 0.0
            return moves.ravel()

        product = LinearOperator((len(wanted), 3 * count), multiply, multiply_back, dtype=np.float64)
        found = lsmr(product, wanted, damp=DAMPING, maxiter=MOST_INNER_ROUNDS, atol=1e-3, btol=1e-3)[0]
        return np.asarray(found.reshape(-1, 3))
