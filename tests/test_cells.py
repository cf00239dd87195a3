"""The sort by cell, pairs of near points, and how full a neighbourhood is, against NumPy and all pairs."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from cortado.device.cells import CellSort, cell_kernels
from cortado.device.grid import Grid
from cortado.device.launching import launch
from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.discretise.shapes import pairs_within
from cortado.sph.moment_functions import moment_functions

CPU = wp.get_device("cpu")
REACH = 0.1
CUBE = Grid.around(np.zeros(3), np.ones(3), np.zeros(3), REACH, 10**4)
GRIDS = {
    "cube": CUBE,
    "plane": Grid.around(np.zeros(2), np.ones(2), np.zeros(2), REACH, 10**4),
    "periodic": Grid.around(np.zeros(3), np.ones(3), np.ones(3), REACH, 10**4),
    "few cells": Grid.around(np.zeros(3), np.ones(3), np.zeros(3), REACH, 27),
    "one cell": Grid.around(np.zeros(2), np.full(2, REACH), np.full(2, REACH), REACH, 1),
}

precisions = pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=lambda precision: precision.name)


def vectors(positions: np.ndarray, precision: Precision) -> wp.array:
    return wp.array(positions.astype(precision.numpy), dtype=precision.vector, device=CPU)


def cells_of(positions: np.ndarray, grid: Grid, precision: Precision, members: int) -> np.ndarray:
    """(members n,) the cell of each particle of so many scenes."""
    real = precision.numpy
    s = (positions.astype(real) - grid.origin.astype(real)) * (1.0 / grid.cell).astype(real)
    c = np.floor(s).astype(np.int64) % np.array(grid.shape)
    member = np.repeat(np.arange(members), len(positions) // members)
    return ((member * grid.shape[2] + c[:, 2]) * grid.shape[1] + c[:, 1]) * grid.shape[0] + c[:, 0]


def check(sort: CellSort, positions: np.ndarray, grid: Grid, precision: Precision, members: int) -> None:
    sort(vectors(positions, precision))
    cells = cells_of(positions, grid, precision, members)
    np.testing.assert_array_equal(sort.order.numpy(), np.argsort(cells, kind="stable"))
    wanted = np.searchsorted(np.sort(cells), np.arange(members * grid.cells + 1))
    np.testing.assert_array_equal(sort.grid.starts.numpy(), wanted)


def cloud(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 3))


@precisions
@pytest.mark.parametrize(("particles", "members"), [(1, 3), (500, 1), (500, 3)])
@pytest.mark.parametrize("name", GRIDS)
def test_cells_in_order_and_ties_as_given(name, particles, members, precision):
    grid = GRIDS[name]
    sort = CellSort(grid, particles, precision, CPU, members)
    for seed, spread in enumerate((1.0, 0.05, 30.0, 0.0)):  # all over, crowded, far outside, in one place
        check(sort, spread * (cloud(members * particles, seed) - 0.3), grid, precision, members)


@precisions
@pytest.mark.parametrize("lost", [np.nan, np.inf, -1e30, 3e9])
def test_particles_that_are_astray_crowd_no_cell(lost, precision):
    """All of one scene of three, with one coordinate that is no good; the others are sorted as ever."""
    positions, n = cloud(6000), 2000
    positions[n : 2 * n, 1] = lost
    sort = CellSort(CUBE, n, precision, CPU, 3)
    with np.errstate(all="ignore"):
        sort(vectors(positions, precision))
    starts, order = sort.grid.starts.numpy(), sort.order.numpy()
    assert np.diff(starts[CUBE.cells : 2 * CUBE.cells + 1]).max() == -(-n // CUBE.cells)
    np.testing.assert_array_equal(np.sort(order[n : 2 * n]), np.arange(n, 2 * n))
    for member in (0, 2):
        own = slice(member * n, (member + 1) * n)
        cells = cells_of(positions[own], CUBE, precision, 1)
        np.testing.assert_array_equal(order[own], member * n + np.argsort(cells, kind="stable"))


def test_the_order_does_not_depend_on_who_arrives_first():
    """On a GPU particles arrive in any order; here they are shuffled within their cells by hand."""
    random, n = np.random.default_rng(1), 3000
    cells = np.sort(random.integers(0, 400, n))
    placed, before = np.zeros(n, dtype=np.int32), np.full(n + 1, -1, dtype=np.int32)
    for cell in np.unique(cells):
        own = np.flatnonzero(cells == cell)
        placed[own], before[own] = random.permutation(own), np.arange(len(own))
    assert (placed != np.arange(n)).any()
    order = wp.empty(n, dtype=wp.int32, device=CPU)
    arrays = {"placed": wp.array(placed, device=CPU), "before": wp.array(before, device=CPU)}
    launch(cell_kernels(FLOAT64).rank, n, CPU, **arrays, order=order)
    np.testing.assert_array_equal(order.numpy(), np.arange(n))


def test_after_an_interruption_the_next_sort_is_right(monkeypatch):
    positions, sort = cloud(300), CellSort(CUBE, 300, FLOAT64, CPU)

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(wp.utils, "array_scan", interrupted)
        sort(vectors(positions, FLOAT64))
    check(sort, positions, CUBE, FLOAT64, 1)


def test_a_captured_sort_follows_the_positions():
    sort, x = CellSort(CUBE, 400, FLOAT64, CPU), vectors(cloud(400), FLOAT64)
    sort(x)
    with wp.ScopedCapture(device=CPU) as capture:
        sort(x)
    for seed in (1, 2):
        x.assign(cloud(400, seed))
        wp.capture_launch(capture.graph)
        cells = cells_of(cloud(400, seed), CUBE, FLOAT64, 1)
        np.testing.assert_array_equal(sort.order.numpy(), np.argsort(cells, kind="stable"))


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp cannot compile for a GPU")
@precisions
def test_the_kernels_compile_for_a_gpu_that_is_not_there(precision, tmp_path):
    wp.compile_aot_module(cell_kernels(precision).count.module, arch=90, module_dir=str(tmp_path))


@pytest.mark.parametrize("lengths", [(1.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_pairs_are_those_of_all_pairs(monkeypatch, lengths):
    random = np.random.default_rng(3)
    some, others = random.uniform(0.0, 1.0, (300, 3)), random.uniform(-0.2, 1.4, (200, 3))
    apart = (some[:, None] - others) - np.array(lengths) * np.round(some[:, None] - others)
    distances = np.linalg.norm(apart, axis=-1)
    monkeypatch.setattr("cortado.discretise.shapes.CHUNK", 70)
    first, second, found = pairs_within(some, others, 0.3, np.full(3, 0.1), lengths)
    assert len(first) == np.count_nonzero(distances <= 0.3) > 1000
    np.testing.assert_allclose(found, distances[first, second], atol=1e-12)
    assert len(np.unique(np.stack([first, second]), axis=1).T) == len(first)


def test_a_point_just_below_the_period_is_in_it_and_no_points_have_no_pairs():
    points = np.array([[-1e-18, 0.0], [0.9, 0.0]])  # the remainder of the first is the length itself
    assert sorted(pairs_within(points, points, 0.15, 0.0, [1.0, 0.0])[2].round(12)) == [0.0, 0.0, 0.1, 0.1]
    none = np.zeros((0, 3))
    assert [len(part) for part in pairs_within(none, none, 0.1)] == [0, 0, 0]


LEAST = 1e-3
"""H that nothing depends on: what is done to a particle begins at 0.1."""


def fullness(precision, dimension, moments):
    """H of moments (n, 3, 3), as kernels find it."""
    function, matrix = moment_functions(precision, dimension).fullness, precision.matrix

    @wp.kernel(module="unique")
    def find(M: wp.array(dtype=matrix), H: wp.array(dtype=precision.real)):
        i = wp.tid()
        H[i] = function(M[i])

    found = wp.zeros(len(moments), dtype=precision.real, device="cpu")
    given = wp.array(moments, dtype=matrix, device="cpu")
    wp.launch(find, len(moments), inputs=[given], outputs=[found], device="cpu")
    return found.numpy()


def moments_of(precision, neighbours):
    """(n, 3, 3) of neighbours (n, k, 3) within a distance of 1, summed up in a precision."""
    x = neighbours.astype(precision.numpy)
    closeness = (1.0 - np.linalg.norm(x, axis=2, keepdims=True)).clip(0.0) ** 3
    return np.einsum("nki,nkj->nij", (closeness * x).astype(precision.numpy), x).astype(precision.numpy)


@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64])
@pytest.mark.parametrize("neighbours", [1, 2, 3])
def test_neighbours_on_a_line_fill_nothing(precision, neighbours):
    """Two drops that fly side by side have moments whose invariants are rounding alone."""
    random = np.random.default_rng(neighbours)
    directions = random.normal(size=(100_000, 1, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    line = directions * random.uniform(-1.0, 1.0, (100_000, neighbours, 1))
    assert np.abs(fullness(precision, 3, moments_of(precision, line))).max() < LEAST


@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64])
def test_elsewhere_it_is_what_the_invariants_say(precision):
    random = np.random.default_rng(0)
    M = moments_of(precision, random.uniform(-0.5, 0.5, (1_000, 12, 3))).astype(float)
    second = 0.5 * (np.trace(M, axis1=1, axis2=2) ** 2 - np.einsum("nij,nji->n", M, M))
    found = fullness(precision, 3, M)
    np.testing.assert_allclose(found, 3.0 * np.linalg.det(M) / second, rtol=3e-4 if precision is FLOAT32 else 1e-9)
    M[:, 2], M[:, :, 2], M[:, 2, 2] = 0.0, 0.0, 1.0
    flat = M[:, :2, :2]
    wanted = 2.0 * np.linalg.det(flat) / np.trace(flat, axis1=1, axis2=2)
    np.testing.assert_allclose(fullness(precision, 2, M), wanted, rtol=1e-4 if precision is FLOAT32 else 1e-9)
