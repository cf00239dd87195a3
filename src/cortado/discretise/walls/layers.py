"""Where the layers of wall particles lie behind a flat wall, and what their particles count for, in float64."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cortado.discretise.calibration import lattice_offsets
from cortado.discretise.smoothing import SmoothingKernel

SHALLOW = 0.4
"""Depth of the shallow layer, in spacings; there is one where the second lattice layer of the fluid sees the wall.

At half a spacing the deep layer would have to be so steep that it lies where the kernel ends."""


@dataclass(frozen=True)
class WallLayers:
    """The layers of wall particles behind a flat wall, the deepest last."""

    depths: tuple[float, ...]
    """Distances behind the surface of the container [m]."""
    weights: tuple[float, ...]
    """What a particle of each layer counts for in the density, a fluid particle being 1."""


@dataclass(frozen=True)
class Planes:
    """Sums over the points of a lattice plane, beside the sum of W over the whole lattice."""

    kernel: SmoothingKernel
    spacing: float
    """[m]"""
    support: float
    """[m]"""
    dimension: int

    @cached_property
    def flat(self) -> np.ndarray:
        """(m, d - 1) the points of a plane that are less than a support away along it [m]."""
        return np.unique(lattice_offsets(self.spacing, self.support, self.dimension)[:, 1:], axis=0)

    def across(self, distance: float) -> np.ndarray:
        """(m, d) separations [m] from the points of a plane at a distance [m], whose first axis is its normal."""
        return np.hstack([np.full((len(self.flat), 1), distance), self.flat])

    def weight(self, distance: float) -> float:
        """Sum of W over a plane at a distance [m]."""
        distances = np.linalg.norm(self.across(distance), axis=1)
        return float(self.kernel.weight(distances, self.dimension, self.support).sum())

    def slope(self, distance: float) -> float:
        """Its derivative by the distance."""
        return float(self.kernel.gradient(self.across(distance), self.support)[:, 0].sum())


def wall_layers(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> WallLayers:
    """The layers that meet these conditions at a flat wall, with fluid on the lattice from half a spacing on:

    - the fluid has the rest density (Band et al. 2018 scale volumes for that), in its first layer and in its second;
    - a uniform pressure pushes no particle of the first layer: what a wall adds to the density of a particle is steep
      enough to balance the pressure of the particle and that of all its neighbours.

    One layer is enough where the second layer of the fluid does not see the wall, with a support of up to two spacings.
    """
    planes = Planes(kernel, spacing, support, dimension)
    below = spacing * np.arange(1, int(support / spacing) + 2)  # the lattice planes that the first layer misses
    missing = np.array([sum(map(planes.weight, below)), sum(map(planes.weight, below[1:]))])
    pull = 2.0 * sum(map(planes.slope, below))
    heights = spacing * np.array([0.5, 1.5])

    two = missing[1] > 1e-6 * missing[0]

    def depths(deepest: float) -> np.ndarray:
        return np.array([SHALLOW * spacing, deepest] if two else [deepest])

    def weights(deepest: float) -> np.ndarray:
        """Those with which the first layers of the fluid, as many as the wall has, have the rest density."""
        layers = depths(deepest)
        seen = [[planes.weight(height + depth) for depth in layers] for height in heights[: len(layers)]]
        return np.linalg.solve(np.array(seen), missing[: len(layers)])

    def push(deepest: float) -> float:
        slopes = [planes.slope(heights[0] + depth) for depth in depths(deepest)]
        return float(weights(deepest) @ slopes - pull)

    from scipy.optimize import brentq

    deepest = brentq(push, 0.5 * spacing, support - (0.5 + 1e-3) * spacing, xtol=1e-14 * spacing)
    return WallLayers(tuple(depths(deepest).tolist()), tuple(weights(deepest).tolist()))
