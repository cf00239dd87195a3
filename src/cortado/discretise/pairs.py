"""Pairs of points that are near each other, across the ends of periods too, and how densely points lie, in float64."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.discretise.shapes import Numbers, Points
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError

CHUNK = 8192
"""How many points look for their neighbours at a time: bounds the memory."""

Period = tuple[Points, Points]
Pairs = tuple[Numbers, Numbers, Points]
"""The first and the second point of each pair, and how far apart they are [m]; each (m,)."""


def pairs_within(some: Points, others: Points, reach: float, lower: ArrayLike = 0.0, lengths: ArrayLike = 0.0) -> Pairs:
    """All pairs of one of ``some`` and one of the ``others`` that are at most ``reach`` [m] apart.

    Args:
        some: (n, d) [m].
        others: (m, d) [m].
        reach: [m].
        lower: (d,) where the period begins [m].
        lengths: (d,) the lengths of the period [m], 0 for axes without one; the nearest image counts.
    """
    from scipy.spatial import cKDTree

    lengths = np.broadcast_to(np.asarray(lengths, dtype=np.float64), some.shape[1:])
    some, others = (wrapped(x - np.asarray(lower, dtype=np.float64), lengths) for x in (some, others))
    numbers = _around(some, others, reach, lengths)
    tree = cKDTree(others[numbers], boxsize=lengths)
    first, second, distances = [], [], []
    for start in range(0, len(some), CHUNK):
        chunk = cKDTree(some[start : start + CHUNK], boxsize=lengths)
        found = chunk.sparse_distance_matrix(tree, reach, output_type="ndarray")
        first.append(found["i"] + start)
        second.append(numbers[found["j"]])
        distances.append(found["v"])
    none = np.zeros(0, dtype=np.int64)
    return np.concatenate([none, *first]), np.concatenate([none, *second]), np.concatenate([np.zeros(0), *distances])


def pairs_among(points: Points, reach: float, lower: ArrayLike, lengths: ArrayLike) -> tuple[Numbers, Numbers]:
    """The first and the second point (m,), i < j, of all pairs among points (n, d) [m]; the arguments are those of
    `pairs_within`, which finds both orders and each point with itself."""
    from scipy.spatial import cKDTree

    lengths = np.broadcast_to(np.asarray(lengths, dtype=np.float64), points.shape[1:])
    tree = cKDTree(wrapped(points - np.asarray(lower, dtype=np.float64), lengths), boxsize=lengths)
    first, second = tree.query_pairs(reach, output_type="ndarray").T
    return first, second


def apart(separations: Points, lengths: ArrayLike) -> Points:
    """Separations (m, d) [m] of pairs with the nearest image, where ``lengths`` (d,) [m] are those of the period."""
    lengths = np.asarray(lengths, dtype=np.float64)
    if not lengths.any():
        return separations
    return np.asarray(separations - lengths * np.rint(separations / np.where(lengths > 0.0, lengths, np.inf)))


def _around(some: Points, others: Points, reach: float, lengths: Points) -> Numbers:
    """Numbers of the ``others`` (m, d) [m] that are in the box around ``some`` (n, d) [m] and ``reach`` [m] further; of
    all of them where there is a period, or nothing to be near to."""
    if lengths.any() or not len(some):
        return np.arange(len(others))
    beyond = reach * (1.0 + 1e-9)
    lower, upper = some.min(axis=0) - beyond, some.max(axis=0) + beyond
    return np.flatnonzero(((others >= lower) & (others <= upper)).all(axis=1))


def wrapped(positions: Points, lengths: Points) -> Points:
    """(..., d) positions within [0, length) on periodic axes; round-off may put a remainder on the length itself."""
    if not lengths.any():
        return positions
    safe = np.where(lengths > 0.0, lengths, 1.0)
    remainder = np.mod(positions, safe)
    return np.where(lengths > 0.0, np.where(remainder >= safe, 0.0, remainder), positions)


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


def check_crowding(
    what: str,
    positions: Points,
    kernel: SmoothingKernel,
    support: float,
    volume: float,
    spacing: float,
    period: Period,
) -> str | None:
    """A warning of particles that are crowded or hardly touch each other, where they may be meant to; None of others.
    Raises `InputError` where they would burst.

    Args:
        what: they in words, in the plural.
        positions: (n, d) [m].
        kernel: W.
        support: radius [m].
        volume: of a particle at rest [m^d].
        spacing: [m].
        period: as of `check_apart`.
    """
    point, _, distances = pairs_within(positions, positions, support, *period)
    seen = kernel.weight(distances, positions.shape[1], support)
    densities = volume * np.bincount(point, seen, minlength=len(positions))  # over that of the lattice
    average = float(np.maximum(densities - 1.0, 0.0).mean())
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


def check_apart(what: str, positions: Points, spacing: float, period: Period) -> None:
    """Raises `InputError`, a sentence that begins with ``what``, where two particles (n, d) [m] are at one place, in a
    period that begins at a corner (d,) and has lengths (d,) [m], 0 along axes without one."""
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
