"""Arrays of points, and shapes as points, in float64: blocks of a lattice, and discs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]
"""(n, d)"""
Which = NDArray[np.bool_]
Numbers = NDArray[np.int64]

ROUND_OFF = 1e-6
"""Share of a spacing by which a length may fall short of a whole number of cells: 0.25 / 0.05 holds 5."""

NEARBY = 4
"""By how many cells along an axis the points of a stretched lattice may differ from what fits."""
EXCESS = 0.003
"""By which part the points of a stretched lattice may differ in number from what its volume holds."""
MOST_STRETCHED = 0.03
"""Logarithm of how much a lattice is stretched along an axis: up to there the density is that of the rest lattice
within 1 %, beside walls too."""


class Rows:
    """Base of dataclasses whose fields are arrays with one first axis."""

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of several, one behind the other."""
        names = [field.name for field in fields(cls)]  # type: ignore[arg-type]
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in names))

    def some(self, which: Any) -> Self:
        """The rows that an index of arrays takes: a slice, numbers or a mask (n,)."""
        return type(self)(*(getattr(self, field.name)[which] for field in fields(self)))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]


def bisected(holds: Callable[[Points], Which], low: Points, high: Points, halvings: int) -> tuple[Points, Points]:
    """Bounds (n,) of where a condition on numbers (n,) ceases to hold, that holds at ``low`` (n,) and not at ``high``
    (n,): nearer ones, halved so many times."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        good = holds(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low, high


@dataclass(frozen=True)
class Block:
    """A lattice of points that fills a box: ``first + i spacings``, 0 <= i < counts."""

    first: Points
    """(d,) [m]"""
    counts: Points
    """(d,) whole numbers, as floats: they may be larger than any array."""
    spacings: Points
    """(d,) between points along each axis [m]"""

    @cached_property
    def size(self) -> float:
        """The number of points."""
        return float(np.prod(self.counts))

    @cached_property
    def extent(self) -> tuple[Points, Points]:
        """The first and the last point, each (d,) [m]."""
        return self.first, self.first + (self.counts - 1.0) * self.spacings

    def grown(self, cells: int) -> "Block":
        """The same lattice with so many cells more on every side."""
        return Block(self.first - cells * self.spacings, self.counts + 2 * cells, self.spacings)

    def points(self) -> Points:
        """(n, d) [m], the last axis fastest."""
        axes = zip(self.first, self.spacings, self.counts, strict=True)
        return grid([x + spacing * np.arange(int(n)) for x, spacing, n in axes])


def block_between(lower: ArrayLike, upper: ArrayLike, spacing: float) -> Block:
    """The points ``lower + (i + 1/2) spacing`` whose cells lie within the box; lower and upper (d,) [m]."""
    first = np.asarray(lower, dtype=np.float64)
    counts = whole_cells(np.asarray(upper, dtype=np.float64) - first, spacing)
    return Block(first + 0.5 * spacing, counts, np.full(len(first), spacing))


def block_filling(lower: ArrayLike, upper: ArrayLike, spacing: float) -> Block:
    """The points ``lower + (i + 1/2) spacing`` of a box whose sides are whole numbers of cells; lower and upper (d,)
    [m]. In another box they are stretched along some axes and narrowed along others, by `MOST_STRETCHED` at most, to be
    as many as its volume holds, within `EXCESS`; where no lattice has both, they are those whose cells lie within."""
    first, last = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    cells, plain = (last - first) / spacing, block_between(lower, upper, spacing)
    if (np.abs(cells - np.rint(cells)) <= ROUND_OFF).all() or not plain.counts.all():
        return plain
    counts = grid([np.maximum(n + np.arange(-NEARBY, NEARBY + 1.0), 1.0) for n in plain.counts])
    errors = np.abs(np.prod(counts / cells, axis=1) - 1.0)
    stretched = np.abs(np.log(cells / counts)).max(axis=1)
    fit = np.flatnonzero((errors <= EXCESS) & (stretched <= MOST_STRETCHED))
    if not len(fit):
        return plain
    best = counts[fit[np.argmin(stretched[fit])]]
    spacings = (last - first) / best
    return Block(first + 0.5 * spacings, best, spacings)


def block_about(centre: ArrayLike, half: ArrayLike, spacing: float) -> Block:
    """A lattice that is symmetric about a centre (d,) [m] and reaches as far as half lengths (d,) [m] allow."""
    counts = whole_cells(2.0 * np.asarray(half, dtype=np.float64), spacing)
    first = np.asarray(centre, dtype=np.float64) - 0.5 * (counts - 1.0) * spacing
    return Block(first, counts, np.full(len(first), spacing))


def disc_cells(radius: float, spacing: float, dimension: int) -> Points:
    """(dimension,) the cells of the lattice around a disc about the origin, at least one along each axis, as floats."""
    return np.full(dimension, np.maximum(whole_cells(np.array(2.0 * radius), spacing), 1.0))


def disc(radius: float, spacing: float, dimension: int) -> Points:
    """(n, dimension) [m] a symmetric lattice in a disc about the origin, or on a line in one dimension: at least 1."""
    counts = disc_cells(radius, spacing, dimension)
    points = Block(-0.5 * (counts - 1.0) * spacing, counts, np.full(dimension, spacing)).points()
    return points[np.linalg.norm(points, axis=1) <= radius]


def across(direction: ArrayLike) -> Points:
    """(d - 1, d) unit vectors, perpendicular to a unit vector (d,) and to one another.

    They begin as the axes of space that the direction is least along, so that one along an axis gives the others.
    """
    frame = [np.asarray(direction, dtype=np.float64)]
    for axis in np.argsort(np.abs(frame[0]), kind="stable")[:-1]:
        vector = np.eye(len(frame[0]))[axis]
        vector = vector - sum((vector @ other) * other for other in frame)
        frame.append(vector / np.linalg.norm(vector))
    return np.array(frame[1:])


def whole_origin(points: Points) -> Points:
    """(d,) [m] near the middle of points (n, d) [m] that are far from the origin beside how far they spread, and 0 of
    all others: whole multiples of a power of two, so that taking it off rounds nothing."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    step = 2.0 ** np.ceil(np.log2(max((upper - lower).max(), np.finfo(np.float64).tiny)))
    return np.asarray(step * np.round((0.5 * lower + 0.5 * upper) / step))


def whole_cells(lengths: Points, spacing: float) -> Points:
    """How many cells fit into lengths [m], any shape."""
    return np.maximum(np.floor(lengths / spacing + ROUND_OFF), 0.0)


def grid(axes: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """(n, d): every combination of the values of the axes, the last axis fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def corners(lower: Points, upper: Points) -> Points:
    """(2^d, d) the corners of a box."""
    return np.array(list(product(*zip(lower, upper, strict=True))), dtype=np.float64)
