"""Whole steps of the engine against the slow twin, and their tangents against complex steps."""

import numpy as np
import pytest

import reference
from cortado import Simulation
from cortado.particles import Parameters, State
from cortado.smoothing import KERNELS
from scenes import plane, scene

GRAVITY, DENSITY, VISCOSITY, TIME_STEP, STEPS = np.array([0.3, -9.81, 0.1]), 1000.0, 5.0, 0.0021, 3


def disturbed(simulation, seed=0):
    """A random state near the scene's own, so that no symmetry hides a mistake."""
    random = np.random.default_rng(seed)
    spacing = simulation.scene.discretisation.spacing
    positions = simulation.positions + 0.05 * spacing * random.standard_normal(simulation.positions.shape)
    return positions, 0.3 * random.standard_normal(positions.shape)


def twin(simulation, viscosity):
    """The slow twin of a simulation, in the simulation's own dimension."""
    lattice, search, d = simulation.solver.lattice, simulation.solver.search, simulation.dimension
    terms = [term for term in simulation.solver.terms if hasattr(term, "_friction")]
    return reference.Pcisph(
        simulation.solver.discretisation.smoothing,
        d,
        lattice.support,
        lattice.volume,
        lattice.stiffness,
        search.wall_positions.numpy()[:, :d].astype(np.float64),
        search.wall_weights.numpy().astype(np.float64),
        viscosity=viscosity,
        friction=terms[0]._friction if terms else 0.0,
        reach=1.03 * lattice.support,
        rigidity=lattice.rigidity,
        push=lattice.wall_push,
    )


CASES = [
    (scene, "cubic_spline", "pairwise", "free"),
    (scene, "wendland_c2", "laminar", "no"),
    (scene, "wendland_c4", "none", "free"),
    (plane, "cubic_spline", "laminar", "no"),
    (plane, "wendland_c2", "pairwise", "no"),
]


@pytest.mark.parametrize(("make", "kernel", "viscosity", "slip"), CASES)
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_steps_equal_those_of_the_twin(make, kernel, viscosity, slip, precision):
    simulation, gravity = prepared(make, kernel, viscosity, slip, precision)
    x, v = positions, velocities = disturbed(simulation)
    rollout = simulation.rollout(STEPS, {"gravity": gravity})
    rollout.initial.set(positions, velocities)
    rollout.parameters.set(gravity, DENSITY, VISCOSITY, TIME_STEP)
    found = rollout.forward().numpy(simulation.dimension)
    slow = twin(simulation, viscosity)
    for _ in range(STEPS):
        x, v = slow.step(x, v, gravity, DENSITY, VISCOSITY, TIME_STEP, 5)
    tolerance = 1e-13 if precision == "float64" else 2e-5
    assert np.abs(x - positions).max() > 1e-3
    np.testing.assert_allclose(found[0], x, rtol=0, atol=tolerance)
    np.testing.assert_allclose(found[1], v, rtol=0, atol=100 * tolerance)


@pytest.mark.parametrize(("make", "kernel", "viscosity", "slip"), CASES)
def test_tangents_equal_complex_steps_of_the_twin(make, kernel, viscosity, slip):
    simulation, gravity = prepared(make, kernel, viscosity, slip, "float64")
    positions, velocities = disturbed(simulation)
    rollout = simulation.rollout(STEPS, {"gravity": gravity})
    rollout.initial.set(positions, velocities)
    rollout.parameters.set(gravity, DENSITY, VISCOSITY, TIME_STEP)
    rollout.forward()
    random = np.random.default_rng(1)
    x_dot, v_dot = random.standard_normal((2, *positions.shape))
    rates = {
        "gravity": random.standard_normal(gravity.shape),
        "rest_density": 10.0,
        "viscosity": 0.3,
        "time_step": 1e-4,
    }
    dot = State.zeros(len(positions), simulation.precision, simulation.device)
    dot.set(x_dot, v_dot)
    parameters = Parameters.zeros(STEPS, simulation.precision, simulation.device)
    parameters.set(**rates)
    rollout.tangent(dot, parameters)
    slow = twin(simulation, viscosity)

    def steps(x, v, *parameters):
        for _ in range(STEPS):
            x, v = slow.step(x, v, *parameters, 5)
        return np.stack([x, v])

    point = (positions, velocities, gravity, DENSITY, VISCOSITY, TIME_STEP)
    wanted = reference.complex_step(steps, point, (x_dot, v_dot, *rates.values()))
    for found, exact in zip(dot.numpy(simulation.dimension), wanted, strict=True):
        assert np.linalg.norm(found - exact) < 1e-12 * np.linalg.norm(exact)


def prepared(make, kernel, viscosity, slip, precision):
    """A simulation of one case, and gravity in its dimension."""
    assert kernel in KERNELS
    original = make()
    simulation = Simulation(
        make(
            discretisation={"spacing": 0.05, "support": 2.0 if kernel == "cubic_spline" else 2.6, "kernel": kernel},
            forces={"gravity": original.forces.gravity, "viscosity": viscosity},
            container={**original.container.model_dump(), "slip": slip},
        ),
        precision=precision,
    )
    return simulation, GRAVITY[: simulation.dimension]
