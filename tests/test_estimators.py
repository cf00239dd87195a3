"""Estimators: each does to the adjoint what its formula says, and nothing else."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import warp as wp

from bad_scenes import one_sentence
from cortado import Problem, Simulation, evaluate, gradients, losses
from cortado.errors import ComputationError, CortadoWarning, DivergedError, InputError
from cortado.gradients import AdjointEstimator, AdjointViscosity, Estimate, Filtered
from reference import complex_step
from scenes import Squares, Weighed, box, jet, plane, plane_of_three, pour, scene, splash
from twins import twin

DROPS = [
    box(lower, upper, phase="water")
    for lower, upper in (([0.0, 0.0], [0.4, 0.2]), ([0.5, 0.5], [0.55, 0.55]), ([0.2, 0.6], [0.3, 0.65]))
]
"""A pool, a particle and a pair of particles."""
ROUND = {"container": box([0.0, 0.0], [0.4, 0.8], periodic=[True, False])}
ROUND |= {"forces": {"gravity": [1.0, -9.81], "viscosity": "pairwise"}}
MAKERS = {"3-D": scene, "2-D": plane, "periodic": lambda: plane(**ROUND), "drops": lambda: plane(fluid=DROPS)}
MAKERS |= {"three phases": plane_of_three, "emitter": jet, "emitter, two phases": pour}


@cache
def simulation_of(kind, precision="float64"):
    return Simulation(MAKERS[kind](), precision=precision)


def point_of(simulation, seed=0):
    """The scene's parameters on a lattice that is disturbed, and moving."""
    random, shape = np.random.default_rng(seed), simulation.positions.shape
    names = ["gravity", "viscosity", "rest_density", "time_step"]
    names += ["mass_fractions", "mobility", "interface_width"] if len(simulation.scene.phase) > 1 else []
    names += ["nozzle.path", "nozzle.flow_rate"] if simulation.scene.emitter else []
    point = {name: simulation.parameters()[name] for name in names}
    spacing = simulation.scene.discretisation.spacing
    point["initial_positions"] = simulation.positions + 0.05 * spacing * random.standard_normal(shape)
    point["initial_velocities"] = simulation.velocities + 0.3 * random.standard_normal(shape)
    return point


STEPS, DT = 4, 0.0021
BLOCKS = {2: [0.15, 0.2], 3: [0.1, 0.1, 0.15]}


def weights(simulation, separation):
    d, support = simulation.dimension, simulation.scene.discretisation.support_radius
    w = simulation.smoothing.weight(np.linalg.norm(separation, axis=-1), d, support)
    np.fill_diagonal(w, 0.0)
    most = np.maximum(w.sum(axis=1), simulation.smoothing.weight(np.array([0.5 * support]), d, support))
    return w / np.maximum(most[:, None], most[None, :])


def strain_rates(simulation, separation, v):
    r2 = (separation**2).sum(axis=-1) + 0.01 * simulation.scene.discretisation.support_radius**2
    jumps = ((v[:, None] - v[None, :]) ** 2).sum(axis=-1)
    return np.sqrt((weights(simulation, separation) * jumps / r2).sum(axis=1))


def viscosity(simulation, separation, v, coefficient, dt):
    """(n, n) the filter of one coordinate of an adjoint, and the strengths (n,)."""
    s = np.minimum(coefficient * dt * strain_rates(simulation, separation, v), 0.6)
    w = np.maximum(s[:, None], s[None, :]) * weights(simulation, separation)
    return np.eye(len(w)) + w - np.diag(w.sum(axis=1)), s


class Twin:
    """Steps of the slow twin, of 12 particles in a corner with viscosity that matters, and their Jacobians."""

    def __init__(self, d):
        honey, fluid = (
            {"name": "honey", "rest_density": 1000.0, "viscosity": 5.0},
            box([0.0] * d, BLOCKS[d], phase="honey"),
        )
        forces = {"gravity": [0.3, -9.81, 0.1][:d], "viscosity": "pairwise"}
        room = box([0.0] * d, [0.3] * d)
        made = scene(dimension=d, phase=[honey], fluid=[fluid], container=room, forces=forces)
        self.simulation = Simulation(made, precision="float64")
        point = point_of(self.simulation)
        self.point = {name: point[name] for name in ("initial_positions", "initial_velocities")}
        self.slow, self.shape = twin(self.simulation), self.simulation.positions.shape
        self.volume, self.gravity = self.simulation.solver.lattice.volume, np.asarray(made.forces.gravity)
        self.states = [np.concatenate([array.ravel() for array in self.point.values()])]
        self.jacobians = []
        for _ in range(STEPS):
            state = self.states[-1]
            self.jacobians.append(np.array([complex_step(self.step, [state], [e]) for e in np.eye(len(state))]).T)
            self.states.append(self.step(state))

    def step(self, state):
        x, v = state.reshape(2, *self.shape)
        ones = np.ones(len(x))
        found = self.slow.step(x, v, self.gravity, 1000.0 * self.volume * ones, 1000.0 * ones, 5.0 * ones, DT, 5)
        return np.concatenate([array.ravel() for array in found])

    def viscosity(self, state, coefficient):
        """(n, n) what a filter of the adjoint of one coordinate is."""
        x, v = state.reshape(2, *self.shape)
        return viscosity(self.simulation, x[:, None] - x[None, :], v, coefficient, DT)[0]

    def adjoint(self, bar, estimator):
        """The gradient with respect to the first state, for the adjoint of the last."""
        if getattr(estimator, "order", 1) == 1:
            return self.back(bar, estimator)
        twice = replace(estimator, coefficient=2 * estimator.coefficient)
        return 2 * self.back(bar, estimator) - self.back(bar, twice)

    def back(self, bar, estimator):
        for state, jacobian in zip(reversed(self.states[:-1]), reversed(self.jacobians), strict=True):
            bar = jacobian.T @ bar
            if isinstance(estimator, gradients.AdjointViscosity):
                viscosity = self.viscosity(state, estimator.coefficient)
                filtered = (limited(viscosity @ a, estimator.limit) for a in bar.reshape(2, *self.shape))
                bar = np.concatenate([a.ravel() for a in filtered])
        return bar


def limited(vectors, times):
    sizes = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(1.0, times * np.sqrt((sizes**2).mean()) / np.maximum(sizes, 1e-300))


twin_of = cache(Twin)
ESTIMATORS = [gradients.Exact(), AdjointViscosity(), AdjointViscosity(5.0), AdjointViscosity(1000.0, limit=np.inf)]
ESTIMATORS += [AdjointViscosity(5.0, limit=1.1), AdjointViscosity(5.0, limit=1.1, order=2)]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_gradients_equal_those_of_the_twin(estimator, dimension):
    slow = twin_of(dimension)
    loss = Weighed(slow.simulation)
    _, found = Problem(slow.simulation, STEPS, loss).value_and_gradient(slow.point, estimator)
    last = np.concatenate([w.ravel() for w in (loss.weights["positions"], loss.weights["velocities"])])
    wanted, exact = slow.adjoint(last, estimator), slow.adjoint(last, gradients.Exact())
    gradient = np.concatenate([found[name].ravel() for name in slow.point])
    np.testing.assert_allclose(gradient, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
    assert (np.linalg.norm(wanted - exact) > 0.01 * np.linalg.norm(exact)) == (estimator != gradients.Exact())


def filtered(simulation, coefficient, point=None):
    """An adjoint before and after the viscosity of the first step, with the strengths (n,) in the scene's order."""
    solver, point = simulation.solver, point or point_of(simulation)
    rollout = simulation.rollout(1, point)
    solver.set_substeps(rollout.substeps)
    solver.step_number.zero_()
    solver.replay(rollout.initial, rollout.parameters, (2,))
    bar, random = solver.new_state(), np.random.default_rng(2)
    arrays = bar.numpy(simulation.dimension)
    given = {name: random.standard_normal(array.shape) + 1.0 for name, array in arrays.items()}
    bar.set(given)
    before = bar.numpy(simulation.dimension)
    viscosity = AdjointViscosity(coefficient, limit=np.inf).derivative(rollout)
    viscosity.filter(bar)
    strengths = np.empty(simulation.particles)
    strengths[solver.search.order.numpy()[: simulation.particles]] = viscosity.strengths.numpy()
    return before, bar.numpy(simulation.dimension), strengths


def separations(x, kind):
    separation = x[:, None] - x[None, :]
    if kind == "periodic":
        separation[..., 0] -= 0.4 * np.round(separation[..., 0] / 0.4)
    return separation


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize(("coefficient", "precision"), [(2.0, "float64"), (30.0, "float32"), (1000.0, "float64")])
def test_a_viscosity_equals_the_twins(kind, coefficient, precision):
    """With a great coefficient the strengths of all that strains are the greatest. It keeps sums and does not grow."""
    simulation = simulation_of(kind, precision)
    point = point_of(simulation)
    before, after, strengths = filtered(simulation, coefficient)
    x, v = point["initial_positions"], point["initial_velocities"]
    dt = float(simulation.parameters()["time_step"])
    matrix, wanted = viscosity(simulation, separations(x, kind), v, coefficient, dt)
    small = 1e-12 if precision == "float64" else 1e-5
    np.testing.assert_allclose(strengths, wanted, rtol=0, atol=small)
    assert wanted.max() > 0.005 and (coefficient < 1000.0 or wanted.max() == 0.6)
    for a, found in ((before[name], after[name]) for name in ("positions", "velocities")):
        np.testing.assert_allclose(found, matrix @ a, rtol=0, atol=10 * small)
        assert np.abs(found - a).max() > 0.005
        np.testing.assert_allclose(found.sum(axis=0), a.sum(axis=0), rtol=1e-13 if precision == "float64" else 1e-4)
        assert (np.linalg.norm(found, axis=0) < np.linalg.norm(a, axis=0)).all()
        assert kind != "drops" or (found[-3] == a[-3]).all()  # a particle alone
    for name in set(before) - {"positions", "velocities"}:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-15 if precision == "float64" else 1e-6)


@pytest.mark.parametrize(("kind", "axes"), [("2-D", (0, 1)), ("2-D", (1, 0)), ("3-D", (2, 1))])
def test_a_shear_flow_has_the_strain_rate_that_one_knows(kind, axes):
    """Of v = k y along x: (k y_ij)^2 is a d-th of (k r_ij)^2 in the mean over a lattice. gamma = k / sqrt(d), but for
    0.01 h^2, and beside edges, whose neighbourhoods are not alike on all sides."""
    simulation, k = simulation_of(kind), 3.0
    along, across = axes
    x, d = simulation.positions, simulation.dimension
    v = np.zeros_like(x)
    v[:, along] = k * x[:, across]
    point = {"initial_positions": x, "initial_velocities": v, "time_step": 0.001}
    _, _, strengths = filtered(simulation, 10.0, point=point)
    h = simulation.scene.discretisation.support_radius
    within = (np.minimum(x - x.min(axis=0), x.max(axis=0) - x) > h - 1e-9).all(axis=1)
    assert within.any()
    gamma = strengths[within] / (10.0 * 0.001)
    np.testing.assert_allclose(gamma, k / np.sqrt(d), rtol=0.02)
    assert (gamma < k / np.sqrt(d)).all()


@pytest.mark.parametrize("kind", ["3-D", "periodic", "emitter, two phases"])
def test_without_strength_a_viscosity_is_exact_bit_for_bit(kind):
    simulation = simulation_of(kind)
    problem, point = Problem(simulation, 5, losses.FinalPositions(simulation.positions + 0.1)), point_of(simulation)
    _, exact = problem.value_and_gradient(point)
    found = problem.estimate(point, gradients.AdjointViscosity(0))
    for name, wanted in exact.items():
        assert found.gradient[name].tobytes() == wanted.tobytes(), name


def test_where_the_flow_is_calm_the_gradient_is_exact():
    """A block in free fall, whose particles keep their distances; and none of its adjoints is limited, where that of
    one particle is far above the others."""
    simulation = Simulation(plane(container={"shape": "none"}), precision="float64")
    of_one = (np.arange(simulation.particles) == 3).astype(float)[:, None]
    problem, point = Problem(simulation, 20, Squares({"positions": of_one})), {"gravity": np.array([0.5, -9.81])}
    point["initial_velocities"] = np.zeros_like(simulation.positions) + 0.25
    _, exact = problem.value_and_gradient(point)
    _, found = problem.value_and_gradient(point, gradients.AdjointViscosity(limit=1.0))
    for name, wanted in exact.items():
        np.testing.assert_array_equal(found[name], wanted, name)
    point["initial_velocities"][:, 0] += 1e-3 * simulation.positions[:, 1]
    _, found = problem.value_and_gradient(point, gradients.AdjointViscosity(limit=1.0))
    assert np.abs(found["initial_velocities"] - exact["initial_velocities"]).max() > 1e-3


@pytest.fixture(scope="module")
def chaotic():
    simulation = Simulation(splash(), precision="float64")
    return Problem(simulation, 300, losses.CentreOfMassAlong([1.0, 0.0, 0.0]))


def test_a_viscosity_keeps_the_adjoint_of_a_long_run_from_growing(chaotic):
    point = {"gravity": np.array([0.5, -9.81, 0.0])}
    exact, found = (chaotic.value_and_gradient(point, one)[1] for one in (None, gradients.AdjointViscosity()))
    assert np.linalg.norm(exact["gravity"]) > 30 * np.linalg.norm(found["gravity"])
    smoothed = chaotic.estimate(point, gradients.RandomizedSmoothing(0.1, samples=8))
    a, b = (one["gravity"][:2] for one in (found, smoothed.gradient))  # along z, by symmetry, there is noise alone
    assert a @ b > 0.9 * np.linalg.norm(a) * np.linalg.norm(b) and 0.5 < np.linalg.norm(a) / np.linalg.norm(b) < 1.5


def test_every_adjoint_of_a_state_can_be_observed():
    simulation = simulation_of("2-D")
    problem, point = Problem(simulation, 7, Weighed(simulation)), point_of(simulation)
    seen = {}
    norms = gradients.AdjointNorms(simulation.solver, 7)

    def observe(step, bar):
        seen[step] = bar.numpy(2)
        norms(step, bar)

    found = problem.estimate(point, gradients.AdjointViscosity(), observe)
    assert list(seen) == [7, 6, 5, 4, 3, 2, 1, 0]
    for k, field in enumerate(("positions", "velocities")):
        np.testing.assert_array_equal(seen[7][field], problem.loss.weights[field])
        np.testing.assert_array_equal(seen[0][field], found.gradient[f"initial_{field}"])
        wanted = [np.linalg.norm(seen[step][field]) for step in range(8)]
        np.testing.assert_allclose(norms.numpy()[:, k], wanted, rtol=1e-13)


class Stub:
    """A function of two parameters in place of a problem."""

    def __init__(self, function):
        self.function, self.simulation, self.calls = function, simulation_of("2-D"), []

    def value(self, parameters):
        self.calls.append(parameters)
        return float(self.function(parameters))


POINT = {"gravity": np.array([[1.0, -2.0], [0.5, 3.0]]), "viscosity": np.array(0.7)}


def quadratic(p):
    g, mu = p["gravity"], p["viscosity"]
    return 3.0 * g[0, 0] ** 2 - g[0, 1] * g[1, 0] + 2.0 * mu * g[1, 1] + mu**2


def noisy(p):
    first = simulation_of("2-D").positions
    x = p.get("initial_positions", first)
    return quadratic(p) + 1e4 * p["gravity"][0, 0] * (x[3, 0] - first[3, 0])


class Slopes:
    """In place of an estimator: the gradient of a function of two parameters."""

    def __init__(self, gravity, viscosity):
        self.gravity, self.viscosity, self.asked = gravity, viscosity, []

    def estimate(self, problem, parameters, observe=None):
        self.asked.append(parameters)
        g, mu = parameters["gravity"], parameters["viscosity"]
        gradient = {"gravity": np.array(self.gravity(g, mu)), "viscosity": np.array(self.viscosity(g, mu))}
        return gradients.Estimate(7.0, gradient)


def slopes_of_quadratic():
    return Slopes(
        lambda g, mu: [[6.0 * g[0, 0], -g[1, 0]], [-g[0, 1], 2.0 * mu]], lambda g, mu: 2.0 * g[1, 1] + 2.0 * mu
    )


def wrong_slopes():
    """Its directions are right, and its sizes and signs wrong, in each row of gravity and of the viscosity."""
    return Slopes(lambda g, mu: [[1.8, -0.15], [-10.0, -7.0]], lambda g, mu: 1e6)


@pytest.mark.parametrize(
    ("make", "slopes", "calls"),
    [
        (lambda spread, _: gradients.RandomizedSmoothing(spread, samples=3), None, 1 + 2 * 5 * 3),
        (lambda spread, one: gradients.EnsembleMean(spread, samples=4, estimator=one), slopes_of_quadratic, 1),
        (lambda spread, one: gradients.Guided(spread, parts=2, surrogate=one), wrong_slopes, 1 + 2 * 3 * 2),
    ],
    ids=["smoothed differences", "averages", "guided differences"],
)
def test_gradients_of_a_quadratic_are_exact(make, slopes, calls):
    stub, surrogate = Stub(quadratic), slopes and slopes()
    found = make({"gravity": 0.5, "viscosity": 0.1}, surrogate).estimate(stub, POINT)
    assert found.loss == quadratic(POINT) and len(stub.calls) == calls
    np.testing.assert_allclose(found.gradient["gravity"], [[6.0, -0.5], [2.0, 1.4]], rtol=1e-12)
    np.testing.assert_allclose(found.gradient["viscosity"], 7.4, rtol=1e-12)
    assert slopes is wrong_slopes or max(np.abs(error).max() for error in found.standard_error.values()) < 1e-12
    assert surrogate is None or len(surrogate.asked) == 4


def test_smoothing_takes_waves_off_that_are_narrower_than_the_spread():
    """L = u + sin(k u) / k: its gradient at 0 is 2, that of its average 1 + sin(k r) / (k r)."""
    stub = Stub(lambda p: p["viscosity"] + np.sin(40.0 * p["viscosity"]) / 40.0)
    found = gradients.RandomizedSmoothing(0.3).estimate(stub, {"viscosity": 0.0})
    assert found.gradient["viscosity"] == pytest.approx(1.0 + np.sin(12.0) / 12.0)


def test_intervals_contain_the_mean_as_often_as_they_say():
    """For a mean of so few samples that a normal distribution would promise far too much."""
    stub = Stub(noisy)
    runs = [gradients.RandomizedSmoothing(0.5, samples=3, seed=seed).estimate(stub, POINT) for seed in range(200)]
    middle = np.mean([run.gradient["gravity"][0, 0] for run in runs])
    ends = [[end["gravity"][0, 0] for end in run.interval(0.9)] for run in runs]
    assert abs(np.mean([lower <= middle <= upper for lower, upper in ends]) - 0.9) < 0.05


class NoisySlopes:
    """In place of an estimator: the gradient of a quadratic, with noise that differs from one sample to the next."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)

    def estimate(self, problem, parameters, observe=None):
        found = slopes_of_quadratic().estimate(problem, parameters)
        noise = self.random.standard_normal((2, 2))
        return gradients.Estimate(7.0, {**found.gradient, "gravity": found.gradient["gravity"] + noise})


def test_intervals_of_a_mean_of_gradients_contain_it_as_often_as_they_say():
    """Samples come in pairs, so that there are half as many independent ones."""
    stub, right, inside, samples = Stub(quadratic), np.array([[6.0, -0.5], [2.0, 1.4]]), [], 4
    for seed in range(200):
        mean = gradients.EnsembleMean(0.5, samples, seed=seed, estimator=NoisySlopes(seed))
        found = mean.estimate(stub, POINT)
        assert found.degrees_of_freedom == samples // 2 - 1
        lower, upper = (end["gravity"] for end in found.interval())
        inside += list(((lower <= right) & (right <= upper)).ravel())
    assert 0.9 <= np.mean(inside) <= 0.98


def test_intervals_of_guided_differences_know_that_directions_are_noisy():
    stub = Stub(quadratic)
    settings = {"parts": 1, "position_noise": 0.0}
    guided = (gradients.Guided(0.1, seed=seed, surrogate=NoisySlopes(seed), **settings) for seed in range(150))
    estimates = [one.estimate(stub, POINT) for one in guided]
    mean = np.mean([one.gradient["gravity"] for one in estimates], axis=0)
    ends = [[end["gravity"] for end in one.interval()] for one in estimates]
    assert 0.9 <= np.mean([(lower <= mean) & (mean <= upper) for lower, upper in ends]) <= 0.99
    assert all(1.0 - 1e-9 <= one.degrees_of_freedom <= 2.0 + 1e-9 for one in estimates)


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_guided_differences_are_a_projection_on_the_direction_of_a_gradient_of_any_size(size):
    """The gradient (6, -1/2, 2, 1.4) of gravity on (1, 0, 1, 0)."""
    surrogate = Slopes(lambda g, mu: [[size, 0.0], [size, 0.0]], lambda g, mu: 0.0)
    found = gradients.Guided(0.5, parts=1, surrogate=surrogate).estimate(Stub(quadratic), POINT)
    np.testing.assert_allclose(found.gradient["gravity"], [[4.0, 0.0], [4.0, 0.0]], rtol=1e-12)
    assert found.gradient["viscosity"] == 0.0
    assert all(np.isfinite(end["gravity"]).all() for end in found.interval())


def test_guided_differences_of_nothing_are_nothing_and_say_where_there_is_no_direction():
    flat = Slopes(lambda g, mu: 0.0 * g, lambda g, mu: 0.0)
    found = gradients.Guided(0.1, surrogate=flat).estimate(Stub(lambda values: 7.0), POINT)
    assert not found.gradient["gravity"].any() and not found.standard_error["gravity"].any()
    assert all(not end["gravity"].any() for end in found.interval())
    told = r"^The gradient of .* is not finite, so that Guided has no direction"
    for size in (np.nan, np.inf):
        lost = Slopes(lambda g, mu, size=size: [[size, 0.0], [1.0, 0.0]], lambda g, mu: 0.0)
        with pytest.raises(ComputationError, match=told):
            gradients.Guided(0.5, surrogate=lost).estimate(Stub(quadratic), POINT)


def test_guided_differences_and_their_directions_draw_other_random_numbers():
    first, spacing = simulation_of("2-D").positions, simulation_of("2-D").scene.discretisation.spacing
    stub, surrogate = Stub(quadratic), slopes_of_quadratic()
    gradients.Guided(0.5, surrogate=surrogate).estimate(stub, POINT)
    moved = [one["initial_positions"] for one in (*surrogate.asked, *stub.calls) if "initial_positions" in one]
    drawn = [(positions - first).ravel() / spacing for positions in moved]
    both = [np.round(abs(array), 9) for array in drawn]
    assert len(drawn) == 4 + 2 * 2 * 3 and np.std(drawn) == pytest.approx(0.01, rel=0.1)
    assert not np.isin(both[0], both[-1]).any() and np.isin(both[-1], both[-2]).all()


class Diverging:
    """A function, or an estimator, some of whose calls diverge, by their numbers."""

    def __init__(self, inner, *numbers):
        self.inner, self.numbers, self.called = inner, numbers, 0

    def _count(self):
        self.called += 1
        if self.called - 1 in self.numbers:
            raise DivergedError(3, self.called - 1, "try less")

    def __call__(self, parameters):
        self._count()
        return self.inner(parameters)

    def estimate(self, problem, parameters, observe=None):
        self._count()
        return self.inner.estimate(problem, parameters, observe)


LEFT_OUT = (
    r"^{} of the ensemble diverged, so that {} are left out of the average\. The first error: The simulation diverged"
)


def test_differences_that_diverge_are_left_out_and_the_others_stand_for_them():
    stub = Stub(Diverging(quadratic, 4, 17))
    with pytest.warns(CortadoWarning, match=LEFT_OUT.format("2 of 40 runs", "2 of 20 differences")):
        found = gradients.RandomizedSmoothing(0.5, samples=4).estimate(stub, POINT)
    assert (found.left_out, found.degrees_of_freedom, len(stub.calls)) == (4, 3, 41)
    assert "4 runs left out" in repr(found)
    u = np.array([np.append(p["gravity"], p["viscosity"]) for p in stub.calls[1:]]).reshape(4, 5, 2, 5)
    middle = np.append(POINT["gravity"], POINT["viscosity"])
    rows = []
    for sample, left in zip(u, ([0, 2, 3, 4], [0, 1, 2, 4], range(5), range(5)), strict=True):
        assert not left or np.allclose(sample.mean(axis=1), middle)
        ends = [[quadratic({"gravity": x[:4].reshape(2, 2), "viscosity": x[4]}) for x in sample[k]] for k in left]
        along = [(sample[k][0] - middle) / np.linalg.norm(sample[k][0] - middle) for k in left]
        h = 0.5 * np.sqrt(5.0)
        slopes = [(a - b) / (2.0 * h) * q for (a, b), q in zip(ends, along, strict=True)]
        rows.append(np.sum(slopes, axis=0) * 5 / len(slopes))
    wanted, error = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / 2.0
    np.testing.assert_allclose(found.gradient["gravity"].ravel(), wanted[:4], rtol=1e-10)
    np.testing.assert_allclose(found.standard_error["gravity"].ravel(), error[:4], rtol=1e-10)


def test_a_sample_without_any_difference_is_left_out():
    stub = Stub(Diverging(lambda p: p["viscosity"] ** 2, 2))
    with pytest.warns(CortadoWarning, match="1 of 4 differences"):
        found = gradients.RandomizedSmoothing(0.5, samples=4).estimate(stub, {"viscosity": 0.7})
    assert found.gradient["viscosity"] == pytest.approx(1.4) and found.degrees_of_freedom == 2
    assert found.standard_error["viscosity"] < 1e-12


def test_a_sample_that_diverges_leaves_its_antithetic_pair_out():
    inner = Diverging(slopes_of_quadratic(), 3)
    mean = gradients.EnsembleMean(0.5, samples=8, estimator=inner)
    with pytest.warns(CortadoWarning, match=LEFT_OUT.format("1 of 8 runs", "1 of 4 antithetic pairs")):
        found = mean.estimate(Stub(quadratic), POINT)
    assert (found.left_out, found.degrees_of_freedom, inner.called) == (2, 2, 8)
    np.testing.assert_allclose(found.gradient["gravity"], [[6.0, -0.5], [2.0, 1.4]], rtol=1e-12)


def test_guided_differences_leave_samples_out_that_diverge():
    made = gradients.Guided(0.5, samples=8, differences=4, surrogate=Diverging(slopes_of_quadratic(), 0))
    stub = Stub(Diverging(quadratic, 8))
    with pytest.warns(CortadoWarning) as said:
        found = made.estimate(stub, POINT)
    assert ["antithetic pairs" in str(one.message) for one in said] == [True, False]
    assert "1 of 4 samples of the differences" in str(said[1].message)
    assert found.left_out == 2 + 6
    np.testing.assert_allclose(found.gradient["gravity"], [[6.0, -0.5], [2.0, 1.4]], rtol=1e-6)


def test_an_average_of_too_few_is_refused():
    few = "cannot be averaged, but at most a quarter may be left out: take .* The first error: The simulation"
    smoothed = gradients.RandomizedSmoothing(0.5, samples=2)
    averaged = gradients.EnsembleMean(0.5, samples=4, estimator=Diverging(slopes_of_quadratic(), 1))
    for made, function, words in [
        (smoothed, Diverging(quadratic, 0), "The simulation diverged in step 3: particle 0"),
        (smoothed, Diverging(quadratic, *range(3, 9)), f"6 of 20 runs .* 3 of 10 differences.* {few}"),
        (averaged, quadratic, f"1 of 4 runs.* {few}"),
    ]:
        with pytest.raises(DivergedError, match=f"^{words}"):
            made.estimate(Stub(function), POINT)


def test_a_member_with_a_parameter_out_of_its_range_is_left_out_too():
    """A real problem: of the viscosities that are drawn some are below 0, of a wider ensemble too many are."""
    simulation = simulation_of("2-D")
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions + 0.01))
    mean = gradients.EnsembleMean(0.2, samples=20, position_noise=0.0, seed=1, estimator=gradients.Exact())
    drawn = mean.around(problem, {"viscosity": 0.18})
    pairs = [abs(float(0.2 * drawn.offset()[0])) for _ in range(10)]
    kept = [u for u in pairs if u <= 0.18]
    assert 7 < len(kept) < 10
    said = r"runs of the ensemble cannot be run, so that \d of 10 antithetic pairs are"
    with pytest.warns(CortadoWarning, match=said):
        found = mean.estimate(problem, {"viscosity": 0.18})
    assert found.left_out == 2 * (10 - len(kept))
    slopes = [problem.value_and_gradient({"viscosity": 0.18 + s * u})[1]["viscosity"] for u in kept for s in (1, -1)]
    assert found.gradient["viscosity"] == pytest.approx(np.mean(slopes), rel=1e-12)
    with pytest.raises(
        InputError, match=r"cannot be averaged, .* logarithm .* The first error: parameter viscosity is -4"
    ):
        replace(mean, spread=5.0).estimate(problem, {"viscosity": 0.18})


@pytest.mark.parametrize("make", [gradients.RandomizedSmoothing, gradients.EnsembleMean, gradients.Guided])
def test_no_step_at_all_is_a_run_too(make):
    problem = Problem(simulation_of("2-D"), 0, losses.CentreOfMass([0.2, 0.1]))
    (found,) = evaluate(problem, [{"viscosity": 0.1}], make(1e-3))
    assert found.loss == problem.value({}) and found.gradient == {"viscosity": 0.0}


def test_averaged_and_smoothed_differentiate_the_same_loss():
    """Of cubes the mean of 3 u^2 over the ball of N = 5 numbers, 3 h^2 5 / 7."""
    stub = Stub(lambda p: (p["gravity"] ** 3).sum() + p["viscosity"] ** 3)
    cubes = Slopes(lambda g, mu: 3.0 * g**2, lambda g, mu: 3.0 * mu**2)
    origin = {"gravity": np.zeros((2, 2)), "viscosity": 0.0}
    for estimator in (gradients.RandomizedSmoothing(0.3, 400), gradients.EnsembleMean(0.3, 4000, estimator=cubes)):
        found = estimator.estimate(stub, origin)
        for name, gradient in found.gradient.items():
            assert (np.abs(gradient - 3.0 * 0.3**2 * 5.0 / 7.0) < 4.0 * found.standard_error[name]).all()
            assert (found.standard_error[name] < 0.05 * gradient).all()
    once, again = (gradients.EnsembleMean(0.3, 40, estimator=cubes).estimate(stub, origin) for _ in range(2))
    assert once.gradient["gravity"].tobytes() == again.gradient["gravity"].tobytes()


@pytest.mark.parametrize("masses", [None, np.linspace(1.0, 2.0, 64)])
@pytest.mark.parametrize("make", [losses.CentreOfMass, losses.CentreOfMassAlong])
def test_centres_of_mass_and_their_gradients(make, masses):
    simulation = simulation_of("2-D")
    x, v = (point_of(simulation)[name] for name in ("initial_positions", "initial_velocities"))
    loss = make([0.3, -0.2], masses)
    problem = Problem(simulation, 0, loss)
    centre = np.average(x, axis=0, weights=masses)
    value = ((centre - [0.3, -0.2]) ** 2).sum() if make is losses.CentreOfMass else centre @ [0.3, -0.2]
    found, gradient = problem.value_and_gradient({"initial_positions": x, "initial_velocities": v})
    assert found == pytest.approx(value, rel=1e-13)
    assert not gradient["initial_velocities"].any()
    direction = np.random.default_rng(4).standard_normal(x.shape)
    ahead, behind = (problem.value({"initial_positions": x + h * direction}) for h in (1e-5, -1e-5))
    assert (gradient["initial_positions"] * direction).sum() == pytest.approx((ahead - behind) / 2e-5, rel=1e-8)
    assert loss.fingerprint != make([0.3, -0.1], masses).fingerprint


SEEN = []


class Looking(Filtered):
    def filter(self, bar):
        SEEN.append(bar.velocities.numpy().tobytes())


@dataclass(frozen=True)
class InNumpy(AdjointEstimator):
    def derivative(self, rollout):
        return Looking(gradients.Exact().derivative(rollout))


def test_a_filter_in_numpy_acts_on_every_step():
    """It is not captured with the first of them, as one that only launches kernels is."""
    simulation = simulation_of("2-D")
    Problem(simulation, 9, Weighed(simulation)).value_and_gradient(point_of(simulation), InNumpy())
    assert len(set(SEEN)) == len(SEEN) == 9


@dataclass
class Changing(AdjointEstimator):
    rate: float = 1.0

    def derivative(self, rollout):
        return gradients.Exact().derivative(rollout)


@dataclass(frozen=True)
class Returning:
    """What an estimate should not be."""

    found: object

    def estimate(self, problem, parameters, observe=None):
        return self.found


def estimated(estimator, **parameters):
    return lambda problem: problem.estimate(parameters, estimator)


AVERAGE = Estimate(1.0, {"viscosity": 2.0})
MISTAKES = {
    "order 3": lambda p: gradients.AdjointViscosity(order=3),
    "odd samples": lambda p: gradients.EnsembleMean(samples=5),
    "endless position noise": lambda p: gradients.EnsembleMean(position_noise=np.inf),
    "too many samples": lambda p: gradients.Guided(samples=10**12),
    "negative seed": lambda p: gradients.RandomizedSmoothing(seed=-1),
    "coefficient NaN": lambda p: gradients.AdjointViscosity(float("nan")),
    "coefficient below 0": lambda p: gradients.AdjointViscosity(-1.0),
    "limit below 1": lambda p: gradients.AdjointViscosity(limit=0.5),
    "one sample": lambda p: gradients.RandomizedSmoothing(samples=1),
    "a spread below 0": lambda p: gradients.EnsembleMean({"viscosity": -1.0}),
    "nothing to smooth": lambda p: p.estimate({}, gradients.RandomizedSmoothing()),
    "a spread that is round-off": lambda p: p.estimate({"viscosity": 1.0}, gradients.Guided(1e-17)),
    "a number of one's own averaged": estimated(gradients.EnsembleMean(estimator=Returning(3.0)), viscosity=1.0),
    "a number of one's own at many points": lambda p: evaluate(p, [{"viscosity": 1.0}], Returning(3.0)),
    "differences of no parts": lambda p: gradients.Guided(parts=0),
    "guided by no estimator": lambda p: gradients.Guided(surrogate=gradients.Exact),
    "an average of no estimator": lambda p: gradients.EnsembleMean(estimator=gradients.Exact),
    "spread 0": lambda p: p.estimate({"viscosity": 1.0}, gradients.RandomizedSmoothing(0.0)),
    "spread without a name": lambda p: p.estimate({"viscosity": 1.0}, gradients.RandomizedSmoothing({"gravity": 1.0})),
    "too many numbers": estimated(gradients.RandomizedSmoothing(), initial_positions=np.zeros((125, 3))),
    "masses of others": lambda p: Problem(p.simulation, 1, losses.CentreOfMass([0.0] * 3, np.ones(7))).value({}),
    "no masses": lambda p: losses.CentreOfMass([0.0] * 3, np.zeros(7)),
    "target's shape": lambda p: Problem(p.simulation, 1, losses.CentreOfMass([0.0] * 2)).value({}),
    "direction's shape": lambda p: Problem(p.simulation, 1, losses.CentreOfMassAlong([0.0] * 2)).value({}),
    "an interval in percent": lambda p: replace(AVERAGE, standard_error={"viscosity": 1.0}).interval(95),
    "an interval of no average": lambda p: AVERAGE.interval(),
    "target a number": lambda p: losses.CentreOfMass(1.0),
    "settings that may change": lambda p: p.estimate({"viscosity": 0.1}, Changing()),
    "no gradient": lambda p: p.estimate({"viscosity": 0.1}, Returning(Estimate(1.0, {}))),
    "a gradient of another shape": estimated(Returning(Estimate(1.0, {"viscosity": [1.0]})), viscosity=0.1),
    "a gradient in words": lambda p: p.estimate({"viscosity": 0.1}, Returning(Estimate(1.0, {"viscosity": "small"}))),
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_a_sentence(chaotic, mistake):
    with one_sentence() as caught:
        mistake(chaotic)
    assert len(str(caught.value)) < 300


def test_a_filter_stays_off_a_users_tape():
    simulation = simulation_of("2-D")
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions))
    recorded = []
    for estimator in (gradients.Exact(), gradients.AdjointViscosity()):
        with wp.Tape() as tape:
            problem.estimate({"gravity": [0.0, -9.81]}, estimator)
        recorded.append(len(tape.launches))
    assert recorded[0] == recorded[1]
