"""The wall particles of solids that move: where they are at the end of a step, sorted by cell, and how fast they get
there."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bundles import bundle
from cortado.device.launching import launch
from cortado.device.precision import Precision
from cortado.particles.cells import CellSort, Grid, cell_grid_type
from cortado.particles.state import Layout
from cortado.particles.wall_arrays import WallArrays


@dataclass(frozen=True)
class Poses:
    """Where solids are, for each scene of a batch."""

    positions: wp.array
    """(members, solids) vectors, of the middles [m]"""
    turns: wp.array
    """(members, solids) matrices, from the frame of a solid to space"""

    @classmethod
    def still(cls, members: int, middles: np.ndarray, turns: np.ndarray, precision: Precision, device: Any) -> "Poses":
        """Where solids begin, (solids, 3) [m] and (solids, 3, 3), in every scene."""
        several = (members, len(middles))
        return cls(
            wp.array(np.broadcast_to(middles, (*several, 3)).copy(), dtype=precision.vector, device=device),
            wp.array(np.broadcast_to(turns, (*several, 3, 3)).copy(), dtype=matrix_of(precision), device=device),
        )

    def like(self) -> "Poses":
        """Others of the same sizes."""
        return Poses(wp.clone(self.positions), wp.clone(self.turns))


@cache
def matrix_of(precision: Precision) -> Any:
    """3 x 3 in a precision."""
    return wp.types.matrix(shape=(3, 3), dtype=precision.real)


@cache
def _kernels(precision: Precision) -> tuple[Any, Any, Any]:
    """Those that place wall particles, that write them in the order of their cells, and that say where cells begin."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    module = wp.get_module(f"cortado_moving_walls_{precision.name}")
    module.options["enable_backward"] = False
    vectors = {f"wall_{name}": vector for name in ("positions", "feet", "velocities")}
    own_of: Any = bundle(own=vector, own_feet=vector, own_slides=vector, own_weights=real, own_grips=real)
    walls_of: Any = bundle(**vectors, wall_weights=real, wall_grips=real)

    @wp.kernel(module=module, enable_backward=False)
    def place(
        count: int,
        own: wp.array(dtype=vector),
        solid: wp.array(dtype=wp.int32),
        positions: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        # out
        x: wp.array(dtype=vector),
    ):
        j = wp.tid()
        member = j // count
        b = j - member * count
        k = solid[b]
        x[j] = positions[member, k] + turns[member, k] * own[b]

    @wp.kernel(module=module, enable_backward=False)
    def write(
        count: int,
        first: int,
        order: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        of: own_of,
        solid: wp.array(dtype=wp.int32),
        before: wp.array2d(dtype=vector),
        turns_before: wp.array2d(dtype=matrix),
        turns: wp.array2d(dtype=matrix),
        x: wp.array(dtype=vector),
        # out
        walls: walls_of,
    ):
        p = wp.tid()
        j = order[p]
        member = j // count
        b = j - member * count
        k = solid[b]
        moved = x[j] - before[member, k] - turns_before[member, k] * of.own[b]
        walls.wall_positions[first + p] = x[j]
        walls.wall_feet[first + p] = turns[member, k] * of.own_feet[b]
        walls.wall_velocities[first + p] = moved / time_step[member] + turns[member, k] * of.own_slides[b]
        walls.wall_weights[first + p] = of.own_weights[b]
        walls.wall_grips[first + p] = of.own_grips[b]

    @wp.kernel(module=module, enable_backward=False)
    def shift(
        first: int,
        starts: wp.array(dtype=wp.int32),
        # out
        shifted: wp.array(dtype=wp.int32),
    ):
        c = wp.tid()
        shifted[c] = starts[c] + first

    return place, write, shift


class MovingWalls:
    """Those of one search for neighbours, behind the wall particles that are at rest in its arrays."""

    def __init__(self, walls: WallArrays, first: int, begun: Poses, grid: Grid, layout: Layout):
        """``walls`` of solids that move, which begin with poses ``begun``; the first of them has the number ``first``
        in the arrays of the search."""
        self.begun, self.before, self.after = begun, begun.like(), begun.like()
        """Poses at the start, and before and after a step; somebody else writes these."""
        precision, device, count = layout.precision, layout.device, len(walls)
        self._device, self._first, self._all = device, first, layout.members * count
        self._kernels = _kernels(precision)
        vectors = {"own": walls.positions, "own_feet": walls.feet, "own_slides": walls.slides}
        numbers = {"own_weights": walls.weights, "own_grips": walls.grips}
        self._own: dict[str, Any] = {
            "count": count,
            "solid": wp.array(walls.solid, dtype=wp.int32, device=device),
            "x": wp.zeros(self._all, dtype=precision.vector, device=device),
            **{name: wp.array(values, dtype=precision.vector, device=device) for name, values in vectors.items()},
            **{name: wp.array(values, dtype=precision.real, device=device) for name, values in numbers.items()},
        }
        self._sort = CellSort(grid, count, precision, device, layout.members)
        self.grid = cell_grid_type(precision)()
        """As kernels that look for neighbours see it: cells begin with numbers in the arrays of the search."""
        for name in ("origin", "frequency", "shape"):
            setattr(self.grid, name, getattr(self._sort.grid, name))
        self.grid.starts = wp.zeros_like(self._sort.grid.starts)

    def write(self, time_step: wp.array, walls: Mapping[str, wp.array]) -> None:
        """Write them to the arrays of a search, given the length (members,) of the step [s]."""
        (place, write, shift), before, after = self._kernels, self.before, self.after
        launch(place, self._all, self._device, self._own, positions=after.positions, turns=after.turns)
        self._sort(self._own["x"])
        starts, shifted = self._sort.grid.starts, self.grid.starts
        launch(shift, starts.size, self._device, first=self._first, starts=starts, shifted=shifted)
        poses = {"before": before.positions, "turns_before": before.turns, "turns": after.turns}
        known = {"first": self._first, "order": self._sort.order, "time_step": time_step}
        launch(write, self._all, self._device, self._own, poses, known, walls)
