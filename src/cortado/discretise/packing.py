"""Particles moved until the fluid has its rest density everywhere, in float64.

In Colagrossi et al. (2012) and in Negi and Ramachandran (2021) particles push each other until they fill a shape
evenly. Here nonlinear least squares (Gauss-Newton) do it: the density of every particle is to be that of the lattice,
where walls count with their weights and air counts as if it were fluid, and no two particles are to be too near each
other. Only particles near a surface move, as those on a lattice have the rest density from the start.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.calibration import SLACK, rest_volume
from cortado.discretise.pairs import apart, are_near, pairs_among, pairs_within
from cortado.discretise.shapes import Points
from cortado.discretise.walls.weights import RestLattice
from cortado.files.terminal import timed_note

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Which = NDArray[np.bool_]

HIGHEST, AIM, LOWEST = 0.5 * SLACK, (-6e-3, -1e-3), -9e-3
"""Of a packed particle's density beside that of the lattice, relative. It is not above, or pressure would drive the
particles apart in the first step."""
MOST_LOOKS, MOST_ROUNDS, ROUNDS = 4, 36, 6
"""How often it is looked at all particles; rounds of least squares after each look, and until those that move are
chosen anew."""
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
MANY = 20_000
"""Particles: a line announces the packing of so many, as it takes some seconds or minutes."""
GRAINS = 2.0**13
"""Particles move by whole numbers of this part of a spacing, so that round-off, which differs between machines, does
not show in where they are."""


@dataclass(frozen=True)
class Packing:
    """What particles are packed among."""

    lattice: RestLattice
    """The lattice of the fluid at rest."""
    fixed: Points
    """(m, d) points of air and of walls [m]"""
    weights: Points
    """(m,) what each counts for in the density, a particle being 1 [-]"""
    air: int
    """How many of these, the first ones, are of air."""
    lower: Points
    """(d,) where the period begins [m]"""
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    def packed(self, particles: Points, stays: Which) -> Points:
        """(n, d) [m] where particles (n, d) [m] come to lie, but for those that stay where they are (n,). The last few
        answers are kept."""
        arrays = self.fixed, self.weights, self.lower, self.lengths, particles, stays
        return _packed(self.lattice, particles.shape, self.air, *(array.tobytes() for array in arrays)).copy()

    def errors(self, particles: Points, stays: Which) -> Points:
        """(n,) by how much the densities of particles (n, d) [m] are above that of the lattice, relative; 0 for those
        that stay, around which no air is counted, where they are below it."""
        return Pairs(self, particles, stays).errors(particles)

    def settled(self, particles: Points, stays: Which) -> Points:
        """As `packed`, computed. Of particles that have the rest density already none moves."""
        found = particles
        for _ in range(MOST_LOOKS):
            wrong = self._wrong(found, stays)
            if not wrong.any():
                break
            found = self._settled_near(wrong, found, stays)
        grain = self.lattice.spacing / GRAINS
        return np.asarray(particles + grain * np.rint((found - particles) / grain))

    def _settled_near(self, wrong: Which, particles: Points, stays: Which) -> Points:
        """Particles (n, d) [m] after those near the ones that are ``wrong`` (n,) were moved. Nothing further away is
        looked at meanwhile, as there may be very much of it."""
        support, near = self.lattice.support, self.lattice.support + self.lattice.spacing
        movable = self._near(particles, wrong, near) & ~stays
        region = self._near(particles, movable, support)
        around, part = self._among(particles[~region]), particles[region]
        for _ in range(MOST_ROUNDS // ROUNDS):
            free = around._near(part, around._wrong(part, stays[region]), near) & movable[region]
            if not free.any():
                break
            seen = around._near(part, free, support)
            pairs = Pairs(around._among(part[~seen]), part[seen], stays[region][seen], free[seen], SKIN)
            part[seen] = pairs.relaxed(part[seen])
        found = particles.copy()
        found[region] = part
        return found

    def _wrong(self, particles: Points, stays: Which) -> Which:
        errors = self.errors(particles, stays)
        return np.asarray((errors > HIGHEST) | (errors < LOWEST))

    def _near(self, particles: Points, some: Which, reach: float) -> Which:
        """(n,) which particles are at most ``reach`` [m] from one of some of them."""
        return are_near(particles, particles[some], reach, self.lower, self.lengths)

    def _among(self, others: Points) -> "Packing":
        """The same with other particles (m, d) [m] that are not looked at."""
        weights = np.append(self.weights, np.ones(len(others)))
        return replace(self, fixed=np.concatenate([self.fixed, others]), weights=weights)


class Pairs:
    """Particles and what they see, as long as none moves by more than half of a ``skin`` [spacings]."""

    def __init__(self, packing: Packing, particles: Points, stays: Which, free: Which | None = None, skin: float = 0.0):
        self._packing, self._lattice, self._stays = packing, packing.lattice, stays
        self._count, self._dimension = particles.shape
        self._free = np.zeros(self._count, dtype=bool) if free is None else free
        reach, period = self._lattice.support + skin * self._lattice.spacing, (packing.lower, packing.lengths)
        self._i, self._j = pairs_among(particles, reach, *period)
        k, fixed, _ = pairs_within(particles, packing.fixed, reach, *period)
        seen = ~stays[k] | (fixed >= packing.air)
        self._k, self._fixed = k[seen], fixed[seen]
        self._weights = packing.weights[self._fixed]
        self._volume = rest_volume(self._lattice.kernel, self._lattice.spacing, self._lattice.support, self._dimension)

    def relaxed(self, particles: Points) -> Points:
        """Particles (n, d) [m] after `ROUNDS` of least squares for those that are free, or fewer."""
        from scipy.sparse import diags_array, vstack
        from scipy.sparse.linalg import lsmr

        spacing, found = self._lattice.spacing, particles.copy()
        for _ in range(ROUNDS):
            pairs, with_fixed = self._separations(found)
            errors, (gaps, pushes) = self._errors(pairs, with_fixed), self._close_pairs(pairs)
            counted = ~self._stays | (errors > HIGHEST)
            slopes = diags_array(counted.astype(np.float64)) @ self._slopes(pairs, with_fixed)
            equations = vstack([slopes, PUSH * pushes]).tocsr()
            wanted = np.concatenate([counted * (np.clip(errors, *AIM) - errors), PUSH * gaps])
            solution = lsmr(equations, wanted, damp=DAMPING, maxiter=MOST_INNER_ROUNDS, atol=1e-3, btol=1e-3)[0]
            moves = solution.reshape(-1, self._dimension)
            sizes = np.linalg.norm(moves, axis=1, keepdims=True)
            found[self._free] += spacing * moves * np.minimum(1.0, FARTHEST / np.maximum(sizes, FARTHEST))
            if np.abs(found - particles).max() > 0.5 * (SKIN - FARTHEST) * spacing:
                break
        return found

    def errors(self, particles: Points) -> Points:
        """See `Packing.errors`."""
        return self._errors(*self._separations(particles))

    def _errors(self, pairs: Points, with_fixed: Points) -> Points:
        kernel, support = self._lattice.kernel, self._lattice.support
        weights = kernel.weight(np.linalg.norm(pairs, axis=1), self._dimension, support)
        of_fixed = kernel.weight(np.linalg.norm(with_fixed, axis=1), self._dimension, support) * self._weights
        found = np.bincount(self._i, weights, self._count) + np.bincount(self._j, weights, self._count)
        found = found + np.bincount(self._k, of_fixed, self._count)
        found = found + kernel.weight(np.zeros(1), self._dimension, support)
        errors = self._volume * found - (1.0 - SLACK)
        return np.where(self._stays, np.maximum(errors, 0.0), errors)

    def _separations(self, particles: Points) -> tuple[Points, Points]:
        """Of pairs of particles, and of particles and what is fixed, (m, d) [m]."""
        lengths = self._packing.lengths
        with_fixed = particles[self._k] - self._packing.fixed[self._fixed]
        return apart(particles[self._i] - particles[self._j], lengths), apart(with_fixed, lengths)

    def _slopes(self, pairs: Points, with_fixed: Points) -> "csr_array":
        """The derivatives (n, free d) of the densities by the places [spacings] of the particles that are free."""
        gradients = self._lattice.kernel.gradient(pairs, self._lattice.support)
        of_fixed = self._lattice.kernel.gradient(with_fixed, self._lattice.support) * self._weights[:, None]
        which = np.concatenate([self._i, self._j, self._k])
        own = [np.bincount(which, part, self._count) for part in np.concatenate([gradients, -gradients, of_fixed]).T]
        itself, first, second = np.flatnonzero(self._free), self._free[self._i], self._free[self._j]
        rows = np.concatenate([itself, self._j[first], self._i[second]])
        columns = np.concatenate([itself, self._i[first], self._j[second]])
        slopes = np.concatenate([np.stack(own, axis=1)[itself], gradients[first], -gradients[second]])
        return _matrix(rows, columns, self._lattice.spacing * self._volume * slopes, self._count, self._free)

    def _close_pairs(self, pairs: Points) -> tuple[Points, "csr_array"]:
        """By how much pairs are too near each other, (m,) [spacings], and the derivatives of their distances."""
        distances = np.linalg.norm(pairs, axis=1) / self._lattice.spacing
        chosen = (distances < NEAR) & (self._free[self._i] | self._free[self._j])
        i, j, distances = self._i[chosen], self._j[chosen], distances[chosen]
        away = pairs[chosen] / (self._lattice.spacing * distances[:, None])
        pair, first, second = np.arange(len(i)), self._free[i], self._free[j]
        rows, columns = np.append(pair[first], pair[second]), np.append(i[first], j[second])
        slopes = np.concatenate([away[first], -away[second]])
        return NEAR - distances, _matrix(rows, columns, slopes, len(i), self._free)


def _matrix(rows: np.ndarray, particles: np.ndarray, slopes: Points, count: int, free: Which) -> "csr_array":
    """(count, free d) of derivatives (m, d), each of a row by the place of a particle that is free."""
    from scipy.sparse import csr_array

    dimension, number = slopes.shape[1], np.cumsum(free) - 1
    columns = dimension * number[particles][:, None] + np.arange(dimension)
    shape = count, dimension * np.count_nonzero(free)
    return csr_array((slopes.ravel(), (np.repeat(rows, dimension), columns.ravel())), shape=shape)


@lru_cache(maxsize=8)
def _packed(lattice: RestLattice, shape: tuple[int, int], air: int, *arrays: bytes) -> Points:
    """See `Packing.packed`: simulations of one scene are made more than once."""
    *numbers, stays = arrays
    fixed, weights, lower, lengths, particles = (np.frombuffer(one) for one in numbers)
    packing = Packing(lattice, fixed.reshape(-1, shape[1]), weights, air, lower, lengths)
    is_long = shape[0] > MANY
    with timed_note(f"Packing the particles of round bodies, {shape[0]:,} in all") if is_long else nullcontext():
        return packing.settled(particles.reshape(shape), np.frombuffer(stays, dtype=bool))
