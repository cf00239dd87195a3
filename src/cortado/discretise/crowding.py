"""How closely first particles lie: fluid that starts compressed flies apart, and particles at one place have no
direction in which to be pushed apart. NumPy in float64."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.pairs import pairs_within
from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError

MOST_AVERAGE_COMPRESSION = 0.1
"""Of the first particles, the mean of (n - 1)+ where n is the number density: a lattice that is squeezed by more
bursts."""
MOST_DENSITY = 1.5
"""Greatest number density of a first particle; on a disturbed lattice with all particles half a spacing apart it is
1.4."""
NOTED_COMPRESSION = 0.03
"""Average compression that is warned of; a lattice whose points are disturbed by a tenth of a spacing has 0.02."""
NOTED_DENSITY = 0.5
"""Where no particle has more, there is no fluid to speak of."""
AT_ONE_PLACE = 1e-3
"""In spacings: particles that are nearer to each other are at one place."""


@dataclass(frozen=True)
class Crowding:
    """Particles, and how densely they lie."""

    positions: Points
    """(n, d) [m]"""
    densities: NDArray
    """(n,) number density over that on the rest lattice."""

    @property
    def compression(self) -> float:
        """The mean of what is above the density at rest."""
        return float(np.maximum(self.densities - 1.0, 0.0).mean())


def crowding_of(
    positions: Points, kernel: SmoothingKernel, support: float, volume: float, period: tuple[Points, Points]
) -> Crowding:
    """That of particles (n, d) [m] with a support radius [m] and a rest volume [m^d], in a period that begins at a
    corner and has lengths [m], 0 along axes without one."""
    point, _, distances = pairs_within(positions, positions, support, *period)
    seen = kernel.weight(distances, positions.shape[1], support)
    return Crowding(positions, volume * np.bincount(point, seen, minlength=len(positions)))


def check_crowding(crowding: Crowding, spacing: float, what: str) -> str | None:
    """What to warn of where particles may be meant to lie as they do, None if there is nothing; raises `InputError`
    where they would burst. ``what``: they in words, in the plural."""
    positions, densities, average = crowding.positions, crowding.densities, crowding.compression
    greatest, inside = densities.max(), float(np.quantile(densities, 0.75))  # away from the surface
    fit = spacing * inside ** (-1.0 / positions.shape[1])
    advice = f"discretisation.spacing is {spacing:g} m, and these points would fit one of {fit:.3g} m"
    if average > MOST_AVERAGE_COMPRESSION or greatest > MOST_DENSITY:
        place = ", ".join(f"{x:g}" for x in positions[densities.argmax()])
        raise InputError(
            f"{what[0].upper()}{what[1:]} have {greatest:.3g} times the rest density at ({place}) m and are compressed "
            f"by {average:.0%} on average, but must have at most {MOST_DENSITY:g} times and be compressed by at most "
            f"{MOST_AVERAGE_COMPRESSION:.0%}: {advice}."
        )
    if average > NOTED_COMPRESSION:
        return f"{what} are compressed by {average:.0%} on average, and will fly apart: {advice}."
    if greatest < NOTED_DENSITY:
        return f"{what} have {greatest:.2g} times the rest density at most, and hardly touch each other: {advice}."
    return None


def check_apart(what: str, positions: Points, spacing: float, period: tuple[Points, Points]) -> None:
    """No two particles (n, d) [m] are at one place; raises `InputError` in a sentence that begins with ``what``."""
    first, second, _ = pairs_within(positions, positions, AT_ONE_PLACE * spacing, *period)
    pairs = np.flatnonzero(first < second)
    if pairs.size:
        one, other = first[pairs[0]], second[pairs[0]]
        place = ", ".join(f"{x:g}" for x in positions[one])
        raise InputError(
            f"{what} has particles {one} and {other} at one place, ({place}) m, but must have them about a spacing, "
            f"{spacing:g} m, apart."
        )


def nearest(positions: Points) -> NDArray:
    """(n,) the distance [m] from each of two or more particles (n, d) [m] to the nearest other one."""
    from scipy.spatial import cKDTree

    return cKDTree(positions).query(positions, k=2)[0][:, 1]
