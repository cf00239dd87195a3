"""Neighbours: particles sorted by cell, and a symmetric list that the step keeps.

The list reaches a little beyond the support radius (`SKIN`), because the density is also taken at predicted positions.
Without it a pair that comes into touch within the step would count or not depending on which side of the support it
started. The map from one state to the next would jump there, and lattices start with pairs at just that distance.

The list holds j for i exactly when it holds i for j, because |x_i - x_j| is computed with the same bits from both
sides.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.cells import CellSort, cell_functions, cell_grid_type
from cortado.device.grid import Grid
from cortado.device.launching import MOST_PARTS, HostCopy, KernelLauncher
from cortado.device.precision import TypesByName
from cortado.errors import InputError
from cortado.particles.candidates import append_function, scan_around
from cortado.particles.mirrors import most_imaged, reflections
from cortado.particles.moving_walls import MovingWalls, WallArrays
from cortado.particles.neighbourhood import (
    UNROLL,
    Discretisation,
    loads,
    neighbourhood_type,
    pair_functions,
)
from cortado.particles.state import Layout


@cache
def fill_kernel(discretisation: Discretisation) -> Any:
    precision, (_, vector, neighbourhood) = discretisation.precision, discretisation.types
    kinds = {neighbourhood: "s", cell_grid_type(precision): "grid wall_grid moving_grid", wp.bool: "near_walls"}
    typed = TypesByName(wp.int32, {**kinds, vector: "x"})
    cell_of = cell_functions(precision).cell_of
    scan = scan_around(discretisation)
    LANES, lane = discretisation.lanes, discretisation.lane

    @wp.kernel(module=discretisation.module(True, "neighbours"), enable_backward=False)
    @typed.arrays
    def fill(s, grid, wall_grid, moving_grid, near_walls, bad_step, x, fluid_count, filling, count, all_count, needed):
        """List neighbours; ``needed``, for each range, becomes the longest list, also where there is no room for it.
        Scenes that have lost a particle, in ``bad_step``, get empty lists. ``near_walls`` comes from `_near_walls`."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if bad_step[member] >= 0:
            if lane() == 0:
                filling[i] = 0
                fluid_count[i] = 0
                count[i] = 0
                all_count[i] = 0
            return
        x_i = x[i]
        c = cell_of(x_i, grid)
        capacity = s.neighbours.shape[0]
        found = scan(i, i, member * grid.shape[2], c, 0, x_i, x, grid, s)
        filled = (found + wp.static(UNROLL - 1)) // wp.static(UNROLL) * wp.static(UNROLL)
        for k in range(found + lane(), wp.min(filled, capacity), LANES):
            s.neighbours[k, i] = i
        to_fill = filled - found
        found = filled
        if near_walls[(c[2] * grid.shape[1] + c[1]) * grid.shape[0] + c[0]]:
            found = scan(i, -1, 0, c, found, x_i, s.wall_positions, wall_grid, s)
        if wp.static(discretisation.moving):
            found = scan(i, -1, member * grid.shape[2], c, found, x_i, s.wall_positions, moving_grid, s)
        if lane() > 0:
            return
        filling[i] = to_fill
        fluid_count[i] = wp.min(filled, capacity)
        count[i] = wp.min(found, capacity)
        all_count[i] = count[i]
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill


@cache
def image_kernel(discretisation: Discretisation) -> Any:
    """Make the kernel that appends images of particles, and of the particle itself, to lists of neighbours."""
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    pair, load = pair_functions(discretisation), loads(discretisation.precision, discretisation.taped)
    separation, sees, shows, sides = pair.separation, pair.sees, pair.shows, pair.sides
    reflection, turned, last_reflection = pair.reflection, pair.turned, pair.last_reflection
    load_vector, neighbour, REFLECTIONS = (
        load.load_vector,
        pair.neighbour,
        wp.constant(reflections(discretisation.moving)),
    )
    LANES, lane, append = discretisation.lanes, discretisation.lane, append_function(discretisation)

    @wp.kernel(module=discretisation.module(True, "neighbours"), enable_backward=False)
    @TypesByName(wp.int32, {neighbourhood: "s", vector: "x"}).arrays
    def fill_images(s, bad_step, x, all_count, needed):
        """Append images to lists; ``needed`` becomes the longest list, as in `fill_kernel`."""
        i = s.first + wp.tid() // LANES
        x_i, limit, found = x[i], s.reach * s.reach, int(s.count[i])
        member = i // s.particles
        near = sides(x_i, s)
        last = last_reflection(near, x_i, member, s)
        if last == 0 or bad_step[member] >= 0:
            return
        others = s.fluid_count[i] - s.filling[i]
        for one in range(1, last + 1):
            if sees(one, near, x_i, member, s):
                R, offset = reflection(one, member, s)
                for first in range(0, others + 1, LANES):
                    place, j = first + lane(), int(i)
                    if place < others:
                        j = neighbour(place, i, s)
                    x_j = load_vector(x, j)
                    x_ij = separation(x_i, turned(R, x_j) + offset, s)
                    is_near = place <= others and wp.dot(x_ij, x_ij) < limit and shows(one, x_j, member, s)
                    found = append(i, REFLECTIONS * j + one, is_near, found, s)
        if lane() > 0:
            return
        all_count[i] = wp.min(found, s.neighbours.shape[0])
        if found > needed[s.part]:
            wp.atomic_max(needed, s.part, found)

    return fill_images


def _near_walls(grid: Grid, starts: np.ndarray) -> np.ndarray:
    """Return (cells,) True where there are walls in a cell or around it; ``starts`` (cells + 1,) has the first wall
    particle of each."""
    near = np.diff(starts).reshape(grid.shape[::-1]) > 0
    for axis in range(3):
        near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
    return near.ravel()


class NeighbourSearch:
    """A search that sorts particles by cell and lists their neighbours, on one device and without a host read.

    The list is stored [particle][neighbour] on a CPU and [neighbour][particle] on a GPU, whichever a device reads
    fastest; kernels index it [neighbour, particle] on both.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        grid: Grid,
        walls: WallArrays,
        layout: Layout,
        capacity: int,
        solids: int = 0,
        dimension: int = 3,
        mirrored: bool = False,
    ):
        """Allocate the search. ``walls`` at rest are shared by all scenes of a batch; moving ones stand behind them,
        scene by scene, and are written by `MovingWalls.write`, of so many ``solids`` in a ``dimension``. Lists of
        ``mirrored`` fluid have images."""
        precision, device, particles = discretisation.precision, layout.device, layout.all_particles
        if mirrored and particles > (most := most_imaged(discretisation.moving)):
            raise InputError(
                f"{particles:,} particles are too many beside walls that mirror them: at most {most:,}, or any "
                'number with container.slip = "no".'
            )
        self.particles, self.device = particles, device
        self._fill, self._fill_images = fill_kernel(discretisation), image_kernel(discretisation)
        self._mirrored = mirrored
        self._sort = CellSort(grid, layout.particles, precision, device, layout.members)
        self.order = self._sort.order
        lists = (wp.zeros(particles, dtype=wp.int32, device=device) for _ in range(4))
        self.fluid_count, self.filling, self.count, self.all_count = lists
        self._launch = KernelLauncher(particles, device, record_tape=False)
        self._needed = wp.zeros(MOST_PARTS, dtype=wp.int32, device=device)
        self._seen = HostCopy(self._needed)
        still, moving = walls.some(walls.solid < 0), walls.some(walls.solid >= 0)
        count = len(still) + layout.members * len(moving)
        kinds = {"positions": precision.vector, "feet": precision.vector, "velocities": precision.vector}
        kinds |= {"weights": precision.real, "grips": precision.real, "solids": wp.int32, "faces": wp.int32}
        own = dict.fromkeys(("positions_dot", "velocities_dot", "turns_dot"), precision.vector)
        own["growths_dot"] = precision.real
        sizes = {**dict.fromkeys(kinds, count), **dict.fromkeys(own, count if solids else 0)}
        self.walls = {
            f"wall_{name}": wp.zeros(sizes[name], dtype=kind, device=device) for name, kind in {**kinds, **own}.items()
        }
        """What kernels know of wall particles, those at rest first; no tangents where no solid moves."""
        self.walls["wall_faces"].fill_(-1)
        self._write_walls(still)
        self._wall_sort = CellSort(grid, len(still), precision, device)
        self._unsorted_walls: WallArrays | None = still
        self.moving = MovingWalls(moving, len(still), solids, dimension, grid, layout) if solids else None
        """Those of solids that move."""
        self._grid, self._near_walls = grid, wp.zeros(grid.cells, dtype=wp.bool, device=device)
        self.allocate(capacity)

    def allocate(self, capacity: int) -> None:
        """Make room for lists of ``capacity`` neighbours, rounded up to a multiple of `UNROLL`."""
        self.capacity = -(-capacity // UNROLL) * UNROLL
        shape = (self.particles, self.capacity)
        if self.device.is_cpu:
            self.neighbours = wp.empty(shape, dtype=wp.int32, device=self.device).transpose((1, 0))
        else:
            self.neighbours = wp.empty(shape[::-1], dtype=wp.int32, device=self.device)

    def sort(self, positions: wp.array) -> None:
        """Find the order of cells (``order``: sorted -> given) of positions (members n,) [m]; ties keep the given
        order."""
        if self._unsorted_walls is not None:  # once, and not before kernels are compiled side by side
            self._sort_walls(self._unsorted_walls)
            self._unsorted_walls = None
        self._sort(positions)

    def _write_walls(self, walls: WallArrays) -> None:
        """Copy the wall particles at rest to the search's arrays on the device, in the given order."""
        known = {name: getattr(walls, name) for name in ("positions", "weights", "grips", "feet")}
        for name, values in {**known, "solids": walls.solid}.items():
            array = self.walls[f"wall_{name}"]
            if len(values):
                wp.copy(array, wp.array(values, dtype=array.dtype, device=self.device), count=len(values))

    def _sort_walls(self, walls: WallArrays) -> None:
        dtype = self.walls["wall_positions"].dtype
        self._wall_sort(wp.array(walls.positions, dtype=dtype, device=self.device))
        self._write_walls(walls.some(self._wall_sort.order.numpy()))
        self._near_walls.assign(_near_walls(self._grid, self._wall_sort.grid.starts.numpy()))

    def fill(self, neighbourhood: Any, positions: wp.array, bad_step: wp.array) -> None:
        """List the neighbours of sorted positions (members n,) [m], but none where the ``bad_step`` (members,) of a
        scene is not -1; `needed` tells whether the lists were long enough."""
        given = {"s": neighbourhood, "bad_step": bad_step, "x": positions, "needed": self._needed}
        grids = {"grid": self._sort.grid, "wall_grid": self._wall_sort.grid, "near_walls": self._near_walls}
        lists = {
            "fluid_count": self.fluid_count,
            "filling": self.filling,
            "count": self.count,
            "all_count": self.all_count,
        }
        moving = self._wall_sort.grid if self.moving is None else self.moving.grid
        self._launch(self._fill, given, lists, grids, moving_grid=moving)
        if self._mirrored:
            self._launch(self._fill_images, given, lists)

    @property
    def needed(self) -> int:
        """Return the length of the longest list since `forget_needed`; it is more than a capacity that is too small."""
        return int(self._seen.read().max())

    def forget_needed(self) -> None:
        """Forget the longest list, so that `needed` begins anew."""
        self._needed.zero_()
