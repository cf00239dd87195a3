"""The GPU computes what the CPU computes; needs a CUDA device."""

import numpy as np
import pytest
import warp as wp

from cortado import Problem, Simulation, gradients, losses
from cortado.device.cells import CellSort, Grid
from cortado.device.precision import FLOAT32, FLOAT64
from scenes import HONEY, plane, plane_of_three, splash, two_layers
from test_neighbours import CLOUDS, check_same, lists

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")

GRAVITY = np.array([0.5, -9.81, 0.2])
EXACT = gradients.Exact()
TOLERANT = {"minimum_iterations": 2, "maximum_iterations": 40, "density_tolerance": 1e-3}


def evaluate(made, device, precision="float64", steps=60, estimator=EXACT):
    """Last positions, iterations, loss and gradient."""
    simulation = Simulation(made, device, precision)
    problem = Problem(simulation, steps, losses.FinalPositions(simulation.positions))
    point = {**simulation.parameters(), "gravity": GRAVITY[: simulation.dimension]}
    point.pop("colours")
    for _ in range(3):  # the second time captures graphs, the third replays them
        loss, gradient = problem.value_and_gradient(point, estimator)
    tangent = problem.tangent(point, {"gravity": np.ones(simulation.dimension)})
    iterations = problem.iterations()
    end = problem.end(point)
    return [
        end.positions,
        end.mass_fractions,
        iterations,
        np.array(loss),
        np.array(tangent),
        *gradient.values(),
    ]


SCENES = {
    "fixed": splash(),
    "tolerance": splash(**TOLERANT),
    "plane": plane(),
    "two fluids": two_layers(),
    "three fluids": plane_of_three(),
    "surface tension": plane(
        phase=[HONEY],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "honey"}],
        forces={"gravity": [0.0, -9.81], "surface_tension": 3.0},
    ),
}


@pytest.mark.parametrize("made", SCENES.values(), ids=SCENES)
def test_the_same_as_the_cpu(made):
    for found, wanted in zip(evaluate(made, "cuda:0"), evaluate(made, "cpu"), strict=True):
        assert np.linalg.norm(found - wanted) <= 1e-8 * np.linalg.norm(wanted)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("made", [splash(**TOLERANT), two_layers()], ids=["tolerance", "two fluids"])
def test_same_bits_twice(made, precision):
    for first, second in zip(*(evaluate(made, "cuda:0", precision) for _ in range(2)), strict=True):
        assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize("lanes", [1, 2, 4, 8, 16, 32])
@pytest.mark.parametrize("name", SCENES)
def test_any_number_of_lanes_computes_the_same(name, lanes, monkeypatch):
    wanted = evaluate(SCENES[name], "cpu", steps=20)
    monkeypatch.setattr("cortado.solvers.build.lanes_for", lambda particles, device: lanes)
    for found, one in zip(evaluate(SCENES[name], "cuda:0", steps=20), wanted, strict=True):
        assert np.linalg.norm(found - one) <= 1e-9 * np.linalg.norm(one)


@pytest.mark.parametrize("estimator", [gradients.AdjointViscosity(0.1), gradients.FrozenGeometry()], ids=repr)
@pytest.mark.parametrize("name", ["fixed", "two fluids"])
def test_estimators_compute_the_same_with_lanes(name, estimator, monkeypatch):
    found = []
    for lanes in (1, 8):
        monkeypatch.setattr("cortado.solvers.build.lanes_for", lambda particles, device, lanes=lanes: lanes)
        found.append(evaluate(SCENES[name], "cuda:0", steps=20, estimator=estimator))
    for one, several in zip(*found, strict=True):
        assert np.linalg.norm(several - one) <= 1e-9 * np.linalg.norm(one)


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
