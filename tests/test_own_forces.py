"""Forces that a user gives: run, differentiated, certified, searched for, in batches, in other processes."""

import pickle

import numpy as np
import pytest

import cortado
from cortado import InputError, Problem, Simulation, gradients
from cortado.scene.parameters import Axis, Parameter
from finite_differences import central_difference
from own_forces import Breeze
from scenes import plane, splash

STEPS = 8
POINT = {
    "breeze.k": np.array(2.0),
    "breeze.wind": np.array([0.5, 1.0, -0.4]),
    "time_step": np.array(0.002),
    "gravity": np.array([0.5, -9.0, 0.3]),
}


def problem(forces, **options):
    simulation = Simulation(options.pop("scene", splash()), **{"precision": "float64", **options}, forces=forces)
    steps = options.pop("steps", STEPS)
    target = simulation.positions + 0.02 * np.sin(7.0 * simulation.positions)
    return Problem(simulation, steps, cortado.losses.FinalPositions(target))


@pytest.mark.parametrize("name", POINT)
def test_reverse_forward_tape_and_differences_agree(name):
    judged = problem([Breeze()])
    random = np.random.default_rng(5)
    direction = random.standard_normal(np.shape(POINT[name]))
    found = judged.value_and_gradient(POINT)[1][name]
    along = float(np.sum(found * direction))
    assert along != 0.0
    np.testing.assert_allclose(along, judged.tangent(POINT, {name: direction}), rtol=1e-9)
    np.testing.assert_allclose(found, judged.value_and_gradient(POINT, gradients.Tape())[1][name], rtol=1e-9)
    h = 1e-6 * max(float(np.abs(POINT[name]).max()), 1e-3)
    np.testing.assert_allclose(along, central_difference(judged.value, POINT, {name: direction}, h), rtol=3e-5)


def test_a_run_that_goes_on_has_the_same_bits_and_its_own_time():
    simulation = Simulation(splash(), forces=[Breeze()])
    whole = simulation.run(STEPS)
    first = simulation.run(3)
    rest = simulation.run(STEPS - 3, state=first.last_state)
    np.testing.assert_array_equal(rest.positions[-1], whole.positions[-1])
    late = simulation.run(STEPS - 3)
    assert np.abs(late.velocities[-1] - rest.velocities[-1]).max() > 0.0


def test_what_the_force_does_is_what_it_says():
    """Without pressure and viscosity one step is exact: v + dt (g + k sin(t) (wind - v)), with t = 0 at the first."""
    free = plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False})
    simulation = Simulation(free, precision="float64", forces=[Breeze(4.0)])
    dt, v, gravity, wind = 0.0021, np.zeros(2), np.array([0.0, -9.81]), np.array([1.0, 0.5])
    for step in range(5):
        v = v + dt * (gravity + 4.0 * np.sin(step * dt) * (wind - v))
    np.testing.assert_allclose(simulation.run(5).velocities[-1], np.tile(v, (64, 1)), rtol=1e-12)


def test_scenes_of_a_batch_have_their_own():
    judged, values = problem([Breeze()], batch=2), {"breeze.k": [1.0, 3.0], "time_step": [0.002, 0.001]}
    loss, gradient = judged.value_and_gradient(values)
    alone = problem([Breeze()])
    for b in range(2):
        one = {name: value[b] for name, value in values.items()}
        single, found = alone.value_and_gradient(one)
        assert single == loss[b]
        for name in values:
            np.testing.assert_array_equal(found[name], gradient[name][b])


def test_one_that_has_no_batches_is_refused():
    class Alone(Breeze):
        def force(self, setting):
            made = super().force(setting)
            made.batches = False
            return made

    with pytest.raises(InputError, match="batch is 2, but must be left out, as the force BreezeForce has no"):
        problem([Alone()], batch=2)


def test_it_is_certified_in_float32():
    assert cortado.certify(problem([Breeze()], precision="float32"), ["breeze.k", "breeze.wind", "time_step"]).right


def test_it_is_searched_for():
    judged = problem([Breeze()])
    goal = judged.end({"breeze.k": 5.0}).positions
    judged = Problem(judged.simulation, STEPS, cortado.losses.FinalPositions(goal))
    found = cortado.optimise(judged, {"breeze.k": 3.0}, optimiser=cortado.optimisers.LBFGS(), iterations=12)
    np.testing.assert_allclose(found.parameters["breeze.k"], 5.0, rtol=1e-3)


def test_it_goes_to_other_processes():
    judged = problem([Breeze()])
    again = pickle.loads(pickle.dumps(judged))
    assert again.value({"breeze.k": 1.5}) == judged.value({"breeze.k": 1.5})
    assert again.fingerprint == judged.fingerprint


class Gusts(Breeze):
    """With a setting that is no parameter."""

    def __init__(self, gusts):
        super().__init__()
        self.gusts = gusts


def test_another_force_is_another_problem():
    of_functions = [Gusts(lambda t: 1.0 * t)], [Gusts(lambda t: 2.0 * t)]
    different = ([], [Breeze()], [Breeze(2.0)], [Gusts(1)], [Gusts(2)], *of_functions)
    texts = {problem(forces).fingerprint for forces in different}
    assert len(texts) == len(different)


class Named(Breeze):
    def __init__(self, *parameters):
        self._parameters = parameters

    @property
    def parameters(self):
        return self._parameters


def number(name, value=1.0):
    return Parameter(name, "", "", Axis.SCALAR, lambda source: value)


@pytest.mark.parametrize(
    ("forces", "said"),
    [
        (Breeze(), "forces is <.*>, but must be a list of forces, such as"),
        ("drag", "forces is 'drag', but must be a list of forces"),
        ([Breeze], r"forces has <class .*> at place 0, but each must be an object with a method force\(setting\)"),
        ([Breeze(), 3.0], "forces has 3.0 at place 1, but each must be"),
        ([Named("k")], r"has parameters \['k'\], but must have a list of"),
        ([Breeze(), Breeze()], "parameter breeze.k of a force has the name of another one, breeze.k, but must have"),
        ([Named(number("gravity"))], "parameter gravity of a force has the name of another one"),
        ([Named(number("a.b")), Named(number("a_b"))], "parameter a_b of a force has the name of another one, a.b"),
        ([Breeze(np.nan)], "parameter breeze.k has a value that is not finite"),
        ([Breeze([1.0, 2.0])], r"parameter breeze.k has shape \(2,\), but must be \(\)"),
        ([Breeze(1e60)], "parameter breeze.k has a value of size 1e.60, but must be at most 1e.50 in float64"),
    ],
)
def test_a_force_that_does_not_fit_is_a_sentence(forces, said):
    with pytest.raises(InputError, match=said):
        problem(forces)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"breeze": 1.0}, "parameter 'breeze' is unknown, but must be one of gravity, .*breeze.k, breeze.wind"),
        ({"time": 1.0}, "parameter 'time' is unknown"),
        ({"breeze.wind": [1.0, 2.0]}, r"parameter breeze.wind has shape \(2,\), but must be \(3,\) in m/s"),
        ({"breeze.k": np.inf}, "parameter breeze.k has a value that is not finite, but must be numbers in 1/s"),
    ],
)
def test_a_value_that_does_not_fit_is_a_sentence(values, said):
    with pytest.raises(InputError, match=said):
        problem([Breeze()]).value(values)


def test_a_scene_without_them_has_no_more_parameters():
    assert "time" not in problem([]).simulation.solver.new_parameters(1).names
    assert "time" not in problem([Breeze()]).simulation.parameters()
