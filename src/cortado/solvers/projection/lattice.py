"""Constants of the projection on the rest lattice, and the grid of its coarse correction, in float64 without Warp."""

import itertools
from dataclasses import dataclass

import numpy as np

from cortado.device.grid import Grid
from cortado.discretise.smoothing import SmoothingKernel, lattice_offsets, rest_volume
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene

MARGIN = 1.05
SMOOTHED = 1.0 / 3.0
"""Part of the greatest stiffness above which density waves are repaired about equally fast."""
DEPARTURE = 0.05
"""Part of a_0 that is added to the diagonal, which is small for particles with few neighbours."""


@dataclass(frozen=True)
class ProjectionConstants:
    spacing: float
    """[m]"""
    relaxation: float
    """omega = 1 / (1.05 lambda) of the Jacobi iteration [-]."""
    least_diagonal: float
    """[1 / m2], `DEPARTURE` times a_0 = sum_j |g_ij|^2."""
    nearest_weight: float
    """V W of two particles one spacing apart [-]."""

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> "ProjectionConstants":
        """Compute the constants on a lattice with a spacing [m], for a support radius [m].

        lambda = max_q |sum_j g_j sin(q . x_j)|^2 / a_0 is the factor by which an undamped Jacobi iteration overshoots
        for the stiffest pressure wave exp(i q . x) of the lattice.
        """
        offsets = lattice_offsets(spacing, support, dimension)
        volume = rest_volume(kernel, spacing, support, dimension)
        gradients = volume * kernel.gradient(offsets, support)
        square = float((gradients**2).sum())
        waves = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 25), repeat=dimension)))
        stiffest = float(((np.sin(waves @ offsets.T) @ gradients) ** 2).sum(axis=1).max()) / square
        nearest = volume * float(kernel.weight(np.array([spacing]), dimension, support)[0])
        return cls(spacing, 1.0 / (MARGIN * stiffest), DEPARTURE * square, nearest)

    def repair_relaxations(self, repairs: int) -> list[float]:
        """Return omega of each repair by Chebyshev's roots (Golub and Varga 1961), for waves from `SMOOTHED` to 1 times
        the greatest stiffness. The greatest omega comes first, because later repairs smooth the waves that it
        excites."""
        middle, half = 0.5 * (1.0 + SMOOTHED), 0.5 * (1.0 - SMOOTHED)
        roots = np.cos(np.pi * (np.arange(repairs) + 0.5) / repairs)
        return [self.relaxation / float(middle - half * root) for root in roots]


def lattice_constants(scene: Scene, discrete: DiscreteScene) -> ProjectionConstants:
    lattice = discrete.kernel, scene.discretisation.spacing, discrete.lattice.support, scene.dimension
    return ProjectionConstants.of(*lattice)


SPACING = 2.0
"""Distance between nodes of the coarse grid, in spacings of particles."""


def endless(discrete: DiscreteScene) -> bool:
    """Return True if all axes are periodic, so that a coarse correction leaves the level of pressure undetermined."""
    return bool((np.asarray(discrete.periods) > 0.0).all())


def coarse_grid(scene: Scene, discrete: DiscreteScene, particles: int) -> Grid:
    """Make the periodic grid of the coarse correction around the region that particles can reach. The number of nodes
    along each axis is 4 to 7 times a power of two, so that each coarser grid has half as many.

    Nodes lie on a container's lower walls, half a spacing below the first row of particles: cells with a single row of
    particles would make solves slow.
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
