"""Neighbour lists against all pairs: whatever the dimension, the periods, the precision and the place."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from cortado.device.grid import Grid
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.discretise.smoothing import CUBIC_SPLINE, SKIN
from cortado.particles import neighbours as candidates
from cortado.particles.moving_walls import WallArrays
from cortado.particles.neighbourhood import UNROLL, Discretisation, neighbourhood_type
from cortado.particles.neighbours import NeighbourSearch
from cortado.particles.state import Layout
from test_cells import cells_of

SUPPORT = 0.1
REACH = (1 + SKIN) * SUPPORT
CPU = wp.get_device("cpu")
GUARD = -7

precisions = pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=lambda precision: precision.name)


def padded(vectors: np.ndarray) -> np.ndarray:
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def walls_at(places: np.ndarray) -> WallArrays:
    """With their numbers as weights, so that sorted walls tell who they were."""
    names, nowhere = np.arange(len(places), dtype=np.float64), 0.0 * padded(places)
    return WallArrays(padded(places), names, names, nowhere, nowhere, *[np.full(len(places), -1)] * 2)


def around(search: NeighbourSearch, period: np.ndarray, precision: Precision) -> Any:
    """What `NeighbourSearch.fill` reads of the neighbourhood, as `ParticleSolver.resize` sets it."""
    s = neighbourhood_type(precision)()
    s.particles = search.particles
    s.neighbours, s.fluid_count = search.neighbours, search.fluid_count
    s.filling, s.count = search.filling, search.count
    s.wall_positions, s.wall_weights = search.walls["wall_positions"], search.walls["wall_weights"]
    s.support, s.reach = SUPPORT, REACH
    s.period = precision.vector(*padded(period[None])[0])
    s.frequency = precision.vector(*(1.0 / length if length else 0.0 for length in padded(period[None])[0]))
    return s


@dataclass(frozen=True)
class Found:
    """Lists of a search, in the order in which the particles were given."""

    search: NeighbourSearch
    grid: Grid
    order: np.ndarray
    fluid: list[np.ndarray]
    walls: list[np.ndarray]
    needed: int
    rows: np.ndarray
    """(n, capacity + guard) the memory of the sorted lists."""
    lengths: np.ndarray


def lists(
    positions: np.ndarray,
    period: Any = 0.0,
    walls: np.ndarray | None = None,
    precision: Precision = FLOAT64,
    capacity: int = 400,
    grid_over: tuple[np.ndarray, np.ndarray] | None = None,
    most: int = 4096,
    kind: type[Discretisation] = Discretisation,
    lanes: int = 1,
    device: Any = CPU,
) -> Found:
    """Neighbours of positions (n, d) by the engine; the memory behind the lists is guarded."""
    n, dimension = positions.shape
    period = np.broadcast_to(np.asarray(period, dtype=np.float64), dimension)
    walls = np.zeros((0, dimension)) if walls is None else walls
    everything = np.concatenate([positions, walls])
    lower, upper = grid_over or (everything.min(axis=0), everything.max(axis=0))
    lower = np.where(period > 0, 0.0, lower)
    grid = Grid.around(lower, upper, period, REACH, most)
    discretisation = kind(CUBIC_SPLINE, precision, lanes, periodic=any(period))
    search = NeighbourSearch(discretisation, grid, walls_at(walls), Layout(n, 1, precision, device), capacity)
    memory = wp.full((n, capacity + 8) if device.is_cpu else (capacity + 8, n), GUARD, dtype=wp.int32, device=device)
    search.neighbours = memory[:, :capacity].transpose((1, 0)) if device.is_cpu else memory[:capacity]
    neighbourhood = around(search, period, precision)
    given_positions = padded(positions).astype(precision.numpy)
    search.sort(wp.array(given_positions, dtype=precision.vector, device=device))
    order = search.order.numpy()[:n]
    nothing_lost = wp.full(1, -1, dtype=wp.int32, device=device)
    search.fill(neighbourhood, wp.array(given_positions[order], dtype=precision.vector, device=device), nothing_lost)
    rows = memory.numpy() if device.is_cpu else memory.numpy().T
    fluid_count, count = search.fluid_count.numpy(), search.count.numpy()
    own = fluid_count - search.filling.numpy()
    wall_names = search.walls["wall_weights"].numpy().astype(int)
    fluid, near_walls = ([np.zeros(0)] * n for _ in range(2))
    for i in range(n):
        fluid[order[i]] = order[rows[i, : own[i]]]
        if capacity == 400:  # else the list may have been cut
            assert (rows[i, own[i] : fluid_count[i]] == i).all(), "a list is filled up with the particle itself"
            assert fluid_count[i] % UNROLL == 0 <= fluid_count[i] - own[i] < UNROLL
        near_walls[order[i]] = wall_names[rows[i, fluid_count[i] : count[i]]]
    return Found(search, grid, order, fluid, near_walls, search.needed, rows, count)


def distances(x: np.ndarray, y: np.ndarray, period: Any, precision: Precision) -> np.ndarray:
    """(n, m) of the nearest image, in float64 from positions as the engine holds them."""
    x, y = (v.astype(precision.numpy).astype(np.float64) for v in (x, y))
    separation = x[:, None] - y[None, :]
    period = np.broadcast_to(np.asarray(period, dtype=np.float64), separation.shape[-1:])
    turns = np.round(separation / np.where(period > 0, period, np.inf))
    return np.linalg.norm(separation - turns * period, axis=-1)


def compare(found: list[np.ndarray], r: np.ndarray, tolerance: float) -> None:
    """Each list holds everybody within reach once and nobody else; pairs at the reach itself may go either way."""
    for i, listed in enumerate(found):
        assert len(np.unique(listed)) == len(listed), f"particle {i} lists a neighbour twice"
        surely, perhaps = (set(np.flatnonzero(r[i] < REACH * (1 + sign * tolerance))) for sign in (-1, 1))
        assert surely <= set(listed), f"particle {i} misses {surely - set(listed)}"
        assert set(listed) <= perhaps, f"particle {i} lists {set(listed) - perhaps}, which are too far away"


def check(positions: np.ndarray, period: Any = 0.0, walls: np.ndarray | None = None, **options: Any) -> Found:
    precision = options.get("precision", FLOAT64)
    found = lists(positions, period, walls, **options)
    size = max(np.abs(positions).max(), REACH) / REACH
    tolerance = 8 * size * np.finfo(precision.numpy).eps
    r = distances(positions, positions, period, precision)
    np.fill_diagonal(r, np.inf)
    compare(found.fluid, r, tolerance)
    pairs = {(i, int(j)) for i, listed in enumerate(found.fluid) for j in listed}
    assert pairs == {(j, i) for i, j in pairs}, "the lists are not symmetric"
    if walls is not None:
        compare(found.walls, distances(positions, walls, period, precision), tolerance)
    longest = max(-(-len(a) // UNROLL) * UNROLL + len(b) for a, b in zip(found.fluid, found.walls, strict=True))
    assert found.needed == longest <= found.search.capacity
    assert (found.rows[:, found.search.capacity :] == GUARD).all()
    check_order(found, positions, precision)
    check_lists(found, positions, precision)
    return found


def check_lists(found: Found, positions: np.ndarray, precision: Precision) -> None:
    cells, shape = cells_of(padded(positions), found.grid, precision, 1), np.array(found.grid.shape)
    c = np.stack([cells % shape[0], cells // shape[0] % shape[1], cells // (shape[0] * shape[1])], axis=1)
    around = [range(-1 if n > 2 else 0, 2 if n > 1 else 1) for n in shape]
    steps = [np.array(step[::-1]) for step in product(*around[::-1])]
    place = np.argsort(found.order)
    for i, listed in enumerate(found.fluid):
        visited = {tuple((c[i] + step) % shape): k for k, step in enumerate(steps)}
        keys = [(visited[tuple(c[j])], place[j]) for j in listed]
        assert keys == sorted(keys), f"the list of particle {i} is in another order"


def check_order(found: Found, positions: np.ndarray, precision: Precision) -> None:
    cells = cells_of(padded(positions), found.grid, precision, 1)
    np.testing.assert_array_equal(found.order, np.argsort(cells, kind="stable"))


def cloud(n: int, dimension: int, size: Any, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, dimension)) * size


@pytest.mark.parametrize(
    ("dimension", "reaches", "precision"),
    [(2, 1.0, FLOAT32), (3, 1.4, FLOAT64), (3, 2.0, FLOAT32), (2, 2.2, FLOAT64), (3, 3.0, FLOAT32), (2, 3.5, FLOAT64)],
)
def test_short_periods(dimension, reaches, precision):
    """With one, two and three cells along an axis no cell is visited twice, and none is left out."""
    size = np.array([reaches, 3.3, reaches])[:dimension] * REACH
    walls = cloud(40, dimension, size, seed=1)
    found = check(cloud(120, dimension, size), period=size, walls=walls, precision=precision)
    assert found.grid.shape[0] == int(reaches)


@precisions
def test_particles_that_went_around_many_times(precision):
    size = np.array([0.52, 0.31, 0.4])
    turns = np.random.default_rng(2).integers(-5, 6, (200, 3))
    check(cloud(200, 3, size) + turns * size, period=size, precision=precision)


@pytest.mark.parametrize(("most", "precision"), [(27, FLOAT32), (64, FLOAT64), (4096, FLOAT32)])
def test_far_outside_of_the_grid(most, precision):
    """The grid wraps around: particles a long way off find one another, and nobody else."""
    positions = cloud(240, 3, 0.4)
    positions[80:160] += [7.3, 0.0, -2.0]
    positions[160:] -= [0.0, 31.7, 0.0]
    walls, grid_over = cloud(30, 3, 0.4, seed=1), (np.zeros(3), np.full(3, 0.4))
    check(positions, walls=walls, grid_over=grid_over, most=most, precision=precision)


def test_lost_particles_harm_nobody():
    """Not a number, infinite, and too large for an integer: no list of the others changes."""
    positions = cloud(100, 3, 0.4)
    grid_over = (np.zeros(3), np.full(3, 0.4))
    before = lists(positions, grid_over=grid_over)
    lost = np.array([[np.nan, 0.1, 0.2], [np.inf, 0.1, 0.2], [0.1, -1e30, 0.2], [3e9, 3e9, -3e9]])
    with np.errstate(all="ignore"):
        after = lists(np.concatenate([positions, lost]), grid_over=grid_over)
    for i in range(100):
        assert set(before.fluid[i]) == set(after.fluid[i])
    assert all(len(after.fluid[i]) == 0 for i in range(100, 104))
    assert check(np.array([[0.3, 0.2, 0.1]])).needed == 0  # nor does being alone


@precisions
def test_coincident_particles(precision):
    positions = np.repeat(cloud(20, 3, 0.2), 4, axis=0)
    found = check(positions, walls=positions[:8].copy(), precision=precision)
    assert all({4 * (i // 4) + k for k in range(4)} - {i} <= set(listed) for i, listed in enumerate(found.fluid))


NEARER, FARTHER = 1 + 0.99 * SKIN, 1 + 1.01 * SKIN


@precisions
@pytest.mark.parametrize("distance, listed", [(1.0, True), (NEARER, True), (FARTHER, False)])
def test_how_far_the_lists_reach(distance, listed, precision):
    found = check(np.array([[0.2, 0.2], [0.2 + distance * SUPPORT, 0.2]]), precision=precision)
    assert (len(found.fluid[0]) == 1) is listed


@precisions
def test_a_crowd_in_one_cell(precision):
    positions = 0.05 + cloud(150, 3, 0.04)
    found = check(positions, walls=cloud(70, 3, 0.1, seed=1), precision=precision, grid_over=(np.zeros(3), np.ones(3)))
    assert all(len(listed) == 149 for listed in found.fluid)


class FewLanes(Discretisation):
    """Scans as with a few lanes, of which a CPU has one."""

    def module(self, forward, topic):
        return super().module(forward, f"{topic}_{type(self).__name__}")


class ManyLanes(FewLanes):
    """Scans as with many lanes, of which a CPU has one."""


CLOUDS = {
    "space": (cloud(300, 3, 0.6), {}),
    "plane": (cloud(300, 2, 0.6), {}),
    "period": (cloud(200, 3, [0.52, 0.43, 0.37]), {"period": [0.52, 0.43, 0.37]}),
    "period along x": (cloud(200, 2, [0.52, 0.43]), {"period": [0.52, 0.0]}),
    "short periods": (cloud(120, 3, [0.12, 0.22, 0.33]), {"period": [0.12, 0.22, 0.33]}),
    "far outside": (cloud(240, 3, 0.4) - [[31.7, 7.3, 0.0]], {"grid_over": (np.zeros(3), np.full(3, 0.4)), "most": 64}),
    "crowd": (cloud(90, 3, 0.05), {}),
    "alone": (np.full((1, 3), 0.3), {}),
    "lost": (np.concatenate([cloud(60, 3, 0.3), np.full((5, 3), np.nan)]), {"grid_over": (np.zeros(3), np.ones(3))}),
}


def check_same(found: Found, wanted: Found) -> None:
    """The same lists, to the order of what they list."""
    np.testing.assert_array_equal(found.order, wanted.order)
    np.testing.assert_array_equal(found.lengths, wanted.lengths)
    np.testing.assert_array_equal(found.search.fluid_count.numpy(), wanted.search.fluid_count.numpy())
    np.testing.assert_array_equal(found.search.filling.numpy(), wanted.search.filling.numpy())
    assert found.needed == wanted.needed
    assert (found.rows[:, found.search.capacity :] == GUARD).all(), "something was written behind the end of a list"
    for ours, theirs, length in zip(found.rows, wanted.rows, wanted.lengths, strict=True):
        np.testing.assert_array_equal(ours[:length], theirs[:length])


@pytest.mark.parametrize(("kind", "short", "precision"), [(FewLanes, 400, FLOAT32), (ManyLanes, 12, FLOAT64)])
@pytest.mark.parametrize("name", CLOUDS)
def test_lanes_list_the_same_as_one_thread(name, kind, short, precision, monkeypatch):
    positions, options = CLOUDS[name]
    options = options | {"walls": cloud(60, positions.shape[1], 0.4, seed=1), "precision": precision, "capacity": short}
    wanted = lists(positions, **options)
    monkeypatch.setattr(candidates, "scan_by_bits", candidates.scan_by_lanes)
    if kind is ManyLanes:
        monkeypatch.setattr(candidates, "LEAST_AT_ONCE", 1)
    found = lists(positions, **options, kind=kind)
    check_same(found, wanted)


@pytest.mark.parametrize(("capacity", "precision"), [(4, FLOAT64), (24, FLOAT32)])
def test_lists_that_are_too_short_say_how_long_they_must_be(capacity, precision):
    positions, walls = cloud(200, 3, 0.35), cloud(80, 3, 0.35, seed=1)
    full = check(positions, walls=walls, precision=precision)
    short = lists(positions, walls=walls, precision=precision, capacity=capacity)
    assert short.needed == full.needed > capacity
    assert (short.rows[:, capacity:] == GUARD).all(), "something was written behind the end of a list"
    np.testing.assert_array_equal(short.lengths, np.minimum(full.lengths, capacity))
    for row, whole, length in zip(short.rows, full.rows, short.lengths, strict=True):
        np.testing.assert_array_equal(row[:length], whole[:length])


@settings(max_examples=20, deadline=None, database=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 120),
    periodic=st.lists(st.booleans(), min_size=2, max_size=3),
    reaches=st.lists(st.floats(1.0, 9.0), min_size=3, max_size=3),
    walls=st.integers(0, 40),
    single=st.booleans(),
    most=st.sampled_from([1, 30, 4096]),
)
def test_random_clouds(seed, n, periodic, reaches, walls, single, most):
    size = np.array(reaches[: len(periodic)]) * REACH
    particles, wall = (cloud(number, len(size), size, seed + k) for k, number in enumerate((n, walls)))
    check(particles, period=size * periodic, walls=wall, precision=FLOAT32 if single else FLOAT64, most=most)
