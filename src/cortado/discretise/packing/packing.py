"""Particles moved until the fluid has its rest density everywhere, in float64.

In Colagrossi et al. (2012) and in Negi and Ramachandran (2021) particles push each other until they fill a shape
evenly. Here nonlinear least squares (Gauss-Newton) do it: the density of every particle is to be that of the lattice,
where walls count with their weights and air counts as if it were fluid, and no two particles are to be too near each
other. Only particles near a surface move, as those on a lattice have the rest density from the start.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.packing.around import PointsAround, Which
from cortado.discretise.packing.relaxation import HIGHEST, LOWEST, ROUNDS, SKIN, Relaxation, density_errors
from cortado.discretise.pairs import pairs_within
from cortado.discretise.shapes import Points
from cortado.discretise.walls.weights import RestLattice
from cortado.files.terminal import timed_note

MOST_LOOKS, MOST_ROUNDS = 12, 36
"""How often it is looked at all particles; rounds of least squares after each look."""
COMPRESSED, DIGITS = 0.03, 6
"""By how much the density of a particle that is left out is above the lattice's, relative, and to how many decimals."""
BESIDE, MOST_OUT = 10.0, 40
"""Particles are left out one at a time within so many supports, as others have more room then; and how often."""
ROUND_OFF = 1e-9
"""By how much, relative, particles of a lattice may be further away than they are."""
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
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    def packed(self, particles: Points, stays: Which) -> tuple[Points, NDArray[np.int64]]:
        """(m, d) [m] where particles (n, d) [m] come to lie, but for those that stay where they are (n,); and the
        numbers (m,) of the particles that there is room for. The last few answers are kept."""
        arrays = self.fixed, self.weights, self.lengths, particles, stays
        found, kept = _packed(self.lattice, particles.shape, self.air, *(array.tobytes() for array in arrays))
        return found.copy(), kept

    def errors(self, particles: Points, stays: Which, some: slice | Which = slice(None)) -> Points:
        """(m,) by how much the densities of ``some`` of particles (n, d) [m] are above that of the lattice, relative; 0
        for those that stay (n,), around which no air is counted, where they are below it."""
        around = self._around(particles, self.lattice.support)
        return density_errors(around, around.sums(particles[some], stays[some]), stays[some])

    def settled(self, particles: Points, stays: Which) -> tuple[Points, NDArray[np.int64]]:
        """As `packed`, computed. Of particles that have the rest density already none moves; while some are compressed,
        as in wedges or where a small body was rounded up to a whole particle, those that are most are left out."""
        kept, found = np.arange(len(particles)), self._at_rest(particles, stays)
        for _ in range(MOST_OUT):
            crowded = self._crowded(found, stays[kept])
            if not len(crowded):
                break
            kept, found = np.delete(kept, crowded), np.delete(found, crowded, axis=0)
            found = self._at_rest(found, stays[kept])
        grain = self.lattice.spacing / GRAINS
        return np.asarray(particles[kept] + grain * np.rint((found - particles[kept]) / grain)), kept

    def _crowded(self, particles: Points, stays: Which) -> NDArray[np.int64]:
        """The numbers (m,) of particles (n, d) [m] that are compressed, and not less than any beside them."""
        errors = np.round(self.errors(particles, np.ones(len(particles), dtype=bool)), DIGITS)
        over = np.flatnonzero((errors > COMPRESSED) & ~stays)
        points, reach = particles[over], BESIDE * self.lattice.support
        lengths = np.where(self.lengths > 2.0 * reach, self.lengths, 0.0)
        one, other, _ = pairs_within(points, points, reach, lengths=lengths)
        less = one[errors[over[one]] < errors[over[other]]]
        return np.delete(over, np.unique(less))

    def _at_rest(self, particles: Points, stays: Which) -> Points:
        """Where all particles (n, d) [m] come to lie."""
        found = particles
        for _ in range(MOST_LOOKS):
            wrong = self._wrong(found, stays)
            if not wrong.any():
                break
            found = self._settled_near(wrong, found, stays)
        return found

    def _settled_near(self, wrong: Which, particles: Points, stays: Which) -> Points:
        """Particles (n, d) [m] after those near the ones that are ``wrong`` (n,) were moved. Nothing further away is
        looked at meanwhile, as there may be very much of it."""
        support, near = self.lattice.support, self.lattice.support + self.lattice.spacing
        movable = self._near(particles, wrong, near) & ~stays
        region = self._near(particles, movable, support)
        around, part = self._among(particles[~region]), particles[region]
        part_stays, part_wrong = stays[region], wrong[region]
        for _ in range(MOST_ROUNDS // ROUNDS):
            free = around._near(part, part_wrong, near) & movable[region]
            if not free.any():
                break
            seen = around._near(part, free, support)
            others, reach = around._among(part[~seen]), support + SKIN * self.lattice.spacing
            part[seen] = Relaxation(others._around(part[seen], reach), part_stays[seen], free[seen]).relaxed()
            part_wrong[seen] = around._wrong(part, part_stays, seen)
        found = particles.copy()
        found[region] = part
        return found

    def _wrong(self, particles: Points, stays: Which, some: slice | Which = slice(None)) -> Which:
        errors = self.errors(particles, stays, some)
        return np.asarray((errors > HIGHEST) | (errors < LOWEST))

    def _near(self, particles: Points, some: Which, reach: float) -> Which:
        """(n,) which particles are at most ``reach`` [m] from one of some of them."""
        others = particles[some]
        weights, reach = np.ones(len(others)), reach * (1.0 + ROUND_OFF)
        found = PointsAround(self.lattice, others, weights, (0, 0), self.lengths, reach)
        return found.near(particles)

    def _around(self, particles: Points, reach: float) -> PointsAround:
        """What particles (n, d) [m] see that look as far as ``reach`` [m]: one another, and what is fixed."""
        count = len(particles)
        points, weights = np.concatenate([particles, self.fixed]), np.append(np.ones(count), self.weights)
        return PointsAround(self.lattice, points, weights, (count, count + self.air), self.lengths, reach)

    def _among(self, others: Points) -> "Packing":
        """The same with other particles (m, d) [m] that are not looked at."""
        weights = np.append(self.weights, np.ones(len(others)))
        return replace(self, fixed=np.concatenate([self.fixed, others]), weights=weights)


@lru_cache(maxsize=8)
def _packed(lattice: RestLattice, shape: tuple[int, int], air: int, *arrays: bytes) -> tuple[Points, NDArray[np.int64]]:
    """See `Packing.packed`: simulations of one scene are made more than once."""
    *numbers, stays = arrays
    fixed, weights, lengths, particles = (np.frombuffer(one) for one in numbers)
    packing = Packing(lattice, fixed.reshape(-1, shape[1]), weights, air, lengths)
    is_long = shape[0] > MANY
    with timed_note(f"Packing the particles of round bodies, {shape[0]:,} in all") if is_long else nullcontext():
        return packing.settled(particles.reshape(shape), np.frombuffer(stays, dtype=bool))
