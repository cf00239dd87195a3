"""The implicit adjoint of the projection's pressure: what it equals at convergence, what it costs, what it refuses."""

import numpy as np
import pytest

from cortado import InputError, Problem, Simulation, gradients, losses
from cortado.device.launching import KernelLauncher
from cortado.gradients import ImplicitPressure
from scenes import box, jet, plane, plane_of_three, scene, thrown

PERIODIC = box([0.0, 0.0], [0.4, 0.8], periodic=[True, False])
MADE = {
    "plane": plane,
    "few": lambda **tables: plane(fluid=[box([0.0, 0.0], [0.2, 0.15], phase="water")], **tables),
    "space": scene,
    "periodic": lambda **tables: plane(container=PERIODIC, **tables),
    "three phases": lambda **tables: plane_of_three(mixture={"mobility": 0.0}, **tables),
    "nozzle": lambda **tables: jet(forces={"gravity": [0.7, -9.81]}, **tables),
}
SOLVED = ImplicitPressure(tolerance=0.0, iterations=100)


def problem_of(case, iterations, steps=5, **options):
    solver = {"kind": "projection", "time_step": 0.002, "iterations": iterations}
    simulation = Simulation(MADE[case](solver=solver), **{"precision": "float64", **options})
    return Problem(simulation, steps, losses.FinalPositions(simulation.positions + 0.03))


def point_of(simulation):
    """Gravity and, of what no nozzle leads, a first state with scatter."""
    found = {"gravity": np.array(simulation.scene.forces.gravity)}
    return found | ({} if simulation.scene.emitter is not None else thrown(simulation))


def distances(case, iterations, estimator):
    """Of each parameter, how far the gradient is from the exact one, relative; after a step and one before it."""
    problem = problem_of(case, iterations, steps=2)
    at = point_of(problem.simulation)
    (loss, exact), (same, found) = (problem.value_and_gradient(at, one) for one in (gradients.Exact(), estimator))
    assert loss == same
    return {name: np.linalg.norm(found[name] - exact[name]) / np.linalg.norm(exact[name]) for name in at}


BOUNDS = {"few": 1e-6, "space": 1e-5, "periodic": 5e-3, "three phases": 1e-5, "nozzle": 1e-5}


@pytest.mark.parametrize("case", BOUNDS)
def test_at_the_fixed_point_it_is_the_exact_gradient(case):
    """Without walls beside it fluid is slow to get there: 4e-3 after 1,000 iterations. Velocities are nearer by then,
    but the shift depends on the pressure itself, whose weakest waves take longest, and no iteration but the first has a
    momentum. Twelve particles in a corner are there after 90."""
    iterations = (40, 90) if case == "few" else (60, 1000)
    near, nearer = (max(distances(case, each, SOLVED).values()) for each in iterations)
    assert nearer < BOUNDS[case] and nearer < 0.1 * near


def test_after_few_iterations_it_points_the_same_way():
    """Of fluid that random velocities scatter; with 2 iterations cosines are 0.985, 0.933 and 1.000."""
    problem = problem_of("plane", 16)
    at = point_of(problem.simulation)
    exact, found = (problem.value_and_gradient(at, one)[1] for one in (gradients.Exact(), ImplicitPressure()))
    for name in at:
        cosine = np.sum(exact[name] * found[name]) / np.linalg.norm(exact[name]) / np.linalg.norm(found[name])
        assert cosine > 0.99, name


def test_without_its_solve_it_would_be_far_off():
    unsolved = ImplicitPressure(tolerance=0.0, iterations=1)
    assert distances("few", 90, unsolved)["initial_velocities"] > 100.0 * BOUNDS["few"]


def test_its_work_does_not_depend_on_the_iterations(monkeypatch):
    counts, launch = [0], KernelLauncher.__call__

    def counted(self, *arguments, **options):
        counts[-1] += 1
        return launch(self, *arguments, **options)

    monkeypatch.setattr(KernelLauncher, "__call__", counted)
    for estimator in (ImplicitPressure(tolerance=0.0, iterations=5), gradients.Exact()):
        for iterations in (4, 32):
            problem = problem_of("plane", iterations, steps=2)
            at = point_of(problem.simulation)
            problem.value(at)
            reserved, backward = [], problem.simulation.solver.reserve
            noted = lambda counts, own=backward, found=reserved: found.append(counts[0]) or own(counts)  # noqa: E731
            monkeypatch.setattr(problem.simulation.solver, "reserve", noted)
            counts.append(0)
            problem.value_and_gradient(at, estimator)
            assert max(reserved) == (iterations if estimator == gradients.Exact() else 0)
    few, many, exact_few, exact_many = counts[1:]
    assert many - few < 0.5 * (exact_many - exact_few)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_bits_batches_and_precisions(precision):
    tilts = np.array([[[0.0, -9.81]], [[2.0, -9.0]]])
    alone, batch = problem_of("plane", 8, precision=precision), problem_of("plane", 8, precision=precision, batch=2)
    values, found = batch.value_and_gradient({"gravity": tilts}, ImplicitPressure())
    for value, gradient, tilt in zip(values, found["gravity"], tilts, strict=True):
        for _ in "12":
            one, wanted = alone.value_and_gradient({"gravity": tilt[0]}, ImplicitPressure())
            assert value == one and gradient.tobytes() == wanted["gravity"].tobytes()


def test_in_float32_it_is_near_that_of_float64():
    single, double = (problem_of("plane", 8, precision=precision) for precision in ("float32", "float64"))
    at = {"gravity": np.array([0.4, -9.0])}
    wanted, found = (p.value_and_gradient(at, ImplicitPressure())[1]["gravity"] for p in (double, single))
    np.testing.assert_allclose(found, wanted, rtol=5e-3, atol=5e-3 * np.abs(wanted).max())


def test_what_is_refused():
    simulation = Simulation(plane(), precision="float64")
    with pytest.raises(InputError, match=r'solver.kind "pcisph" has no implicit adjoint of its pressure'):
        Problem(simulation, 2, losses.FinalPositions(simulation.positions)).value_and_gradient({}, ImplicitPressure())
    with pytest.raises(InputError, match=r"tolerance is 1\.0"):
        ImplicitPressure(tolerance=1.0)
    with pytest.raises(InputError, match="iterations is 0"):
        ImplicitPressure(iterations=0)
