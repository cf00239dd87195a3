"""Constants of the projection on the rest lattice, and the grid of its coarse correction, in float64."""

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from cortado.device.grid import Grid
from cortado.discretise.smoothing import SmoothingKernel, lattice_offsets, rest_volume
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.scene import Scene

MARGIN = 1.05
SMOOTHED = 1.0 / 3.0
"""Relative stiffness from which repairs remove density waves evenly."""
DEPARTURE = 0.05
"""Regularisation of the diagonal of the pressure iteration, relative to its value on the lattice."""


@dataclass(frozen=True)
class ProjectionConstants:
    spacing: float
    relaxation: float
    least_diagonal: float
    """Regularisation of the diagonal of the pressure iteration [1 / m2]."""
    nearest_weight: float
    """Smoothing kernel at a distance of one spacing, times the volume of a particle [-]."""

    def repair_relaxations(self, repairs: int) -> list[float]:
        """Return the relaxation factors of repairs, from roots of a Chebyshev polynomial (Golub and Varga 1961)."""
        middle, half = 0.5 * (1.0 + SMOOTHED), 0.5 * (1.0 - SMOOTHED)
        roots = np.cos(np.pi * (np.arange(repairs) + 0.5) / repairs)
        return [self.relaxation / float(middle - half * root) for root in roots]


@cache
def lattice_constants(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> ProjectionConstants:
    """The relaxation factor makes the Jacobi iteration stable for the stiffest pressure wave on the rest lattice."""
    offsets = lattice_offsets(spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension)
    gradients = volume * kernel.gradient(offsets, support)
    square = float((gradients**2).sum())
    waves = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 25), repeat=dimension)))
    stiffest = float(((np.sin(waves @ offsets.T) @ gradients) ** 2).sum(axis=1).max()) / square
    nearest = volume * float(kernel.weight(np.array([spacing]), dimension, support)[0])
    return ProjectionConstants(spacing, 1.0 / (MARGIN * stiffest), DEPARTURE * square, nearest)


SPACING = 2.0
"""Distance between nodes of the coarse grid [particle spacings]."""


def endless(discrete: DiscreteScene) -> bool:
    return bool((np.asarray(discrete.periods) > 0.0).all())


def coarse_grid(scene: Scene, discrete: DiscreteScene, particles: int) -> Grid:
    """The number of nodes along each axis is 4 to 7 times a power of two, so that coarser levels can halve the number.
    In a container, nodes lie on the lower walls."""
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
