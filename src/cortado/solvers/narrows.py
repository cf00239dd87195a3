"""Where walls face one another nearer than a spacing, so that they leave particles no room."""

from itertools import combinations

import numpy as np

from cortado.discretise.shapes import Points
from cortado.solvers.containment import Containment, Distance

NARROW = 0.95
"""In spacings: walls that are nearer to one another press on what is between them."""
FACING = -0.5
"""The product of the normals of two walls, below which they face one another: corners of 90 degrees have 0."""
STEP = 1e-3
"""In spacings: half of the difference of places that normals are computed with."""


def shut_in(containment: Containment, member: int, points: Points) -> str | None:
    """Name in words the walls of a scene between which some of the points (n, d) [m] are shut in; None with room around
    all. Moving solids are where they are after the last step."""
    spacing = containment.walled.spacing
    best, found = NARROW * spacing, None
    near = [
        (name, distance, distances)
        for name, distance in containment.walls(member)
        if ((distances := distance(points)) < NARROW * spacing).any()
    ]
    for (name, one, d), (other, two, e) in combinations(near, 2):
        narrow = np.flatnonzero(d + e < best)
        x = points[narrow]
        facing = (_normals(one, x, STEP * spacing) * _normals(two, x, STEP * spacing)).sum(axis=1) < FACING
        if facing.any():
            best = float((d + e)[narrow][facing].min())
            found = f"{name} and {other}" if name != other else name
    if found is None:
        return None
    gap = f"{max(best, 0.0):.2g} m apart" if best > STEP * spacing else "with no room between them"
    return f"fluid is shut in by {found}, {gap}, nearer than a spacing: leave one, or make the spacing smaller"


def _normals(distance: Distance, points: Points, step: float) -> Points:
    """Return normals (n, d) out of a wall at points (n, d) [m], by central differences of distances over a step [m]."""
    moves = step * np.eye(points.shape[1])
    return np.stack([(distance(points + move) - distance(points - move)) / (2.0 * step) for move in moves], axis=1)
