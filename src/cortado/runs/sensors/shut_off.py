"""Places that solids at rest keep all fluid of a scene away from, such as the inside of a shell."""

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.scene.scene import Scene

MOST = 200_000
"""Cells of half a spacing that are looked at; a larger container is not judged."""


def is_shut_off(scene: Scene, fluid: Points, points: Points) -> NDArray[np.bool_]:
    """(n,) which points (n, d) [m] no way leads to from particles (m, d) [m] through cells half a spacing wide, in a
    container without periods and emitters: solids at rest are in the way, those that move are not."""
    from scipy.ndimage import label

    nowhere, ends = np.zeros(len(points), dtype=bool), scene.container.extent()
    solids = [table.solid() for table in scene.solid if not table.moves]
    if ends is None or not solids or scene.emitter is not None or any(scene.container.periods(scene.dimension)[1]):
        return nowhere
    lower, upper = np.array(ends, dtype=np.float64)
    counts = np.maximum(np.ceil((upper - lower) / (0.5 * scene.discretisation.spacing)), 1.0)
    if np.prod(counts) > MOST:
        return nowhere
    shape, cells = tuple(counts.astype(int)), (upper - lower) / counts
    middles = lower + (np.indices(shape).reshape(len(shape), -1).T + 0.5) * cells
    taken = np.any([one.distance_up_to(middles, float(cells.max())) <= 0.0 for one in solids], axis=0)
    names, _ = label(~taken.reshape(shape), np.ones((3,) * len(shape)))

    def named(places: Points) -> NDArray[np.int_]:
        return np.asarray(names[tuple(np.clip((places - lower) // cells, 0, counts - 1).astype(int).T)])

    found = named(points)
    return (found > 0) & ~np.isin(found, named(fluid))
