"""A shorter box whose walls have the weights of those of a long one: far from edges and corners they repeat."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.walls.points import nearest_cells

ENDS = 6.0
"""In supports: what is this far from an edge has the same weight as what is further, to 1e-6 of it and better."""
WHOLE = 1e-9
"""In cells: by how much a side may be off a whole number of them."""


@dataclass(frozen=True)
class ShortBox:
    """A box of which cells are left out in the middle of its long sides, of those that have a whole number of cells."""

    lower: Points
    """(d,) of both boxes [m]"""
    upper: Points
    """(d,) of the shorter one [m]"""
    spacing: float
    """Of cells [m]."""
    left_out: Points
    """(d,) cells along each axis"""
    ends: int
    """Cells that stay at each end, besides the one between them."""

    @classmethod
    def of(cls, lower: Points, upper: Points, spacing: float, support: float) -> "ShortBox":
        """Of the box between two corners (d,) [m], beside fluid with a spacing and a support [m]."""
        ends, lengths = int(np.ceil(ENDS * support / spacing)), upper - lower
        cells = np.array([nearest_cells(length, spacing) for length in lengths])
        whole = np.abs(lengths / spacing - cells) < WHOLE * cells
        left_out = np.where(whole, np.maximum(cells - 2 * ends - 1, 0), 0)
        return cls(lower, np.where(left_out > 0, upper - left_out * spacing, upper), spacing, left_out, ends)

    def folded(self, points: Points) -> Points:
        """(n, d) [m] where points (n, d) [m] of the walls of the long box are in the shorter one."""
        cells = np.floor((points - self.lower) / self.spacing)
        middle = self.lower + (self.ends + 0.5) * self.spacing
        behind = cells >= self.ends + self.left_out + 1
        found = np.where(behind, points - self.left_out * self.spacing, np.where(cells < self.ends, points, middle))
        return np.where(self.left_out > 0, found, points)
