"""How full a neighbourhood is, by its second moment, also where that is nearly singular."""

import numpy as np
import pytest
import warp as wp

from cortado.device.precision import FLOAT32, FLOAT64
from cortado.sph.moment_functions import matrix_type, moment_functions

LEAST = 1e-3
"""H that nothing depends on: what is done to a particle begins at 0.1."""


def fullness(precision, dimension, moments):
    """H of moments (n, 3, 3), as kernels find it."""
    function, matrix = moment_functions(precision, dimension).fullness, matrix_type(precision)

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
