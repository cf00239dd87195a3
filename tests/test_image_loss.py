"""Losses of images: how far images are apart, and gradients through picture, grid, particles and fluid."""

from functools import cache

import numpy as np
import pytest

from cortado import InputError, Problem, Scene, Simulation, losses
from cortado.device.precision import FLOAT64
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.image_losses import Pyramid, SquaredDifference, psnr, reduce, reduce_transposed
from cortado.render.cameras import TopView
from cortado.render.renderer import Renderer, scene_renderer
from finite_differences import both_modes, decades, directional, distance, fourth_order_difference
from scenes import plane_of_three, two_layers

RESOLUTION = [20, 16]
EYE = {"view": "volume", "position": [0.6, 0.5, 0.7], "look_at": [0.15, 0.1, 0.12], "resolution": RESOLUTION}
MAKERS = {
    "top": lambda: two_layers(render={"view": "top", "resolution": RESOLUTION}),
    "volume": lambda: two_layers(render=EYE),
    "plane": lambda: plane_of_three(render={"view": "plane", "resolution": RESOLUTION, "background": [0.2, 0.4, 0.3]}),
}
DISTANCES = {"top": SquaredDifference(), "volume": Pyramid(), "plane": Pyramid(levels=3)}
scenes = pytest.mark.parametrize("name", MAKERS)
FRAMES = (0, 4, 12)
SIZES = {
    **{"gravity": 1.0, "gravity over time": 1.0, "initial_positions": 0.01, "initial_velocities": 0.1},
    **{"mass_fractions": 0.1, "colours": 0.3, "mobility": 0.01, "viscosity": 0.05},
}
"""Size of a direction of each parameter."""


def target_of(renderer, seed=7):
    """(rows, columns, 3) of noise."""
    return np.random.default_rng(seed).random(renderer.shape)


@cache
def case(name):
    """A problem of three frames, with its renderer."""
    simulation = Simulation(MAKERS[name](), precision="float64")
    renderer = scene_renderer(simulation)
    frames = {step: losses.Image(renderer, target_of(renderer, step), DISTANCES[name]) for step in FRAMES}
    return Problem(simulation, FRAMES[-1], losses.Frames(frames)), renderer


def point_of(problem, over_time=False):
    """The scene's parameters, but for a lattice that is disturbed and phases that are mixed a little."""
    simulation, random = problem.simulation, np.random.default_rng(3)
    own = simulation.parameters()
    point = {name.removesuffix(" over time"): own[name.removesuffix(" over time")] for name in SIZES}
    x, c = point["initial_positions"], point["mass_fractions"]
    point["initial_positions"] = x + 0.001 * random.standard_normal(x.shape)
    point["mass_fractions"] = 0.8 * c + 0.2 * random.dirichlet(np.ones(c.shape[1]), len(c))
    point["colours"] = random.uniform(0.1, 0.9, point["colours"].shape)
    if over_time:
        point["gravity"] = point["gravity"] + random.standard_normal((problem.steps, simulation.dimension))
    return point


def directions_of(point, chosen):
    found = {}
    for name in chosen:
        direction = np.random.default_rng(4).standard_normal(point[name].shape)
        found[name] = SIZES[name] * direction / np.linalg.norm(direction)
    return found


@scenes
@pytest.mark.parametrize("what", [*SIZES, "all"])
def test_gradient_equals_tangent_and_differences(name, what):
    problem, _ = case(name)
    point = point_of(problem, over_time="over time" in what)
    directions = directions_of(point, [what.removesuffix(" over time")] if what != "all" else list(point))
    loss, gradient = problem.value_and_gradient(point)
    assert loss == problem.value(point) and {k: g.shape for k, g in gradient.items()} == {
        k: value.shape for k, value in point.items()
    }
    tangent = problem.tangent(point, directions)
    assert abs(directional(gradient, directions) - tangent) <= 1e-10 * abs(tangent)
    # In the plane the loss of 1.26 has a derivative of 2e-7 with respect to the viscosities: differences of second
    # order end at the round-off of the loss, some 1e-6 of it, where those of fourth order come to 5e-9.
    given = {"steps": decades(1.5, 5.5), "enough": 1e-7, "difference": fourth_order_difference}
    assert distance(problem.value, point, directions, tangent, **given) < 1e-6


@scenes
def test_a_parameter_alone_has_the_gradient_that_it_has_among_all(name):
    problem, _ = case(name)
    own = {k: value for k, value in problem.simulation.parameters().items() if k in SIZES}
    _, wanted = problem.value_and_gradient(own)
    for what, value in own.items():
        _, found = problem.value_and_gradient({what: value})
        assert found.keys() == {what} and found[what].tobytes() == wanted[what].tobytes()


@scenes
def test_frames_add_up(name):
    problem, _ = case(name)
    point = point_of(problem)
    loss, gradient = problem.value_and_gradient(point)
    own = problem.loss.losses.items()
    alone = [Problem(problem.simulation, step, one).value_and_gradient(point) for step, one in own]
    assert loss == pytest.approx(sum(value for value, _ in alone), rel=1e-14)
    for key, found in gradient.items():
        parts = sum(part[key] for _, part in alone)
        assert np.linalg.norm(found - parts) <= 1e-10 * np.linalg.norm(parts), key


@scenes
def test_its_own_picture_is_the_lowest(name):
    problem, renderer = case(name)
    point = point_of(problem)
    end = problem.end(point)
    target = renderer.render(end.state.positions, end.state.mass_fractions, end.colours)
    loss = losses.Image(renderer, target, DISTANCES[name])
    np.testing.assert_array_equal(loss.image(end), target)
    value, gradient = Problem(problem.simulation, problem.steps, loss).value_and_gradient(point)
    assert value == 0.0 and not any(array.any() for array in gradient.values())


def test_float32_is_near_float64():
    wide, renderer = case("top")
    simulation = Simulation(MAKERS["top"](), precision="float32")
    narrow_renderer = scene_renderer(simulation)
    frames = {step: losses.Image(narrow_renderer, target_of(renderer, step)) for step in FRAMES}
    narrow, point = Problem(simulation, FRAMES[-1], losses.Frames(frames)), point_of(wide)
    (loss, exact), (found, gradient) = wide.value_and_gradient(point), narrow.value_and_gradient(point)
    assert found == pytest.approx(loss, rel=1e-5)
    for key, array in exact.items():
        assert np.linalg.norm(gradient[key] - array) < 5e-3 * np.linalg.norm(array), key


def test_a_target_cannot_be_changed_behind_the_back_and_has_the_size_of_the_pictures():
    _, renderer = case("plane")
    target = target_of(renderer)
    loss = losses.Image(renderer, target)
    target[:] = 0.0
    assert loss.target.max() > 0.9
    with pytest.raises(ValueError, match="read-only"):
        loss.target[0] = 1.0
    _, renderer = case("plane")
    light = "but must be linear light from 0 to 1, as"
    for target, wanted in [
        (np.zeros((16, 21, 3)), r"shape \(16, 21, 3\), but must have that of the renderer's .*, \(16, 20, 3\)\.$"),
        (np.zeros((16, 20)), r"shape \(16, 20\), but must be a picture \(rows, columns, 3\)\.$"),
        (np.full((16, 20, 3), np.nan), r"not finite, but must be made of finite numbers\.$"),
        ("heart", r"^target is 'heart', but must be a number or an array"),
        (np.full((16, 20, 3), 200.0), f"a value of 200, {light} that of cortado"),
        (np.full((16, 20, 3), -5.0), f"a value of -5, {light} that of cortado"),
        (np.ones((16, 20, 3), np.uint8), f"made of whole numbers, {light}"),
    ]:
        with pytest.raises(InputError, match=wanted):
            losses.Image(renderer, target)


def test_fingerprints_tell_targets_distances_and_grids_apart():
    _, renderer = case("plane")
    made = [
        losses.Image(renderer, target_of(renderer)),
        losses.Image(renderer, target_of(renderer, 8)),
        losses.Image(renderer, target_of(renderer), Pyramid()),
        losses.Image(renderer, target_of(renderer), Pyramid(levels=2)),
        losses.Frames({3: losses.Image(renderer, target_of(renderer))}),
        losses.Frames({4: losses.Image(renderer, target_of(renderer))}),
    ]
    assert len({loss.fingerprint for loss in made}) == len(made)
    assert made[0].fingerprint == losses.Image(renderer, target_of(renderer), SquaredDifference()).fingerprint
    assert len({loss.fingerprint for loss in LOSSES}) == len(LOSSES)
    assert Pyramid(weights=[1, 2]).fingerprint == Pyramid(weights=(1.0, 2.0)).fingerprint
    given = {"smoothing": CUBIC_SPLINE, "support": 0.2, "volume": 1e-3, "particles": 5, "phases": 1}
    view = TopView((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1, (20, 16))
    grids = [
        Renderer(view, np.zeros(3), upper, **given, precision=FLOAT64, device="cpu", cell=cell)
        for upper, cell in (([1.0, 1.0, 1.0], 0.1), ([1.0, 1.0, 1.0], 0.05), ([1.0, 2.0, 1.0], 0.1))
    ]
    assert len({renderer.fingerprint for renderer in grids}) == 3


@pytest.mark.parametrize("distance", ["pyramid", Pyramid, 3.0])
def test_a_distance_that_is_none_is_a_sentence(distance):
    _, renderer = case("plane")
    with pytest.raises(InputError, match=r"^distance is .*, but must be an object such as cortado.image_lo"):
        losses.Image(renderer, np.zeros((16, 20, 3)), distance)


def cup() -> Scene:
    """Milk on coffee in a round cup, as examples/latte_art_small.toml has it: about 1,000 particles."""
    spacing = 0.0035
    radius, depth = 8.5 * spacing, 4.5 * spacing
    phases = [
        {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.02, "colour": [0.20, 0.09, 0.04]},
        {"name": "milk", "rest_density": 900.0, "viscosity": 0.04, "colour": [0.95, 0.92, 0.85]},
    ]
    coffee = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": radius, "height": depth, "phase": "coffee"}
    milk = {**coffee, "base": [0.0, depth, 0.0], "radius": 0.7 * radius, "height": 2.0 * spacing, "phase": "milk"}
    return Scene(
        name="cup",
        dimension=3,
        discretisation={"spacing": spacing},
        phase=phases,
        fluid=[coffee, milk],
        container={"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": radius, "height": 0.05},
        mixture={"mobility": 1e-5},
        forces={"gravity": [0.0, -9.81, 0.0]},
        solver={"kind": "pcisph", "time_step": 0.0018, "minimum_iterations": 5, "maximum_iterations": 5},
        render={"view": "top", "resolution": [32, 32]},
    )


@cache
def whole_chain():
    """The picture of the cup after 30 steps, against that of one that is swung around."""
    simulation = Simulation(cup(), precision="float64")
    renderer = scene_renderer(simulation)
    time = np.linspace(0.0, 1.0, 30)[:, None]
    truth = np.array([0.0, -9.81, 0.0]) + 6.0 * np.hstack([np.sin(6.0 * time), 0.0 * time, np.cos(6.0 * time)])
    problem = Problem(simulation, 30, losses.FinalPositions(simulation.positions))
    end = problem.end({"gravity": truth})
    target = renderer.render(end.state.positions, end.state.mass_fractions, end.colours)
    return Problem(simulation, 30, losses.Image(renderer, target))


@pytest.mark.parametrize("over_time", [False, True])
def test_the_whole_chain_from_gravity_to_the_picture(over_time):
    """Image <- grid <- particles <- mixture PCISPH <- gravity, with about 1,000 particles."""
    problem = whole_chain()
    assert 950 < problem.simulation.particles < 1300
    random = np.random.default_rng(1)
    gravity = np.array([2.0, -9.81, 1.0])
    if over_time:
        gravity = gravity + random.standard_normal((30, 3))
    direction = random.standard_normal(gravity.shape)
    point, directions = {"gravity": gravity}, {"gravity": direction / np.linalg.norm(direction)}
    gradient, tangent = both_modes(problem, point, directions)
    assert problem.value(point) > 1e-4 and abs(tangent) > 1e-6
    adjoint = directional(gradient, directions)
    assert distance(problem.value, point, directions, adjoint, decades(2.0, 7.0), enough=1e-6) < 1e-5


IMAGES = [(7, 10), (1, 9), (16, 5), (1, 1)]
LOSSES = [SquaredDifference(), Pyramid(), Pyramid(levels=3), Pyramid(weights=(0.0, 1.5, 4.0))]


def image_of(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """(rows, columns, 3) from 0 to 1"""
    return np.random.default_rng(seed).random((*size, 3))


@pytest.mark.parametrize("size", IMAGES)
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_adjoint_is_the_limit_of_differences(loss, size):
    image, target, step = image_of(size), image_of(size, 1), 1e-3  # the losses are quadratic: no truncation error
    differences = np.empty_like(image)
    for place in np.ndindex(image.shape):
        shift = np.zeros_like(image)
        shift[place] = step
        differences[place] = (loss.value(image + shift, target) - loss.value(image - shift, target)) / (2.0 * step)
    adjoint = loss.adjoint(image, target)
    assert np.abs(adjoint).max() > 1e-3
    assert np.linalg.norm(adjoint - differences) < 1e-8 * np.linalg.norm(adjoint)


@pytest.mark.parametrize("size", [*IMAGES, (33, 64)])
def test_reduce_has_a_transpose_and_keeps_what_is_constant(size):
    image = image_of(size)
    next_level = reduce(image)
    bar = image_of(next_level.shape[:2], 1)
    forward, backward = np.sum(bar * next_level), np.sum(reduce_transposed(bar, size) * image)
    assert forward == pytest.approx(backward, rel=1e-13)
    colour = np.array([0.2, 0.5, 0.9])
    assert np.allclose(reduce(np.ones((*size, 3)) * colour), colour, rtol=1e-14, atol=0.0)


def weights_by_hand(size: int, place: int) -> dict[int, float]:
    """Pixel -> weight in the pixel `place` of the next level, of those that are there."""
    if size % 2:
        weights = {2 * place + k: w for k, w in {-2: 1.0, -1: 4.0, 0: 6.0, 1: 4.0, 2: 1.0}.items()}
    else:
        weights = {2 * place + k: w for k, w in {-1: 1.0, 0: 3.0, 1: 3.0, 2: 1.0}.items()}
    return {pixel: weight for pixel, weight in weights.items() if 0 <= pixel < size}


def reduced_by_hand(image: np.ndarray) -> np.ndarray:
    """The next level, pixel by pixel: the weighted mean of the pixels that are there."""
    rows, columns, _ = image.shape
    level = np.zeros(((rows + 1) // 2, (columns + 1) // 2, 3))
    for i, j in np.ndindex(level.shape[:2]):
        total = 0.0
        for row, down in weights_by_hand(rows, i).items():
            for column, right in weights_by_hand(columns, j).items():
                level[i, j] += down * right * image[row, column]
                total += down * right
        level[i, j] /= total
    return level


@pytest.mark.parametrize("size", IMAGES)
def test_reduce_is_the_binomial(size):
    """And treats both ends of an image alike."""
    image = image_of(size)
    assert np.allclose(reduce(image), reduced_by_hand(image), rtol=1e-14, atol=0.0)
    assert np.allclose(reduce(image[::-1, ::-1]), reduce(image)[::-1, ::-1], rtol=1e-14, atol=0.0)


def test_a_pyramid_adds_its_levels():
    image, target = image_of((16, 12)), image_of((16, 12), 1)
    squares = []
    for _ in range(4):  # 16 x 12, 8 x 6, 4 x 3, 2 x 2
        squares.append(np.mean((image - target) ** 2))
        image, target = reduce(image), reduce(target)
    pair = image_of((16, 12)), image_of((16, 12), 1)
    assert Pyramid().value(*pair) == pytest.approx(np.dot((1.0, 2.0, 4.0, 8.0), squares))
    weights = (0.5, 0.0, 3.0, 1.0)
    assert Pyramid(weights=weights).value(*pair) == pytest.approx(np.dot(weights, squares))


def disc(place: np.ndarray, size: int) -> np.ndarray:
    """(size, size, 3) black, with a white disc of radius 5 at (x, y), whose edge is three pixels wide"""
    rows, columns = np.mgrid[:size, :size]
    inside = np.clip((5.0 - np.hypot(columns - place[0], rows - place[1])) / 3.0 + 0.5, 0.0, 1.0)
    return np.repeat(inside[..., None], 3, axis=2)


def pull(loss, place: np.ndarray, target: np.ndarray, size: int) -> np.ndarray:
    """(2,) the way on which the loss falls fastest when the disc moves"""
    motions = [0.5 * (disc(place + step, size) - disc(place - step, size)) for step in np.eye(2)]
    adjoint = loss.adjoint(disc(place, size), disc(target, size))
    return -np.array([np.sum(adjoint * motion) for motion in motions])


@pytest.mark.parametrize("size", [64, 65, 60])
def test_only_the_pyramid_pulls_a_disc_towards_a_target_far_away(size):
    random, directions = np.random.default_rng(0), []
    while len(directions) < 20:
        place, target = random.uniform(8.0, size - 8.0, (2, 2))
        way = target - place
        distance = np.linalg.norm(way)
        if distance < 16.0:  # they would overlap
            continue
        near_sighted, far_sighted = (pull(loss, place, target, size) for loss in (SquaredDifference(), Pyramid()))
        strength = np.linalg.norm(far_sighted)
        assert np.linalg.norm(near_sighted) < 1e-12 * strength
        directions.append(way @ far_sighted / (distance * strength))
    assert min(directions) > 0.4 and np.mean(directions) > 0.85


def test_noise_ratio():
    target = image_of((4, 5))
    assert psnr(target + 0.1, target) == pytest.approx(20.0)
    assert psnr(target, target) == np.inf


def test_wrong_settings_are_a_sentence():
    for settings in ({"levels": 0}, *({"weights": one} for one in ((), (1.0, -1.0), (0.0,), (np.nan,)))):
        with pytest.raises(InputError, match="must be"):
            Pyramid(**settings)
    with pytest.raises(InputError, match="2 weights for 3 levels"):
        Pyramid(levels=3, weights=(1.0, 1.0))


@pytest.mark.parametrize("loss", LOSSES[:2], ids=str)
@pytest.mark.parametrize(
    "shapes", [((4, 4, 3), (4, 5, 3)), ((4, 4), (4, 4)), ((4, 4, 3), (3,)), ((0, 4, 3), (0, 4, 3))]
)
def test_other_shapes_are_a_sentence(loss, shapes):
    for function in (loss.value, loss.adjoint):
        with pytest.raises(InputError, match="has shape"):
            function(*(np.zeros(shape) for shape in shapes))
