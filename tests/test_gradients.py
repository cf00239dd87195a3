"""The gradient is right: reverse mode, forward mode, Warp's tape and central differences agree."""

import numpy as np
import pytest

from cortado import Problem, Simulation, losses
from finite_differences import both_modes, central_difference, decades, distance, plateau
from scenes import plane, splash

SCALES = {"gravity": 1.0, "gravity over time": 1.0, "initial_positions": 0.05, "initial_velocities": 0.1}
SCALES["viscosity"] = 0.05
"""Size of a direction of each parameter."""


def problem_of(made, steps):
    simulation = Simulation(made, precision="float64")
    random = np.random.default_rng(5)
    return Problem(simulation, steps, losses.FinalPositions(0.2 + 0.1 * random.random(simulation.positions.shape)))


def point_and_direction(problem, what, seed=0):
    simulation, random = problem.simulation, np.random.default_rng(seed)
    name = what.removesuffix(" over time")
    point = simulation.parameters()[name]
    if what != name:
        point = np.tile(point, (problem.steps, 1))
    direction = random.standard_normal(point.shape)
    return name, point, SCALES[what] * direction / np.linalg.norm(direction)


def disturbed(positions):
    return positions + 0.001 * np.random.default_rng(3).standard_normal(positions.shape)


ITERATIONS = {"fixed": {}, "tolerance": {"minimum_iterations": 2, "maximum_iterations": 40, "density_tolerance": 0.001}}


@pytest.mark.parametrize(
    ("what", "steps", "iterations"),
    [
        *((what, 100, iterations) for what in SCALES for iterations in ITERATIONS),
        *((what, 200, iterations) for what, iterations in zip(SCALES, 3 * list(ITERATIONS), strict=False)),
    ],
)
def test_splash(what, steps, iterations):
    """From a start off the lattice, on which all particles without free surface have the rest density: many of them
    would be so near the kink of the pressure's clamp that a difference crosses it before round-off is small in it."""
    problem = problem_of(splash(**ITERATIONS[iterations]), steps)
    name, value, direction = point_and_direction(problem, what)
    start = problem.simulation.positions
    point = {name: value, "initial_positions": disturbed(start)}
    directions = {"initial_positions": np.zeros_like(start), name: direction}
    _, tangent = both_modes(problem, point, directions)
    limit = 1e-3 if steps == 200 else 1e-6  # at 200 steps chaos limits the difference
    first = 4.5 if steps == 200 else 3.0  # chaos and curvature hide the limit of larger ones
    assert distance(problem.value, point, directions, tangent, decades(first, 11.0, apart=0.25), enough=limit) < limit


def test_a_fluid_without_viscosity_has_gradients_by_pairs():
    """Whose mean viscosity divides by 0 where nobody looks."""
    water = [{"name": "water", "rest_density": 1000.0, "viscosity": 0.0}]
    problem = problem_of(plane(phase=water, forces={"gravity": [0.0, -9.81], "viscosity": "pairwise"}), 40)
    point = {"initial_positions": disturbed(problem.simulation.positions)}
    directions = {"initial_positions": 0.05 * np.random.default_rng(1).standard_normal((64, 2)) / 8.0}
    _, tangent = both_modes(problem, point, directions)
    assert distance(problem.value, point, directions, tangent, decades(2.0, 11.0, apart=0.25), enough=1e-6) < 1e-6


POINT, ALONG = {"x": np.array(1.0), "y": np.array(5.0)}, {"x": np.array(1.0)}


def cube(values):
    """Its central difference is 3 x^2 + h^2."""
    return float(values["x"] ** 3)


def test_a_right_derivative_is_on_a_plateau_of_neighbours_and_a_chance_agreement_is_none():
    assert central_difference(cube, POINT, ALONG, 0.1) == pytest.approx(3.01, rel=1e-13)
    assert distance(cube, POINT, ALONG, 3.0, decades(1.0, 6.0)) < 1e-9
    wrong, steps = 3.0 + 1e-4, decades(1.0, 6.0)
    nearest = min(abs(central_difference(cube, POINT, ALONG, h) - wrong) for h in steps)
    assert nearest < 1e-12  # at h = 0.01
    assert distance(cube, POINT, ALONG, wrong, steps, enough=1e-6) > 1e-5
    assert plateau([1.0, 0.1, 5.0, 0.2, 0.3, 0.1, 9.0]) == 0.3
    with pytest.raises(AssertionError):
        plateau([0.1, 0.1])
