"""Walls of boxes and cups, layer by layer, and the weights of wall particles in the density, in float64."""

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
    """Return the number of cells, at least 1, that best fills a length [m]."""
    return max(int(np.floor(length / spacing + 0.5)), 1)


def box_walls(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, depth: float) -> Points:
    """Return one layer (n, d) around a box, ``depth`` [m] outside: faces, edges and corners, each point once.

    Along a face the points continue the lattice inside, slightly stretched if a side is no multiple of the spacing.
    Periodic axes have no wall. Points are built axis by axis: outside along this axis, inside along earlier axes,
    either along later ones.
    """
    inside = [_cells(a, b, nearest_cells(b - a, spacing)) for a, b in zip(lower, upper, strict=True)]
    outside = [
        np.zeros(0) if open_axis else np.array([a - depth, b + depth])
        for a, b, open_axis in zip(lower, upper, periodic, strict=True)
    ]
    both = [np.sort(np.concatenate(pair)) for pair in zip(inside, outside, strict=True)]
    return np.concatenate([grid([*inside[:axis], outside[axis], *both[axis + 1 :]]) for axis in range(len(inside))])


def cup_walls(radius: float, height: float, lid: bool, spacing: float, depth: float) -> Points:
    """Return one layer (n, 3) of the walls of an upright cup, with the centre of its base at the origin and its height
    along the third axis.

    The side consists of rings ``depth`` outside of the radius, about a spacing apart. Base and lid (if any) have the
    lattice of fluid in the cup, ``depth`` outside, and a ring that continues the side.
    """
    side = ring(radius + depth, spacing)
    end = np.concatenate([disc(radius, spacing, 2), side])
    ends = [-depth, height + depth] if lid else [-depth]
    levels = _cells(0.0, height, nearest_cells(height, spacing))
    return np.concatenate([stacked(side, levels), stacked(end, np.array(ends))])


def ring(radius: float, spacing: float) -> Points:
    """Return points (n, 2) on a circle, about a spacing apart."""
    count = max(nearest_cells(2.0 * np.pi * radius, spacing), 3)
    angles = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _cells(lower: float, upper: float, count: int) -> Points:
    """Return the centres (count,) of equal cells between two ends."""
    return lower + (upper - lower) * (np.arange(count) + 0.5) / count


def stacked(flat: Points, levels: Points) -> Points:
    return np.column_stack([np.tile(flat, (len(levels), 1)), np.repeat(levels, len(flat))])


OVERLAP = 0.8
"""Largest distance of upright lattices from the side of a cup, as a fraction of the reach."""


@dataclass(frozen=True)
class Places(Rows):
    """Points beside walls for fluid at rest, each with the axes of its lattice."""

    points: Points
    """(n, d) [m]"""
    axes: Points
    """(n, d, d) one unit vector in each row"""

    @classmethod
    def upright(cls, points: Points) -> "Places":
        dimension = points.shape[1]
        return cls(points, np.broadcast_to(np.eye(dimension), (len(points), dimension, dimension)))


def box_places(lower: Points, upper: Points, periodic: Sequence[bool], spacing: float, reach: float) -> Places:
    """Return places less than ``reach`` [m] from a wall of a box, starting half a spacing from the wall. Places are
    built axis by axis: near a wall along this axis, far from walls along earlier axes, anywhere along later ones."""
    every = [_between(a, b, open_axis, spacing) for a, b, open_axis in zip(lower, upper, periodic, strict=True)]
    beside = [
        np.zeros(len(x), dtype=bool) if open_axis else np.minimum(x - a, b - x) < reach
        for x, a, b, open_axis in zip(every, lower, upper, periodic, strict=True)
    ]
    near, far = [x[c] for x, c in zip(every, beside, strict=True)], [x[~c] for x, c in zip(every, beside, strict=True)]
    blocks = [grid([*far[:axis], near[axis], *every[axis + 1 :]]) for axis in range(len(every))]
    return Places.upright(np.concatenate(blocks))


def cup_places(radius: float, height: float, lid: bool, spacing: float, reach: float) -> Places:
    """Return places less than ``reach`` [m] from a wall of an upright cup, with the centre of its base at the origin
    and its height along the third axis.

    At the side, lattices are aligned with the side; on the base and the lid, further inside, they are lattices of fluid
    in the cup. The top of an open cup, which may overflow, has no places.
    """
    levels = _between(0.0, height, False, spacing)
    closed = levels if lid else levels[levels < height - reach]
    ends = closed[np.minimum(closed, height - closed) < reach] if lid else closed[closed < reach]
    radii = radius - spacing * (np.arange(max(int(np.ceil(reach / spacing)), 1)) + 0.5)
    rings = [ring(value, spacing) for value in radii[radii > 0.0]]
    flat = np.concatenate([np.zeros((0, 2)), *rings])
    side = stacked(flat, closed)
    outward = np.pad(side[:, :2] / np.linalg.norm(side[:, :2], axis=1, keepdims=True), ((0, 0), (0, 1)))
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), side.shape)
    middle = disc(radius, spacing, 2)
    inner = Places.upright(stacked(middle[np.linalg.norm(middle, axis=1) <= radius - OVERLAP * reach], ends))
    return Places.joined([Places(side, np.stack([outward, np.cross(up, outward), up], axis=1)), inner])


def _between(lower: float, upper: float, periodic: bool, spacing: float) -> Points:
    """Return coordinates along an axis: a spacing apart from each wall on, or evenly spaced along a period."""
    count = nearest_cells(upper - lower, spacing)
    cells = np.arange(count, dtype=np.float64) + 0.5
    if periodic:
        return np.asarray(lower + (upper - lower) / count * cells)
    return np.asarray(np.where(cells < 0.5 * count, lower + spacing * cells, upper - spacing * cells[::-1]))


ENDS = 6.0
"""Distance from an edge beyond which weights of wall particles are constant, to a relative 1e-6 [supports]."""
WHOLE = 1e-9
"""Tolerance within which a side is an integer number of cells [cells]."""


def short_box(
    lower: Points, upper: Points, spacing: float, support: float
) -> tuple[Points, Callable[[Points], Points]]:
    """Shorten a box between corners (d,) [m], without changing the weights of its wall particles, which repeat far from
    edges and corners. Cells of a spacing [m] are removed from the middle of long sides that are an integer number of
    cells. Return the upper corner (d,) [m], and a function from points (n, d) [m] on the walls of the long box to those
    of the short one."""
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
"""Depth of the shallow layer [spacings], which exists if the fluid's second lattice layer reaches the wall. With half a
spacing the deep layer would lie at the kernel's edge."""


@dataclass(frozen=True)
class RestLattice:
    kernel: SmoothingKernel
    spacing: float
    """[m]"""
    support: float
    """[m]"""
    dimension: int

    @cached_property
    def offsets(self) -> Points:
        """(m, d) [m]"""
        return lattice_offsets(self.spacing, self.support, self.dimension)

    def weights(self, separations: Points) -> Points:
        """Return W (m,) [1 / m^d] at separations (m, d) [m]."""
        return self.kernel.weight(np.linalg.norm(separations, axis=1), self.dimension, self.support)

    def sums(self, separations: Points) -> Points:
        """Return W, and the gradient of W times the spacing, (m, 1 + d) [-], relative to the sum of W on the
        lattice."""
        gradients = self.kernel.gradient(separations, self.support)
        both = np.column_stack([self.weights(separations), self.spacing * gradients])
        return np.asarray(both / self.weights(self.offsets).sum())

    def _to_plane(self, distance: float) -> Points:
        """Return separations (m, d) [m] from the points of a lattice plane at a distance [m], along the first axis."""
        flat = np.unique(self.offsets[:, 1:], axis=0)
        return np.hstack([np.full((len(flat), 1), distance), flat])

    def plane_weight(self, distance: float) -> float:
        """Return the sum of W [1 / m^d] over a lattice plane at a distance [m]."""
        return float(self.weights(self._to_plane(distance)).sum())

    def plane_slope(self, distance: float) -> float:
        """Return the derivative of `plane_weight` [1 / m^(d + 1)]."""
        return float(self.kernel.gradient(self._to_plane(distance), self.support)[:, 0].sum())


@dataclass(frozen=True)
class WallLayers:
    """Layers of wall particles behind a flat wall, the deepest last."""

    depths: tuple[float, ...]
    """Distances behind the surface of the container [m]."""
    weights: tuple[float, ...]
    """Weight in the density of a particle of each layer, relative to a fluid particle."""


def wall_layers(lattice: RestLattice) -> WallLayers:
    """Find the layers that meet these conditions at a flat wall, for fluid on a lattice that starts at half a spacing:

    - the fluid has the rest density (Band et al. 2018 scale volumes for that), in its first layer and in its second;
    - a uniform pressure pushes no particle of the first layer. The contribution of a wall to the density of a particle
      is steep enough to balance the pressure of the particle and of all its neighbours.

    One layer is enough if the second layer of fluid does not reach the wall: with supports of up to two spacings.
    """
    spacing, support, weight, slope = lattice.spacing, lattice.support, lattice.plane_weight, lattice.plane_slope
    below = spacing * np.arange(1, int(support / spacing) + 2)  # the lattice planes that the first layer misses
    missing = np.array([sum(map(weight, below)), sum(map(weight, below[1:]))])
    pull = 2.0 * sum(map(slope, below))
    heights = spacing * np.array([0.5, 1.5])

    two = missing[1] > 1e-6 * missing[0]

    def depths(deepest: float) -> np.ndarray:
        return np.array([SHALLOW * spacing, deepest] if two else [deepest])

    def weights(deepest: float) -> np.ndarray:
        """Return weights that give the rest density to as many first layers of the fluid as the wall has layers."""
        layers = depths(deepest)
        seen = [[weight(height + depth) for depth in layers] for height in heights[: len(layers)]]
        return np.linalg.solve(np.array(seen), missing[: len(layers)])

    def push(deepest: float) -> float:
        slopes = [slope(heights[0] + depth) for depth in depths(deepest)]
        return float(weights(deepest) @ slopes - pull)

    from scipy.optimize import brentq

    deepest = brentq(push, 0.5 * spacing, support - (0.5 + 1e-3) * spacing, xtol=1e-14 * spacing)
    return WallLayers(tuple(depths(deepest).tolist()), tuple(weights(deepest).tolist()))


STIFFNESS = 3e-3
"""Penalty on relative changes of weights, compared with errors of the density, towards a flat wall's weights."""
UNEVEN_STIFFNESS = 0.06
"""Penalty as `STIFFNESS` for particles off a lattice; with 0.003 some would have no weight, and fluid would leak."""
LEAST, ROUNDS = 0.6, 4
"""Smallest weight of particles off a lattice, relative to a flat wall's, and rounds that impose it."""
BALANCE = 0.02
"""Weight of the push of a uniform pressure, compared with an error of the density. Without it the slopes of two layers
around a cup become so shallow that fluid leaks; with 0.1 corners are too dense."""
RAISED = 3.0
"""Distance along the first axis of a place, away from a solid, over which free room is measured [spacings]."""
CHUNK = 4096


Crossed = Callable[[Points, Points], Which]
"""Test of which segments between points (n, d) [m] cross a sheet."""


def _missing(lattice: RestLattice, places: Places, room: Room, crossed: Crossed | None) -> Points:
    """Return, for each of n places, the part (n, 1 + d) of the `RestLattice.sums` from lattice points outside of the
    room or behind a sheet. Points near the boundary count by the fraction of their cell that is outside."""
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
    """Compute the weights (b,) of wall particles in the density [-], relative to a fluid particle.

    With these weights the lattice has the rest density at all places, and a uniform pressure pushes no particle less
    than a spacing from a wall, both by least squares. To balance the push, as in `wall_layers`, the wall contributes
    twice the gradient of the missing fluid.

    Args:
        walls: (b, d) wall particles [m].
        flat: (b,) their weights in a flat wall [-], or known weights.
        places: places where fluid may rest.
        lattice: the lattice of the fluid at rest.
        room: the room for fluid.
        lower: (d,) start of the period [m].
        are_even: True for particles on lattices, whose weights are at least 0; others have the weight `LEAST` or more.
        known: number of wall particles, the last ones, with known weights.
        crossed: the test for the sheet to which the wall particles belong, except the known ones. Fluid interacts with
            them only through the sheet.
    """
    from scipy.sparse import coo_array, vstack

    sought, changes, is_sheet = len(walls) - known, np.zeros(len(walls)), np.zeros(len(walls), dtype=bool)
    if not sought or not len(places):
        return flat.copy()
    is_sheet[:sought] = crossed is not None

    def demands(places: Places) -> tuple["csr_array", Points]:
        """Return a matrix (m, b) of sums over wall particles at places, as functions of weights relative to flat walls,
        and the sums (m,) that fluid at rest needs there."""
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
    """Return the relative changes (b,) of flat-wall weights with which a matrix (m, b) gives the wanted product (m,),
    for wall particles on lattices; weights are at least 0."""
    from scipy.optimize import lsq_linear
    from scipy.sparse import eye_array, vstack

    count = sums.shape[1]
    system = vstack([sums, STIFFNESS * eye_array(count)]).tocsr()
    right = np.concatenate([wanted, np.zeros(count)])
    return np.asarray(lsq_linear(system, right, bounds=(-1.0, np.inf), lsq_solver="lsmr", tol=1e-10).x)


def uneven_changes(sums: "csr_array", wanted: Points) -> Points:
    """Return changes as `even_changes`, for evenly spaced particles off a lattice; weights are at least `LEAST`."""
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
