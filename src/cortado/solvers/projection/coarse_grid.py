"""The grid of the coarse correction, without Warp."""

from cortado.device.grid import Grid
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene

SPACING = 2.0
"""Distance of nodes, in spacings of particles."""


def coarse_grid(scene: Scene, discrete: DiscreteScene, particles: int) -> Grid:
    """The nodes of the coarse correction: about everything that can be reached; what goes further wraps around. Along
    each axis there are 4 to 7 times a power of two, so that coarser grids have half as many."""
    reach, most = SPACING * scene.discretisation.spacing, max(4 * particles, 512)
    grid = Grid.around(discrete.near.lower, discrete.near.upper, discrete.periods, reach, most)
    cell, shape = grid.cell.copy(), [*grid.shape]
    for axis, period in enumerate(discrete.periods):
        part = 1 << max((shape[axis] // 4).bit_length() - 1, 0)
        whole = shape[axis] // part if period > 0.0 else -(-shape[axis] // part)
        shape[axis] = whole * part
        if period > 0.0:
            cell[axis] = period / shape[axis]
    return Grid(grid.origin, cell, (shape[0], shape[1], shape[2]))
