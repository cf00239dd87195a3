"""Fits that start in the wrong valley, and those of a rough model, on formulas that take no simulation."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

import cortado
from bad_scenes import assert_one_sentence
from cortado.errors import DivergedError, InputError
from cortado.measured import Experiment
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, Weighting
from cortado.optimisation.fitting.search import other_starts, over_the_bars
from cortado.scene.parameters import Range

TIMES = np.linspace(0.0, 2.0, 40)
SIZE = 0.01
STEP = 1e-6
"""Of differences, in the place of tangents."""


class Formula(Experiment):
    """What is predicted is a function of the logarithm u of one number."""

    start: ClassVar[dict[str, np.ndarray]] = {}
    unseen: ClassVar[dict[str, np.ndarray]] = {}

    def __init__(self, function, true, noise=SIZE, seed=0):
        self.__dict__["function"] = function
        measured = function(np.log(true)) + SIZE * np.random.default_rng(seed).standard_normal(len(TIMES))
        gauge = SimpleNamespace(times=TIMES, measured=measured[:, None], noise=noise, unit="m", start={})
        known = {"viscosity": SimpleNamespace(range=Range.POSITIVE)}
        held = SimpleNamespace(container=None)
        told = {"known": known, "scene": held, "parameters": lambda: {"rest_density": np.ones(1)}}
        self.__dict__ |= {"observations": {"gauge": gauge}, "simulation": SimpleNamespace(**told)}

    def predicted(self, values):
        return {"gauge": self.function(np.log(values["viscosity"]))[:, None]}

    def linearised(self, values, directions):
        u = np.log(values["viscosity"])
        slope = (self.function(u + STEP) - self.function(u - STEP)) / (2.0 * STEP)
        columns = [slope * one.get("viscosity", 0.0) / values["viscosity"] for one in directions]
        return self.predicted(values), {"gauge": np.stack(columns, axis=-1)[:, None, :]}


def behind_a_wall(u):
    """From below, the sum of squares rises to a wall at 0.5."""
    return np.exp(-np.exp(u) * TIMES) + 2.0 * np.exp(-((u - np.log(0.5)) ** 2)) * np.cos(9.0 * TIMES)


def even(u):
    """As likely at v as at 1 / v."""
    return 0.3 * u**2 * TIMES


def rough(u):
    """Wiggles whose slope is that of the trend three times, and which are far narrower than a standard error."""
    return 0.03 * u * TIMES + 0.001 * np.sin(90.0 * u + 3.0 * TIMES)


def flat(u):
    return 1e-4 * u * TIMES


def test_a_start_in_a_wrong_valley_is_left_and_a_good_one_costs_no_more():
    made = Formula(behind_a_wall, 2.0)
    alone = cortado.fit(made, {"viscosity": 0.1}, starts=1)
    assert alone.in_doubt and alone.values["viscosity"] < 0.5 and "in doubt" in repr(alone)
    found = cortado.fit(made, {"viscosity": 0.1})
    assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=0.05)
    assert len(found.tried) > 1 and found.tried[0].end == pytest.approx(alone.u) and found.runs > alone.runs
    near = cortado.fit(made, {"viscosity": 1.5})
    assert len(near.tried) == 1 and near.runs <= 8 and near.u == pytest.approx(found.u, abs=0.01)


def test_valleys_that_are_as_deep_are_a_doubt():
    found = cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, starts=4)
    assert len(found.tried) == 4
    (doubt,) = found.doubts
    other = 1.0 / found.values["viscosity"]
    assert f"viscosity is {other:.3g}" in doubt and "hardly tells which" in doubt
    assert_one_sentence(doubt)
    assert not cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, {"viscosity": (1.0, 100.0)}, starts=4).doubts


def test_other_starts_lie_within_the_bounds_and_apart_and_the_likeliest_comes_first():
    bounds = {"viscosity": (0.05, 40.0)}
    made = LeastSquares([Formula(behind_a_wall, 2.0)], Coordinates.of({"viscosity": 0.1}, ["viscosity"], bounds))
    found = np.exp(other_starts(made, 3))
    assert made.runs == 8 and len(found) == 3 and ((found > 0.05) & (found < 40.0)).all()
    assert found[0] == pytest.approx(2.0, rel=0.6)
    assert np.diff(np.sort(np.log(found).ravel())).min() > 0.2 * np.log(800.0)


def test_a_start_from_where_runs_diverge_is_none():
    def diverges(u):
        if u > np.log(5.0):
            raise DivergedError(3, 0, "less")
        return behind_a_wall(u)

    found = cortado.fit(Formula(diverges, 2.0), {"viscosity": 0.1})
    assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=0.05)


def test_bars_of_a_rough_model_are_those_of_its_trend():
    """Its tangents alone would make them a third as long."""
    slope, made = 0.03 * TIMES, [Formula(rough, 3.0, seed=seed) for seed in range(8)]
    noise = np.array([one.observations["gauge"].measured[:, 0] - rough(np.log(3.0)) for one in made])
    of_trend = np.log(3.0) + noise @ slope / (slope @ slope)
    fits = [cortado.fit(one, {"viscosity": 1.0}) for one in made]
    bars = np.array([np.sqrt(one.coordinate_covariance[0, 0]) for one in fits])
    assert all(one.converged for one in fits)
    assert 0.7 < np.median(bars) / (SIZE / np.linalg.norm(slope)) < 1.7
    assert (np.abs([one.u[0] for one in fits] - of_trend) < 1.5 * bars).all()


def test_where_tangents_hold_they_stay():
    made = LeastSquares([Formula(behind_a_wall, 2.0)], Coordinates.of({"viscosity": 1.9}, ["viscosity"], None))
    at = made.linearised(np.log([2.0]))
    runs = made.runs
    assert over_the_bars(made, at, [Weighting(SIZE)]) == (at, None) and made.runs == runs + 1


def test_what_is_hardly_told_is_a_doubt():
    found = cortado.fit(Formula(flat, 3.0), {"viscosity": 1.0}, starts=1)
    assert any("hardly tells viscosity" in one for one in found.doubts)


def test_what_is_explained_to_the_last_bit_is_not_doubted():
    made = Formula(behind_a_wall, 2.0)
    made.observations["gauge"].measured = made.predicted({"viscosity": np.array(2.0)})["gauge"]
    made.observations["gauge"].noise = None
    for start in (2.0, 1.5):
        found = cortado.fit(made, {"viscosity": start}, starts=3)
        assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize("starts", [0, 1.5, "many"])
def test_wrong_starts_are_a_sentence(starts):
    with pytest.raises(InputError, match="starts is") as error:
        cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, starts=starts)
    assert_one_sentence(str(error.value))
