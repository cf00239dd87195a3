"""Places beside the walls of a box or a cup where fluid may rest on the lattice, in float64."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points, disc, grid
from cortado.discretise.walls.points import nearest_cells, ring, stacked

OVERLAP = 0.8
"""How far from the side of a cup, over the reach, fluid on the base may rest upright."""


@dataclass(frozen=True)
class Places:
    """Points, and how the lattice around each of them lies."""

    points: Points
    """(n, d) [m]"""
    axes: NDArray[np.float64]
    """(n, d, d) the axes of each lattice, a unit vector a row"""

    @classmethod
    def upright(cls, points: Points) -> "Places":
        """On lattices along the axes of space."""
        dimension = points.shape[1]
        return cls(points, np.broadcast_to(np.eye(dimension), (len(points), dimension, dimension)))

    @classmethod
    def joined(cls, parts: Sequence["Places"]) -> "Places":
        """One behind the other."""
        return cls(np.concatenate([one.points for one in parts]), np.concatenate([one.axes for one in parts]))

    def some(self, which: slice | NDArray[np.bool_]) -> "Places":
        """Some of them."""
        return Places(self.points[which], self.axes[which])


def box_places(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, reach: float) -> Places:
    """Those less than ``reach`` [m] from a wall of a box, with the first of them half a spacing from it.

    Axis by axis: near a wall on this axis, far from all on those before it, anywhere on those after it.
    """
    every = [_between(a, b, open_axis, spacing) for a, b, open_axis in zip(lower, upper, periodic, strict=True)]
    beside = [
        np.zeros(len(x), dtype=bool) if open_axis else np.minimum(x - a, b - x) < reach
        for x, a, b, open_axis in zip(every, lower, upper, periodic, strict=True)
    ]
    near, far = [x[c] for x, c in zip(every, beside, strict=True)], [x[~c] for x, c in zip(every, beside, strict=True)]
    blocks = [grid([*far[:axis], near[axis], *every[axis + 1 :]]) for axis in range(len(every))]
    return Places.upright(np.concatenate(blocks))


def cup_places(radius: float, height: float, lid: bool, spacing: float, reach: float) -> Places:
    """Those less than ``reach`` [m] from a wall of an upright cup whose base is centred on the origin, the third axis
    along its height.

    Along the side the lattices are turned as the side is; on the base, up to where the side is hardly seen, they are
    those of fluid in the cup. The uppermost part of an open cup, which may overflow, has none.
    """
    levels = _between(0.0, height, False, spacing)
    closed = levels if lid else levels[levels < height - reach]
    ends = closed[np.minimum(closed, height - closed) < reach] if lid else closed[closed < reach]
    radii = radius - spacing * (np.arange(max(int(np.ceil(reach / spacing)), 1)) + 0.5)
    rings = [ring(value, spacing) for value in radii[radii > 0.0]]
    flat = np.concatenate([np.zeros((0, 2)), *rings])
    side = stacked(flat, closed)
    outward = np.pad(side[:, :2] / np.linalg.norm(side[:, :2], axis=1, keepdims=True), ((0, 0), (0, 1)))
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), side.shape)
    middle = disc(radius, spacing, 2)
    inner = Places.upright(stacked(middle[np.linalg.norm(middle, axis=1) <= radius - OVERLAP * reach], ends))
    return Places(
        np.concatenate([side, inner.points]),
        np.concatenate([np.stack([outward, np.cross(up, outward), up], axis=1), inner.axes]),
    )


def _between(lower: float, upper: float, periodic: bool, spacing: float) -> Points:
    """Places along an axis: from each wall on, a spacing apart, or evenly along a period."""
    count = nearest_cells(upper - lower, spacing)
    cells = np.arange(count, dtype=np.float64) + 0.5
    if periodic:
        return np.asarray(lower + (upper - lower) / count * cells)
    return np.asarray(np.where(cells < 0.5 * count, lower + spacing * cells, upper - spacing * cells[::-1]))
