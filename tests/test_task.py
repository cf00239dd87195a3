"""Tasks: good ones load, bad ones end in one sentence, a result is judged as its task asks; and motions of solids."""

import math
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import one_sentence
from bad_tasks import BAD_TASKS, GOOD_TASK
from cortado import SceneError, gradients, optimise
from cortado.cli.optimise import found_in_words, judge
from cortado.optimisation.optimise import Record, Result
from cortado.optimisation.optimisers import LBFGS, Adam, GradientDescent
from cortado.optimisation.solved_task import knot_values
from cortado.optimisation.task_files import load_task, setup

TASK = """
dimension = 2
discretisation.spacing = 0.05
container = {shape = "box", lower = [0.0, 0.0], upper = [1.0, 1.0], slip = "no"}
solver = {kind = "projection", time_step = 0.001}

phase = [{name = "water", rest_density = 1000.0, viscosity = 1.0}]
fluid = [{shape = "box", lower = [0.0, 0.0], upper = [0.6, 0.4], phase = "water"}]

[[solid]]
name = "rotor"
shape = "box"
lower = [0.2, 0.15]
upper = [0.4, 0.25]
motion = "path"
velocity = [0.0, 0.0]
slip = "no"

[problem]
steps = 10
target.rotor.displacement = [[0.0, 0.0], [0.004, 0.001], [0.002, 0.0]]
target.rotor.turn = [0.0, 0.05]
target.rotor.scale = 1.05

[optimise]
start.rotor.displacement = [[0.0, 0.0], [0.0, 0.0]]
start.rotor.turn = [0.0, 0.0]
start.rotor.scale = 1.0
bounds.rotor.turn = [-0.1, 0.1]
knots = 3
optimiser = "lbfgs"
learning_rate = 0.001
iterations = 20
"""


@pytest.fixture
def task_file(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text(GOOD_TASK)
    return path


def test_a_task_keeps_what_its_file_says(task_file):
    task = load_task(task_file)
    assert task.scene.name == "tiny" and task.problem.steps == 5
    np.testing.assert_array_equal(task.problem.target["gravity"], [1.5, -9.81])
    np.testing.assert_array_equal(task.optimise.start["gravity"], [0.0, -7.0])
    assert task.optimise.algorithm() == Adam(learning_rate=0.5) and task.optimise.iterations == 6
    assert (task.optimise.check.loss_reduction, task.optimise.check.parameter_error) == (2.0, 0.5)
    assert (task.problem.loss, task.problem.frames, task.problem.picture) == ("positions", 1, None)
    assert (task.optimise.knots, task.optimise.logarithmic, task.optimise.bounds) == (None, (), None)
    assert task.folder == task_file.parent and task.problem.compared == [5]


def test_a_task_without_a_check_asks_for_nothing(task_file):
    task_file.write_text(GOOD_TASK[: GOOD_TASK.index("[optimise.check]")].replace('optimiser = "adam"', ""))
    task = load_task(task_file)
    assert judge(task, result({"gravity": [900.0, 0.0]}, [1.0, 1.0])).failures == []
    assert isinstance(task.optimise.algorithm(), Adam)


@pytest.mark.parametrize(
    ("name", "more", "wanted"),
    [
        ("adam", [], Adam(0.5)),
        ("gradient_descent", [], GradientDescent(0.5)),
        ("lbfgs", ["optimise.tolerance=1e-5"], LBFGS(scale=0.5, tolerance=1e-5)),
    ],
)
def test_an_optimiser_is_chosen_by_name(task_file, name, more, wanted):
    assert load_task(task_file, [f"optimise.optimiser={name}", *more]).optimise.algorithm() == wanted


ROWS = [[0.0, -float(step)] for step in range(5)]
BETWEEN = [[0, -9], [1, -8], [2, -7], [3, -6], [4, -5]], [[0, -7], [1, -7], [2, -7], [1, -6], [0, -5]]


@pytest.mark.parametrize(
    ("target", "start", "wanted"),
    [(ROWS, ROWS, (ROWS, ROWS)), ([[0, -9], [4, -5]], [[0, -7], [2, -7], [0, -5]], BETWEEN)],
)
def test_gravity_may_change_with_time(task_file, target, start, wanted):
    """A few rows are interpolated to one for each step."""
    task = load_task(task_file, [f"problem.target.gravity={target}", f"optimise.start.gravity={start}"])
    found = task.true_parameters["gravity"], task.start["gravity"]
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("steps", "frames", "wanted"),
    [(0, 1, [0]), (5, 2, [2, 5]), (7, 7, [*range(1, 8)]), (100, 4, [25, 50, 75, 100])],
)
def test_frames_are_spread_evenly_up_to_the_last(task_file, steps, frames, wanted):
    task = load_task(task_file, [f"problem.steps={steps}", f"problem.frames={frames}"])
    assert task.problem.compared == wanted


def test_a_picture_needs_no_hidden_parameters(task_file):
    task_file.write_text(GOOD_TASK.replace("target.gravity = [1.5, -9.81]", 'loss = "image"\npicture = "heart"'))
    with pytest.raises(SceneError, match=r"parameter_error is 0\.5, but must be left out"):
        load_task(task_file)
    task_file.write_text(task_file.read_text().replace("parameter_error = 0.5", "psnr = 10.0"))
    task = load_task(task_file)
    assert (task.problem.loss, task.problem.picture, task.true_parameters) == ("image", "heart", {})
    assert task.optimise.check.psnr == 10.0


SMOOTHING = ['optimise.gradient.name="adjoint_viscosity"']
SEVERAL = ["optimise.gradient.samples=4", "optimise.gradient.spread.gravity=0.5"]
STILL = "optimise.gradient.position_noise=0"
ESTIMATORS = {
    "exact": ([], gradients.Exact()),
    "with a coefficient": ([*SMOOTHING, "optimise.gradient.coefficient=3.0"], gradients.AdjointViscosity(3.0)),
    "averaged in place": ([*SMOOTHING, *SEVERAL, STILL], gradients.EnsembleMean({"gravity": 0.5}, 4, 0.0)),
    "averaged without smoothing": (SEVERAL, gradients.EnsembleMean({"gravity": 0.5}, 4, estimator=gradients.Exact())),
}


@pytest.mark.parametrize(("overrides", "wanted"), ESTIMATORS.values(), ids=ESTIMATORS)
def test_a_gradient_is_chosen_by_name(task_file, overrides, wanted):
    assert load_task(task_file, overrides).optimise.gradient.estimator() == wanted


FILES = sorted((Path(__file__).parents[1] / "examples").glob("*.toml"))
EXAMPLES = [path for path in FILES if "[optimise]" in path.read_text("utf-8")]


def test_an_example_is_a_task():
    for path in EXAMPLES:
        task = load_task(path)
        assert task.scene.name and task.start.keys() >= (task.optimise.bounds or {}).keys()


@pytest.mark.parametrize("old, new, field", [bad[1:] for bad in BAD_TASKS], ids=[bad[0] for bad in BAD_TASKS])
def test_a_bad_task_is_a_sentence(task_file, old, new, field):
    assert old in GOOD_TASK
    task_file.write_text(GOOD_TASK.replace(old, new, 1))
    with one_sentence(error=SceneError) as caught:
        load_task(task_file)
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{task_file}: {field} ")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD_TASK.replace("[problem", "[problems"), r"problems is not a key of the scene; did you mean problem\?"),
        (TASK.replace("rotor.turn", "rotor.turns"), r"'rotor\.turns' is unknown, but must be one of .*, rotor\.turn, "),
    ],
)
def test_a_word_that_is_no_key_is_told_those_that_are(task_file, text, words):
    task_file.write_text(text)
    with pytest.raises(SceneError, match=words):
        load_task(task_file)


def result(parameters, losses):
    """What an optimisation with these losses would give back."""
    found = {name: np.asarray(value, dtype=float) for name, value in parameters.items()}
    history = tuple(Record(k, k, loss, 0.0, found, replayed=False) for k, loss in enumerate(losses))
    return Result(found, min(losses), found, history, len(losses) - 1, len(losses), "done", converged=False)


TRUE, OFF = [1.5, -9.81], [3.0, 5.0]
FELL, ASKED = [4.0, 1.0], "problem.target.gravity=[3,4]"
NOT_REACHED = [
    "The loss fell 1.5 times, but the task asks for 2 times.",
    "The parameter gravity is 20% off, but the task asks for 10%.",
]
JUDGED = {
    "reached": ([], TRUE, [1.0, 0.25], 0.0, 4.0, []),
    "not reached": ([ASKED, "optimise.check.parameter_error=0.1"], OFF, [3.0, 4.0, 2.0], 0.2, 1.5, NOT_REACHED),
    "no loss": ([], TRUE, [0.0], 0.0, math.inf, []),
    "distance from a hidden zero": (["problem.target.gravity=[0,0]"], [0.3, 0.4], FELL, 0.5, 4.0, None),
    "target over time": ([f"problem.target.gravity={[[3.0, 4.0]] * 5}"], OFF, FELL, 0.2, 4.0, []),
    "found over time": ([ASKED], [OFF] * 5, FELL, 0.2, 4.0, []),
}


@pytest.mark.parametrize(
    ("overrides", "found", "losses", "error", "reduction", "failures"), JUDGED.values(), ids=JUDGED
)
def test_a_result_is_judged_as_its_task_asks(task_file, overrides, found, losses, error, reduction, failures):
    task = load_task(task_file, overrides)
    verdict = judge(task, result({"gravity": found}, losses))
    assert verdict.errors == {"gravity": pytest.approx(error)} and verdict.reduction == reduction
    assert failures is None or verdict.failures == failures
    assert verdict.first == losses[0]
    coordinates = judge(task, result({"gravity": [9.0, 9.0]}, losses), {"gravity": np.array(found)})
    assert coordinates.errors == verdict.errors, "what is found is judged, not its coordinates"


def test_an_image_is_judged_by_its_noise(task_file):
    task_file.write_text(GOOD_TASK.replace("steps = 5", 'steps = 5\nloss = "image"'))
    task, reached = load_task(task_file, ["optimise.check.psnr=30"]), result({"gravity": [1.5, -9.81]}, [4.0, 1.0])
    assert judge(task, reached, noise=30.5).failures == []
    assert judge(task, reached, noise=math.inf).psnr == math.inf
    missed = "The image is matched to 29.5 dB, but the task asks for 30 dB."
    assert judge(task, reached, noise=29.5).failures == [missed]
    assert found_in_words(0.004).startswith("found with an error of 0.4%") and found_in_words(0.81)[:9] == "not found"


def test_only_parameters_of_the_scene_are_offered(task_file):
    for override in ("optimise.start.mobilty=1", 'optimise.logarithmic=["mobilty"]', "problem.target.mobilty=1"):
        with pytest.raises(SceneError, match=r"must be one of gravity, tilt, .*viscosity") as caught:
            load_task(task_file, [override])
        unknown = ("flow_rate", "surface", "mass_fractions", "width")
        assert not any(word in str(caught.value) for word in unknown)


def test_a_task_searches_a_path_by_its_knots(task_file):
    """Also one of numbers, and a knot is where the solid is at the end of its step; and how large the solid is."""
    task_file.write_text(TASK)
    made = setup(load_task(task_file), "cpu", "float64")
    assert made.start["rotor.displacement"].shape == (3, 2) and made.start["rotor.turn"].shape == (3,)
    assert made.start["rotor.scale"] == 1.0
    found = optimise(made.search, made.start, optimiser="lbfgs", iterations=8, bounds=made.bounds)
    assert found.loss < 0.5 * made.search.value(made.start)
    knots = knot_values(made, found.parameters, made.search.parameters(found.parameters))
    np.testing.assert_allclose(knots["rotor.turn"].times, [0.001, 0.0055, 0.01], rtol=1e-12)
    np.testing.assert_allclose(knots["rotor.turn"].true, [0.0, 0.025, 0.05], atol=1e-12)
