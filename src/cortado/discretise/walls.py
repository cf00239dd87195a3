"""Place layers of wall particles around boxes and cups, and compute the weights of wall particles in the density, in
float64."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cortado.discretise.room import Room
from cortado.discretise.shapes import Points, Rows, Which, apart, disc, grid, pairs_within
from cortado.discretise.smoothing import SmoothingKernel, lattice_offsets

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def nearest_cells(length: float, spacing: float) -> int:
    return max(int(np.floor(length / spacing + 0.5)), 1)


def box_walls(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, depth: float) -> Points:
    """Return one layer of points (n, d) at the distance ``depth`` [m] outside a box. Periodic axes have no such points.
    The points continue the lattice inside the box, stretched slightly if a side is not a multiple of the spacing."""
    inside = [_cells(a, b, nearest_cells(b - a, spacing)) for a, b in zip(lower, upper, strict=True)]
    outside = [
        np.zeros(0) if open_axis else np.array([a - depth, b + depth])
        for a, b, open_axis in zip(lower, upper, periodic, strict=True)
    ]
    both = [np.sort(np.concatenate(pair)) for pair in zip(inside, outside, strict=True)]
    return np.concatenate([grid([*inside[:axis], outside[axis], *both[axis + 1 :]]) for axis in range(len(inside))])


def cup_walls(radius: float, height: float, lid: bool, spacing: float, depth: float) -> Points:
    """Return one layer of points (n, 3) around an upright cup, with the centre of the cup's base at the origin. The
    side wall consists of rings at the distance ``depth`` [m] outside the cup. The base and the lid continue the lattice
    of the fluid, with an additional ring at the side wall."""
    side = ring(radius + depth, spacing)
    end = np.concatenate([disc(radius, spacing, 2), side])
    ends = [-depth, height + depth] if lid else [-depth]
    levels = _cells(0.0, height, nearest_cells(height, spacing))
    return np.concatenate([stacked(side, levels), stacked(end, np.array(ends))])


def ring(radius: float, spacing: float) -> Points:
    count = max(nearest_cells(2.0 * np.pi * radius, spacing), 3)
    angles = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _cells(lower: float, upper: float, count: int) -> Points:
    return lower + (upper - lower) * (np.arange(count) + 0.5) / count


def stacked(flat: Points, levels: Points) -> Points:
    return np.column_stack([np.tile(flat, (len(levels), 1)), np.repeat(levels, len(flat))])


OVERLAP = 0.8
"""Least distance of axis-parallel lattices from the side of a cup, relative to ``reach``."""


@dataclass(frozen=True)
class Places(Rows):
    """Points beside walls where fluid may rest. Each point has the axes of its local particle lattice."""

    points: Points
    axes: Points
    """Unit vectors along the axes of each point's lattice (n, d, d)."""

    @classmethod
    def upright(cls, points: Points) -> "Places":
        dimension = points.shape[1]
        return cls(points, np.broadcast_to(np.eye(dimension), (len(points), dimension, dimension)))


def box_places(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, reach: float) -> Places:
    """Return points less than ``reach`` [m] from a wall. The points nearest to a wall are half a spacing away."""
    every = [_between(a, b, open_axis, spacing) for a, b, open_axis in zip(lower, upper, periodic, strict=True)]
    beside = [
        np.zeros(len(x), dtype=bool) if open_axis else np.minimum(x - a, b - x) < reach
        for x, a, b, open_axis in zip(every, lower, upper, periodic, strict=True)
    ]
    near, far = [x[c] for x, c in zip(every, beside, strict=True)], [x[~c] for x, c in zip(every, beside, strict=True)]
    blocks = [grid([*far[:axis], near[axis], *every[axis + 1 :]]) for axis in range(len(every))]
    return Places.upright(np.concatenate(blocks))


def cup_places(radius: float, height: float, lid: bool, spacing: float, reach: float) -> Places:
    """Return points less than ``reach`` [m] from a wall of the cup in `cup_walls`. Lattices near the side of the cup
    are aligned with the side. Points at the base and at the lid lie on the lattice of the fluid. The top of an open cup
    has no points."""
    levels = _between(0.0, height, False, spacing)
    closed = levels if lid else levels[levels < height - reach]
    ends = closed[np.minimum(closed, height - closed) < reach] if lid else closed[closed < reach]
    radii = radius - spacing * (np.arange(max(int(np.ceil(reach / spacing)), 1)) + 0.5)
    side = stacked(np.concatenate([np.zeros((0, 2)), *(ring(r, spacing) for r in radii[radii > 0.0])]), closed)
    outward = np.pad(side[:, :2] / np.linalg.norm(side[:, :2], axis=1, keepdims=True), ((0, 0), (0, 1)))
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), side.shape)
    middle = disc(radius, spacing, 2)
    inner = Places.upright(stacked(middle[np.linalg.norm(middle, axis=1) <= radius - OVERLAP * reach], ends))
    return Places.joined([Places(side, np.stack([outward, np.cross(up, outward), up], axis=1)), inner])


def _between(lower: float, upper: float, periodic: bool, spacing: float) -> Points:
    """The coordinates start half a spacing from each wall, or are evenly spaced along a periodic axis."""
    count = nearest_cells(upper - lower, spacing)
    cells = np.arange(count, dtype=np.float64) + 0.5
    if periodic:
        return np.asarray(lower + (upper - lower) / count * cells)
    return np.asarray(np.where(cells < 0.5 * count, lower + spacing * cells, upper - spacing * cells[::-1]))


ENDS = 6.0
"""Distance from an edge of a box [support radii]. At greater distances the weights of wall particles are constant."""
WHOLE = 1e-9


def short_box(
    lower: Points, upper: Points, spacing: float, support: float
) -> tuple[Points, Callable[[Points], Points]]:
    """Remove cells from the middle of the long sides of a box. The weights of wall particles far from edges are
    constant, and do not change. Return the upper corner of the short box (d,) [m], and a function that maps points on
    the walls (n, d) [m] to the short box."""
    ends, lengths = int(np.ceil(ENDS * support / spacing)), upper - lower
    cells = np.array([nearest_cells(length, spacing) for length in lengths])
    whole = np.abs(lengths / spacing - cells) < WHOLE * cells
    left_out = np.where(whole, np.maximum(cells - 2 * ends - 1, 0), 0)

    def folded(points: Points) -> Points:
        numbers = np.floor((points - lower) / spacing)
        middle = lower + (ends + 0.5) * spacing
        behind = numbers >= ends + left_out + 1
        found = np.where(behind, points - left_out * spacing, np.where(numbers < ends, points, middle))
        return np.where(left_out > 0, found, points)

    return np.where(left_out > 0, upper - left_out * spacing, upper), folded


SHALLOW = 0.4
"""Depth of the shallow layer of wall particles [spacings]. The layer exists only if the second fluid layer's kernel
reaches the wall."""


@dataclass(frozen=True)
class WallLayers:
    """Layers of wall particles behind a flat wall, from the shallowest to the deepest."""

    depths: tuple[float, ...]
    """Distance of each layer behind the wall's surface [m]."""
    weights: tuple[float, ...]
    """Density weight of a wall particle in each layer, relative to the weight of a fluid particle."""


@dataclass(frozen=True)
class RestLattice:
    kernel: SmoothingKernel
    spacing: float
    support: float
    dimension: int

    @cached_property
    def offsets(self) -> Points:
        return lattice_offsets(self.spacing, self.support, self.dimension)

    def weights(self, separations: Points) -> Points:
        """Return the smoothing kernel (m,) [1 / m^d] at separations (m, d) [m]."""
        return self.kernel.weight(np.linalg.norm(separations, axis=1), self.dimension, self.support)

    def sums(self, separations: Points) -> Points:
        """Return the kernel, and its gradient times the spacing (m, 1 + d), over the sum on the lattice [-]."""
        gradients = self.kernel.gradient(separations, self.support)
        both = np.column_stack([self.weights(separations), self.spacing * gradients])
        return np.asarray(both / self.weights(self.offsets).sum())

    def _to_plane(self, distance: float) -> Points:
        flat = np.unique(self.offsets[:, 1:], axis=0)
        return np.hstack([np.full((len(flat), 1), distance), flat])

    def plane_weight(self, distance: float) -> float:
        """Return the sum of the smoothing kernel over a lattice plane at a distance [m] [1 / m^d]."""
        return float(self.weights(self._to_plane(distance)).sum())

    @cached_property
    def layers(self) -> WallLayers:
        """Layers of wall particles at a flat wall. The first layer of fluid is half a spacing from the wall. The layers
        of wall particles meet two conditions:

        - The first and second layer of fluid have the rest density. Band et al. (2018) scale volumes for this purpose.
        - A uniform pressure pushes no particle of the first layer. The wall's density contribution is steep enough to
          balance the pressures of the particle and its neighbours.

        Support radii of up to two spacings need only one wall layer, because the kernel of the second fluid layer does
        not reach the wall.
        """
        from scipy.optimize import brentq

        spacing, support, weight = self.spacing, self.support, self.plane_weight

        def slope(distance: float) -> float:
            return float(self.kernel.gradient(self._to_plane(distance), support)[:, 0].sum())

        below = spacing * np.arange(1, int(support / spacing) + 2)  # the lattice planes that the first layer misses
        missing = np.array([sum(map(weight, below)), sum(map(weight, below[1:]))])
        pull = 2.0 * sum(map(slope, below))
        heights = spacing * np.array([0.5, 1.5])
        two = missing[1] > 1e-6 * missing[0]

        def depths(deepest: float) -> np.ndarray:
            return np.array([SHALLOW * spacing, deepest] if two else [deepest])

        def weights(deepest: float) -> np.ndarray:
            layers = depths(deepest)
            seen = [[weight(height + depth) for depth in layers] for height in heights[: len(layers)]]
            return np.linalg.solve(np.array(seen), missing[: len(layers)])

        def push(deepest: float) -> float:
            slopes = [slope(heights[0] + depth) for depth in depths(deepest)]
            return float(weights(deepest) @ slopes - pull)

        deepest = brentq(push, 0.5 * spacing, support - (0.5 + 1e-3) * spacing, xtol=1e-14 * spacing)
        return WallLayers(tuple(depths(deepest).tolist()), tuple(weights(deepest).tolist()))


STIFFNESS = 3e-3
"""Least-squares penalty on relative deviations from the weights of a flat wall. The penalty on density errors is 1."""
UNEVEN_STIFFNESS = 0.06
"""Penalty like `STIFFNESS`, for wall particles that are not on a lattice. A smaller penalty would let fluid leak."""
LEAST, ROUNDS = 0.6, 4
"""Least weight of wall particles off lattices, relative to a flat wall, and iterations that impose this bound."""
BALANCE = 0.02
"""Least-squares weight of the force from a uniform pressure, relative to density errors. Smaller weights let fluid
leak, and larger weights make corners too dense."""
RAISED = 3.0
"""Distance from a solid at which the free space around a point is measured [spacings]."""
CHUNK = 4096
Crossed = Callable[[Points, Points], Which]
"""A function that tests which line segments between two arrays of points (n, d) [m] cross a sheet."""


def _missing(lattice: RestLattice, places: Places, room: Room, crossed: Crossed | None) -> Points:
    """Sum the kernel and its gradient over lattice points outside the room or behind a sheet (n, 1 + d), as in
    `RestLattice.sums`. A lattice point near the boundary is weighted with the outside fraction of its cell."""
    offsets = lattice.offsets
    cells = places.points[:, None] + offsets @ places.axes
    raised = places.points + RAISED * lattice.spacing * places.axes[:, 0]
    furthest = (RAISED + 0.5) * lattice.spacing + lattice.support
    empty = -room.distance(raised, furthest)  # the radius of an empty ball around each
    open_cells = np.linalg.norm(cells - raised[:, None], axis=2) <= empty[:, None] - 0.5 * lattice.spacing
    shares = np.ones(open_cells.shape)
    shares[~open_cells] = room.cell_shares(cells[~open_cells], lattice.spacing)
    if crossed is not None:
        seen_from = np.repeat(places.points, len(offsets), axis=0)
        shares[crossed(seen_from, cells.reshape(seen_from.shape)).reshape(shares.shape)] = 0.0
    found = (1.0 - shares) @ lattice.sums(-offsets)
    found[:, 1:] = (found[:, None, 1:] @ places.axes)[:, 0]
    return np.asarray(found)


def wall_weights(
    walls: Points,
    flat: Points,
    places: Places,
    lattice: RestLattice,
    room: Room,
    lower: Points,
    are_even: bool,
    known: int = 0,
    crossed: Crossed | None = None,
) -> Points:
    """Fit the weights of wall particles (b,), relative to a fluid particle, by least squares. The lattice has the rest
    density at all places. A uniform pressure pushes no particle less than a spacing from a wall, as in
    `RestLattice.layers`.

    ``flat`` (b,) are the weights in a flat wall. The last ``known`` of these weights are final. If the wall particles
    are on lattices (``are_even``), weights are at least 0, and otherwise at least `LEAST` times ``flat``. ``crossed``
    is given only for the wall particles of a sheet. The particles interact only with fluid across the sheet.
    """
    from scipy.sparse import coo_array, vstack

    sought, changes, is_sheet = len(walls) - known, np.zeros(len(walls)), np.zeros(len(walls), dtype=bool)
    if not sought or not len(places):
        return flat.copy()
    is_sheet[:sought] = crossed is not None

    def demands(places: Places) -> tuple["csr_array", Points]:
        """Return the matrix (m, b) and the right-hand side (m,) of a fit of weights relative to flat walls."""
        place, wall, _ = pairs_within(places.points, walls, lattice.support, lower, room.periods)
        if crossed is not None:
            seen = crossed(places.points[place], walls[wall]) == is_sheet[wall]
            place, wall = place[seen], wall[seen]
        separations = apart(places.points[place] - walls[wall], room.periods)
        shape, indices = (len(places), len(walls)), (place.astype(np.int32), wall.astype(np.int32))
        parts = flat[wall, None] * lattice.sums(separations)
        densities, *gradients = (coo_array((part, indices), shape=shape).tocsr() for part in parts.T)
        missing = _missing(lattice, places, room, crossed)
        near = ~room.contains(places.points, -lattice.spacing)
        sums = vstack([densities, *(BALANCE * gradient[near] for gradient in gradients)]).tocsr()
        return sums, np.concatenate([missing[:, 0], 2.0 * BALANCE * missing[near, 1:].T.ravel()])

    found = [demands(places.some(slice(start, start + CHUNK))) for start in range(0, len(places), CHUNK)]
    sums = vstack([part for part, _ in found]).tocsr()
    left = np.concatenate([part for _, part in found]) - sums.sum(axis=1)
    own = sums[:, :sought]
    seen = np.diff(own.indptr) > 0
    changes[:sought] = (even_changes if are_even else uneven_changes)(own[seen], left[seen])
    return np.asarray(flat * (1.0 + changes), dtype=np.float64)


def even_changes(sums: "csr_array", wanted: Points) -> Points:
    """Solve ``sums @ changes = wanted`` for relative changes, at least -1, of the weights of flat walls' particles."""
    from scipy.optimize import lsq_linear
    from scipy.sparse import eye_array, vstack

    count = sums.shape[1]
    system = vstack([sums, STIFFNESS * eye_array(count)]).tocsr()
    right = np.concatenate([wanted, np.zeros(count)])
    return np.asarray(lsq_linear(system, right, bounds=(-1.0, np.inf), lsq_solver="lsmr", tol=1e-10).x)


def uneven_changes(sums: "csr_array", wanted: Points) -> Points:
    """Solve like `even_changes`. New weights are at least `LEAST` times the flat-wall weights."""
    from scipy.sparse.linalg import lsmr

    changes, free = np.zeros(sums.shape[1]), np.ones(sums.shape[1], dtype=bool)
    for _ in range(ROUNDS):
        some = sums[:, free]
        held = wanted - sums[:, ~free] @ changes[~free]
        changes[free] = lsmr(some, held, damp=UNEVEN_STIFFNESS, atol=1e-6, btol=1e-6)[0]
        if (changes[free] >= LEAST - 1.0).all():
            break
        free &= changes >= LEAST - 1.0
        changes[~free] = LEAST - 1.0
    return np.maximum(changes, LEAST - 1.0)
