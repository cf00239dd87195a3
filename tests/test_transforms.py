"""Coordinates: there and back, derivatives, and a problem that is searched in them."""

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, gradients, losses
from cortado.optimisation.transforms import SMALLEST, Affine, Logarithm, Softmax, TimeInterpolation, Transformed
from finite_differences import decades, directional, distance
from scenes import plane_of_three

STEPS = 6


def random_array(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


CASES = {
    "logarithm": (Logarithm(), random_array(4, 3)),
    "softmax": (Softmax(), random_array(5, 3)),
    "softmax, steep": (Softmax(), 20.0 * random_array(5, 2)),
    "knots": (TimeInterpolation(11, 4), random_array(4, 3)),
    "a knot for each step": (TimeInterpolation(5, 5), random_array(5, 2)),
    "affine": (Affine(random_array(5, 2), random_array(5, 2, 3, 2, seed=3)), random_array(3, 2)),
    "affine of one vector": (Affine(random_array(6), random_array(6, 4, seed=3)), random_array(4)),
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


TABLE, KNOTS = Affine(np.zeros((5, 2)), np.zeros((5, 2, 4))), TimeInterpolation(5, 3)
NO_MATRIX, NO_SHAPE = r"must have \(5, 2\), the shape of base", r"have shape \(.*\), but must have"
NO_NUMBER, NOT_POSITIVE = "but must be a whole number of at least 1", "greater than 0"
MISTAKES = {
    "matrix of a vector": (lambda: Affine(np.zeros((5, 2)), np.zeros((5, 3))), NO_MATRIX),
    "matrix of nothing": (lambda: Affine(np.zeros((5, 2)), np.zeros((5, 2))), NO_MATRIX),
    "affine": (lambda: TABLE.parameter(np.zeros(3)), NO_SHAPE),
    "one knot": (lambda: KNOTS.parameter(np.float64(1.0)), NO_SHAPE),
    "softmax": (lambda: Softmax().parameter(np.zeros(3)), NO_SHAPE),
    "no knots": (lambda: TimeInterpolation(5, 0), NO_NUMBER),
    "half a knot": (lambda: TimeInterpolation(5, 2.5), NO_NUMBER),
    "logarithm of 0": (lambda: Logarithm().coordinate(0.0), NOT_POSITIVE),
}


@pytest.mark.parametrize(("call", "words"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_a_sentence(call, words):
    with pytest.raises(InputError, match=words):
        call()


@pytest.mark.parametrize("u", [np.array([[900.0, -900.0, 0.0]]), np.array([[-1e5, -1e5, -1e5]])])
def test_fractions_add_up_to_1_wherever_the_coordinates_are(u):
    parameter = Softmax().parameter(u)
    assert (parameter >= 0.0).all() and parameter.sum() == pytest.approx(1.0, rel=1e-15)
    assert np.isfinite(Softmax().adjoint(u, np.ones((1, 3)))).all()


@pytest.mark.parametrize(("steps", "knots"), [(11, 4), (5, 5)])
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
    **dict.fromkeys(("viscosity", "time_step"), Logarithm()),
}


def start_of(problem):
    parameters = problem.simulation.parameters()
    c = parameters["mass_fractions"]
    return {
        "gravity": parameters["gravity"] + 0.5 * random_array(STEPS, 2),
        "mass_fractions": 0.8 * c + 0.2 * np.random.default_rng(2).dirichlet(np.ones(3), len(c)),
        "viscosity": parameters["viscosity"],
        "time_step": parameters["time_step"],
        "initial_velocities": 0.3 * random_array(*parameters["initial_velocities"].shape),
    }


@pytest.mark.parametrize("what", ["gravity", "mass_fractions", "viscosity", "time_step", "initial_velocities", "all"])
def test_the_gradient_in_coordinates_is_the_limit_of_differences(problem, what):
    search = Transformed(problem, COORDINATES)
    u = search.coordinate(start_of(problem))
    shapes = {name: np.shape(value) for name, value in u.items()}
    assert shapes == dict(zip(u, [(3, 2), (64, 3), (3,), (), (64, 2)], strict=True))
    loss, gradient = search.value_and_gradient(u)
    assert loss == search.value(u) == problem.value(search.parameters(u))
    sizes = {name: 0.05 if name == "time_step" else 0.3 for name in (u if what == "all" else [what])}
    directions = {name: size * random_array(*np.shape(u[name]), seed=7) for name, size in sizes.items()}
    derivative = directional(gradient, directions)
    assert distance(search.value, u, directions, derivative, decades(2.0, 7.0), enough=1e-6) < 1e-6


def test_estimators_go_back_to_coordinates(problem):
    search, estimator = Transformed(problem, COORDINATES), gradients.AdjointViscosity()
    u = search.coordinate(start_of(problem))
    found, plain = search.estimate(u, estimator), problem.estimate(search.parameters(u), estimator)
    assert found.loss == plain.loss
    for name, gradient in plain.gradient.items():
        wanted = COORDINATES[name].adjoint(u[name], gradient) if name in COORDINATES else gradient
        np.testing.assert_allclose(found.gradient[name], wanted, rtol=1e-12, atol=1e-15 * np.abs(wanted).max())


def test_fingerprints_tell_coordinates_apart(problem):
    coordinates = [{}, *({"gravity": TimeInterpolation(STEPS, knots)} for knots in (3, 4)), {"time_step": Logarithm()}]
    searches = [Transformed(problem, own) for own in [*coordinates, {"viscosity": Logarithm()}]]
    assert len({search.fingerprint for search in searches}) == 5
    turned = {name: COORDINATES[name] for name in reversed(COORDINATES)}
    assert Transformed(problem, COORDINATES).fingerprint == Transformed(problem, turned).fingerprint
    with pytest.raises(InputError, match=r"'viscosty' is unknown, but must be one of .*viscosity"):
        Transformed(problem, {"viscosty": Logarithm()})
