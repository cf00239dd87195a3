"""Arrays of wall particles, and the wall particles of moving solids.

Wall particles of moving solids have positions at the end of a time step, and the velocity of the nearest surface point.

A scale sigma may stretch a solid about its middle. In the solid's frame a wall particle has the position r and the
weight w, and q is the nearest point on the surface. The vector to the surface is f = q - r. With the middle c and the
rotation R of the solid, the wall particle is at c + R (sigma q - f) in space. The scaled weight is sigma^(d - 1) w in d
dimensions, because the area of the surface grows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import CellSort, cell_grid_type
from cortado.device.grid import Grid
from cortado.device.launching import bundle, launch
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.discretise.shapes import Rows
from cortado.particles.state import Layout, zeros


@dataclass(frozen=True)
class WallArrays(Rows):
    positions: np.ndarray
    """Array of shape (b, 3) with positions [m]. Positions on moving solids are in the frame of the solid."""
    weights: np.ndarray
    """Array of shape (b,) with the weights of wall particles in the density [-]. Fluid has the weight 1."""
    grips: np.ndarray
    """Array of shape (b,) with the weights of wall particles in sums of friction [-]. Free-slip walls have 0."""
    feet: np.ndarray
    """Array of shape (b, 3) with vectors from wall particles to the nearest point on the surface [m]."""
    slides: np.ndarray
    """Array of shape (b, 3) with the velocities at which the surface slides along the solid [m/s]."""
    solid: np.ndarray
    """Array of shape (b,) with numbers of solids: from 0 up if moving, from -2 down at rest, -1 for the container."""
    faces: np.ndarray
    """Array of shape (b,) with the number of the flat face that mirrors fluid before a wall particle, or -1."""


def pose_arrays(members: int, solids: int, precision: Precision, device: Any) -> dict[str, wp.array]:
    """Make arrays (members, solids) for the poses of solids before and after a time step, by kernel argument."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    kinds = {"before": vector, "turns_before": matrix, "after": vector, "turns": matrix}
    kinds |= dict.fromkeys(("before_dot", "turned_before_dot", "after_dot", "turned_dot"), vector)
    kinds |= {"scales": real, "scales_dot": real}
    made = zeros({name: ((members, solids), kind) for name, kind in kinds.items()}, device)
    made["scales"].fill_(1.0)
    return made


def resting_pose(layout: Layout) -> dict[str, wp.array]:
    made = pose_arrays(layout.members, 1, layout.precision, layout.device)
    for name in ("turns", "turns_before"):
        made[name].fill_(layout.precision.matrix(*np.eye(3).ravel()))
    return {name: array[:, 0] for name, array in made.items()}


@cache
def turn_functions(precision: Precision) -> tuple[Any, Any]:
    """The functions convert adjoints of a rotation matrix to adjoints of a rotation vector, and back."""
    real, vector, matrix = precision.real, precision.vector, precision.matrix

    @wp.func
    def turning(R: matrix, bar: matrix) -> vector:
        T = bar * wp.transpose(R)
        return vector(T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1])

    @wp.func
    def leaning(R: matrix, turn_bar: vector) -> matrix:
        return (real(0.5) * wp.skew(turn_bar)) * R

    return turning, leaning


@cache
def sizes_type(precision: Precision) -> Any:
    scales = wp.array2d(dtype=precision.real)
    return struct_of("Sizes", precision, scales=scales, scales_dot=scales, power=precision.real)


@cache
def _kernels(precision: Precision) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    module = kernel_module(f"moving_walls_{precision.name}")
    vectors = {f"wall_{name}": vector for name in ("positions", "feet", "velocities")}
    own_vectors = dict.fromkeys(("own", "own_feet", "own_slides"), vector)
    own_of: Any = bundle(**own_vectors, own_weights=real, own_grips=real, own_solids=wp.int32, own_faces=wp.int32)
    sizes_of = sizes_type(precision)
    numbers = {f"wall_{name}": wp.int32 for name in ("solids", "faces")}
    walls_of: Any = bundle(**vectors, wall_weights=real, wall_grips=real, **numbers)
    length_of: Any = bundle(time_step=real, time_step_dot=real)
    vector_dots = {f"wall_{name}_dot": vector for name in ("positions", "velocities", "turns")}
    dots_of: Any = bundle(**vector_dots, wall_growths_dot=real)
    bundles = {own_of: "of", sizes_of: "sizes", length_of: "length"}
    poses = {wp.array2d(dtype=vector): "before after turned", wp.array2d(dtype=matrix): "turns turns_before"}
    typed = TypesByName(real, {wp.int32: "order starts shifted", vector: "x wall_velocities", **bundles, **poses})

    @wp.func
    def place_of(b: int, scale: real, of: own_of) -> vector:
        return of.own[b] + (scale - real(1.0)) * (of.own[b] + of.own_feet[b])

    @wp.func
    def surface_of(b: int, scale: real, of: own_of) -> vector:
        return scale * (of.own[b] + of.own_feet[b])

    @typed.kernel(module)
    def place(count: int, of, after, turns, sizes, x):
        j = wp.tid()
        member = j // count
        b = j - member * count
        k = of.own_solids[b]
        x[j] = after[member, k] + turns[member, k] * place_of(b, sizes.scales[member, k], of)

    @typed.kernel(module)
    def write(count: int, first: int, order, time_step, of, before, turns_before, turns, sizes, x, walls: walls_of):
        p = wp.tid()
        j = order[p]
        member = j // count
        b = j - member * count
        k = of.own_solids[b]
        foot, scale = turns[member, k] * of.own_feet[b], sizes.scales[member, k]
        grown = wp.pow(scale, sizes.power)
        surface_before = before[member, k] + turns_before[member, k] * surface_of(b, scale, of)
        moved = x[j] + foot - surface_before
        walls.wall_positions[first + p] = x[j]
        walls.wall_feet[first + p] = foot
        walls.wall_velocities[first + p] = moved / time_step[member] + turns[member, k] * of.own_slides[b]
        walls.wall_weights[first + p] = grown * of.own_weights[b]
        walls.wall_grips[first + p] = grown * of.own_grips[b]
        walls.wall_solids[first + p] = k
        walls.wall_faces[first + p] = of.own_faces[b]

    @typed.kernel(module)
    def shift(first: int, starts, shifted):
        c = wp.tid()
        shifted[c] = starts[c] + first

    @typed.kernel(module)
    def write_tangent(
        count: int, first: int, order, length, of, turns_before, turns, sizes, before_dot, turned_before_dot,
        after_dot, turned_dot, wall_velocities, walls: dots_of,
    ):  # fmt: skip
        p = wp.tid()
        j = order[p]
        member = j // count
        b = j - member * count
        k = of.own_solids[b]
        turned, slide = turned_dot[member, k], turns[member, k] * of.own_slides[b]
        scale = sizes.scales[member, k]
        growth, surface = sizes.scales_dot[member, k] / scale, surface_of(b, scale, of)
        arm, arm_before = turns[member, k] * surface, turns_before[member, k] * surface
        surface_dot = after_dot[member, k] + wp.cross(turned, arm) + growth * arm
        x_dot = surface_dot - wp.cross(turned, turns[member, k] * of.own_feet[b])
        surface_before_dot = before_dot[member, k] + wp.cross(turned_before_dot[member, k], arm_before)
        surface_before_dot += growth * arm_before
        dt = length.time_step[member]
        moved_dot = surface_dot - surface_before_dot
        moved_dot -= length.time_step_dot[member] * (wall_velocities[first + p] - slide)
        walls.wall_positions_dot[first + p] = x_dot
        walls.wall_velocities_dot[first + p] = moved_dot / dt + wp.cross(turned, slide)
        walls.wall_turns_dot[first + p] = turned
        walls.wall_growths_dot[first + p] = sizes.power * growth

    return by_name(place, write, shift, write_tangent)


class MovingWalls:
    def __init__(self, walls: WallArrays, first: int, solids: int, dimension: int, grid: Grid, layout: Layout):
        """``first`` is the index of the first wall particle in the arrays of the neighbour search."""
        precision, device, count = layout.precision, layout.device, len(walls)
        self.solids, self.named = solids, pose_arrays(layout.members, solids, precision, device)
        self.sizes = sizes_type(precision)()
        self.sizes.scales, self.sizes.scales_dot = self.named["scales"], self.named["scales_dot"]
        self.sizes.power = precision.real(dimension - 1)
        self.each = [{name: array[:, k] for name, array in self.named.items()} for k in range(solids)]
        self.slides = wp.zeros(solids, dtype=precision.vector, device=device)
        """Velocity [m/s] of each solid's surface relative to the solid, in the solid's frame: vectors (solids,)."""
        slides = np.zeros((solids, 3))
        slides[walls.solid] = walls.slides
        self.slides.assign(slides)
        self._device, self._first, self._all = device, first, layout.members * count
        self._kernels = _kernels(precision)
        vectors = {"own": walls.positions, "own_feet": walls.feet, "own_slides": walls.slides}
        numbers = {"own_weights": walls.weights, "own_grips": walls.grips}
        self._own: dict[str, Any] = {
            "count": count,
            "sizes": self.sizes,
            "own_solids": wp.array(walls.solid, dtype=wp.int32, device=device),
            "own_faces": wp.array(walls.faces, dtype=wp.int32, device=device),
            "x": wp.zeros(self._all, dtype=precision.vector, device=device),
            **{name: wp.array(values, dtype=precision.vector, device=device) for name, values in vectors.items()},
            **{name: wp.array(values, dtype=precision.real, device=device) for name, values in numbers.items()},
        }
        self._sort = CellSort(grid, count, precision, device, layout.members)
        self.grid = cell_grid_type(precision)()
        for name in ("origin", "frequency", "shape"):
            setattr(self.grid, name, getattr(self._sort.grid, name))
        self.grid.starts = wp.zeros_like(self._sort.grid.starts)

    def write(self, time_step: wp.array, walls: Mapping[str, wp.array]) -> None:
        """Write the wall particles to the arrays of a neighbour search. Each scene has its own ``time_step`` [s]."""
        launch(self._kernels.place, self._all, self._device, self._own, self.named)
        self._sort(self._own["x"])
        starts, shifted = self._sort.grid.starts, self.grid.starts
        launch(self._kernels.shift, starts.size, self._device, first=self._first, starts=starts, shifted=shifted)
        known = {"first": self._first, "order": self._sort.order, "time_step": time_step}
        launch(self._kernels.write, self._all, self._device, self._own, self.named, known, walls)

    def write_tangent(self, time_step: wp.array, time_step_dot: wp.array, walls: Mapping[str, wp.array]) -> None:
        known = {"first": self._first, "order": self._sort.order}
        known |= {"time_step": time_step, "time_step_dot": time_step_dot}
        launch(self._kernels.write_tangent, self._all, self._device, self._own, known, self.named, walls)
