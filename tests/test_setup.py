"""Setups: targets, starts, coordinates and bounds of a task, on a device."""

import numpy as np
import pytest

from bad_scenes import one_sentence
from bad_tasks import GOOD_TASK, LATTE_PARTICLES, PARTICLES, PLANE_PICTURE, TINY_LATTE
from cortado import optimise
from cortado.image_losses import Pyramid, SquaredDifference
from cortado.optimisation.optimisers import LBFGS, Adam
from cortado.optimisation.task_files import load_task, setup
from cortado.optimisation.transforms import Logarithm, Softmax, TimeInterpolation
from cortado.pictures.image_files import heart, rosetta, write_picture
from cortado.scene.parameter_values import Tilt


@pytest.fixture
def made(tmp_path):
    """Makes the setup of a text with values replaced."""

    def make(text, *overrides, precision="float64"):
        (tmp_path / "task.toml").write_text(text)
        return setup(load_task(tmp_path / "task.toml", overrides), "cpu", precision)

    return make


FREE_STEPS = TINY_LATTE.replace("knots = 3", "")


def test_positions_are_those_of_the_hidden_run(made):
    ready = made(GOOD_TASK, "problem.frames=2")
    assert ready.renderer is None and list(ready.targets) == [2, 5]
    trajectory = ready.problem.run({"gravity": [1.5, -9.81]})
    for step, target in ready.targets.items():
        np.testing.assert_array_equal(target, trajectory.positions[step])
    assert ready.search.value(ready.task.true_parameters) == 0.0
    np.testing.assert_array_equal(ready.task.true_parameters["gravity"], [1.5, -9.81])


def test_images_are_those_of_the_hidden_run(made):
    ready = made(TINY_LATTE, "problem.frames=2")
    assert list(ready.targets) == [3, 6] and all(image.shape == (12, 16, 3) for image in ready.targets.values())
    truth = ready.task.true_parameters
    assert truth["gravity"].shape == (6, 3)
    steps = ready.problem.steps
    np.testing.assert_array_equal(ready.image(ready.problem.states(truth, [steps])[steps]), ready.targets[6])
    assert ready.problem.value(truth) == 0.0
    assert ready.search.value(ready.start) > 1e-6


def test_hidden_colours_are_in_the_target(made):
    red = [[0.9, 0.1, 0.1], [0.8, 0.2, 0.2]]
    ready = made(TINY_LATTE, f"problem.target.colours={red}", f"optimise.start.colours={[[0.5] * 3] * 2}")
    target = ready.targets[6]
    assert ready.problem.value({**ready.task.true_parameters, "colours": np.array(red)}) == 0.0
    assert (target[..., 0] - target[..., 1]).max() > 0.3


@pytest.mark.parametrize(
    ("name", "draw", "distance"), [("heart", heart, SquaredDifference()), ("rosetta", rosetta, Pyramid())]
)
def test_our_pictures_have_the_colours_of_the_scene(made, name, draw, distance):
    kind = "pyramid" if name == "rosetta" else "squared_difference"
    ready = made(PLANE_PICTURE, f"problem.picture={name}", f"problem.distance={kind}")
    (loss,) = ready.problem.loss.losses.values()
    assert loss.distance == distance
    wanted = draw((20, 16), milk=(0.9, 0.8, 0.7), coffee=(0.3, 0.2, 0.1))
    np.testing.assert_array_equal(ready.targets[0], wanted)
    assert ready.task.true_parameters == {}


def test_a_picture_in_a_round_cup_ends_at_its_wall(made):
    text = TINY_LATTE.replace("target.gravity = [[0.0, -9.81, 4.0], [4.0, -9.81, 0.0]]", 'picture = "heart"')
    target = made(text.replace("parameter_error", "# parameter_error")).targets[6]
    wanted = {(0, 0): [1.0, 1.0, 1.0], (1, 8): [0.20, 0.09, 0.04], (6, 8): [0.95, 0.92, 0.85]}
    for place, colour in wanted.items():
        np.testing.assert_allclose(target[place], colour)


def test_a_picture_of_ones_own_is_beside_the_task(made, tmp_path):
    image = np.zeros((32, 40, 3))
    image[:16, :, 0] = 1.0
    write_picture(tmp_path / "mine.png", image)
    target = made(PLANE_PICTURE, "problem.picture=mine.png").targets[0]
    assert target.shape == (16, 20, 3)
    np.testing.assert_allclose(target[:7, :, 0], 1.0, atol=1e-6)
    np.testing.assert_allclose(target[9:], 0.0, atol=1e-6)


def test_random_places_are_the_same_each_time_and_within_the_container(made):
    first, again = (made(PLANE_PICTURE).start["initial_positions"] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (PARTICLES, 2)
    assert (first >= 0.025).all() and (first <= [0.675, 0.775]).all()
    assert np.ptp(first, axis=0).min() > 0.5
    ready = made(PLANE_PICTURE, "optimise.bounds.initial_positions=[[0.1,0.2],[0.3,0.4]]")
    x = ready.start["initial_positions"]
    assert (x >= [0.1, 0.2]).all() and (x <= [0.3, 0.4]).all()
    optimise(ready.search, ready.start, Adam(0.01), 1, bounds=ready.bounds)


def test_random_places_in_a_round_cup(made):
    lattice = np.stack(np.meshgrid(range(4), range(5), range(4)), axis=-1).reshape(-1, 3)[:LATTE_PARTICLES]
    hidden = [-0.005, 0.002, -0.005] + 0.0035 * lattice
    target = f"problem.target.initial_positions={hidden.tolist()}"
    start = "problem.steps=2", 'optimise.start={initial_positions="random"}'  # before fluid leaves, which is crowded
    x = made(FREE_STEPS, target, *start).start["initial_positions"]
    assert np.hypot(x[:, 0], x[:, 2]).max() <= 0.0105 and x[:, 1].min() > 0.0 and np.ptp(x[:, 1]) > 0.01


def test_a_picture_that_cannot_be_read_is_a_sentence(made):
    for name in ("absent.png", "task.toml", "."):
        with one_sentence("cannot be read"):
            made(PLANE_PICTURE, f'problem.picture="{name}"')


def test_random_places_need_a_container(made):
    start, end = PLANE_PICTURE.index("[container]"), PLANE_PICTURE.index("[solver]")
    with one_sentence("has no container to fill"):
        made(PLANE_PICTURE[:start] + PLANE_PICTURE[end:])


def test_random_fractions_add_up_to_1(made):
    even = np.full((LATTE_PARTICLES, 2), 0.5).tolist()
    ready = made(FREE_STEPS, f"problem.target.mass_fractions={even}", 'optimise.start={mass_fractions="random"}')
    found = ready.search.parameters(ready.start)["mass_fractions"]
    assert found.shape == (LATTE_PARTICLES, 2) and found.min() > 0.0 and found.std() > 0.1
    np.testing.assert_allclose(found.sum(axis=1), 1.0, rtol=1e-14)
    assert isinstance(ready.search.coordinates["mass_fractions"], Softmax)


def test_coordinates_are_those_that_the_task_asks_for(made):
    values = "problem.target.viscosity=[0.02,0.04]", "optimise.start.viscosity=[0.03,0.03]"
    bounds = "optimise.bounds.viscosity=[[0.01,0.02],[0.1,0.2]]", "optimise.bounds.gravity=[-20,20]"
    ready = made(TINY_LATTE, *values, *bounds, 'optimise.logarithmic=["viscosity"]')
    assert ready.search.coordinates == {"gravity": TimeInterpolation(6, 3), "viscosity": Logarithm()}
    np.testing.assert_allclose(ready.start["viscosity"], np.log([0.03, 0.03]))
    np.testing.assert_allclose(ready.start["gravity"], np.tile([0.0, -9.81, 0.0], (3, 1)), atol=1e-14)
    np.testing.assert_allclose(ready.bounds["viscosity"], np.log([[0.01, 0.02], [0.1, 0.2]]))
    assert ready.bounds["gravity"] == (-20.0, 20.0)


def test_a_tilt_is_hidden_searched_and_bounded(made):
    text = TINY_LATTE.replace("[[0.0, -9.81, 4.0], [4.0, -9.81, 0.0]]", "[[0.0, 20.0], [20.0, 0.0]]")
    text = text.replace("[[0.0, -9.81, 0.0], [0.0, -9.81, 0.0]]", "[[0.0, 0.0], [0.0, 0.0]]").replace("gravity", "tilt")
    ready = made(text, "optimise.bounds.tilt=[-15,15]")
    assert ready.search.coordinates == {"tilt": TimeInterpolation(6, 3)} and ready.start["tilt"].shape == (3, 2)
    gravity = Tilt((0.0, -9.81, 0.0)).gravity(ready.task.true_parameters["tilt"])
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81, rtol=1e-14)
    end = ready.problem.states({"gravity": gravity}, [6])[6]
    np.testing.assert_array_equal(ready.targets[6], ready.image(end))
    found = optimise(ready.search, ready.start, LBFGS(scale=10.0), 3, bounds=ready.bounds)
    assert found.loss < found.history[0].loss
    assert 0.0 < max(np.abs(record.parameters["tilt"]).max() for record in found.history) <= 15.0


def test_what_cannot_be_negative_is_bounded(made):
    target = ["problem.target.mobility=2e-5", "problem.target.viscosity=[0.1,0.2]"]
    start = "optimise.start={mobility=1e-5,viscosity=[0.2,0.1]}"
    ready = made(FREE_STEPS, *target, start, 'optimise.logarithmic=["viscosity"]')
    assert ready.bounds == {"mobility": (0.0, None)}
    found = optimise(ready.search, ready.start, Adam(2e-5), 2, ready.bounds)
    assert min(record.parameters["mobility"] for record in found.history) >= 0.0
    narrow = made(FREE_STEPS, *target, start, "optimise.bounds.mobility=[1e-6,1e-4]")
    assert narrow.bounds == {"mobility": (1e-6, 1e-4), "viscosity": (0.0, None)}


@pytest.mark.parametrize("lower", [-9.81, -9.810000001])
def test_a_start_on_its_bound_is_within(made, lower):
    """Whatever round-off does to its knots."""
    ready = made(TINY_LATTE, f"optimise.bounds.gravity=[[-3,{lower},-3],[3,0,3]]")
    low, high = ready.bounds["gravity"]
    assert (ready.start["gravity"] >= low).all() and (ready.start["gravity"] <= high).all()
    found = optimise(ready.search, ready.start, Adam(5.0), 2, bounds=ready.bounds)
    for record in found.history:
        rows = ready.search.parameters(record.parameters)["gravity"]
        assert (rows >= low - 1e-12).all() and (rows <= high + 1e-12).all()


def test_fingerprints_tell_tasks_apart(made):
    latte = ["optimise.knots=4", "problem.frames=2", "problem.distance=pyramid", "problem.steps=7"]
    latte += ["render.resolution=[12,16]", "problem.target.gravity=[0,-9.81,4]"]
    texts = [(TINY_LATTE,), *((TINY_LATTE, one) for one in latte), (PLANE_PICTURE,)]
    texts += [(PLANE_PICTURE, one) for one in ("problem.picture=rosetta", "render.background=[0,0,0]")]
    assert len({made(*text).search.fingerprint for text in texts}) == len(texts) == 10
    assert made(TINY_LATTE).search.fingerprint == made(TINY_LATTE).search.fingerprint


def test_an_optimisation_moves_particles_into_the_picture(made):
    ready = made(PLANE_PICTURE)
    found = optimise(ready.search, ready.start, Adam(0.01), 40, bounds=ready.bounds)
    assert found.loss < 0.7 * found.history[0].loss
