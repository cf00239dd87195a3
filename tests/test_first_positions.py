"""First positions as a parameter: judged as points of a file are, and found from last ones, in JAX too."""

import warnings

import numpy as np
import pytest

from cortado import CortadoWarning, InputError, Problem, Simulation, losses, optimise, optimisers
from scenes import plane, scene

STEPS = 2
PERIODIC = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.8], "periodic": [True, False]}


def problem_of(made, **options):
    simulation = Simulation(made, precision="float64", **options)
    return Problem(simulation, STEPS, losses.CentreOfMass(np.zeros(made.dimension))), simulation.positions


def squeezed(positions, factor):
    middle = positions.mean(axis=0)
    return middle + factor * (positions - middle)


def told(work):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        work()
    return [str(one.message) for one in caught if issubclass(one.category, CortadoWarning)]


@pytest.mark.parametrize("make, apart", [(plane, 0.0), (scene, 1e-9)])
def test_two_particles_at_one_place_are_refused(make, apart):
    problem, x = problem_of(make())
    x = x.copy()
    x[9] = x[2] + apart
    words = r"^parameter initial_positions has particles 2 and 9 at one place, \(.*\) m, but must have them about a"
    for work in (problem.value, problem.value_and_gradient, lambda v: problem.simulation.run(1, v)):
        with pytest.raises(InputError, match=words):
            work({"initial_positions": x})
    problem.value({"initial_positions": problem.simulation.positions})


def once_round(x):
    return np.where(np.arange(len(x))[:, None] == 9, x[2] + [2.0 * 0.4, 0.0], x)


def burst(x):
    return squeezed(x, 0.9)


BURST = "Particles at initial_positions have "


@pytest.mark.parametrize(
    ("made", "options", "moved", "words"),
    [
        (plane(container=PERIODIC), {}, once_round, "particles 2 and 9 at one place"),
        (plane(), {}, burst, rf"^{BURST}1\.\d+ times the rest density .* compressed"),
        (scene(), {}, burst, rf"^{BURST}1\.\d+ times the rest density .* compressed"),
        (plane(), {"batch": 3}, lambda x: np.stack([x, burst(x), x]), f"^In scene 1 of the batch, {BURST}"),
    ],
    ids=["across a period", "in the plane", "in space", "one of a batch"],
)
def test_positions_that_cannot_be_are_refused(made, options, moved, words):
    problem, x = problem_of(made, **options)
    with pytest.raises(InputError, match=words):
        problem.value({"initial_positions": moved(x)})


def test_a_lattice_that_is_squeezed_a_little_and_near_particles_are_warned_of_once():
    problem, x = problem_of(plane())

    def search():
        for factor in (0.97, 0.965, 0.96):
            problem.value({"initial_positions": squeezed(x, factor)})

    (sentence,) = told(search)
    assert sentence.startswith("particles at initial_positions are compressed by ") and "fly apart" in sentence
    disturbed = np.clip(x + 0.005 * np.random.default_rng(3).standard_normal(x.shape), 0.01, None)
    assert told(lambda: problem_of(plane())[0].value({"initial_positions": disturbed})) == []
    x = x.copy()
    x[0] = x[1] + [-0.3 * 0.05, 0.0]
    (sentence,) = told(lambda: problem_of(plane())[0].value({"initial_positions": x}))
    assert "only 0.3 spacings apart" in sentence


def test_positions_that_move_little_by_little_are_judged_where_they_come_to():
    problem, x = problem_of(plane())
    for factor in np.arange(1.0, 0.96, -0.004):
        problem.value({"initial_positions": squeezed(x, factor)})
    with pytest.raises(InputError, match="compressed"):
        for factor in np.arange(0.96, 0.85, -0.004):
            problem.value({"initial_positions": squeezed(x, factor)})


def test_a_search_refuses_steps_that_crowd_particles():
    problem, x = problem_of(plane())
    together, start = Problem(problem.simulation, 1, losses.FinalPositions(squeezed(x, 0.7))), {"initial_positions": x}
    with pytest.warns(CortadoWarning, match="compressed"):
        found = optimise(together, start, optimisers.GradientDescent(2.0), 20)
    aside = optimise(together, start, optimisers.LineSearch(scale=0.05), 2)
    assert found.refused > 0 and max(found.loss, aside.loss) < together.value(start)


def test_each_limit_of_stability_is_told_once():
    problem, _ = problem_of(plane())

    def search():
        thick = ({"viscosity": 200.0}, {"viscosity": 300.0}, {"viscosity": 300.0, "gravity": [0.0, -50.0]})
        for values in (*thick, {"gravity": [0.0, -2000.0]}, {"gravity": [0.0, -3000.0]}):
            problem._space.checked(values)

    sentences = told(search)
    assert len(sentences) == 2
    assert "comes from viscosity" in sentences[0] and "comes from viscosity" not in sentences[1]


def test_first_positions_are_found_from_last_ones():
    """Of a cube that hits the floor on the way: after 5 iterations nearer than JAX-SPH's notebook after 15. Steps are
    four times as long as in docs/layers.md, to be quick."""
    jax = pytest.importorskip("jax", reason="JAX is not installed", exc_type=ImportError)
    import cortado.jax

    box = cortado.load_scene("docs/figures/falling_cube.toml")
    box = box.replaced("fluid.0.lower=[0.5, 0.3]", "fluid.0.upper=[0.8, 0.6]", "solver.time_step=0.02")
    guess = cortado.Simulation(box.replaced("fluid.0.lower=[0.075, 0.475]", "fluid.0.upper=[0.375, 0.775]"))
    true = cortado.Simulation(box)
    last = true.run(25).positions[-1]
    assert last[:, 1].min() < 0.05
    distance = cortado.jax.value(cortado.Problem(guess, 25, cortado.losses.FinalPositions(last)))
    slope = jax.jit(jax.value_and_grad(lambda x: distance({"initial_positions": x})))
    positions = jax.numpy.asarray(guess.positions, dtype="float32")
    begun = np.sqrt(np.mean((positions - true.positions) ** 2))
    for _ in range(5):
        value, gradient = slope(positions)
        positions -= 0.25 * len(positions) * gradient
    assert np.sqrt(value / 2.0) < 0.023
    assert np.sqrt(np.mean((positions - true.positions) ** 2)) < 0.2 * begun
