"""Pairs of points that are near each other, in float64."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.discretise.shapes import Points

CHUNK = 8192
"""How many points look for their neighbours at a time: bounds the memory."""

Pairs = tuple[NDArray[np.int64], NDArray[np.int64], Points]
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


def pairs_among(
    points: Points, reach: float, lower: ArrayLike, lengths: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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


def _around(some: Points, others: Points, reach: float, lengths: Points) -> NDArray[np.int64]:
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
