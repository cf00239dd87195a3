"""The leaderboard of gradient estimators: a cell is computed once, and the truth knows how wrong it is."""

import json

import numpy as np
import pytest
from scipy.stats import t as student

from benchmarks.counting import Counted, Steps
from benchmarks.gradients import scenes
from benchmarks.gradients.__main__ import main
from benchmarks.gradients.cells import Cell
from benchmarks.gradients.certificates import main as certificates
from benchmarks.gradients.controls import CONTROLS, VelocityModes
from benchmarks.gradients.coverage import REFERENCE, Intervals, coverage
from benchmarks.gradients.over_scenes import over_scenes
from benchmarks.gradients.results import Results
from benchmarks.gradients.table import ceiling, cosine, table
from benchmarks.gradients.truth import SAMPLES, smoothed
from cortado import InputError, Problem, Scene, Simulation
from cortado.gradients import EnsembleMean, Exact, RandomizedSmoothing
from cortado.optimisation.transforms import Transformed

TINY = scenes.dam(0.1, (3, 3))


@pytest.fixture(scope="module")
def simulation():
    return Simulation(Scene(**TINY), precision="float64")


@pytest.fixture
def tiny(monkeypatch):
    """A scene of nine particles on the leaderboard."""
    monkeypatch.setitem(scenes.SCENES, "tiny", TINY)


def words(path, *more):
    cell = {"scenes": "tiny", "controls": "velocity-modes", "losses": "centre-of-mass", "horizons": 2, "seeds": 5}
    options = [word for name, value in cell.items() for word in (f"--{name}", str(value))]
    return [str(path), *options, "--estimators", "exact", *more]


def test_a_cell_is_computed_and_a_killed_command_goes_on(tiny, tmp_path, capsys):
    path = tmp_path / "results.jsonl"
    assert main(words(path)) == 0
    whole = path.read_bytes()
    head, *records = map(json.loads, whole.splitlines())
    assert head["settings"]["precision"] == "float64"
    assert [Cell.of(record).estimator for record in records] == ["truth", "exact"]
    assert records[1]["cost"] == 2 * (1 + 3)
    assert records[0]["cost"] == 2 * (1 + SAMPLES * 2 * 8)
    first = capsys.readouterr().out
    assert "| exact | 1.00 [1.00] 1 | 4 |" in first

    path.write_bytes(whole[:-20])  # killed while it wrote the second record
    assert main(words(path)) == 0
    again = [json.loads(line) for line in path.read_bytes().splitlines()]
    assert again[:2] == [head, records[0]]  # not computed again: even the seconds are the same
    assert again[2]["derivatives"] == records[1]["derivatives"]

    capsys.readouterr()
    before = path.read_bytes()
    assert main(words(path, "--table")) == 0
    assert capsys.readouterr().out == first and path.read_bytes() == before


def test_every_scene_is_one():
    assert all(scenes.scene(name).dimension == (3 if name.startswith("space") else 2) for name in scenes.SCENES)


@pytest.mark.parametrize("name", [name for name in CONTROLS if name != "nozzle-path"])
def test_controls_have_the_shape_of_their_parameter(simulation, name):
    control, steps = CONTROLS[name], 32
    u = control.drawn(simulation, steps, np.random.default_rng(0))
    bijector = control.bijector(simulation, steps)
    p = bijector.parameter(u)
    assert p.shape == (simulation.positions.shape if name == "velocity-modes" else (steps, 2))
    bar = np.random.default_rng(1).standard_normal(p.shape)
    assert (bar * p).sum() == pytest.approx((bijector.adjoint(u, bar) * u).sum())  # linear
    assert np.allclose(bijector.coordinate(p), u)


class Product:
    """sum_i v_i . x_i + v_i^2 / 2: its gradient with respect to v is x + v, which the noise of x makes uncertain."""

    def value(self, end):
        return float((end.velocities * end.positions).sum() + 0.5 * (end.velocities**2).sum())

    def value_and_adjoint(self, end):
        return self.value(end), (end.velocities, end.positions + end.velocities)


def test_the_standard_error_of_the_truth_is_right(simulation):
    """Of a quadratic loss, whose smoothed gradient is its gradient, the 95 % interval covers it as often as it says."""
    bijector = VelocityModes().bijector(simulation, 0)
    problem = Transformed(Problem(simulation, 0, Product()), {"initial_velocities": bijector})
    u = np.random.default_rng(3).standard_normal((4, 2))
    right = bijector.adjoint(u, simulation.positions + bijector.parameter(u)).ravel()
    quantile = student.ppf(0.975, SAMPLES - 1)
    inside = []
    for seed in range(60):
        found = smoothed(problem, "initial_velocities", u, 0.1, seed)
        inside += list(np.abs(found.derivatives - right) < quantile * found.standard_errors)
    assert 0.90 <= np.mean(inside) <= 0.98
    assert np.std(inside) > 0.0


def test_steps_are_counted_in_batches_too(simulation):
    problem = Problem(simulation, 3, Product())
    values = {"initial_velocities": np.zeros_like(simulation.positions)}
    for estimator, forward, reverse in (
        (Exact(), 1, 1),
        (EnsembleMean(samples=4, estimator=Exact()), 1 + 4, 4),
        (RandomizedSmoothing(samples=2), 1 + 2 * 2 * simulation.positions.size, 0),
    ):
        steps = Steps()
        estimator.estimate(Counted(problem, 3, steps), values)
        assert (steps.forward, steps.backward) == (3 * forward, 3 * reverse)


def test_two_commands_do_not_write_one_file(tmp_path):
    path = tmp_path / "results.jsonl"
    record = {"scene": "s", "control": "c", "loss": "l", "horizon": 1, "seed": 1, "estimator": "one"}
    first, second = Results(path), Results(path)
    with first.adding({}, {}) as add:
        add(record)
        with pytest.raises(InputError, match="is being written by another command"), second.adding({}, {}):
            pass
    with pytest.raises(InputError, match="is being written"), second.adding({}, {}):  # as it has not seen the record
        pass
    with path.open("a") as file:
        file.write('{"scene": "s", "cont')
    with Results(path).adding({}, {}) as add:
        add({**record, "seed": 2})
    assert [line["seed"] for line in Results(path).records.values()] == [1, 2]


def test_the_table_says_what_noise_leaves():
    assert cosine(np.array([1e200, 0.0]), np.array([1.0, 1.0])) == pytest.approx(0.5**0.5)
    base = {"scene": "s", "control": "c", "loss": "l", "horizon": 100, "cost": 400}
    truth = {"estimator": "truth", "derivatives": [3.0, 4.0], "standard_errors": [3.0, 0.0]}
    assert ceiling(truth) == pytest.approx(0.8)
    records = [
        *({**base, **truth, "seed": seed} for seed in range(3)),
        *({**base, "estimator": "one", "seed": seed, "derivatives": [6.0, 8.0]} for seed in range(2)),
        {**base, "estimator": "one", "seed": 2, "derivatives": None},
        *({**base, "estimator": "two", "seed": seed, "failed": "it did"} for seed in range(3)),
    ]
    records += [{**base, **truth, "seed": 3, "derivatives": [0.0, 0.0]}]  # to which nothing has a direction
    records += [{**base, "estimator": "one", "seed": 3, "derivatives": [1.0, 0.0]}]
    text = table(records)
    assert "| one | 1.00 [1.00] 2, 1 without | 4 |" in text and "0.00" not in over_scenes(records, 0.1)
    assert "| two | - | - |" in text
    assert "| *at most* | 0.80 [0.00] | |" in text


def test_scenes_and_seeds_are_put_together():
    def record(scene, estimator, loss="l", **found):
        cell = {"scene": scene, "control": "c", "loss": loss, "horizon": 1200, "seed": 1, "estimator": estimator}
        return {**cell, **found}

    truth = {"derivatives": [3.0, 4.0], "standard_errors": [3.0, 0.0]}
    records = [record(scene, "truth", **truth) for scene in ("a", "b", "e")]
    records += [record("a", "one", derivatives=[6.0, 8.0]), record("b", "one", derivatives=[-4.0, 3.0])]
    records += [record("e", "one", derivatives=None), record("without a truth", "one", derivatives=[1.0, 0.0])]
    records += [record("a", "truth", "m", **truth), record("a", "one", "m", derivatives=[3.0, 4.0])]
    text = over_scenes(records)
    assert "| l | 1,200 | one | 0.50 [0.00] | 1.50 | 2 |" in text
    assert "| all of these | 1,200 | one | 1.00 [0.00] | 1.00 | 3 |" in text
    assert "| l | 1,200 | *at most* | 0.80 [0.80] |  | 3 |" in text


def drawn(seed, mean, error):
    """Intervals of 400 averages of 5 normal numbers each: right ones, about this mean, times an error."""
    samples = np.random.default_rng(seed).normal(mean, 1.0, (400, 5, 3))
    middle, scatter = samples.mean(axis=1), samples.std(axis=1, ddof=1) / np.sqrt(5)
    reach = error * student.ppf(0.975, 4) * scatter
    return Intervals(middle, middle - reach, middle + reach)


def test_coverage_tells_right_intervals_from_narrow_and_biased_ones():
    right, narrow, biased = drawn(1, 5.0, 1.0), drawn(2, 5.0, 0.5), drawn(3, 7.0, 1.0)
    assert right.contain_mean == pytest.approx(0.95, abs=0.02)
    assert narrow.contain_mean < 0.85
    assert biased.contain_mean == pytest.approx(0.95, abs=0.02) and biased.contain(np.full(3, 5.0)) < 0.5
    *_, reference, moved = coverage({REFERENCE: right, "biased": biased}).splitlines()
    assert reference.endswith("|  |") and "| 0.40 |" in moved


def test_a_short_run_of_a_scene_has_certificates(tiny, capsys):
    assert certificates(["--scenes", "tiny", "--steps", "8", "--seeds", "1", "2"]) == 0
    *_, row = capsys.readouterr().out.splitlines()
    assert row.startswith("| tiny | 2 of 2 | 8 [8, 8] | ")
