"""The grid of the coarse correction, without Warp."""

import numpy as np

from cortado.device.grid import Grid
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene

SPACING = 2.0
"""Distance of nodes, in spacings of particles."""


def endless(discrete: DiscreteScene) -> bool:
    """Whether all axes are periodic: such a scene has no coarse correction, as nothing sets its level of pressure."""
    return bool((np.asarray(discrete.periods) > 0.0).all())


def coarse_grid(scene: Scene, discrete: DiscreteScene, particles: int) -> Grid:
    """The nodes of the coarse correction: about everything that can be reached; what goes further wraps around. Along
    each axis there are 4 to 7 times a power of two, so that coarser grids have half as many.

    Nodes lie on the lower walls of a container, and the first row of particles half a spacing above them. If one row
    had the cells beside a wall for itself, some combinations of nodes would push nothing, and solves would take long.
    """
    reach, most = SPACING * scene.discretisation.spacing, max(4 * particles, 512)
    grid = Grid.around(discrete.near.lower, discrete.near.upper, discrete.periods, reach, most)
    cell, shape = grid.cell.copy(), [*grid.shape]
    edge, _ = scene.container.extent() or (discrete.fluid.positions.min(axis=0) - 0.5 * scene.discretisation.spacing, 0)
    for axis, period in enumerate(discrete.periods):
        part = 1 << max((shape[axis] // 4).bit_length() - 1, 0)
        whole = shape[axis] // part if period > 0.0 else -(-shape[axis] // part)
        shape[axis] = whole * part
        if period > 0.0:
            cell[axis] = period / shape[axis]
        else:
            grid.origin[axis] = edge[axis] - cell[axis] * np.ceil((edge[axis] - grid.origin[axis]) / cell[axis])
    return Grid(grid.origin, cell, (shape[0], shape[1], shape[2]))
