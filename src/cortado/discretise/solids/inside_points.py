"""Points of a lattice inside of a solid, in float64."""

import numpy as np

from cortado.discretise.shapes import Block, Points, block_between
from cortado.discretise.solids.solid import Solid


def block_around(solid: Solid, spacing: float) -> Block:
    """The lattice ``lower + (i + 1/2) spacing`` in the box around a solid; its last points may be so near the box's end
    that their cells reach beyond it, by less than half a spacing [m]."""
    lower, upper = solid.extent()
    return block_between(lower, upper + 0.5 * spacing, spacing)


def points_inside(solid: Solid, spacing: float) -> Points:
    """(n, d) [m] the points of the lattice in the box around a solid that are inside of it."""
    points = block_around(solid, spacing).points()
    return np.asarray(points[solid.distance_up_to(points, spacing) < 0.0])
