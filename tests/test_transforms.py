"""Coordinates: there and back, derivatives, and a problem that is searched in them."""

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, gradients, losses
from cortado.optimisation.transforms import SMALLEST, Affine, Logarithm, Softmax, TimeInterpolation, Transformed
from finite_differences import decades, distance
from scenes import plane, plane_of_three

STEPS = 6


def random_array(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


CASES = {
    "logarithm of a number": (Logarithm(), random_array()),
    "logarithm": (Logarithm(), random_array(4, 3)),
    "softmax": (Softmax(), random_array(5, 3)),
    "softmax, steep": (Softmax(), 20.0 * random_array(5, 2)),
    "knots": (TimeInterpolation(11, 4), random_array(4, 3)),
    "a knot for each step": (TimeInterpolation(5, 5), random_array(5, 2)),
    "affine": (Affine(random_array(5, 2), random_array(5, 2, 3, 2, seed=3)), random_array(3, 2)),
    "affine of one vector": (Affine(random_array(6), random_array(6, 4, seed=3)), random_array(4)),
    "two knots for two steps": (TimeInterpolation(2, 2), random_array(2, 2)),
}
cases = pytest.mark.parametrize(("coordinates", "u"), CASES.values(), ids=CASES)


@cases
def test_the_adjoint_is_the_limit_of_differences(coordinates, u):
    direction, bar = random_array(*u.shape, seed=1), random_array(*coordinates.parameter(u).shape, seed=2)
    h = 1e-5
    ahead, behind = (coordinates.parameter(u + sign * h * direction) for sign in (1, -1))
    difference = (bar * (ahead - behind)).sum() / (2.0 * h)
    adjoint = coordinates.adjoint(u, bar)
    assert np.shape(adjoint) == u.shape
    assert (adjoint * direction).sum() == pytest.approx(difference, rel=1e-8, abs=1e-12)


@cases
def test_there_and_back(coordinates, u):
    parameter = coordinates.parameter(u)
    if isinstance(coordinates, Softmax):
        parameter = np.maximum(parameter, 2.0 * SMALLEST)
        parameter /= parameter.sum(axis=1, keepdims=True)
    found = coordinates.coordinate(parameter)
    np.testing.assert_allclose(coordinates.parameter(found), parameter, rtol=1e-12)
    np.testing.assert_allclose(coordinates.coordinate(coordinates.parameter(found)), found, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(5, 3), (4, 2, 3), (5, 2)])
def test_a_matrix_that_does_not_fit_is_a_sentence(shape):
    with pytest.raises(InputError, match=r"must have \(5, 2\), the shape of base"):
        Affine(np.zeros((5, 2)), np.zeros(shape))


WRONG_SHAPES = {
    "affine": lambda: Affine(np.zeros((5, 2)), np.zeros((5, 2, 4))).parameter(np.zeros(3)),
    "affine of a number": lambda: Affine(np.zeros((5, 2)), np.zeros((5, 2, 4))).parameter(np.float64(1.0)),
    "affine of a table": lambda: Affine(np.zeros(5), np.zeros((5, 4))).parameter(np.zeros((4, 4))),
    "affine, back": lambda: Affine(np.zeros((5, 2)), np.zeros((5, 2, 4))).coordinate(np.zeros((4, 2))),
    "knots": lambda: TimeInterpolation(5, 3).parameter(np.zeros((4, 2))),
    "knots, back": lambda: TimeInterpolation(5, 3).coordinate(np.zeros((4, 2))),
    "one knot": lambda: TimeInterpolation(5, 3).parameter(np.float64(1.0)),
    "softmax": lambda: Softmax().parameter(np.zeros(3)),
}


@pytest.mark.parametrize("call", WRONG_SHAPES.values(), ids=WRONG_SHAPES)
def test_numbers_of_another_shape_are_a_sentence(call):
    with pytest.raises(InputError, match=r"have shape \(.*\), but must have"):
        call()


@pytest.mark.parametrize(("steps", "knots"), [(5, 0), (0, 3), (5, 2.5), (True, 1)])
def test_so_many_knots_cannot_be(steps, knots):
    with pytest.raises(InputError, match="but must be a whole number of at least 1"):
        TimeInterpolation(steps, knots)


def test_coordinates_of_a_parameter_that_is_misspelt_are_a_sentence(problem):
    with pytest.raises(InputError, match=r"'viscosty' is unknown, but must be one of .*viscosity"):
        Transformed(problem, {"viscosty": Logarithm()})


def test_affine_maps_are_told_apart():
    one, same, other = (Affine(np.zeros(3), scale * np.eye(3)) for scale in (1.0, 1.0, 2.0))
    assert repr(one) == repr(same) != repr(other)


def test_what_is_changed_by_factors_is_positive():
    assert (Logarithm().parameter(np.array([-700.0, 0.0, 3.0])) > 0.0).all()
    for wrong in (0.0, np.array([1.0, -1.0])):
        with pytest.raises(InputError, match="greater than 0"):
            Logarithm().coordinate(wrong)


@pytest.mark.parametrize("u", [np.array([[900.0, -900.0, 0.0]]), np.array([[-1e5, -1e5, -1e5]])])
def test_fractions_add_up_to_1_wherever_the_coordinates_are(u):
    parameter = Softmax().parameter(u)
    assert (parameter >= 0.0).all() and parameter.sum() == pytest.approx(1.0, rel=1e-15)
    assert np.isfinite(Softmax().adjoint(u, np.ones((1, 3)))).all()


def test_pure_particles_have_coordinates_nearby():
    pure = np.eye(3)[[0, 2, 1]]
    u = Softmax().coordinate(pure)
    assert np.isfinite(u).all() and np.abs(u.sum(axis=1)).max() < 1e-12
    assert np.abs(Softmax().parameter(u) - pure).max() < 3.0 * SMALLEST


def test_a_common_shift_of_coordinates_changes_no_fraction():
    u = random_array(5, 3)
    np.testing.assert_allclose(Softmax().parameter(u + 7.0), Softmax().parameter(u), rtol=1e-13)
    assert np.abs(Softmax().adjoint(u, random_array(5, 3, seed=1)).sum(axis=1)).max() < 1e-15


@pytest.mark.parametrize(("steps", "knots"), [(11, 4), (9, 2), (100, 33), (5, 5)])
def test_between_knots_is_a_straight_line(steps, knots):
    u = random_array(knots, 3)
    path = TimeInterpolation(steps, knots).parameter(u)
    wanted = [np.interp(np.linspace(0, 1, steps), np.linspace(0, 1, knots), column) for column in u.T]
    np.testing.assert_allclose(path, np.transpose(wanted), rtol=0, atol=1e-13)
    np.testing.assert_array_equal(path[[0, -1]], u[[0, -1]])
    np.testing.assert_allclose(TimeInterpolation(steps, knots).parameter(np.full((knots, 2), 9.81)), 9.81, rtol=1e-14)


def test_knots_are_the_nearest_path():
    path, knots = random_array(12, 2), TimeInterpolation(12, 3)
    u = knots.coordinate(path)
    rest = knots.parameter(u) - path
    assert np.linalg.norm(rest) > 1.0 and np.abs(knots.adjoint(u, rest)).max() < 1e-13


@pytest.fixture(scope="module")
def problem():
    simulation = Simulation(plane_of_three(), precision="float64")
    random = np.random.default_rng(5)
    target = 0.2 + 0.1 * random.random(simulation.positions.shape)
    return Problem(simulation, STEPS, losses.FinalPositions(target))


COORDINATES = {
    "gravity": TimeInterpolation(STEPS, 3),
    "mass_fractions": Softmax(),
    "viscosity": Logarithm(),
    "time_step": Logarithm(),
}


def start_of(problem):
    parameters = problem.simulation.parameters()
    c = parameters["mass_fractions"]
    mixed = 0.8 * c + 0.2 * np.random.default_rng(2).dirichlet(np.ones(3), len(c))
    rows = parameters["gravity"] + 0.5 * random_array(STEPS, 2)
    velocities = 0.3 * random_array(*parameters["initial_velocities"].shape)
    return {
        "gravity": rows,
        "mass_fractions": mixed,
        "viscosity": parameters["viscosity"],
        "time_step": parameters["time_step"],
        "initial_velocities": velocities,
    }


@pytest.mark.parametrize("what", ["gravity", "mass_fractions", "viscosity", "time_step", "initial_velocities", "all"])
def test_the_gradient_in_coordinates_is_the_limit_of_differences(problem, what):
    search = Transformed(problem, COORDINATES)
    u = search.coordinate(start_of(problem))
    assert {name: np.shape(value) for name, value in u.items()} == {
        "gravity": (3, 2),
        "mass_fractions": (64, 3),
        "viscosity": (3,),
        "time_step": (),
        "initial_velocities": (64, 2),
    }
    loss, gradient = search.value_and_gradient(u)
    assert loss == search.value(u) == problem.value(search.parameters(u))
    chosen = [what] if what != "all" else list(u)
    sizes = {"time_step": 0.05}
    directions = {name: sizes.get(name, 0.3) * random_array(*np.shape(u[name]), seed=7) for name in chosen}
    derivative = sum((gradient[name] * directions[name]).sum() for name in chosen)
    assert distance(search.value, u, directions, derivative, decades(2.0, 7.0), enough=1e-6) < 1e-6


def test_without_coordinates_it_is_the_problem_itself(problem):
    point = start_of(problem)
    search = Transformed(problem, {})
    assert search.parameters(point) == point and search.coordinate(point) == point
    (loss, gradient), (wanted, exact) = search.value_and_gradient(point), problem.value_and_gradient(point)
    assert loss == wanted and all(gradient[name].tobytes() == exact[name].tobytes() for name in point)


@pytest.mark.parametrize("estimator", [gradients.AdjointViscosity(), gradients.AdjointViscosity(order=2)], ids=repr)
def test_estimators_go_back_to_coordinates(problem, estimator):
    search = Transformed(problem, COORDINATES)
    u = search.coordinate(start_of(problem))
    found, plain = search.estimate(u, estimator), problem.estimate(search.parameters(u), estimator)
    assert found.loss == plain.loss
    for name, gradient in plain.gradient.items():
        wanted = COORDINATES[name].adjoint(u[name], gradient) if name in COORDINATES else gradient
        np.testing.assert_allclose(found.gradient[name], wanted, rtol=1e-12, atol=1e-15 * np.abs(wanted).max())


def test_a_cloud_is_one_of_coordinates(problem):
    """Its gravity has one row a knot, and there are few numbers enough for differences."""
    search = Transformed(problem, COORDINATES)
    u = {"gravity": search.coordinate(start_of(problem))["gravity"]}
    _, exact = search.value_and_gradient(u)
    for estimator in (
        gradients.RandomizedSmoothing(0.01, position_noise=0.0),
        gradients.EnsembleMean(0.01, position_noise=0.0, estimator=gradients.Exact()),
    ):
        found = search.estimate(u, estimator).gradient["gravity"]
        assert found.shape == (3, 2)
        assert np.linalg.norm(found - exact["gravity"]) < 0.01 * np.linalg.norm(exact["gravity"])


def test_coordinates_of_parameters_that_are_not_given_do_no_harm(problem):
    search = Transformed(problem, COORDINATES)
    _, gradient = search.value_and_gradient({"viscosity": np.log(problem.simulation.parameters()["viscosity"])})
    assert gradient.keys() == {"viscosity"}


def test_fingerprints_tell_coordinates_apart(problem):
    other = Problem(Simulation(plane(), precision="float64"), STEPS, lambda x, v, loss: None)
    searches = [
        Transformed(problem, {}),
        Transformed(problem, {"gravity": TimeInterpolation(STEPS, 3)}),
        Transformed(problem, {"gravity": TimeInterpolation(STEPS, 4)}),
        Transformed(problem, {"viscosity": Logarithm()}),
        Transformed(problem, {"time_step": Logarithm()}),
        Transformed(other, {"viscosity": Logarithm()}),
    ]
    assert len({search.fingerprint for search in searches}) == len(searches)
    turned = {name: COORDINATES[name] for name in reversed(COORDINATES)}
    assert Transformed(problem, COORDINATES).fingerprint == Transformed(problem, turned).fingerprint
