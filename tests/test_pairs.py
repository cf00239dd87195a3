"""Pairs of near points against all pairs."""

import numpy as np
import pytest

from cortado.discretise.pairs import pairs_within


@pytest.mark.parametrize("lengths", [(1.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_pairs_are_those_of_all_pairs(monkeypatch, lengths):
    random = np.random.default_rng(3)
    some, others = random.uniform(0.0, 1.0, (300, 3)), random.uniform(-0.2, 1.4, (200, 3))
    apart = (some[:, None] - others) - np.array(lengths) * np.round(some[:, None] - others)
    distances = np.linalg.norm(apart, axis=-1)
    monkeypatch.setattr("cortado.discretise.pairs.CHUNK", 70)
    first, second, found = pairs_within(some, others, 0.3, np.full(3, 0.1), lengths)
    assert len(first) == np.count_nonzero(distances <= 0.3) > 1000
    np.testing.assert_allclose(found, distances[first, second], atol=1e-12)
    assert len(np.unique(np.stack([first, second]), axis=1).T) == len(first)


def test_a_point_just_below_the_period_is_in_it():
    points = np.array([[-1e-18, 0.0], [0.9, 0.0]])  # the remainder of the first is the length itself
    assert sorted(pairs_within(points, points, 0.15, 0.0, [1.0, 0.0])[2].round(12)) == [0.0, 0.0, 0.1, 0.1]


def test_no_points_have_no_pairs():
    none = np.zeros((0, 3))
    assert [len(part) for part in pairs_within(none, none, 0.1)] == [0, 0, 0]
