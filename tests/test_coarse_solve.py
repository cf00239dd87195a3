"""Solves on the coarse grid of the pressure, against dense ones."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from cortado.device.launching import KernelLauncher
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.solvers.projection.coarse_levels import Levels

SHAPES = {
    "plane": (2, (10, 8, 1)),
    "one level": (2, (5, 7, 1)),
    "period of three": (2, (3, 12, 1)),
    "space": (3, (6, 5, 4)),
}


def system(dimension, shape, rng, empty=0.3):
    """A of each offset and node, dense A and the nodes that have one: sums over cells of q q^T of their corners."""
    n = np.array(shape)
    cells = np.stack(np.meshgrid(*(np.arange(k) for k in shape), indexing="ij"), -1).reshape(-1, 3)
    corners = np.array([[c & 1, (c >> 1) & 1, c >> 2] for c in range(2**dimension)])

    def number(at):
        return np.ravel_multi_index(tuple((at % n)[::-1]), shape[::-1])

    steps = np.array([[o % 3 - 1, o // 3 % 3 - 1, (o // 9 - 1) * (dimension == 3)] for o in range(3**dimension)])
    stencil, dense = np.zeros((3**dimension, n.prod())), np.zeros((n.prod(), n.prod()))
    for cell in cells[rng.random(len(cells)) > empty]:
        q = rng.normal(size=(4, len(corners)))
        q[0] = 0.1
        part = q.T @ q
        for a, one in enumerate(corners):
            for b, other in enumerate(corners):
                offset = np.flatnonzero((steps == other - one).all(1))[0]
                stencil[offset, number(cell + one)] += part[a, b]
                dense[number(cell + one), number(cell + other)] += part[a, b]
    return stencil, dense, np.diag(dense) > 0.0


@pytest.mark.parametrize("case", SHAPES)
@pytest.mark.parametrize("precision, tolerance, most", [(FLOAT64, 1e-14, 1e-11), (FLOAT32, 3e-7, 1e-3)])
def test_a_solve_is_the_dense_one_for_each_scene(case, precision, tolerance, most):
    """With two rows of B, which are a large part of the matrix."""
    (dimension, shape), rng = SHAPES[case], np.random.default_rng(3)
    made = [system(dimension, shape, rng) for _ in range(2)]
    levels = Levels(precision, dimension, shape, 2, wp.get_device("cpu"), rows=2)
    rows = [rng.normal(size=(2, np.prod(shape))) * full for _, _, full in made]
    levels.B.assign(np.concatenate(rows, axis=1))
    r = rng.normal(size=(2, np.prod(shape))) * [full for _, _, full in made]
    levels.A.assign(np.concatenate([stencil for stencil, _, _ in made], axis=1))
    levels.begin(SimpleNamespace(launch=KernelLauncher(1, levels.A.device, False)))
    levels.r.assign(r.ravel())
    e = wp.zeros_like(levels.r)
    levels.solve(e, tolerance, 1_000)
    found = e.numpy().reshape(2, -1)
    for (_, dense, full), B, one, wanted in zip(made, rows, found, r, strict=True):
        exact = np.linalg.solve((dense + B.T @ B)[np.ix_(full, full)], wanted[full])
        np.testing.assert_allclose(one[full], exact, atol=most * np.abs(exact).max())
        assert not one[~full].any()
    assert (levels.count.numpy() < 60).all()


def test_what_is_not_finite_is_solved_by_nothing():
    levels = Levels(FLOAT64, 2, (4, 4, 1), 1, wp.get_device("cpu"))
    levels.r.fill_(np.nan)
    e = wp.full_like(levels.r, 7.0)
    levels.solve(e, 1e-14, 1_000)
    assert not e.numpy().any()
