"""One layer of wall particles around a box or a cup, in float64."""

from collections.abc import Sequence

import numpy as np

from cortado.discretise.shapes import Points, disc, grid


def nearest_cells(length: float, spacing: float) -> int:
    """How many cells fill a length [m] best, at least 1."""
    return max(int(np.floor(length / spacing + 0.5)), 1)


def box_walls(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, depth: float) -> Points:
    """(n, d) one layer around a box, ``depth`` outside of it: faces, edges and corners, each point once.

    Along a face the points continue the lattice inside; an axis whose length is no multiple of the spacing is stretched
    a little between its walls. A periodic axis has no wall. Axis by axis: outside on this axis, inside on those before
    it, either on those after it.
    """
    inside = [_cells(a, b, nearest_cells(b - a, spacing)) for a, b in zip(lower, upper, strict=True)]
    outside = [
        np.zeros(0) if open_axis else np.array([a - depth, b + depth])
        for a, b, open_axis in zip(lower, upper, periodic, strict=True)
    ]
    both = [np.sort(np.concatenate(pair)) for pair in zip(inside, outside, strict=True)]
    return np.concatenate([grid([*inside[:axis], outside[axis], *both[axis + 1 :]]) for axis in range(len(inside))])


def cup_walls(radius: float, height: float, lid: bool, spacing: float, depth: float) -> Points:
    """(n, 3) the walls of an upright cup whose base is centred on the origin, the third axis along its height.

    The side: rings ``depth`` outside of the radius, about a spacing apart along and across. The base, and the lid if
    there is one: the lattice that fluid in the cup has, ``depth`` outside, and a ring that continues the side.
    """
    side = ring(radius + depth, spacing)
    end = np.concatenate([disc(radius, spacing, 2), side])
    ends = [-depth, height + depth] if lid else [-depth]
    levels = _cells(0.0, height, nearest_cells(height, spacing))
    return np.concatenate([stacked(side, levels), stacked(end, np.array(ends))])


def ring(radius: float, spacing: float) -> Points:
    """(n, 2) points on a circle, about a spacing apart."""
    count = max(nearest_cells(2.0 * np.pi * radius, spacing), 3)
    angles = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _cells(lower: float, upper: float, count: int) -> Points:
    """(count,) the centres of equal cells between two ends."""
    return lower + (upper - lower) * (np.arange(count) + 0.5) / count


def stacked(flat: Points, levels: Points) -> Points:
    """(levels n, 3) a plane set of points (n, 2) repeated at every level."""
    return np.column_stack([np.tile(flat, (len(levels), 1)), np.repeat(levels, len(flat))])
