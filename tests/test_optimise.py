"""The optimisers against closed forms and plain twins, and resuming bit for bit."""

import os
import re
from dataclasses import dataclass, replace
from html import unescape

import numpy as np
import pytest

import cortado
from cortado import ComputationError, CortadoWarning, DivergedError, InputError, Problem, Simulation
from cortado.files.disk import REPLAY_LOG
from cortado.gradients import EnsembleMean, Estimate
from cortado.losses import FinalPositions
from cortado.optimisation.optimise import Record, Result, optimise
from cortado.optimisation.optimisers import LBFGS, Adam, GradientDescent, LineSearch
from rosenbrock_valley import Interrupted, Rosenbrock, rosenbrock
from scenes import plane

OPTIMISERS = [Adam(learning_rate=0.05), GradientDescent(learning_rate=1e-3, momentum=0.5), LBFGS(), LineSearch()]


class Quadratic:
    """sum over the parameters of stiffness / 2 |p - target|^2; notes the parameters that it is given."""

    def __init__(self, targets, stiffness=1.0):
        self.targets = {name: np.asarray(target) for name, target in targets.items()}
        self.stiffness = stiffness
        self.seen: list[dict[str, np.ndarray]] = []
        self.estimators: list[object] = []

    def value_and_gradient(self, parameters, gradient=None):
        self.seen.append(parameters)
        self.estimators.append(gradient)
        offsets = {name: parameters[name] - target for name, target in self.targets.items()}
        loss = sum(0.5 * self.stiffness * float(np.sum(offset**2)) for offset in offsets.values())
        return loss, {name: self.stiffness * np.asarray(offset) for name, offset in offsets.items()}


def bits(result: Result) -> list[bytes]:
    """Everything an optimisation computed, as bytes: equal only if equal bit for bit."""
    numbers = [result.loss, *result.parameters.values(), *result.last_parameters.values()]
    for record in result.history:
        numbers += [record.iteration, record.updates, record.loss, record.gradient_norm, *record.parameters.values()]
    return [np.asarray(number).tobytes() for number in numbers]


# ---- convergence ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("optimiser", "iterations"),
    [
        (Adam(learning_rate=0.1), 600),
        (GradientDescent(learning_rate=0.2), 120),
        (GradientDescent(learning_rate=0.2, momentum=0.5), 120),
        (LBFGS(), 10),
    ],
)
def test_quadratic_of_scalar_and_array_converges(optimiser, iterations):
    targets = {"viscosity": np.array(0.3), "velocities": np.arange(12.0).reshape(4, 3) / 10.0}
    problem = Quadratic(targets)
    result = optimise(problem, {"viscosity": 1.0, "velocities": np.zeros((4, 3))}, optimiser, iterations)
    assert isinstance(result.parameters["viscosity"], float)
    assert result.parameters["viscosity"] == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(result.parameters["velocities"], targets["velocities"], atol=1e-6)
    assert result.evaluations == len(problem.seen) == len(result.history)
    assert problem.seen[0]["viscosity"].shape == () and problem.seen[0]["velocities"].shape == (4, 3)
    assert problem.seen[0]["velocities"].dtype == np.float64


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_lbfgs_takes_its_tolerance_from_the_first_gradient(unit):
    class InUnit(Rosenbrock):
        def value_and_gradient(self, parameters, gradient=None):
            loss, gradient = super().value_and_gradient(parameters)
            return unit * loss, {name: unit * slope for name, slope in gradient.items()}

    loose, tight = (rosenbrock(LBFGS(tolerance=t), 100, problem=InUnit()) for t in (1e-3, 1e-9))
    assert loose.converged and tight.converged
    assert tight.history[-1].gradient_norm < 2e-9 * tight.history[0].gradient_norm
    assert 1e-7 < loose.history[-1].gradient_norm / loose.history[0].gradient_norm < 2e-3
    assert loose.evaluations < tight.evaluations


@pytest.mark.parametrize("stiffness", [1e-8, 1.0, 1e8])
def test_lbfgs_first_step_is_as_long_as_its_scale(stiffness):
    problem = Quadratic({"viscosity": 0.08}, stiffness)
    result = optimise(problem, {"viscosity": 0.05}, LBFGS(scale={"viscosity": 0.01}), 20)
    assert problem.seen[1]["viscosity"] == pytest.approx(0.06)
    assert result.parameters["viscosity"] == pytest.approx(0.08)


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_updates_are_counted_beside_evaluations(optimiser):
    result = rosenbrock(optimiser, 20)
    updates = [record.updates for record in result.history]
    assert result.updates == 20 and str(result.updates) in result.message
    assert updates[0] == 0 and updates == sorted(updates) and set(range(20)) <= set(updates)
    if isinstance(optimiser, LBFGS):
        assert updates[-1] == 19 and result.evaluations > 21  # a line search takes several evaluations
    else:
        assert updates == list(range(21))


# ---- against plain twins --------------------------------------------------------------------------------------------
def test_adam_follows_algorithm_1_of_its_paper():
    alpha, beta_1, beta_2, epsilon = 0.05, 0.8, 0.97, 1e-6
    theta, m, v = [-1.2, 1.0], [0.0, 0.0], [0.0, 0.0]
    expected = [tuple(theta)]
    for t in range(1, 41):
        _, gradient = Rosenbrock().value_and_gradient({"a": theta[0], "b": theta[1]})
        for i, g in enumerate([float(gradient["a"]), float(gradient["b"])]):
            m[i] = beta_1 * m[i] + (1 - beta_1) * g
            v[i] = beta_2 * v[i] + (1 - beta_2) * g * g
            theta[i] -= alpha * (m[i] / (1 - beta_1**t)) / ((v[i] / (1 - beta_2**t)) ** 0.5 + epsilon)
        expected.append(tuple(theta))
    result = rosenbrock(Adam(alpha, beta_1, beta_2, epsilon), 40)
    found = [(record.parameters["a"], record.parameters["b"]) for record in result.history]
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    assert result.evaluations == 41 and result.last_parameters == {"a": found[-1][0], "b": found[-1][1]}


def test_momentum_follows_the_heavy_ball_with_a_learning_rate_for_each_parameter():
    rates = {"x": 0.1, "y": 0.05}
    result = optimise(
        Quadratic({"x": 0.0, "y": np.zeros(2)}, 2.0),
        {"x": 3.0, "y": np.array([3.0, 3.0])},
        GradientDescent(rates, momentum=0.7),
        10,
    )
    for name, rate in rates.items():
        x, before, expected = 3.0, 3.0, [3.0]
        for _ in range(10):
            x, before = x - rate * 2.0 * x + 0.7 * (x - before), x
            expected.append(x)
        found = [np.ravel(record.parameters[name])[-1] for record in result.history]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


# ---- whether gradients keep what they promise -----------------------------------------------------------------------
MANY = (Adam(0.1), GradientDescent(0.1), LBFGS(scale=0.1), LineSearch(scale=0.5))


class Promising(Quadratic):
    """A bowl whose gradient is right times a factor that depends on where it is."""

    def __init__(self, factor):
        super().__init__({"x": np.array([1.0, -2.0])})
        self.factor = factor

    def value_and_gradient(self, parameters, gradient=None):
        loss, found = super().value_and_gradient(parameters)
        return loss, {"x": self.factor(parameters["x"]) * found["x"]}


@pytest.mark.parametrize("optimiser", MANY, ids=lambda one: type(one).__name__)
@pytest.mark.parametrize(
    "factor",
    [lambda x: 1e4 * (2.0 + np.sin(1e5 * x.sum())), lambda x: -1.0, lambda x: 1e-3],
    ids=["beyond its horizon", "wrong sign", "too small"],
)
def test_a_gradient_that_disagrees_with_what_steps_do_is_said(optimiser, factor):
    if isinstance(optimiser, GradientDescent):
        optimiser = GradientDescent({-1.0: 1e-3, 1e-3: 100.0}.get(factor(np.zeros(2)), 1e-5))
    found = optimise(Promising(factor), {"x": np.zeros(2)}, optimiser, 12)
    assert found.misled and not found.converged
    assert "The gradient is wrong: in " in found.message and "another start" in found.message
    assert "converged after" not in found.message and "Try Adam" not in found.message
    assert found.message in unescape(found._repr_html_())


@pytest.mark.parametrize("optimiser", [*MANY, GradientDescent(1.9), LineSearch(scale=5.0)])
@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e9])
def test_gradients_that_are_right_are_not_doubted(optimiser, factor):
    if isinstance(optimiser, GradientDescent):
        optimiser = GradientDescent(optimiser.learning_rate / factor)
    found = optimise(Quadratic({"x": np.array([1.0, -2.0])}, factor), {"x": np.zeros(2)}, optimiser, 40)
    assert not found.misled and "disagrees" not in found.message
    if not isinstance(optimiser, GradientDescent):
        assert not rosenbrock(optimiser, 60).misled


def test_a_search_beyond_its_horizon_names_the_certificate_and_the_pair():
    simulation = Simulation(plane(forces={"gravity": [0.0, -9.81], "viscosity": "pairwise"}))
    goal = simulation.run(250, {"gravity": [1.0, -9.0]}).positions[-1].astype(float)
    start = {"gravity": np.array([-1.0, -9.81])}
    found = optimise(Problem(simulation, 250, FinalPositions(goal)), start, LBFGS(scale=0.5), 2)
    assert found.misled and not found.converged
    for name in ("certify", "AdjointViscosity() with the optimiser LineSearch"):
        assert name in found.message
    short = Problem(simulation, 20, FinalPositions(simulation.positions))
    still = optimise(short, start, Adam(1e-9), 8)
    assert still.stays and not still.misled and "AdjointViscosity() with the optimiser LineSearch" in still.message
    near = optimise(short, start, "lbfgs", 4)
    assert not near.misled and "certify" not in near.message


@pytest.mark.parametrize("optimiser", MANY, ids=lambda one: type(one).__name__)
def test_a_loss_that_stays_may_be_in_a_wrong_local_minimum(optimiser):
    def double_well(parameters):
        x = parameters["x"]
        return (x**2 - 1.0) ** 2 + 0.2 * (x + 1.0), {"x": 4.0 * x * (x**2 - 1.0) + 0.2}

    wrong, right = (optimise(double_well, {"x": x}, optimiser, 60) for x in (1.4, -1.5))
    assert wrong.stays and "maybe in a wrong local minimum. Try another start" in wrong.message
    assert ("LineSearch" in wrong.message) is not isinstance(optimiser, LineSearch)
    assert not right.stays and "local minimum" not in right.message


@pytest.mark.parametrize("optimiser", MANY, ids=lambda one: type(one).__name__)
def test_a_search_that_ends_at_its_bound_names_the_bound(optimiser):
    """And no local minimum; one that only began there, or that bounds do not hold, says nothing of bounds."""

    def far(parameters):
        x, y = parameters["x"], parameters["y"]
        return float(((x - 9.0) ** 2).sum() + y**2), {"x": 2.0 * (x - 9.0), "y": 2.0 * y}

    bounds = {"x": (-1.0, 1.0), "y": (0.0, 5.0)}
    held = optimise(far, {"x": np.zeros(2), "y": 4.0}, optimiser, 60, bounds=bounds)
    assert "x is at a bound, and the loss falls further beyond: widen" in held.message
    assert not held.stays and "local minimum" not in held.message
    free = optimise(far, {"x": np.full(2, -1.0), "y": 4.0}, optimiser, 60, bounds={**bounds, "x": (-1.0, 20.0)})
    assert "bound" not in free.message


def test_lbfgs_converges_only_where_its_gradient_is_small():
    """At an optimum at once."""

    def stairs(parameters):
        return float(np.round(parameters["x"])) + 1.0, {"x": 1.0}

    found = optimise(stairs, {"x": 0.2}, LBFGS(scale=1e-3), 20)
    assert not found.converged and "the gradient is 1 times the first gradient" in found.message
    small = optimise(Quadratic({"x": 2.0}), {"x": 1.0}, LBFGS(), 20)
    assert "times the first gradient" in small.message and "LineSearch" not in small.message
    there = optimise(Quadratic({"x": 2.0}), {"x": 2.0}, LBFGS(), 20)
    assert there.converged and there.evaluations == 1


def test_the_best_is_not_the_last():
    result = optimise(Quadratic({"x": 0.0}), {"x": 1.0}, GradientDescent(learning_rate=3.0), 4)
    assert result.parameters == {"x": 1.0} and result.loss == 0.5 and not result.converged
    assert result.last_parameters == {"x": 16.0}


# ---- bounds ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("optimiser", [Adam(0.05), GradientDescent(0.2, momentum=0.5), LBFGS(scale=0.3)])
def test_bounds_are_kept_and_reached(optimiser):
    """A component with equal bounds stays."""
    problem = Quadratic({"g": np.array([2.0, -2.0, 0.1, 0.0]), "mu": 0.7})
    lower, upper = np.array([-1.0, -0.5, -1.0, 0.3]), np.array([1.0, 1.0, 1.0, 0.3])
    start, bounds = {"g": np.array([0.0, 0.0, 0.0, 0.3]), "mu": 0.5}, {"g": (lower, upper), "mu": (None, 0.6)}
    result = optimise(problem, start, optimiser, 200, bounds)
    for parameters in problem.seen:
        assert (parameters["g"] >= lower).all() and (parameters["g"] <= upper).all()
        assert parameters["mu"] <= 0.6
    np.testing.assert_allclose(result.parameters["g"], [1.0, -0.5, 0.1, 0.3], atol=1e-4)
    assert result.parameters["mu"] == pytest.approx(0.6, abs=1e-12)
    if isinstance(optimiser, LBFGS):
        result = rosenbrock(optimiser, 100, bounds={"a": (None, 0.5)})
        assert result.parameters == {"a": 0.5, "b": pytest.approx(0.25, abs=1e-8)}


# ---- the line search ------------------------------------------------------------------------------------------------
class Rough:
    """A bowl with dents of 0.02 everywhere, whose gradient is that of the bowl."""

    def __init__(self):
        self.tried = []

    def value(self, parameters):
        x = np.asarray(parameters["x"])
        self.tried.append(x)
        return float(x @ x + 0.02 * np.sin(200.0 * x).sum())

    def value_and_gradient(self, parameters, gradient=None):
        return self.value(parameters), {"x": 2.0 * np.asarray(parameters["x"])}


def test_a_line_search_goes_down_a_rough_slope_and_leaves_its_dents():
    start = {"x": np.array([2.0, -1.0])}
    result = optimise(Rough(), start, LineSearch(), 20)
    assert result.loss < 0.02 and np.abs(result.parameters["x"]).max() < 0.1
    iterates = np.array([record.parameters["x"] for record in optimise(Rough(), start, LineSearch(), 60).history])
    steps = np.abs(np.diff(iterates, axis=0)).max(axis=1)
    assert (steps[-20:] > 0.01).sum() >= 5


@pytest.mark.parametrize("error", [DivergedError(step=1, particle=0, advice=""), InputError("viscosity is below 0.")])
@pytest.mark.parametrize("kind", ["function", "object without losses", "object"])
def test_a_trial_that_cannot_be_is_left_aside(error, kind):
    def both(parameters, gradient=None):
        if parameters["x"] < 0.5:
            raise error
        return parameters["x"], {"x": 1.0}

    members = {"value_and_gradient": staticmethod(both)}
    if kind == "object":
        members["value"] = staticmethod(lambda parameters: both(parameters)[0])
    problem = both if kind == "function" else type("Slope", (), members)()
    result = optimise(problem, {"x": 2.0}, LineSearch(scale=2.0), 30)
    assert 0.5 <= result.parameters["x"] < 0.6


@pytest.mark.parametrize("value", [None, "low", [1.0, 2.0]])
def test_a_loss_of_a_trial_is_one_number(value):
    problem = type("Slope", (), {"value": lambda *_: value, "value_and_gradient": lambda *_, **__: (1.0, {"x": 1.0})})
    with pytest.raises(InputError, match=r"^The problem's loss"):
        optimise(problem(), {"x": 2.0}, LineSearch(), 3)


def test_a_line_search_takes_shorter_steps_about_a_minimum():
    problem = Quadratic({"g": np.array([1.0, 2.0])})
    result = optimise(problem, {"g": np.array([0.0, 0.0])}, LineSearch(), 40)
    np.testing.assert_allclose(result.last_parameters["g"], [1.0, 2.0], atol=1e-3)
    still = optimise(problem, {"g": np.array([1.0, 2.0])}, LineSearch(), 3)
    assert still.loss == 0.0 and still.updates == 3


def test_the_scale_of_a_line_search_is_its_longest_step():
    problem = Rough()
    optimise(problem, {"x": np.array([0.9, -0.9])}, LineSearch(scale=0.5, trials=3, shortest=0.25), 1)
    steps = [np.abs(x - [0.9, -0.9]).max() for x in problem.tried[1:4]]
    np.testing.assert_allclose(steps, [0.125, 0.25, 0.5])


# ---- resuming -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda optimiser: type(optimiser).__name__)
@pytest.mark.parametrize("evaluations", [0, 1, 13])
def test_interrupted_run_resumes_bit_for_bit(optimiser, evaluations, tmp_path):
    valley = Rosenbrock()
    whole = rosenbrock(optimiser, problem=valley)
    with pytest.raises(Interrupted):
        rosenbrock(optimiser, problem=Rosenbrock(fail_at=evaluations), checkpoint=tmp_path / "run")
    rest, records = Rosenbrock(), []
    resumed = rosenbrock(optimiser, problem=rest, checkpoint=tmp_path / "run", resume=True, on_iteration=records.append)
    assert bits(resumed) == bits(whole)
    assert resumed.message == whole.message
    assert rest.evaluations == valley.evaluations - evaluations
    replayed = [record.replayed for record in records]
    assert replayed == sorted(replayed, reverse=True) and any(replayed) == (evaluations > 0)
    if not isinstance(optimiser, LineSearch):  # which also replays the losses that it has tried
        assert replayed == [i < evaluations for i in range(whole.evaluations)]
    assert records == list(resumed.history)


@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda optimiser: type(optimiser).__name__)
def test_finished_run_resumes_to_more_and_to_fewer_iterations(optimiser, tmp_path):
    rosenbrock(optimiser, 10, checkpoint=tmp_path)
    longer = rosenbrock(optimiser, 25, checkpoint=tmp_path, resume=True)
    assert bits(longer) == bits(rosenbrock(optimiser, 25))
    unused = Rosenbrock()
    shorter = rosenbrock(optimiser, 5, problem=unused, checkpoint=tmp_path, resume=True)
    assert bits(shorter) == bits(rosenbrock(optimiser, 5))
    assert unused.evaluations == 0


def test_torn_last_record_is_computed_again_and_damage_before_it_is_refused(tmp_path):
    """Every record is in the file before the next evaluation, so that a kill leaves it."""
    optimiser, log, sizes = Adam(learning_rate=0.05), tmp_path / REPLAY_LOG, []
    record_size = 8 + 8 * 5 + 4
    whole = bits(rosenbrock(optimiser, 3, checkpoint=tmp_path, on_iteration=lambda _: sizes.append(log.stat().st_size)))
    assert np.diff(sizes).tolist() == 3 * [record_size]
    content = log.read_bytes()
    torn = [content[:-cut] for cut in range(1, record_size + 1, 3)]
    torn.append(content[:-record_size] + bytes(record_size))
    torn.append(content[:-1] + bytes([content[-1] ^ 1]))
    for remains in torn:
        log.write_bytes(remains)
        problem = Rosenbrock()
        assert bits(rosenbrock(optimiser, 3, problem=problem, checkpoint=tmp_path, resume=True)) == whole
        assert problem.evaluations == 1 and log.read_bytes() == content
    damaged = bytearray(content)
    damaged[-100] ^= 1
    log.write_bytes(damaged)
    with pytest.raises(InputError, match=r"Evaluation 2 of the 4 .* damaged"):
        rosenbrock(optimiser, 3, checkpoint=tmp_path, resume=True)
    assert log.read_bytes() == damaged


@pytest.mark.parametrize("content", [b"something else\n", b"[" * 100_000, b"\n", b'{"format": 1}\n'])
def test_a_foreign_file_is_refused(tmp_path, content):
    (tmp_path / REPLAY_LOG).write_bytes(content)
    with pytest.raises(InputError, match="no replay log"):
        rosenbrock(Adam(0.05), 5, checkpoint=tmp_path, resume=True)


def test_other_settings_are_refused_and_leave_the_log(tmp_path):
    optimiser = Adam(learning_rate=0.05)
    rosenbrock(optimiser, 5, checkpoint=tmp_path)
    before = (tmp_path / REPLAY_LOG).read_bytes()
    with pytest.raises(InputError, match=r"learning_rate=0.05.* now has optimiser = .*learning_rate=0.06"):
        rosenbrock(replace(optimiser, learning_rate=0.06), 5, checkpoint=tmp_path, resume=True)
    with pytest.raises(InputError, match="gradient = None and now has gradient = 'exact'"):
        rosenbrock(optimiser, 5, checkpoint=tmp_path, resume=True, gradient="exact")
    with pytest.raises(InputError, match=r"names = \[.a., .b.\] and now has names = \[.c.\]"):
        optimise(Quadratic({"c": 0.0}), {"c": 1.0}, optimiser, 5, checkpoint=tmp_path, resume=True)
    with pytest.raises(InputError, match="Evaluation 0 has another 'b'"):
        start = {"a": -1.2, "b": np.nextafter(1.0, 2.0)}
        optimise(Rosenbrock(), start, optimiser, 5, checkpoint=tmp_path, resume=True)
    with pytest.raises(InputError, match="Evaluation 2 has another 'a'"):
        rosenbrock(optimiser, 5, checkpoint=tmp_path, resume=True, bounds={"a": (-2.0, -1.12)})
    with pytest.raises(InputError, match="already holds the evaluations"):
        rosenbrock(optimiser, 5, checkpoint=tmp_path)
    assert (tmp_path / REPLAY_LOG).read_bytes() == before
    one, other, folder = Rosenbrock(), Rosenbrock(), tmp_path / "begun" / "where there is nothing"
    one.fingerprint, other.fingerprint = "60 steps", "61 steps"
    for iterations in (2, 3):  # an estimator without a repr of its own is the same
        options = {"checkpoint": folder, "resume": True, "gradient": type("Plain", (), {})()}
        assert rosenbrock(optimiser, iterations, problem=one, **options).evaluations == iterations + 1
    with pytest.raises(InputError, match="problem = 60 steps and now has problem = 61 steps"):
        rosenbrock(optimiser, 2, problem=other, **options)
    one, other = (lambda parameters: Rosenbrock().value_and_gradient(parameters) for _ in range(2))
    one.__qualname__ = "valley"
    assert bits(rosenbrock(optimiser, 2, problem=one, checkpoint=tmp_path / "b")) == bits(rosenbrock(optimiser, 2))
    with pytest.raises(InputError, match="problem"):
        rosenbrock(optimiser, 2, problem=other, checkpoint=tmp_path / "b", resume=True)


def test_a_checkpoint_that_cannot_be_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / REPLAY_LOG)
    for options, words in [
        ({"resume": True}, "resume=True needs the checkpoint"),
        ({"checkpoint": tmp_path / "file" / "run"}, "cannot be written"),
        *(({"checkpoint": tmp_path, "resume": resume}, "no regular file") for resume in (False, True)),
    ]:
        with pytest.raises(InputError, match=words):
            rosenbrock(Adam(0.05), 3, **options)


# ---- not finite -----------------------------------------------------------------------------------------------------
@dataclass
class Breaks:
    """A quadratic of which one number is broken from the third evaluation on."""

    loss: float = 1.0
    gradient: float = 1.0
    evaluations: int = 0

    def value_and_gradient(self, parameters, gradient=None):
        self.evaluations += 1
        broken = self.evaluations > 2
        x, g = parameters["x"], parameters["g"].copy()
        if broken:
            g[1, 2] = self.gradient
        return (self.loss if broken else float(x**2 + np.sum(parameters["g"] ** 2))), {"x": 2.0 * x, "g": g}


@pytest.mark.parametrize("optimiser", [Adam(0.1), GradientDescent(0.1), LBFGS()])
@pytest.mark.parametrize(
    ("problem", "what"),
    [
        (Breaks(gradient=np.nan), "gradient with respect to 'g' is not finite"),
        (Breaks(gradient=1e200), "gradient with respect to 'g' is not finite or beyond"),
        (Breaks(loss=np.inf), "loss is inf as a function of 'x', 'g'"),
        (Breaks(loss=np.nan), "loss is nan"),
    ],
)
def test_not_finite_stops_with_advice_and_keeps_the_rest(optimiser, problem, what, tmp_path):
    start = {"x": 1.0, "g": np.ones((2, 3))}
    with pytest.raises(ComputationError, match=r"^At the start the (loss is (nan|inf) .*; try another|gradient)"):
        optimise(replace(problem, evaluations=2), start, optimiser, 10)
    with pytest.raises(ComputationError, match=f"In evaluation 2 the {what}.*smaller learning rate") as caught:
        optimise(replace(problem), start, optimiser, 10, checkpoint=tmp_path)
    assert str(tmp_path) in str(caught.value)
    records: list[Record] = []
    with pytest.raises(ComputationError):
        again = {"checkpoint": tmp_path, "resume": True, "on_iteration": records.append}
        optimise(replace(problem, evaluations=2), start, optimiser, 10, **again)
    assert [record.replayed for record in records] == [True, True]


@dataclass
class Walled:
    """x^2, which refuses what is not above a floor."""

    floor: float

    def value_and_gradient(self, parameters, gradient=None):
        if parameters["x"] < self.floor:
            raise InputError(f"parameter x is {parameters['x']:g}, but must be at least {self.floor:g}.")
        return float(parameters["x"] ** 2), {"x": 2.0 * parameters["x"]}


def test_parameters_that_a_search_comes_to_are_no_mistake_of_the_user(tmp_path):
    """The step to them is refused and halved, until it is next to nothing."""
    found = optimise(Walled(0.75), {"x": 1.0}, Adam(learning_rate=0.1), 3)
    assert found.parameters["x"] == pytest.approx(0.75, abs=2e-3) and found.refused == 1
    assert found.message.endswith("It refused 1 step, as runs diverged or parameters were out of their range.")
    with pytest.raises(ComputationError, match=r"In evaluation 1 the search tried .* x is 0.7499") as caught:
        optimise(Walled(0.75), {"x": 0.75}, Adam(learning_rate=0.1), 10, checkpoint=tmp_path)
    assert str(tmp_path) in str(caught.value)
    with pytest.raises(InputError, match="x is 1, but"):
        optimise(Walled(2.0), {"x": 1.0}, Adam(learning_rate=0.1), 10)


def steep(parameters):
    """Leads to where all runs diverge, beyond a speed of 1."""
    if parameters["speed"][0] > 1.0:
        raise DivergedError(step=3, particle=7, advice="try a smaller time step")
    return 5.0 - parameters["speed"][0], {"speed": np.array([-1.0, 0.0])}


def test_a_search_that_comes_to_a_run_that_diverges_says_where(tmp_path):
    """After the step was halved 10 times; also where it is resumed."""
    words = (
        r"step 3: particle 7 was lost; try a smaller time step, a smaller learning rate or scale, or bounds on the "
        r"parameters; the search had reached speed \[1\.0002 0\. +\]; the lowest earlier loss is 4 at speed "
        r"\[1\. 0\.\]\.$"
    )
    records = []
    options = {"checkpoint": tmp_path, "resume": True, "on_iteration": records.append}
    for _ in range(2):
        with pytest.raises(DivergedError, match=words) as caught:
            optimise(steep, {"speed": [0.0, 0.0]}, GradientDescent(learning_rate=0.25), 10, **options)
        assert (caught.value.step, caught.value.particle) == (3, 7)
    assert [record.replayed for record in records] == [False] * 5 + [True] * 5
    with pytest.raises(DivergedError, match=r"try a smaller time step\.$"):
        optimise(steep, {"speed": [2.0, 0.0]}, GradientDescent(learning_rate=0.4), 10)


class Cliff:
    """A bowl, beyond whose bottom a cliff is where runs diverge; a call may be interrupted."""

    def __init__(self, fail_at=None):
        self.calls, self.lost, self.fail_at = 0, 0, fail_at

    def value_and_gradient(self, parameters, gradient=None):
        if self.calls == self.fail_at:
            raise Interrupted
        self.calls += 1
        x = parameters["x"]
        if x[0] > 1.3:
            self.lost += 1
            raise DivergedError(step=1, particle=0, advice="try less")
        offset = x - [1.0, 0.5]
        return float(offset @ (offset * [1.0, 3.0])), {"x": 2.0 * offset * [1.0, 3.0]}


TOO_FAR = [Adam(0.9), GradientDescent(0.3, momentum=0.6), LBFGS(scale=4.0), LineSearch(scale=3.0)]
"""Each comes to the cliff on its way."""


@pytest.mark.parametrize("optimiser", TOO_FAR, ids=lambda optimiser: type(optimiser).__name__)
def test_a_search_goes_on_past_runs_that_diverge(optimiser, tmp_path):
    """And goes on from any interruption with the same bits."""

    def search(cliff, **options):
        return optimise(cliff, {"x": np.array([-1.0, 0.4])}, optimiser, 20, **options)

    whole = Cliff()
    found = search(whole)
    assert whole.lost > 0 and found.updates >= 8 and found.loss < 1e-2
    assert found.evaluations == len(found.history) and all(np.isfinite(one.loss) for one in found.history)
    if not isinstance(optimiser, LineSearch):  # whose trials are no evaluations
        assert found.refused == found.history[-1].refused == whole.lost
        assert found.history[0].refused == 0 and whole.calls == found.evaluations + found.refused
        told = rf" It refused {found.refused} steps?, as runs diverged or parameters were out of their range\.$"
        assert re.search(told, found.message)
    for calls in range(0, whole.calls, 4):
        folder = tmp_path / str(calls)
        with pytest.raises(Interrupted):
            search(Cliff(fail_at=calls), checkpoint=folder)
        rest = Cliff()
        again = search(rest, checkpoint=folder, resume=True)
        assert bits(again) == bits(found) and rest.calls == whole.calls - calls
        assert (again.message, again.refused) == (found.message, found.refused)


def test_a_step_that_is_refused_is_halved_and_the_learning_rate_with_it():
    """Along x = 0, 0.25 the whole step of 0.5 leads to 0.75, where runs diverge."""

    def slope(parameters):
        asked.append(float(parameters["x"]))
        if parameters["x"] >= 0.75:
            raise DivergedError(step=1, particle=0, advice="try less")
        return -parameters["x"], {"x": -1.0}

    asked = []
    found = optimise(slope, {"x": 0.0}, GradientDescent(learning_rate=0.5), 3)
    assert asked == [0.0, 0.5, 1.0, 0.75, 0.625, 0.75, 0.6875]
    assert [(one.updates, one.refused) for one in found.history] == [(0, 0), (1, 0), (2, 2), (3, 3)]
    assert found.parameters == found.last_parameters == {"x": 0.6875}


def test_refused_steps_leave_what_lbfgs_knows_of_the_curvature():
    """A quadratic of many numbers takes hardly more evaluations with a cliff beyond its bottom than without one."""
    sizes = np.geomspace(1.0, 50.0, 12)

    def search(farthest):
        def bowl(parameters):
            if (parameters["x"] > farthest).any():
                raise DivergedError(step=1, particle=0, advice="try less")
            offset = parameters["x"] - 1.0
            return float(offset**2 @ sizes), {"x": 2.0 * offset * sizes}

        return optimise(bowl, {"x": np.zeros(12)}, LBFGS(scale=3.0), 60)

    free, bounded = search(np.inf), search(1.05)
    assert bounded.loss < 1e-6 and bounded.refused > 0
    assert bounded.evaluations + bounded.refused < 2 * free.evaluations


def test_an_ensemble_too_much_of_which_diverges_is_refused_too():
    """The trials of a line search do not diverge, but the members of the ensemble about the best of them."""

    class Problem:
        def value_and_gradient(self, parameters, gradient=None):
            if parameters["x"] > 0.97:
                raise DivergedError(1, 0, "try less").among_others("5 of 8 runs of the ensemble diverged:")
            return self.value(parameters), {"x": -1.0}

        def value(self, parameters):
            return float(-parameters["x"])

    found = optimise(Problem(), {"x": 0.0}, LineSearch(scale=0.4), 10, bounds={"x": (None, 2.0)})
    assert found.refused > 0 and 0.9 < found.parameters["x"] <= 0.97


class Members:
    """A slope whose runs have members of an ensemble that diverge, one of 8 at each gradient."""

    def __init__(self):
        self.simulation = cortado.Simulation(plane(), precision="float64")

    def value(self, parameters):
        return float(parameters["gravity"][0])

    def value_and_gradient(self, parameters, gradient=None):
        found = gradient.estimate(self, parameters)
        return found.loss, found.gradient


@dataclass(frozen=True)
class OneOfEight:
    """An estimator of which every eighth gradient diverges."""

    count: list

    def estimate(self, problem, parameters, observe=None):
        self.count.append(0)
        if len(self.count) % 8 == 0:
            raise DivergedError(len(self.count), 0, "try less")
        return Estimate(problem.value(parameters), {"gravity": np.array([1.0, 0.0])})


def test_a_search_counts_what_its_averages_leave_out_and_warns_once():
    mean = EnsembleMean(0.1, samples=8, position_noise=0.0, estimator=OneOfEight([]))
    with pytest.warns(CortadoWarning) as said:
        found = optimise(Members(), {"gravity": [0.0, -9.81]}, GradientDescent(1.0), 2, gradient=mean)
    assert [str(one.message)[:44] for one in said] == ["1 of 8 runs of the ensemble diverged, so tha"]
    assert found.left_out == 6 and [one.left_out for one in found.history] == [2, 4, 6]
    assert "updates. It left 6 runs out of its averages, as runs diverged or" in found.message


# ---- wrong input ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "setting", "values"),
    [
        (Adam, "learning_rate", (0.0, np.nan, "fast", {"x": 0.0})),
        *((Adam, name, (1.0, -0.1)) for name in ("beta1", "beta2")),
        (Adam, "epsilon", (0.0,)),
        (GradientDescent, "momentum", (1.0,)),
        (LBFGS, "memory", (0, 10**9)),
        (LBFGS, "tolerance", (-1.0,)),
        (LBFGS, "scale", (0.0,)),
        (LineSearch, "trials", (1, 10**9)),
    ],
)
def test_wrong_settings_are_refused(kind, setting, values):
    for value in values:
        with pytest.raises(InputError, match="must be"):
            kind(**({} if kind in (LBFGS, LineSearch) else {"learning_rate": 0.1}) | {setting: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": {}}, "start is empty"),
        ({"start": {"x": np.array([1.0, np.nan])}}, "'x' has components that are not finite"),
        ({"start": {"x": "one"}}, "'x' is 'one', but must be a number or an array"),
        ({"bounds": {"x": (None, "2")}}, "upper bound of 'x' is '2'"),
        ({"start": {"x": np.zeros((0, 3))}}, r"'x' has shape \(0, 3\), but must have at least one"),
        ({"start": np.ones(2)}, r"^The start is array\(\[1., 1.\]\), but must be a dictionary"),
        ({"optimiser": Adam}, "^The optimiser must be an object such as"),
        ({"optimiser": "adm"}, "^The optimiser is 'adm', but must be one of 'adam', 'gradient_descent', 'lbfgs'"),
        ({"optimiser": "gradient_descent"}, "^'gradient_descent' needs a value for 'learning_rate'; its settings are"),
        ({"optimiser": "lbfgs", "learning_rate": 0.1}, "^'lbfgs' has no setting 'learning_rate'; its settings"),
        ({"optimiser": "adam", "learning_rate": -1.0}, "^learning_rate must be a positive, finite number"),
        ({"learning_rate": 0.1}, "^optimise was given 'learning_rate', but takes settings only with the name of an"),
        ({"optimiser": Adam({"y": 0.1})}, "learning_rate is given for 'y', but the optimised parameters are 'x'"),
        ({"optimiser": LBFGS(scale={})}, "scale is given for none"),
        ({"iterations": 0}, "number of iterations"),
        ({"iterations": 10**12}, "number of iterations must be .* at most 10,000,000, not 1000000000000"),
        ({"bounds": {"y": (0.0, 1.0)}}, "Bounds are given for 'y'"),
        ({"bounds": {"x": (2.0, 3.0)}}, "start of 'x' is outside of its bounds in 2 of 2"),
        ({"bounds": {"x": (3.0, 2.0)}}, "lower bound of 'x' must not exceed"),
        ({"bounds": {"x": (np.zeros(3), None)}}, r"must be a pair \(lower, upper\)"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_evaluated(change, message):
    problem = Quadratic({"x": np.zeros(2)})
    call = {"start": {"x": np.ones(2)}, "optimiser": Adam(0.1), "iterations": 3} | change
    with pytest.raises(InputError, match=message):
        optimise(problem, **call)
    assert not problem.seen


@pytest.mark.parametrize("optimiser", [LineSearch(trials=1000), LBFGS(memory=1000)])
def test_what_does_not_fit_into_memory_is_refused(optimiser, monkeypatch):
    monkeypatch.setattr("cortado.device.threads.available", lambda device=None: 1e7)
    with pytest.raises(InputError, match=r"^This needs about .* of memory, most of it for .*; take fewer"):
        optimise(Quadratic({"x": np.zeros(2000)}), {"x": np.ones(2000)}, optimiser, 3)


# ---- what is handed on ----------------------------------------------------------------------------------------------


def test_the_history_is_safe_from_a_problem_that_overwrites_its_arguments():
    class Careless(Quadratic):
        def value_and_gradient(self, parameters, gradient=None):
            answer = super().value_and_gradient({"x": parameters["x"].copy()})
            parameters["x"][:] = np.nan
            return answer

    start = np.ones(2)
    careful = optimise(Quadratic({"x": np.zeros(2)}), {"x": start}, LBFGS(), 5)
    assert bits(optimise(Careless({"x": np.zeros(2)}), {"x": start}, LBFGS(), 5)) == bits(careful)
    np.testing.assert_array_equal(start, np.ones(2))


# ---- names and functions --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "settings", "optimiser"),
    [
        ("adam", {"learning_rate": 0.05, "beta1": 0.8}, Adam(0.05, beta1=0.8)),
        ("gradient_descent", {"learning_rate": {"a": 1e-3, "b": 2e-3}}, GradientDescent({"a": 1e-3, "b": 2e-3})),
        ("lbfgs", {}, LBFGS()),
    ],
)
def test_an_optimiser_may_be_given_by_its_name(name, settings, optimiser):
    assert bits(rosenbrock(name, **settings)) == bits(rosenbrock(optimiser))


TWO = "but must return two things: the loss, a number, and the gradient, a dictionary with an array for each parameter"
WRONG_PROBLEMS = [
    (3, {}, r"problem is 3, but must be a cortado\.Problem, an object with"),
    (Rosenbrock, {}, "problem is the class Rosenbrock, but must be an instance"),
    (lambda p: (0.0, {}), {"gradient": object()}, "gradient is given, but must be left out"),
    (lambda p: 1.5, {}, f"problem returned 1.5, {TWO}"),
    (lambda p: None, {}, f"problem returned None, {TWO}"),
    (lambda p: (1.0, {"a": 0.0}, 2), {}, f"problem returned a tuple of 3, {TWO}"),
    (lambda p: (1.0, {"a": np.zeros(2), "b": 0.0}), {}, ".*gradients of shapes"),
    (lambda p: (1.0, np.zeros(2)), {}, f"problem returned a loss and a gradient of type ndarray, {TWO}"),
]


@pytest.mark.parametrize(("problem", "options", "words"), WRONG_PROBLEMS)
def test_what_cannot_be_optimised_is_refused(problem, options, words):
    with pytest.raises(InputError, match=f"^{words}"):
        rosenbrock(LBFGS(), problem=problem, **options)
