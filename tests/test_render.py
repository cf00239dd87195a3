"""Pictures against a slow twin in NumPy, and their derivatives against central differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from cortado.device.precision import FLOAT32, FLOAT64, Precision
from cortado.discretise.smoothing import CUBIC_SPLINE, KERNELS, WENDLAND_C2, SmoothingKernel
from cortado.errors import InputError
from cortado.render.cameras import Camera, Orthographic, Perspective, TopView, View, Volume
from cortado.render.renderer import RenderAdjoint, Renderer
from finite_differences import decades, plateau

SPACING, SUPPORT, N, PHASES = 0.1, 0.2, 200, 3
LOWER, UPPER = np.array([-0.31, 0.02, -0.23]), np.array([0.3, 0.47, 0.27])
RESOLUTION = (24, 20)
MIDDLE = (0.01, 0.25, 0.03)
OUTSIDE, INSIDE = (0.4, 0.9, 1.1), (0.11, 0.21, 0.13)

VIEWS: dict[str, View] = {
    "top": TopView(tuple(LOWER), tuple(UPPER), SPACING, RESOLUTION, background=(0.2, 0.9, 0.4)),
    "parallel": Volume(Orthographic(OUTSIDE, MIDDLE, (0.1, 1, 0), 0.8, resolution=RESOLUTION), 9.0, (0.2, 0.9, 0.4)),
    "perspective": Volume(Perspective(OUTSIDE, MIDDLE, (0.1, 1, 0), 40.0, resolution=RESOLUTION), 9.0),
    "within": Volume(Perspective(INSIDE, MIDDLE, (0, 1, 0), 100.0, resolution=RESOLUTION, far=0.6), 9.0),
}
CUDA = pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")
views = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())


def renderer(view: View, **changed: Any) -> Renderer:
    given = {**flat(3), "smoothing": CUBIC_SPLINE, "support": SUPPORT}
    given |= {"particles": N, "phases": PHASES, "precision": FLOAT64, "device": "cpu"}
    return Renderer(view, **(given | changed))


def flat(dimension: int = 2) -> dict[str, Any]:
    lower, upper = LOWER[:dimension], UPPER[:dimension]
    return {"lower": lower, "upper": upper, "volume": SPACING**dimension, "dimension": dimension}


def sheet() -> TopView:
    """In 2-D one looks at a sheet, x to the right and y upwards."""
    return TopView(tuple(LOWER[:2]), tuple(UPPER[:2]), SPACING, RESOLUTION, up_axis=2)


def scene(dimension: int = 3, n: int = N, phases: int = PHASES) -> dict[str, np.ndarray]:
    random = np.random.default_rng(3)
    positions = random.uniform(LOWER, UPPER, (n, 3))
    positions[:, dimension:] = 0.0
    return {
        "positions": positions,
        "fractions": random.dirichlet(np.full(phases, 0.3), n),
        "colours": random.uniform(0.0, 1.0, (phases, 3)),
    }


def picture(made: Renderer, values: dict[str, np.ndarray], precision: Precision = FLOAT64, device: Any = "cpu"):
    phases = len(values["colours"])
    x = wp.array(values["positions"], dtype=precision.vector, device=device)
    c = wp.array(values["fractions"], dtype=precision.fractions(phases), device=device)
    return made.render(x, c, values["colours"])


def weights(made: Renderer) -> np.ndarray:
    return np.random.default_rng(5).standard_normal(made.shape)


def gradient(adjoint: RenderAdjoint) -> dict[str, np.ndarray]:
    found = vars(adjoint).items()
    return {name: value.numpy().astype(float) if isinstance(value, wp.array) else value for name, value in found}


def twin_field(nodes, values, smoothing: SmoothingKernel, dimension: int) -> np.ndarray:
    """(nx, ny, nz, 4): the colour times the coverage, and the coverage."""
    r = np.linalg.norm(nodes[..., None, :] - values["positions"], axis=-1)
    w = SPACING**dimension * smoothing.weight(r, dimension, SUPPORT)
    return w @ np.column_stack([values["fractions"] @ values["colours"], np.ones(len(values["positions"]))])


def twin_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where rays start and where they go, both (rows, columns, 3)."""
    columns, rows = camera.resolution
    ahead = np.subtract(camera.look_at, camera.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    u = (np.arange(columns) + 0.5) / columns - 0.5
    v = (0.5 - (np.arange(rows) + 0.5) / rows) * rows / columns
    offset = u[None, :, None] * right + v[:, None, None] * up
    start, way = np.broadcast_to(camera.position, offset.shape), np.broadcast_to(ahead, offset.shape)
    if isinstance(camera, Orthographic):
        return start + camera.width * offset, way
    assert isinstance(camera, Perspective)
    way = way + 2 * np.tan(np.radians(camera.field_of_view / 2)) * offset
    return start, way / np.linalg.norm(way, axis=-1, keepdims=True)


def twin_samples(camera: Camera, step: float) -> np.ndarray:
    """Where the samples are (samples, rows, columns, 3)."""
    start, way = twin_rays(camera)
    t = camera.near + (np.arange(np.ceil((camera.far - camera.near) / step)) + 0.5) * step
    return start + t[:, None, None, None] * way


def corners(x: np.ndarray, nodes: np.ndarray, cell: float):
    """For each of the eight nodes around points (..., 3): its index if there is such a node, and its weight."""
    s = (x - nodes[0, 0, 0]) / cell
    base = np.floor(s).astype(int)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, s - base, 1 - s + base), axis=-1)
        index = base + corner
        there = ((index >= 0) & (index < nodes.shape[:3])).all(axis=-1)
        yield np.where(there[..., None], index, 0), np.where(there, weight, 0.0)


def twin_picture(view: View, nodes: np.ndarray, field: np.ndarray, cell: float) -> np.ndarray:
    """Sample by sample from the back, the other way round."""
    layers = sum(
        weight[..., None] * field[tuple(np.moveaxis(index, -1, 0))]
        for index, weight in corners(twin_samples(view.camera, cell / 2), nodes, cell)
    )
    image = np.zeros(layers.shape[1:3] + (3,)) + view.background
    for rgba in layers[::-1]:
        u = view.extinction * cell / 2 * rgba[..., 3:]
        opacity = -np.expm1(-u)
        colour = np.divide(rgba[..., :3], rgba[..., 3:], out=np.zeros_like(rgba[..., :3]), where=rgba[..., 3:] > 0)
        image = image * (1 - opacity) + opacity * colour
    return image


@pytest.mark.parametrize("smoothing", KERNELS.values(), ids=KERNELS.keys())
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_field_is_its_definition(dimension, smoothing):
    values = scene(dimension)
    made = renderer(VIEWS["top"], **flat(dimension), smoothing=smoothing)
    picture(made, values)
    coverage, colour = made.field()
    nodes = made.nodes()
    assert coverage.shape[2] == 1 if dimension == 2 else coverage.shape[2] > 5
    wanted = twin_field(nodes, values, smoothing, dimension)
    np.testing.assert_allclose(coverage, wanted[..., 3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(colour, wanted[..., :3], rtol=0, atol=1e-14)
    assert coverage.max() > 0.8
    for axis in range(dimension):
        assert not coverage.take([0, -1], axis).any(), "the field does not end within the grid"


def assert_is_its_twin(found: np.ndarray, made: Renderer, values: dict[str, np.ndarray], dimension: int) -> None:
    nodes = made.nodes()
    wanted = twin_picture(made.view, nodes, twin_field(nodes, values, CUBIC_SPLINE, dimension), SUPPORT / 2)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)


@views
def test_the_picture_is_its_definition(view):
    values, made = scene(), renderer(view)
    found = picture(made, values)
    assert_is_its_twin(found, made, values, 3)
    assert np.ptp(found, axis=(0, 1)).min() > 0.01, "there is too little to see"


def test_the_plane_as_a_picture():
    values = scene(2, n=1, phases=1)
    values["positions"][:] = [0.2, 0.4, 0.0]
    made = renderer(sheet(), **flat(), particles=1, phases=1)
    found = picture(made, values)
    assert_is_its_twin(found, made, values, 2)
    row, column = centre(found)
    assert row < 8 and column > 16


def centre(image: np.ndarray, background: float = 1.0) -> np.ndarray:
    seen = np.abs(image - background).sum(axis=-1)
    return np.array([(index * seen).sum() for index in np.indices(seen.shape)]) / seen.sum()


@pytest.mark.parametrize(
    ("up_axis", "towards_right", "towards_bottom"), [(0, (1, 1), (2, -1)), (1, (0, 1), (2, 1)), (2, (0, 1), (1, -1))]
)
def test_what_is_where_from_above(up_axis, towards_right, towards_bottom):
    room = {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 1.0, 1.0)}
    view = TopView(**room, spacing=SPACING, up_axis=up_axis, resolution=(20, 20))
    made = renderer(view, **room, particles=1, phases=1)

    def seen(x: np.ndarray) -> np.ndarray:
        return centre(picture(made, {"positions": x[None], "fractions": np.ones((1, 1)), "colours": np.zeros((1, 3))}))

    middle = np.full(3, 0.5)
    np.testing.assert_allclose(seen(middle), 9.5, atol=1e-3)
    for (axis, sign), moved in ((towards_right, (0, 4)), (towards_bottom, (4, 0))):
        np.testing.assert_allclose(seen(middle + 0.2 * sign * np.eye(3)[axis]), np.add(9.5, moved), atol=0.1)


def directions(values: dict[str, np.ndarray], dimension: int = 3) -> dict[str, np.ndarray]:
    random = np.random.default_rng(7)
    found = {name: random.standard_normal(value.shape) for name, value in values.items()}
    found["positions"][:, dimension:] = 0.0
    return found | {"translation": random.standard_normal(3), "rotation": random.standard_normal(3)}


def moved(view: View, translation: np.ndarray, rotation: np.ndarray) -> Volume:
    return Volume(view.camera.moved(translation, rotation), view.extinction, view.background)


def check_gradient(view: View, values: dict[str, np.ndarray], names: list[str], **changed: Any):
    made = renderer(view, **changed)
    picture(made, values)
    bar = weights(made)
    found, along = gradient(made.adjoint(bar)), directions(values, changed.get("dimension", 3))

    def function(name: str, h: float) -> float:
        pose = {key: h * (key == name) * along[key] for key in ("translation", "rotation")}
        there = {key: value + h * (key == name) * along[key] for key, value in values.items()}
        seen = renderer(moved(view, **pose), **changed) if name in pose else made
        return float((bar * picture(seen, there)).sum())

    for name in names:
        wanted = float((found[name] * along[name]).sum())
        misses = [abs((function(name, h) - function(name, -h)) / (2 * h) - wanted) for h in decades(4.0, 7.5)]
        assert plateau(misses) < 1e-6 * abs(wanted) and wanted != 0.0, f"{name}: {plateau(misses) / abs(wanted):.1e}"


EVERYTHING = ["positions", "fractions", "colours", "translation", "rotation"]


@views
def test_gradient_is_the_limit_of_central_differences(view):
    check_gradient(view, scene(), EVERYTHING)


def test_gradient_in_the_plane():
    check_gradient(sheet(), scene(2, phases=1), EVERYTHING, **flat(), phases=1, smoothing=WENDLAND_C2)


@views
def test_nodes_gather_what_samples_would_scatter(view):
    """Nothing is missed on the way from the screen, from wherever one looks, and nothing counts twice."""
    made = renderer(view)
    picture(made, scene())
    made.adjoint(weights(made))
    rays, nodes, cell = made._rays, made.nodes(), SUPPORT / 2
    samples_bar, spans = rays._samples_bar.numpy(), rays._spans.numpy()
    columns, rows = view.camera.resolution
    x = twin_samples(view.camera, cell / 2).reshape(-1, rows * columns, 3)
    wanted, landed = np.zeros((*nodes.shape[:3], 4)), 0.0
    for pixel, (first, last) in enumerate(spans):
        for index, weight in corners(x[first:last, pixel], nodes, cell):
            np.add.at(wanted, tuple(index.T), weight[:, None] * samples_bar[: last - first, pixel])
            landed += weight.sum()
    found = rays._field_bar.numpy().transpose(2, 1, 0, 3)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13 * np.abs(wanted).max())
    everywhere = sum(weight.sum() for _, weight in corners(x, nodes, cell))
    assert landed == pytest.approx(everywhere, rel=1e-12), "a sample in the field lies in no span"


def test_pictures_converge_with_the_grid():
    """To second order: nodes and samples are refined together."""
    values = scene(n=30)
    camera = Orthographic(OUTSIDE, MIDDLE, (0.1, 1, 0), 0.8, resolution=(12, 10))
    images = [picture(renderer(Volume(camera, 9.0), particles=30, cell=SUPPORT / n), values) for n in (4, 8, 16)]
    coarse, fine = (np.linalg.norm(images[k] - images[k + 1]) for k in range(2))
    assert 1.7 < np.log2(coarse / fine) < 2.5
    assert fine < 0.01 * np.linalg.norm(1.0 - images[2])


@views
def test_empty_space(view):
    """Nothing is seen where nothing is, and nothing pulls."""
    values = scene(n=1)
    values["positions"][:] = [5.0, 5.0, 5.0]
    made = renderer(view, particles=1)
    np.testing.assert_array_equal(picture(made, values), np.broadcast_to(view.background, made.shape))
    assert all(not value.any() for value in gradient(made.adjoint(weights(made))).values())


@views
def test_a_single_particle_moves_without_a_step(view):
    """Through nodes, faces of cells and out at the end of the grid; there is no step, and nothing is not a number."""
    values, made = scene(n=1), renderer(view, particles=1)
    corner = made.nodes()[3, 3, 3]
    for x in (corner, corner + [0.5 * SUPPORT, 0.0, 0.0], LOWER, UPPER + 0.5 * SUPPORT):
        sides = []
        for sign in (1, 0, -1):
            image = picture(made, values | {"positions": x[None] + sign * 1e-9})
            pulls = gradient(made.adjoint(weights(made)))
            assert np.isfinite(image).all() and all(np.isfinite(value).all() for value in pulls.values())
            sides.append((image, pulls["positions"]))
        (ahead, pull_ahead), (there, _), (behind, pull_behind) = sides
        assert np.abs(ahead - there).max() < 1e-6 and np.abs(there - behind).max() < 1e-6
        assert np.abs(pull_ahead - pull_behind).max() < 1e-5 * (1 + np.abs(pull_ahead).max())


def test_thin_and_thick_samples_meet():
    """The series of E(u) and its formula: as the extinction passes u = 0.1 neither the picture nor a pull steps."""
    values = {"positions": np.array([MIDDLE]), "fractions": np.ones((1, 1)), "colours": np.full((1, 3), 0.5)}
    view = VIEWS["parallel"]
    made = renderer(view, particles=1, phases=1)
    picture(made, values)
    limit = 0.1 / (made.field()[0].max() * SUPPORT / 4)
    found = []
    for factor in np.linspace(0.9, 2.0, 23):
        thick = renderer(replace(view, extinction=factor * limit), particles=1, phases=1)
        image = picture(thick, values)
        pull = thick.adjoint(weights(thick)).positions.numpy()[0]
        found.append([*image[10, 12], *(pull / np.abs(pull).max())])
    assert np.abs(np.diff(found, n=4, axis=0)).max() < 1e-4


@pytest.mark.parametrize(
    ("options", "precision", "device", "most"),
    [
        ({"precision": FLOAT32}, FLOAT32, "cpu", (1e-5, 1e-4)),
        pytest.param({"device": "cuda:0"}, FLOAT64, "cuda:0", (1e-12, 1e-10), marks=CUDA),
    ],
    ids=["float32", "cuda"],
)
@views
def test_single_precision_and_the_gpu_agree(view, options, precision, device, most):
    values = scene()
    made, other = renderer(view), renderer(view, **options)
    np.testing.assert_allclose(picture(other, values, precision, device), picture(made, values), rtol=0, atol=most[0])
    wanted = gradient(made.adjoint(weights(made)))
    for name, found in gradient(other.adjoint(weights(made))).items():
        assert np.linalg.norm(found - wanted[name]) < most[1] * np.linalg.norm(wanted[name]), name


def test_a_renderer_keeps_what_the_way_back_needs():
    """What happens to the given arrays after `render` does not matter."""
    made, values = renderer(VIEWS["top"]), scene()
    x = wp.array(values["positions"], dtype=wp.vec3d, device="cpu")
    c = wp.array(values["fractions"], dtype=FLOAT64.fractions(PHASES), device="cpu")
    made.render(x, c, values["colours"])
    wanted = gradient(made.adjoint(weights(made)))
    x.zero_()
    c.zero_()
    for name, found in gradient(made.adjoint(weights(made))).items():
        np.testing.assert_array_equal(found, wanted[name])


def test_cameras_move():
    camera = VIEWS["perspective"].camera
    turned = camera.moved([1, 2, 3], [0, 0, np.pi / 2])
    np.testing.assert_allclose(turned.position, np.add(camera.position, [1, 2, 3]))
    x, y, z = camera.orientation
    np.testing.assert_allclose(turned.orientation, [-y, x, z], atol=1e-15)
    assert (turned.near, turned.far, turned.resolution) == (camera.near, camera.far, camera.resolution)
    assert np.linalg.det(camera.orientation) == pytest.approx(1.0)


def camera(**changed: Any) -> Perspective:
    given = {"position": (0, 1, 0), "look_at": (0, 0, 0), "up": (0, 0, 1), "field_of_view": 40.0}
    return Perspective(**given | changed)


def top(**changed: Any) -> TopView:
    return TopView(**{"lower": (0, 0, 0), "upper": (1, 1, 1), "spacing": 0.1} | changed)


def rendered(**values: Any) -> Renderer:
    """After a picture of a scene in which ``values`` replace what they name."""
    made = renderer(top())
    made.render(**scene() | values)
    return made


def test_wrong_input_is_a_sentence():
    for make, sentence in [
        (lambda: camera(look_at=(0, 1, 0)), "look_at is .* must not be the position"),
        (lambda: camera(up=(0, 2, 0)), "up is .* parallel to the view"),
        (lambda: camera(position=(0, 1)), "position is .* must be 3 finite numbers"),
        (lambda: camera(field_of_view=180.0), "field_of_view is 180.0, but must be between 0 and 180"),
        (lambda: camera(resolution=(0, 4)), "resolution is .* positive whole numbers"),
        (lambda: camera(near=2.0, far=1.0), "near is 2.0 and far is 1.0"),
        (lambda: Orthographic((0, 1, 0), (0, 0, 0), (0, 0, 1), 0.0), "width is 0.0"),
        (lambda: Volume(camera(), -1.0), "extinction is -1.0, but must be a positive number"),
        (lambda: Volume(camera(), 1.0, (0, 1)), "background is .* 3 finite numbers"),
        (lambda: top(up_axis=3), "up_axis is 3, but must be 0, 1 or 2"),
        (lambda: top(upper=(0, 1, 1)), "upper is .* must be above lower"),
        (lambda: renderer(top(), support=0.0), "support is 0.0"),
        (lambda: renderer(top(), particles=0), "particles is 0, but must be at least 1"),
        (lambda: renderer(top(), lower=[1, 1, 1]), "upper is .* must not be below lower"),
        (lambda: renderer(top(), cell=1e-5), "cell is 1e-05, which makes .* nodes"),
        (lambda: renderer(top()).adjoint(np.zeros((256, 256, 3))), "call render before"),
        (lambda: rendered().adjoint(np.zeros((3, 3, 3))), "image_bar has shape"),
        (lambda: renderer(top(), periods=[0.3, 0, 0]), r"^periods is \[0\.3, 0\.0, 0\.0\], .* 0 or greater than two"),
        (lambda: picture(renderer(top()), scene(n=4)), r"positions is vec3d of shape \(4,\) on cpu, but"),
        (lambda: picture(renderer(top()), scene(), FLOAT32), "positions is vec3f"),
        (lambda: renderer(top()).render(**scene(n=4)), r"positions has shape \(4, 3\), but must have \(200, 3\)"),
        (lambda: rendered(fractions=np.full((N, PHASES), np.nan)), "fractions has a value"),
        (lambda: picture(renderer(top()), scene() | {"colours": np.zeros((3, 4))}), "colours has shape"),
    ]:
        with pytest.raises(InputError, match=sentence):
            make()


@pytest.mark.parametrize(("dimension", "precision"), [(2, FLOAT32), (3, FLOAT64)])
def test_numpy_arrays_make_the_same_picture(dimension, precision):
    view = sheet() if dimension == 2 else VIEWS["top"]
    made = renderer(view, **flat(dimension), precision=precision)
    values = scene(dimension)
    wanted = picture(made, values, precision)
    given = values | {"positions": values["positions"][:, :dimension]}
    np.testing.assert_array_equal(made.render(**given), wanted)
    np.testing.assert_array_equal(made.render(*(value.tolist() for value in given.values())), wanted)


PERIODS = np.array([UPPER[0] - LOWER[0], 0.0, UPPER[2] - LOWER[2]])
LOOK = {name: view for name, view in VIEWS.items() if name != "within"}
periodic_views = pytest.mark.parametrize("view", LOOK.values(), ids=LOOK.keys())


def wandered(turns: int) -> dict[str, np.ndarray]:
    """Particles some of which have left the region by up to so many periods."""
    values = scene()
    values["positions"] += PERIODS * np.random.default_rng(8).integers(-turns, turns + 1, (N, 3))
    return values


def test_images_fill_a_periodic_field():
    made, values = renderer(VIEWS["top"], periods=PERIODS), wandered(2)
    picture(made, values)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1) if period else (0,) for period in PERIODS], indexing="ij"), -1)
    shifts = steps.reshape(-1, 3) * PERIODS
    nodes, inside = made.nodes(), scene()
    images = ({**inside, "positions": inside["positions"] + shift} for shift in shifts)
    wanted = sum(twin_field(nodes, image, CUBIC_SPLINE, 3) for image in images)
    coverage, colour = made.field()
    np.testing.assert_allclose(coverage, wanted[..., 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(colour, wanted[..., :3], rtol=0, atol=1e-12)


@periodic_views
def test_the_derivative_of_a_periodic_picture_is_its_slope(view):
    made, values = renderer(view, periods=PERIODS), wandered(1)
    bar = weights(made)
    picture(made, values)
    found, random = gradient(made.adjoint(bar)), np.random.default_rng(6)
    for name in ("positions", "fractions", "colours"):
        way = random.standard_normal(values[name].shape)
        h = 1e-6

        def moved(step: float, name: str = name, way: np.ndarray = way) -> float:
            return float((bar * picture(made, {**values, name: values[name] + step * way})).sum())

        slope = (moved(h) - moved(-h)) / (2 * h)
        assert (found[name] * way).sum() == pytest.approx(slope, rel=1e-6, abs=1e-7), name
