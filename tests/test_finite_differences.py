"""A derivative that is right is on a plateau of differences; one that a single step happens to hit is not."""

import numpy as np
import pytest

from finite_differences import central_difference, decades, distance, plateau

POINT, ALONG = {"x": np.array(1.0), "y": np.array(5.0)}, {"x": np.array(1.0)}


def cube(values):
    """Its central difference is 3 x^2 + h^2."""
    return float(values["x"] ** 3)


def test_a_right_derivative_is_on_a_plateau():
    assert central_difference(cube, POINT, ALONG, 0.1) == pytest.approx(3.01, rel=1e-13)
    assert distance(cube, POINT, ALONG, 3.0, decades(1.0, 6.0)) < 1e-9


def test_a_chance_agreement_is_none():
    wrong, steps = 3.0 + 1e-4, decades(1.0, 6.0)
    nearest = min(abs(central_difference(cube, POINT, ALONG, h) - wrong) for h in steps)
    assert nearest < 1e-12  # at h = 0.01
    assert distance(cube, POINT, ALONG, wrong, steps, enough=1e-6) > 1e-5


def test_a_plateau_is_of_neighbours():
    assert plateau([1.0, 0.1, 5.0, 0.2, 0.3, 0.1, 9.0]) == 0.3
    with pytest.raises(AssertionError):
        plateau([0.1, 0.1])
