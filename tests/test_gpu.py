"""The GPU computes what the CPU computes; needs a CUDA device."""

import numpy as np
import pytest
import warp as wp

from cortado import Problem, Simulation, losses
from scenes import plane, splash

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")

POINT = {"gravity": np.array([0.5, -9.81, 0.2]), "viscosity": 0.05, "rest_density": 1000.0, "time_step": 0.0021}
TOLERANT = {"minimum_iterations": 2, "maximum_iterations": 40, "density_tolerance": 1e-3}


def evaluate(made, device, precision="float64", steps=60):
    """Last positions, iterations, loss and gradient."""
    simulation = Simulation(made, device, precision)
    problem = Problem(simulation, steps, losses.FinalPositions(simulation.positions))
    point = {**POINT, "initial_positions": simulation.positions, "initial_velocities": simulation.velocities}
    point["gravity"] = POINT["gravity"][: simulation.dimension]
    for _ in range(3):  # the second time captures graphs, the third replays them
        loss, gradient = problem.value_and_gradient(point)
    tangent = problem.tangent(point, {"gravity": np.ones(simulation.dimension)})
    iterations = problem.iterations()
    return [problem.end(point).positions, iterations, np.array(loss), np.array(tangent), *gradient.values()]


@pytest.mark.parametrize("made", [splash(), splash(**TOLERANT), plane()], ids=["fixed", "tolerance", "plane"])
def test_the_same_as_the_cpu(made):
    for found, wanted in zip(evaluate(made, "cuda:0"), evaluate(made, "cpu"), strict=True):
        assert np.linalg.norm(found - wanted) < 1e-8 * np.linalg.norm(wanted)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_same_bits_twice(precision):
    for first, second in zip(*(evaluate(splash(**TOLERANT), "cuda:0", precision) for _ in range(2)), strict=True):
        assert first.tobytes() == second.tobytes()


def test_short_lists_grow():
    simulation = Simulation(splash(), "cuda:0", "float64")
    wanted = simulation.run(40).positions
    simulation.solver.search.forget_needed()
    simulation.solver.grow(8)
    np.testing.assert_array_equal(simulation.run(40).positions, wanted)
    assert simulation.solver.search.capacity > 8
