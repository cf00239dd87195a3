"""The control tasks of `benchmarks/control`: small ones run, their gradients are right, and searches can be resumed."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.control.__main__ import main
from benchmarks.control.catalogue import TASKS, task
from benchmarks.control.contenders import CONTENDERS, Descent
from benchmarks.control.curves import curves, reached
from benchmarks.control.multiple_shooting import Gaps, MultipleShooting
from benchmarks.control.objective import BudgetSpent, Objective
from benchmarks.control.records import Record, Records, Run
from benchmarks.control.staged import Easier
from benchmarks.counting import BACKWARD
from cortado import CortadoWarning, DivergedError, InputError, Simulation, gradients
from finite_differences import decades, distance

SHORT = {
    "carry": {"moving": 10, "standing": 5, "blocks": 5, "distance": 1e-3},
    "carry_cup": {"moving": 10, "standing": 5, "blocks": 5, "distance": 1e-3},
    "pour_jug": {"turning": 12, "blocks": 4, "turn": 0.02, "aside": 0.01},
    "splash": {"blocks": 4, "repeats": 3},
    "splash_projection": {"blocks": 4, "repeats": 3},
    "latte": {"actions": 4, "repeats": 3, "standing": 2, "column": 2},
    "latte_dense": {"actions": 4, "repeats": 3, "standing": 2, "column": 2},
    "mix": {"blocks": 4, "repeats": 3},
    "steer_raft": {"moving": 12, "amplitude": 1e-3},
    "stir_milk": {"actions": 4, "repeats": 3, "reach": 0.01},
}
"""The small tasks for a few steps."""
tasks = pytest.mark.parametrize("name", TASKS)


def short(name):
    return replace(task(name, "small"), **SHORT[name])


@tasks
def test_the_gradient_is_the_limit_of_differences(name):
    chosen = short(name)
    objective = Objective(chosen, chosen.problem(precision="float64"), seed=1, budget=np.inf)
    random = np.random.default_rng(2)
    point, direction = (objective.named(u) for u in random.uniform(-0.5, 0.5, (2, chosen.controls.numbers)))
    _, gradient = objective.problem.value_and_gradient(point)
    derivative = sum((gradient[name] * direction[name]).sum() for name in gradient)
    assert distance(objective.problem.value, point, direction, derivative, decades(2, 6, 0.25), 1e-6) < 1e-6


@tasks
def test_the_known_solution_does_better_than_no_search(name):
    chosen = task(name, "small")
    problem = chosen.problem()
    parameters = [chosen.controls.parameters(u) for u in (chosen.known, chosen.baseline)]
    losses, scores = ([judge(one) for one in parameters] for judge in (problem.value, partial(chosen.score, problem)))
    assert losses[0] < 0.7 * losses[1]
    assert scores[0].keys() == scores[1].keys()
    assert all(scores[0][what] <= scores[1][what] + 1e-12 for what in scores[0])


@tasks
def test_controls_are_bounded_and_large_tasks_are_long(name):
    chosen = task(name, "large")
    assert np.abs(chosen.known).max() <= 1.0 and np.abs(chosen.baseline).max() <= 0.5
    assert chosen.known.shape == (chosen.controls.numbers,)
    assert chosen.steps >= 1000 and chosen.controls.numbers >= 50
    for parameter, value in chosen.controls.parameters(chosen.known).items():
        assert value.shape == ((chosen.steps,) if parameter == "jug.turn" else (chosen.steps, chosen.scene.dimension))


@pytest.mark.parametrize("blocks", [10, 25])
def test_a_tank_always_arrives_and_stands(blocks):
    chosen = replace(task("carry", "small"), blocks=blocks)
    u = np.random.default_rng(0).uniform(-1.0, 1.0, chosen.controls.numbers)
    accelerations = -chosen.controls.parameters(u)["gravity"][:, 0]
    velocities = chosen.time_step * np.cumsum(accelerations)
    assert abs(velocities[-1]) < 1e-12 and not accelerations[chosen.moving :].any()
    assert chosen.time_step * velocities.sum() == pytest.approx(chosen.distance)


def test_a_cup_always_arrives_and_a_nozzle_stays_in_its_reach():
    chosen = task("carry_cup", "small")
    u = np.random.default_rng(0).uniform(-1.0, 1.0, chosen.controls.numbers)
    path = chosen.controls.parameters(u)["cup.displacement"]
    np.testing.assert_allclose(path[chosen.moving - 1 :], [[chosen.distance, 0.0]] * (chosen.standing + 1), atol=1e-12)
    assert np.abs(path[0]).max() < 1e-3 and np.ptp(path[:, 0]) > 0.1
    chosen = task("latte", "small")
    for u in (np.ones(25), -np.ones(25), np.random.default_rng(0).choice([-1.0, 1.0], 25)):
        path = chosen.controls.parameters(u)["nozzle.path"]
        assert np.abs(path[:, 0]).max() <= 0.6 * chosen.cup
        assert np.ptp(path[:, 1]) == 0.0


def test_milk_counts_once_it_has_come_out():
    chosen = task("latte_dense", "small")
    losses = chosen.milk_distances(Simulation(chosen.scene))
    counts = [len(one.particles) for one in losses.values()]
    assert counts == sorted(counts) and 0 < counts[0] < counts[-1] == Simulation(chosen.scene).particles - 144


def test_steps_are_counted_alone_and_in_batches():
    chosen = short("splash")
    problem, steps = chosen.problem(), chosen.steps

    def metered(estimator):
        objective = Objective(chosen, problem, 0, np.inf)
        objective.value_and_gradient(objective.named(objective.start), estimator)
        assert objective.curve == [(objective.steps.cost, objective.best_loss)]
        return objective.steps

    once = metered(gradients.Exact())
    assert (once.forward, once.backward, once.cost) == (steps, steps, (1 + BACKWARD) * steps)
    mean = metered(gradients.EnsembleMean(0.05, 4, estimator=gradients.Exact()))
    assert (mean.forward, mean.backward) == (5 * steps, 4 * steps)
    objective = Objective(chosen, problem, 0, np.inf)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (3, chosen.controls.numbers))
    together = objective.values(list(points))
    assert objective.steps.forward == 3 * steps and [at for at, _ in objective.curve] == [steps, 2 * steps, 3 * steps]
    assert together.tolist() == [objective.problem.value(objective.named(u)) for u in points]


def test_a_run_that_diverges_is_a_bad_score():
    chosen = replace(short("splash"), repeats=20)
    objective = Objective(chosen, chosen.problem(), 0, np.inf)
    wild = np.full(chosen.controls.numbers, 300.0)
    with pytest.warns(CortadoWarning, match="time_step"):
        baseline, bad = objective.values([objective.start, wild])
    assert bad > 9.0 * baseline and objective.curve[1][1] == np.inf and objective.best_loss == baseline
    with pytest.warns(CortadoWarning, match="time_step"):
        loss, gradient = objective.value_and_gradient(objective.named(wild), gradients.Exact())
    assert loss == bad and (gradient["gravity"] * (wild - objective.start)).sum() == pytest.approx(bad - baseline)


@pytest.mark.parametrize("contender", CONTENDERS.values(), ids=CONTENDERS)
def test_a_contender_stays_within_its_budget(contender):
    chosen = short("splash")
    objective = Objective(chosen, chosen.problem(), 0, budget=60.0 * chosen.steps)
    contender.search(objective, seed=0)
    steps, losses = zip(*objective.curve, strict=True)
    assert max(steps) <= objective.budget and objective.best_loss == min(losses) and np.abs(objective.best).max() <= 1.0
    if contender == Descent(gradients.Exact()):
        assert objective.best_loss < losses[0]
    with pytest.raises(BudgetSpent):
        while True:
            objective.values([objective.start])


@pytest.mark.parametrize("name", ["carry", "splash", "mix"])
def test_the_lagrangian_of_segments_has_the_right_gradient(name):
    """With gaps between them, and multipliers that have learnt."""
    chosen, random = short(name), np.random.default_rng(3)
    objective = Objective(chosen, chosen.problem(precision="float64"), seed=1, budget=np.inf)
    gaps = Gaps(objective, 3, gradients.Exact(), 2.0)
    u = random.uniform(-0.5, 0.5, chosen.controls.numbers)
    point = {"controls": u, **gaps.closed(u)}
    closed, _ = gaps.value_and_gradient(point)
    assert closed == pytest.approx(objective.problem.value(objective.named(u)), rel=1e-9)
    direction = {part: random.standard_normal(value.shape) for part, value in point.items()}
    for part in ("positions", "velocities"):
        point[part] = point[part] + 0.02 * random.standard_normal(point[part].shape)
    gaps.value_and_gradient(point)
    gaps.learn()
    _, gradient = gaps.value_and_gradient(point)
    derivative = sum((gradient[part] * direction[part]).sum() for part in point)
    assert distance(lambda p: gaps.value_and_gradient(p)[0], point, direction, derivative, decades(4, 7), 1e-6) < 1e-5


def test_segments_need_all_particles():
    chosen = short("latte")
    with pytest.raises(InputError, match="nozzle"):
        MultipleShooting().search(Objective(chosen, chosen.problem(), 0, np.inf), 0)


def test_easier_problems_have_curves_and_parameters_of_their_own():
    chosen = short("mix")
    objective = Objective(chosen, chosen.problem(), 0, budget=60.0 * chosen.steps)
    thick = Easier(viscosity=16.0, share=0.5).of(objective, objective.start)
    assert thick.fixed["viscosity"].tolist() == [0.8, 0.8] and "viscosity" not in objective.fixed
    thick.values([thick.start])
    assert (len(thick.curve), len(objective.curve)) == (1, 0) and objective.steps.forward == chosen.steps
    late = Easier(late=0.5).of(objective, objective.start)
    _, gradient = late.value_and_gradient(late.named(late.start), gradients.Exact())
    half = chosen.controls.numbers // 2
    assert not gradient["gravity"][:half].any() and gradient["gravity"][half:].all()


COMMAND = ["--task", "carry", "--contender", "exact", "random_search", "--budget", "1000"]


def test_what_is_done_is_not_repeated(tmp_path, capsys):
    command = [*COMMAND, "--out", str(tmp_path)]
    assert main([*command, "--seeds", "1"]) == 0
    first = (tmp_path / "runs.jsonl").read_text()
    assert len(first.splitlines()) == 2 and main([*command, "--seeds", "1"]) == 0
    assert (tmp_path / "runs.jsonl").read_text() == first
    assert main([*command, "--seeds", "1", "2"]) == 0
    text = (tmp_path / "runs.jsonl").read_text()
    assert text.startswith(first) and "2 of 4 runs are in" in capsys.readouterr().out
    records = Records(tmp_path / "runs.jsonl").read()
    wanted = [(name, seed) for seed in (1, 2) for name in ("exact", "random_search")]
    assert [(one.run.contender, one.run.seed) for one in records] == wanted
    assert all(one.forward_steps + BACKWARD * one.backward_steps >= one.steps[-1] for one in records)
    assert main([*command, "--seeds", "1", "2", "--figures"]) == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"carry_small.png", "carry_small_pictures.png"}
    assert "| carry | exact | 2 |" in capsys.readouterr().out


def record_of(seed, loss=0.5):
    run = Run("carry", "small", "exact", seed, 100.0, "cpu", "float32")
    return Record(run, [10.0], [loss], [0.0], {"sloshing": loss}, 10, 10, 0.1, "0.1.0")


def test_a_record_is_added_to_the_end_of_its_file_and_the_last_of_a_run_counts(tmp_path):
    """A file that is written anew for each record takes longer with each."""
    records = Records(tmp_path / "runs.jsonl")
    records.add(record_of(1))
    before = records.path.stat().st_ino, records.path.read_bytes()
    records.add(record_of(2))
    assert records.path.stat().st_ino == before[0] and records.path.read_bytes().startswith(before[1])
    assert records.read() == [record_of(1), record_of(2)]
    records = Records(tmp_path / "runs.jsonl")
    for one in (record_of(1), record_of(2), record_of(1, loss=0.25)):
        records.add(one)
    assert records.read() == [record_of(1, loss=0.25), record_of(2)]


def test_a_record_that_was_cut_off_is_left_aside(tmp_path):
    records = Records(tmp_path / "runs.jsonl")
    for seed in (1, 2):
        records.add(record_of(seed))
    whole = records.path.read_bytes()
    for length in (len(whole) - 1, len(whole) - 30):
        records.path.write_bytes(whole[:length])
        assert records.read() == [record_of(1)] and records.missing([record_of(2).run]) == [record_of(2).run]
        records.add(record_of(3))
        assert records.read() == [record_of(1), record_of(3)]
    records.path.write_bytes(b"{}\n" + whole)
    with pytest.raises(InputError, match=r"Line 1 of .*runs\.jsonl is no run of this benchmark"):
        records.read()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (["--task", "juggle"], "must be one of carry"),
        (["--contender", "luck"], "must be one of exact"),
        (["--processes", "0"], "must be at least 1"),
        (["--figures"], "no runs of carry small"),
    ],
)
def test_a_mistake_is_a_sentence(changed, said, tmp_path, capsys):
    assert main([*COMMAND, "--out", str(tmp_path), *changed]) == 2
    assert said in capsys.readouterr().err


def test_a_budget_below_one_run_is_a_sentence(tmp_path, capsys):
    assert main([*COMMAND, "--seeds", "1", "--out", str(tmp_path), "--budget", "10"]) == 1
    assert "The budget of 10 steps ends before the first evaluation" in capsys.readouterr().err
    assert not Records(tmp_path / "runs.jsonl").read()


def test_where_a_neighbour_diverges_the_run_itself_counts():
    """The first one of an ensemble's runs diverges, and not that at the controls."""
    objective = Objective(short("splash"), short("splash").problem(), seed=1, budget=np.inf)
    u = objective.named(objective.start)
    wanted = objective.value(u)

    def lost(*_):
        raise DivergedError(step=1, particle=0, advice="")

    class Neighbours:
        def estimate(self, problem, parameters, observe=None):
            lost()

    loss, gradient = objective.value_and_gradient(u, Neighbours())
    assert loss == wanted == objective.curve[-1][1] and not gradient[next(iter(u))].any()
    bad, _ = objective.value_and_gradient(u, type("Lost", (gradients.AdjointEstimator,), {"derivative": lost})())
    assert bad > wanted and objective.curve[-1][1] == np.inf


def test_curves_are_quartiles_of_the_least_loss():
    run = Run("carry", "small", "exact", 1, 10.0, "cpu", "float32")
    losses = [[1.0, 0.5], [2.0, 1.0], [3.0, 1.5], [4.0, 2.0], [5.0, 6.0], [9.0, None]]
    steps, found = curves([Record(run, [2.0, 6.0], one, [], {}, 0, 0, 0.0, "") for one in losses])
    before = found[:, steps < 6.0 - 1e-9]
    assert (steps[0], steps[-1]) == (2.0, 10.0) and 0 < before.shape[1] < len(steps)
    np.testing.assert_array_equal(before, np.tile([[2.25], [3.5], [4.75]], before.shape[1]))
    np.testing.assert_array_equal(found[:, -1], np.percentile([0.5, 1.0, 1.5, 2.0, 5.0, 9.0], (25, 50, 75)))


def test_steps_until_a_loss_are_medians_over_runs():
    def of(who, *losses):
        run = Run("carry", "small", who, len(losses), 30.0, "cpu", "float32")
        return Record(run, [10.0, 20.0, 30.0][: len(losses)], list(losses), [], {}, 0, 0, 0.0, "")

    rows = reached([of("exact", 1.0, 0.4, 0.15), of("exact", 1.0, None, 0.3), of("cma_es", 1.0, 0.9)]).splitlines()
    assert rows[0].split(" | ")[-2:] == ["exact", "cma_es |"]
    assert [row.split(" | ")[2:] for row in rows[2:]] == [["0.5", "25", "> 30 |"]]
