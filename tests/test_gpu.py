"""The GPU computes what the CPU computes; needs a CUDA device."""

import numpy as np
import pytest
import warp as wp

from cortado import Problem, Simulation, gradients, losses
from cortado.device.cells import CellSort
from cortado.device.grid import Grid
from cortado.device.precision import COUNTS, FLOAT32, FLOAT64
from cortado.device.reduction import sum_and_maximum, sum_of
from cortado.pictures.painter import painter
from cortado.scene.motions import told
from scenes import HONEY, Squares, box, plane, plane_of_three, scene, splash, thrown, two_layers
from test_neighbours import CLOUDS, check_same, lists
from test_step_reader import CASES as READ

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")

GRAVITY = np.array([0.5, -9.81, 0.2])
EXACT = gradients.Exact()
TOLERANT = {"minimum_iterations": 2, "maximum_iterations": 40, "density_tolerance": 1e-3}


def over_time(point, steps):
    """Parameters, of which those of the paths of solids grow in each step."""
    grows = 0.0003 * np.arange(1, steps + 1)
    ends = (".displacement", ".turn")
    return {k: np.multiply.outer(grows, 1.0 + v) if k.endswith(ends) else v for k, v in point.items()}


def evaluate(made, device, precision="float64", steps=30, estimator=EXACT, lanes=None):
    """Last positions, iterations, loss and gradient, from a first state with scatter: of a block that falls freely the
    derivative with respect to the viscosity would be round-off."""
    simulation = Simulation(made, device, precision, lanes=lanes)
    problem = Problem(simulation, steps, losses.FinalPositions(simulation.positions))
    point = {**simulation.parameters(), **thrown(simulation), "gravity": GRAVITY[: simulation.dimension]}
    point.pop("colours")
    point = over_time(point, steps)
    for _ in range(3):  # the second time captures graphs, the third replays them
        loss, gradient = problem.value_and_gradient(point, estimator)
    tangent = problem.tangent(point, {"gravity": np.ones(simulation.dimension)})
    iterations, end = problem.iterations(), problem.end(point)
    return [end.positions, end.mass_fractions, iterations, np.array(loss), np.array(tangent), *gradient.values()]


PROJECTED = {"kind": "projection", "time_step": 0.002}
HONEYED = {"phase": [HONEY], "fluid": [box([0.0, 0.0], [0.4, 0.4], phase="honey")]}
LAW = {"kind": "bingham", "yield_stress": 5.0, "regularisation": 0.5}
TENSION = {"gravity": [0.0, -9.81], "surface_tension": 3.0}
IN_SPACE = box([0.05, 0.1, 0.05], [0.15, 0.25, 0.2], rotation=[0.1, 0.2, 0.0], velocity=[0.2, 0.1, 0.0])
IN_SPACE |= {"angular_velocity": [0.0, 3.0, 1.0]}


def ball(centre, radius, **more):
    return {"name": "ball", "shape": "sphere", "centre": centre, "radius": radius, **more}


SCENES = {
    "fixed": splash(),
    "tolerance": splash(**TOLERANT),
    "plane": plane(),
    "steps that are chosen": plane(solver={"kind": "pcisph", "time_step": "auto"}),
    "two fluids": two_layers(),
    "three fluids": plane_of_three(),
    "stress": plane(forces={"gravity": [0.0, -9.81], "viscosity": "stress"}),
    "projection": splash(kind="projection"),
    "projection in the plane": plane_of_three(solver=PROJECTED),
    "implicit, with a law": plane(
        **{**HONEYED, "phase": [{**HONEY, "rheology": LAW}]},
        forces={"gravity": [0.0, -9.81], "viscosity": "stress", "viscous_solve": "implicit"},
    ),
    "surface tension": plane(**HONEYED, forces=TENSION),
    "surface tension by curvature": plane(**HONEYED, forces=TENSION, solver=PROJECTED),
    "solids in the plane": plane(
        solid=[
            box([0.5, 0.0], [0.6, 0.3], name="post", rotation=0.1, slip="no"),
            ball([0.2, 0.45], 0.08, motion="path", velocity=[0.3, -1.0]),
        ],
        solver=PROJECTED,
        forces={"gravity": [0.0, -9.81], "viscosity": "stress"},
    ),
    "solids in space": scene(
        solid=[ball([0.3, 0.1, 0.12], 0.08), {**IN_SPACE, "name": "paddle", "motion": "path", "slip": "no"}],
        solver={**PROJECTED, "time_step": 0.0021},
    ),
    "free bodies in the plane": plane(
        solid=[
            box([0.1, 0.42], [0.3, 0.56], name="raft", rotation=0.1, motion="free", density=500.0),
            ball([0.36, 0.5], 0.06, motion="free", density=300.0, velocity=[-0.3, 0.0]),
        ],
        solver=PROJECTED,
    ),
    "a free body in space": scene(
        solid=[{**IN_SPACE, "name": "brick", "motion": "free", "density": 500.0}],
        solver={**PROJECTED, "time_step": 0.0021},
    ),
}
BATCHED = {
    "tolerance": splash(**TOLERANT),
    **{name: SCENES[name] for name in ("two fluids", "plane", "projection", "projection in the plane")},
    **{name: SCENES[name] for name in ("solids in the plane", "solids in space", "free bodies in the plane")},
}


@pytest.mark.parametrize("made", SCENES.values(), ids=SCENES)
def test_the_same_as_the_cpu(made):
    assert_near(evaluate(made, "cuda:0"), evaluate(made, "cpu"), within=1e-8)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    "made", [splash(**TOLERANT), two_layers(), *(SCENES[n] for n in ("projection in the plane", "solids in space"))]
)
def test_same_bits_twice(made, precision):
    for first, second in zip(*(evaluate(made, "cuda:0", precision) for _ in range(2)), strict=True):
        assert first.tobytes() == second.tobytes()


def assert_near(found, wanted, within=1e-9):
    for one, other in zip(found, wanted, strict=True):
        assert np.linalg.norm(one - other) <= within * np.linalg.norm(other)


@pytest.mark.parametrize("lanes", COUNTS)
@pytest.mark.parametrize("name", SCENES)
def test_any_number_of_lanes_computes_the_same(name, lanes):
    wanted = evaluate(SCENES[name], "cpu", steps=20)
    assert_near(evaluate(SCENES[name], "cuda:0", steps=20, lanes=lanes), wanted)


@pytest.mark.parametrize(
    ("name", "estimator"),
    [
        *((name, gradients.AdjointViscosity()) for name in ("fixed", "two fluids")),
        *((name, gradients.AdjointViscosity()) for name in ("projection", "projection in the plane")),
    ],
)
@pytest.mark.parametrize("lanes", [1, 8])
def test_estimators_are_those_of_the_cpu(name, lanes, estimator):
    wanted = evaluate(SCENES[name], "cpu", steps=20, estimator=estimator)
    assert_near(evaluate(SCENES[name], "cuda:0", steps=20, estimator=estimator, lanes=lanes), wanted)


@pytest.mark.parametrize("name", ["plane", "projection", "solids in the plane", "solids in space"])
def test_pressures_and_loads_are_those_of_the_cpu(name):
    """With their gradients, and the same bits twice."""
    made = SCENES[name]
    names = ["pressure", "wall_force", *(f"{solid.name}.load" for solid in made.solid)]
    wanted, found, again = (read(made, device, names) for device in ("cpu", "cuda:0", "cuda:0"))
    assert_near(found, wanted, within=1e-8)
    assert all(one.tobytes() == other.tobytes() for one, other in zip(found, again, strict=True))


def read(made, device, names):
    """The sum of the squares of quantities of the last state, each over its first size, with its gradient by gravity
    and first velocities."""
    simulation = Simulation(made, device, "float64")
    point = {**thrown(simulation), "gravity": GRAVITY[: simulation.dimension]}

    end = Problem(simulation, 20, losses.FinalPositions(simulation.positions)).end(point)
    values = [end[name] for name in names]
    weights = {name: 1.0 / (float((value**2).sum()) or 1.0) for name, value in zip(names, values, strict=True)}
    loss, gradient = Problem(simulation, 20, Squares(weights)).value_and_gradient(point)
    return [*values, np.array(loss), *gradient.values()]


@pytest.mark.parametrize("name", ["fixed", "two fluids"])
def test_the_tape_follows_kernels_of_one_lane(name):
    simulation = Simulation(SCENES[name], "cuda:0", "float64")
    problem = Problem(simulation, 10, losses.FinalPositions(simulation.positions))
    moved = ("gravity", "initial_positions", "initial_velocities", "viscosity")
    point = {name: simulation.parameters()[name] for name in moved}
    exact = problem.value_and_gradient(point)[1]
    taped = problem.value_and_gradient(point, gradients.Tape())[1]
    for name, wanted in exact.items():
        assert np.linalg.norm(taped[name] - wanted) <= 1e-9 * np.linalg.norm(wanted)


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("size", [1, 5, 1000, 1024, 1025, 8192, 8193, 100_003])
def test_sums_of_every_length(size, members):
    device, random = wp.get_device("cuda:0"), np.random.default_rng(size)
    for dtype, shape in ((wp.float64, ()), (wp.vec3d, (3,)), (wp.types.matrix((3, 3), wp.float64), (3, 3))):
        values = random.standard_normal((members, size, *shape))
        array = wp.array(values.reshape(-1, *shape), dtype=dtype, device=device)
        found = sum_of(dtype, size, device, members)(array).numpy()
        np.testing.assert_allclose(found, values.sum(axis=1), atol=1e-10 * size)
    pairs = random.uniform(-1.0, 1.0, (members, size, 2))
    array = wp.array(pairs.reshape(-1, 2), dtype=wp.vec2d, device=device)
    found = sum_and_maximum(size, FLOAT64, device, members)(array).numpy()
    np.testing.assert_allclose(found[:, 0], pairs[..., 0].sum(axis=1), atol=1e-10 * size)
    np.testing.assert_array_equal(found[:, 1], pairs[..., 1].max(axis=1))


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("made", BATCHED.values(), ids=BATCHED)
def test_a_scene_of_a_batch_has_the_bits_of_its_single_run(made, precision):
    single, many = (Simulation(made, "cuda:0", precision, batch=batch) for batch in (None, 7))
    gravity = np.random.default_rng(1).normal(-3.0, 6.0, (7, 1, single.dimension))
    loss = losses.FinalPositions(single.positions)
    problem, alone = Problem(many, 40, loss), Problem(single, 40, loss)
    also = {} if told(made.solid) else {"time_step": 0.002}
    for _ in range(3):
        found, gradient = problem.value_and_gradient({"gravity": gravity, **also})
    for b in range(7):
        wanted, bars = alone.value_and_gradient({"gravity": gravity[b, 0], **also})
        assert wanted == found[b]
        for name, bar in bars.items():
            np.testing.assert_array_equal(gradient[name][b].reshape(bar.shape), bar)


def test_ensembles_run_in_batches_with_the_same_bits(monkeypatch):
    simulation = Simulation(splash(**TOLERANT), "cuda:0")
    problem = Problem(simulation, 30, losses.FinalPositions(simulation.positions))
    for estimator in (gradients.RandomizedSmoothing(samples=2), gradients.EnsembleMean(estimator=EXACT)):
        together = problem.value_and_gradient({"gravity": GRAVITY}, estimator)[1]["gravity"]
        monkeypatch.setattr(Problem, "room", lambda *_: 1)
        np.testing.assert_array_equal(
            problem.value_and_gradient({"gravity": GRAVITY}, estimator)[1]["gravity"], together
        )
        monkeypatch.undo()


def test_short_lists_grow():
    simulation = Simulation(splash(), "cuda:0", "float64")
    wanted = simulation.run(40).positions
    simulation.solver.search.forget_needed()
    simulation.solver.resize(8)
    np.testing.assert_array_equal(simulation.run(40).positions, wanted)
    assert simulation.solver.search.capacity > 8


@pytest.mark.parametrize("short", [400, 12])
@pytest.mark.parametrize("lanes", [1, 2, 4, 8, 16, 32])
@pytest.mark.parametrize("name", CLOUDS)
def test_lists_are_those_of_the_cpu(name, lanes, short):
    positions, options = CLOUDS[name]
    walls = np.random.default_rng(1).uniform(0.0, 0.4, (60, positions.shape[1]))
    options = options | {"walls": walls, "precision": FLOAT64, "capacity": short}
    check_same(lists(positions, **options, lanes=lanes, device=wp.get_device("cuda:0")), lists(positions, **options))


@pytest.mark.parametrize("spread", [1.0, 0.2, 0.0], ids=["cloud", "crowd", "one place"])
@pytest.mark.parametrize(("members", "particles"), [(1, 30_000), (5, 6_000), (3, 1)])
def test_the_order_of_cells_is_that_of_the_cpu(members, particles, spread):
    """Again and again, and in a captured graph: particles arrive in their cells in another order each time."""
    grid = Grid.around(np.zeros(3), np.ones(3), np.zeros(3), 0.05, 10**5)
    x = spread * np.random.default_rng(0).uniform(0.0, 1.0, (members * particles, 3))
    x[:: max(particles // 3, 1)] = np.nan
    found = []
    for name in ("cpu", "cuda:0"):
        device = wp.get_device(name)
        sort = CellSort(grid, particles, FLOAT32, device, members)
        positions = wp.array(x.astype(np.float32), dtype=FLOAT32.vector, device=device)
        sort(positions)
        with wp.ScopedCapture(device=device) as capture:
            sort(positions)
        for _ in range(4):
            found.append((sort.order.numpy(), sort.grid.starts.numpy()))
            wp.capture_launch(capture.graph)
    for order, starts in found:
        np.testing.assert_array_equal(order, found[0][0])
        np.testing.assert_array_equal(starts, found[0][1])


PICTURES = {
    "a box": scene(),
    "a cup": scene(container={"shape": "cylinder", "base": [0.2, 0.0, 0.2], "radius": 0.3, "height": 0.6}),
    "spheres": scene(picture={"surface": "spheres"}),
    "solids": scene(
        solid=[
            {"name": "pillar", "shape": "box", "lower": [0.25, 0.0, 0.1], "upper": [0.35, 0.4, 0.2]},
            {"name": "ball", "shape": "sphere", "centre": [0.1, 0.3, 0.1], "radius": 0.08, "transparency": 0.7},
        ]
    ),
}


@pytest.mark.parametrize("made", PICTURES.values(), ids=PICTURES)
def test_a_picture_is_that_of_the_cpu(made):
    positions = Simulation(made).positions
    positions = positions + 0.005 * np.random.default_rng(0).standard_normal(positions.shape)
    colours = np.tile((0.1, 0.3, 0.6), (len(positions), 1))
    one, other = (painter(made, positions[None], device).image(positions, colours) for device in ("cpu", "cuda:0"))
    assert one.std() > 0.02
    assert np.mean((one - other) ** 2) < 1e-5  # 50 dB


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("name", READ)
def test_sensors_read_what_they_read_on_a_cpu(name, batch):
    """From the first run on, and from captured graphs."""
    make, sensors = READ[name]
    runs = [Simulation(make(), device, "float64", batch=batch) for device in ("cpu", "cuda:0")]
    wanted, *found = (one.run(70, sensors=sensors) for one in (runs[0], runs[1], runs[1]))
    for run in found:
        for host, own in zip((wanted,) if batch is None else wanted, (run,) if batch is None else run, strict=True):
            for sensor, read in own.sensors.items():
                scale = np.abs(host.sensors[sensor].values).max()
                np.testing.assert_allclose(read.values, host.sensors[sensor].values, atol=1e-8 * scale, err_msg=sensor)
