"""Rotations by rotation vectors, and how they change with these, against series of the matrix exponential."""

from math import factorial

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from cortado.device.precision import FLOAT64
from cortado.sph.rotations import SMALL, rotations

VECTOR, REAL = FLOAT64.vector, FLOAT64.real
SPACE = rotations(FLOAT64, 3)
NEAR = SMALL**0.5
SIZES = [0.0, 1e-9, 1e-3, 0.9 * NEAR, 0.999 * NEAR, 1.001 * NEAR, 0.3, 3.0]
"""Of turns [rad]: on both sides of where a series ends."""


@wp.kernel(enable_backward=False)
def all_of(
    turn: wp.array(dtype=VECTOR),
    change: wp.array(dtype=VECTOR),
    bar: wp.array(dtype=VECTOR),
    # out
    columns: wp.array2d(dtype=VECTOR),
    further: wp.array(dtype=VECTOR),
    back: wp.array(dtype=VECTOR),
):
    i = wp.tid()
    for k in range(3):
        axis = VECTOR()
        axis[k] = REAL(1.0)
        columns[i, k] = wp.static(SPACE.rotation)(turn[i]) * axis
    further[i] = wp.static(SPACE.further)(turn[i], change[i])
    back[i] = wp.static(SPACE.back)(turn[i], bar[i])


def found(turn, change, bar):
    """(n, 3, 3) rotations, and (n, 3) further changes and adjoints."""
    n = len(turn)
    out = [wp.zeros(shape, dtype=VECTOR, device="cpu") for shape in ((n, 3), n, n)]
    given = [wp.array(values, dtype=VECTOR, device="cpu") for values in (turn, change, bar)]
    wp.launch(all_of, n, [*given, *out], device="cpu")
    columns, further, back = (array.numpy() for array in out)
    return columns.transpose(0, 2, 1), further, back


def jacobian(w):
    """J(w) = sum_k [w]^k / (k + 1)!."""
    cross, power, total = np.cross(w, np.eye(3)).T, np.eye(3), np.zeros((3, 3))
    for k in range(40):
        total += power / factorial(k + 1)
        power = power @ cross
    return total


@pytest.mark.parametrize("size", SIZES)
def test_a_rotation_and_its_changes(size):
    random = np.random.default_rng(4)
    turn, change, bar = random.normal(size=(3, 20, 3))
    turn *= size / np.linalg.norm(turn, axis=1, keepdims=True)
    matrices, further, back = found(turn, change, bar)
    wanted = np.array([jacobian(w) for w in turn])
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(further, np.einsum("nab,nb->na", wanted, change), atol=3e-15)
    np.testing.assert_allclose(back, np.einsum("nab,na->nb", wanted, bar), atol=3e-15)


def test_the_series_is_that_of_a_rotation():
    """R(w + w') R(w)^T turns by J(w) w'."""
    random = np.random.default_rng(5)
    w, change, h = random.normal(size=3), random.normal(size=3), 1e-5
    ahead, behind = (Rotation.from_rotvec(w + sign * h * change) for sign in (1.0, -1.0))
    np.testing.assert_allclose((ahead * behind.inv()).as_rotvec() / (2.0 * h), jacobian(w) @ change, atol=1e-9)
