"""What particles see: others, walls and air, found by cells, in float64."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.calibration import lattice_offsets, rest_volume
from cortado.discretise.cpu_launches import launched_in_bands, shared, started
from cortado.discretise.shapes import Points
from cortado.discretise.walls.weights import RestLattice

Which = NDArray[np.bool_]
Numbers = NDArray[np.int32]
MOST_CELLS = 2_000_000
"""Of a grid: what is further apart shares them."""
NO_LIMIT = 2**31 - 1


@dataclass(frozen=True, eq=False)
class PointsAround:
    """Points that particles see: first particles, if any, then what is fixed."""

    lattice: RestLattice
    """The lattice of the fluid at rest."""
    points: Points
    """(m, d) [m]"""
    weights: Points
    """(m,) what each counts for in the density, a particle being 1 [-]"""
    air: tuple[int, int]
    """The first of them that is air, which blind particles do not see, and the first behind it."""
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""
    reach: float
    """How far particles look [m]."""

    def near(self, particles: Points) -> Which:
        """(n,) whether there is a point within the reach of particles (n, d) [m]."""
        return self._looked(particles, np.zeros(len(particles), dtype=bool), most=1)["counts"] > 0

    def sums(self, particles: Points, blind: Which) -> Points:
        """(n,) the sum of the kernels [1 / m^d] of the points at particles (n, d) [m], which look as far as the
        support."""
        return np.asarray(self._looked(particles, blind)["sums"])

    def lists(self, particles: Points, blind: Which) -> tuple[Numbers, Numbers, Numbers]:
        """Which points are within the reach of particles (n, d) [m], the first of the points, and come after them:
        where the list of each begins (n,) and ends (n,), and numbers of points, with gaps between the lists."""
        room = len(lattice_offsets(self.lattice.spacing, self.reach, self.points.shape[1]))
        while True:
            starts = (room * np.arange(len(particles) + 1)).astype(np.int32)
            others = np.empty(max(starts[-1], 1), dtype=np.int32)
            counts = self._looked(particles, blind, are_own=True, starts=starts, others=others)["counts"]
            if counts.max(initial=0) <= room:
                return starts[:-1], starts[:-1] + counts, others
            room = int(counts.max())

    def _looked(self, particles: Points, blind: Which, **given: Any) -> dict[str, Any]:
        """What the kernel ``look_around`` finds."""
        count = len(particles)
        given = {"are_own": False, "most": NO_LIMIT, "starts": np.zeros(count + 1, dtype=np.int32), **given}
        found = {"others": np.zeros(1, dtype=np.int32), "counts": np.zeros(count, dtype=np.int32), **given}
        found = {"sums": np.zeros(count), **found}
        if len(self.points):
            placed, grid = self._by_cell
            where = {"around": self.on_cpu, "placed": placed, "grid": grid, "reach": self.reach}
            launched_in_bands(self.kernels.look_around, count, x=in_space(particles), blind=blind, **where, **found)
        return found

    @property
    def volume(self) -> float:
        """Of a particle [m^d], with which the sum of kernels on the lattice gives its density."""
        return rest_volume(self.lattice.kernel, self.lattice.spacing, self.lattice.support, self.points.shape[1])

    @property
    def own_weight(self) -> float:
        """The kernel of a particle at its own place [1 / m^d]."""
        return float(self.lattice.kernel.weight(np.zeros(1), self.points.shape[1], self.lattice.support)[0])

    @cached_property
    def kernels(self) -> Any:
        """Those of the lattice's smoothing kernel."""
        started()
        from cortado.discretise.packing.kernels import packing_kernels

        return packing_kernels(self.lattice.kernel)

    @cached_property
    def in_space(self) -> Points:
        """(m, 3) the points as kernels see them [m]."""
        return in_space(self.points)

    @cached_property
    def on_cpu(self) -> Any:
        """What kernels see."""
        around, dimension = self.kernels.around(), self.points.shape[1]
        around.x, around.weights = shared(self.in_space), shared(self.weights)
        around.air, around.behind_air = self.air
        around.is_periodic, around.period = bool(self.lengths.any()), in_space(self.lengths)
        around.frequency = np.divide(1.0, around.period, where=np.array(around.period) > 0.0, out=np.zeros(3))
        around.per_support = 1.0 / self.lattice.support
        around.normalisation = self.lattice.kernel.normalisation(dimension, self.lattice.support)
        return around

    @cached_property
    def _by_cell(self) -> tuple[Any, Any]:
        """The points in the order of cells as wide as the reach, and the grid of these."""
        from cortado.device.grid import Grid

        ends = self.points.min(axis=0), self.points.max(axis=0)
        cells = Grid.around(*ends, self.lengths, self.reach, MOST_CELLS)
        along = np.floor((self.in_space - cells.origin) / cells.cell).astype(np.int64) % np.array(cells.shape)
        own = (along[:, 2] * cells.shape[1] + along[:, 1]) * cells.shape[0] + along[:, 0]
        order = np.argsort(own, kind="stable").astype(np.int32)
        placed, grid = self.kernels.placed(), self.kernels.grid()
        placed.x, placed.numbers = shared(self.in_space[order]), shared(order)
        grid.origin, grid.frequency, grid.shape = cells.origin, 1.0 / cells.cell, cells.shape
        grid.starts = shared(starts_of(np.bincount(own, minlength=cells.cells)))
        return placed, grid


def in_space(points: Points) -> Points:
    """(..., 3) points (..., d), with 0 along an axis that there is not."""
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, 3 - points.shape[-1])])


def starts_of(counts: NDArray[np.int64] | Numbers) -> Numbers:
    """(n + 1,) where each of lists of these lengths (n,) begins, one behind the other, and the end."""
    return np.append(0, np.cumsum(counts)).astype(np.int32)
