"""Arrays of points in float64: lattices in boxes and discs, pairs of neighbours, and the density of points."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property
from itertools import product
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.calls import point_in_words
from cortado.discretise.smoothing import SmoothingKernel
from cortado.errors import InputError

Points = NDArray[np.float64]
"""Array of points, usually (n, d)."""
Which = NDArray[np.bool_]
Numbers = NDArray[np.int64]

ROUND_OFF = 1e-6
"""Tolerated round-off of a length when its cells are counted [spacings]."""
NEARBY = 4
EXCESS = 0.003
"""Greatest relative difference between the volume of a stretched lattice and the volume of its shape."""
MOST_STRETCHED = 0.03
"""Greatest logarithm of the stretching along an axis, which limits the error of the density to 1 %."""


class Rows:
    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        names = [field.name for field in fields(cls)]  # type: ignore[arg-type]
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in names))

    def some(self, which: Any) -> Self:
        return type(self)(*(getattr(self, field.name)[which] for field in fields(self)))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]


def bisected(holds: Callable[[Points], Which], low: Points, high: Points, halvings: int) -> tuple[Points, Points]:
    """The condition ``holds`` is true at ``low`` (n,) and false at ``high`` (n,). Return the two bounds (n,)."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        good = holds(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low, high


@dataclass(frozen=True)
class Block:
    """A lattice of points along the axes, with lengths (d,) in [m]."""

    first: Points
    counts: Points
    """Number of points along each axis (d,), as floats, because a number may exceed the size of any array."""
    spacings: Points

    @cached_property
    def size(self) -> float:
        return float(np.prod(self.counts))

    @cached_property
    def extent(self) -> tuple[Points, Points]:
        return self.first, self.first + (self.counts - 1.0) * self.spacings

    def grown(self, cells: int) -> "Block":
        return Block(self.first - cells * self.spacings, self.counts + 2 * cells, self.spacings)

    def points(self) -> Points:
        """Return the points (n, d) [m]. The last axis varies fastest."""
        axes = zip(self.first, self.spacings, self.counts, strict=True)
        return grid([x + spacing * np.arange(int(n)) for x, spacing, n in axes])


def block_between(lower: ArrayLike, upper: ArrayLike, spacing: float) -> Block:
    """Return a lattice of the cells that fit inside the box between corners (d,) [m], starting at the lower corner."""
    first = np.asarray(lower, dtype=np.float64)
    counts = whole_cells(np.asarray(upper, dtype=np.float64) - first, spacing)
    return Block(first + 0.5 * spacing, counts, np.full(len(first), spacing))


def block_filling(lower: ArrayLike, upper: ArrayLike, spacing: float) -> Block:
    """A lattice that does not fit is stretched or compressed along the axes by at most `MOST_STRETCHED`. The number of
    points then matches the volume within `EXCESS`. If no lattice meets both limits, only cells inside the box have
    points."""
    first, last = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    cells, plain = (last - first) / spacing, block_between(lower, upper, spacing)
    if (np.abs(cells - np.rint(cells)) <= ROUND_OFF).all() or not plain.counts.all():
        return plain
    counts = grid([np.maximum(n + np.arange(-NEARBY, NEARBY + 1.0), 1.0) for n in plain.counts])
    errors = np.prod(counts / cells, axis=1) - 1.0
    stretched = np.abs(np.log(cells / counts)).max(axis=1)
    fit = np.flatnonzero((np.abs(errors) <= EXCESS) & (stretched <= MOST_STRETCHED))
    loose = fit[errors[fit] <= ROUND_OFF]
    fit = loose if len(loose) else fit
    if not len(fit):
        return plain
    best = counts[fit[np.argmin(stretched[fit])]]
    spacings = (last - first) / best
    return Block(first + 0.5 * spacings, best, spacings)


def block_about(centre: ArrayLike, half: ArrayLike, spacing: float) -> Block:
    """The lattice is symmetric about ``centre`` (d,), and ``half`` (d,) are half side lengths [m]."""
    counts = whole_cells(2.0 * np.asarray(half, dtype=np.float64), spacing)
    first = np.asarray(centre, dtype=np.float64) - 0.5 * (counts - 1.0) * spacing
    return Block(first, counts, np.full(len(first), spacing))


def lattice(counts: Points, spacing: float) -> Points:
    """Return a lattice (n, d) [m] symmetric about the origin, with ``counts`` (d,) points along the axes."""
    return Block(-0.5 * (counts - 1.0) * spacing, counts, np.full(len(counts), spacing)).points()


def disc(radius: float, spacing: float, dimension: int) -> Points:
    """With ``dimension`` 1 the disc is a line segment. The disc has at least one point."""
    points = lattice(np.full(dimension, np.maximum(whole_cells(np.array(2.0 * radius), spacing), 1.0)), spacing)
    return points[np.linalg.norm(points, axis=1) <= radius]


def across(direction: ArrayLike) -> Points:
    """Return perpendicular unit vectors (d - 1, d), which are also perpendicular to a unit vector (d,)."""
    frame = [np.asarray(direction, dtype=np.float64)]
    for axis in np.argsort(np.abs(frame[0]), kind="stable")[:-1]:
        vector = np.eye(len(frame[0]))[axis]
        vector = vector - sum((vector @ other) * other for other in frame)
        frame.append(vector / np.linalg.norm(vector))
    return np.array(frame[1:])


def whole_origin(points: Points) -> Points:
    """Return an origin near distant points, or 0. Subtracting the origin from the points is exact."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    step = 2.0 ** np.ceil(np.log2(max((upper - lower).max(), np.finfo(np.float64).tiny)))
    return np.asarray(step * np.round((0.5 * lower + 0.5 * upper) / step))


def whole_cells(lengths: Points, spacing: float) -> Points:
    return np.maximum(np.floor(lengths / spacing + ROUND_OFF), 0.0)


def grid(axes: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return all combinations of the values of the axes (n, d). The last axis varies fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def in_space(vectors: Any) -> Any:
    return np.pad(vectors, [(0, 0)] * (np.ndim(vectors) - 1) + [(0, 3 - np.shape(vectors)[-1])])


def corners(lower: Points, upper: Points) -> Points:
    return np.array(list(product(*zip(lower, upper, strict=True))), dtype=np.float64)


CHUNK = 8192
Period = tuple[Points, Points]
Pairs = tuple[Numbers, Numbers, Points]
"""Arrays (m,) of the first point, the second point and the distance [m] of each pair."""


def pairs_within(some: Points, others: Points, reach: float, lower: ArrayLike = 0.0, lengths: ArrayLike = 0.0) -> Pairs:
    """Return all pairs of a point in ``some`` (n, d) and a point in ``others`` (m, d) at most ``reach`` [m] apart.
    ``lower`` and ``lengths`` (d,) [m] belong to the periodic box. A length is 0 along an axis without a period."""
    from scipy.spatial import cKDTree

    lengths = np.broadcast_to(np.asarray(lengths, dtype=np.float64), some.shape[1:])
    some, others = (wrapped(x - np.asarray(lower, dtype=np.float64), lengths) for x in (some, others))
    numbers, beyond = np.arange(len(others)), reach * (1.0 + 1e-9)
    if len(some) and not lengths.any():
        first, last = some.min(axis=0) - beyond, some.max(axis=0) + beyond
        numbers = np.flatnonzero(((others >= first) & (others <= last)).all(axis=1))
    tree = cKDTree(others[numbers], boxsize=lengths)
    parts = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for start in range(0, len(some), CHUNK):
        chunk = cKDTree(some[start : start + CHUNK], boxsize=lengths)
        found = chunk.sparse_distance_matrix(tree, reach, output_type="ndarray")
        parts.append((found["i"] + start, numbers[found["j"]], found["v"]))
    one, other, distances = map(np.concatenate, zip(*parts, strict=True))
    return one, other, distances


def apart(separations: Points, lengths: ArrayLike) -> Points:
    """Return separations (m, d) [m] to the nearest periodic image, in a box with ``lengths`` (d,) [m]."""
    lengths = np.asarray(lengths, dtype=np.float64)
    if not lengths.any():
        return separations
    return np.asarray(separations - lengths * np.rint(separations / np.where(lengths > 0.0, lengths, np.inf)))


def wrapped(positions: Points, lengths: Points) -> Points:
    """Move positions (..., d) into the range [0, length) along periodic axes."""
    if not lengths.any():
        return positions
    safe = np.where(lengths > 0.0, lengths, 1.0)
    remainder = np.mod(positions, safe)
    return np.where(lengths > 0.0, np.where(remainder >= safe, 0.0, remainder), positions)


MOST_AVERAGE_COMPRESSION = 0.1
"""Greatest mean of the initial compression, which is the excess of the relative number density over 1."""
MOST_DENSITY = 1.5
"""Largest relative number density of an initial particle."""
NOTED_COMPRESSION = 0.03
"""Mean compression above which a warning is given."""
NOTED_DENSITY = 0.5
"""Relative number density below which particles are too far apart for a fluid."""
AT_ONE_PLACE = 1e-3


def check_crowding(
    what: str,
    positions: Points,
    kernel: SmoothingKernel,
    support: float,
    volume: float,
    spacing: float,
    period: Period,
    bodies: Sequence[str] | NDArray[np.str_] = (),
) -> str | None:
    """Return a warning if particles are crowded or too far apart, or None. Raises `InputError` if the particles would
    burst apart. ``what`` names the particles in the plural, and ``bodies`` (n,) names each particle's body of fluid.
    ``volume`` is the volume of a particle at rest [m^d]."""
    point, other, distances = pairs_within(positions, positions, support, *period)
    seen = volume * kernel.weight(distances, positions.shape[1], support)
    densities = np.bincount(point, seen)  # relative to the lattice
    average, greatest = _compression(densities), densities.max()
    fit = spacing * float(np.quantile(densities, 0.75)) ** (-1.0 / positions.shape[1])  # away from the surface
    advice = f"discretisation.spacing is {spacing:g} m, and these points would fit one of {fit:.3g} m"
    if average > MOST_AVERAGE_COMPRESSION or greatest > MOST_DENSITY:
        if len(bodies):
            _check_meeting(np.asarray(bodies), positions, point, other, seen)
        place = point_in_words(positions[densities.argmax()])
        raise InputError(
            f"{what[0].upper()}{what[1:]} have {greatest:.3g} times the rest density at {place} m and are compressed "
            f"by {average:.0%} on average, but must have at most {MOST_DENSITY:g} times and be compressed by at most "
            f"{MOST_AVERAGE_COMPRESSION:.0%}: {advice}."
        )
    if average > NOTED_COMPRESSION:
        return f"{what} are compressed by {average:.0%} on average, and will fly apart: {advice}."
    if greatest < NOTED_DENSITY:
        return f"{what} have {greatest:.2g} times the rest density at most, and hardly touch each other: {advice}."
    return None


def _compression(densities: NDArray[Any]) -> float:
    return float(np.maximum(densities - 1.0, 0.0).mean())


def _check_meeting(
    bodies: NDArray[np.str_], positions: Points, point: Numbers, other: Numbers, seen: NDArray[Any]
) -> None:
    """``seen`` (k,) is the density contribution of each pair of particles."""
    foreign = bodies[point] != bodies[other]
    together, added = np.bincount(point, seen), np.bincount(point, seen * foreign)
    alone = together - added
    if alone.max() > MOST_DENSITY or _compression(alone) > MOST_AVERAGE_COMPRESSION:
        return
    worst = int(np.argmax(np.where(added > 0.0, together, 0.0)))
    near = np.flatnonzero(foreign & (point == worst))
    second, first = sorted((bodies[worst], bodies[other[near[np.argmax(seen[near])]]]), reverse=True)
    place = point_in_words(positions[worst])
    raise InputError(
        f"{second} is overlapping {first} at {place} m, where both together have {together[worst]:.3g} times the "
        f"rest density, but must have at most {MOST_DENSITY:g} times, and be compressed by at most "
        f"{MOST_AVERAGE_COMPRESSION:.0%} on average: move one away from the other."
    )


def check_apart(what: str, positions: Points, spacing: float, period: Period) -> None:
    first, second, _ = pairs_within(positions, positions, AT_ONE_PLACE * spacing, *period)
    pairs = np.flatnonzero(first < second)
    if pairs.size:
        one, other = first[pairs[0]], second[pairs[0]]
        raise InputError(
            f"{what} has particles {one} and {other} at one place, {point_in_words(positions[one])} m, but must have "
            f"them about a spacing, {spacing:g} m, apart."
        )


def nearest(positions: Points) -> NDArray:
    """Return the distance from each particle (n, d) [m] to its nearest neighbour (n,) [m]."""
    from scipy.spatial import cKDTree

    return cKDTree(positions).query(positions, k=2)[0][:, 1]


@cache
def _in_bands() -> Any:
    import warp as wp

    from cortado.device.launching import BandLauncher

    return BandLauncher(wp.get_device("cpu"))


def launch_on_cpu(kernel: Any, threads: int, **arguments: Any) -> None:
    """Arguments may be NumPy arrays. No two threads may write to the same element."""
    from cortado.device.threads import WARP

    if threads:
        with WARP:
            _in_bands()(kernel, threads, **_shared(arguments))


def recorded_on_cpu(kernel: Any, threads: int, **arguments: Any) -> Callable[[], None]:
    """Return a function that launches a kernel with these arguments, which may be NumPy arrays. Repeated launches are
    cheaper than by `launch_on_cpu`. Repeated launches use one core, so that threads may write to the same element."""
    from cortado.device.launching import recorded
    from cortado.device.threads import WARP

    if not threads:
        return lambda: None
    with WARP:
        launch = recorded(kernel, threads, _in_bands().device, **_shared(arguments))
    return WARP(launch)


def _shared(arguments: Mapping[str, Any]) -> dict[str, Any]:
    return {name: shared(x) if isinstance(x, np.ndarray) else x for name, x in arguments.items()}


def shared(values: NDArray[Any], dtype: Any = None) -> Any:
    """The array shares the memory of ``values``. The last of several axes becomes the components of vectors."""
    import warp as wp

    types = {"float64": (wp.float64, wp.vec3d), "int32": (wp.int32, wp.vec3i), "bool": (wp.bool, None)}
    found = dtype or types[values.dtype.name][values.ndim > 1]
    return wp.array(values, dtype=found, device="cpu", copy=False)
