"""Fluid that rubs free bodies: momenta, a slow twin, closed forms, and what is refused. `test_features.py` and
`test_solid_loads.py` have their derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from cortado import Problem, SceneError, Simulation
from cortado.losses import SolidPose
from cortado.scene.stability import stability_limits
from floating_bodies import settling_disc, stopping_cylinder
from reference_projection import Projection
from scenes import bodies, box
from test_free_bodies import BALL, RAFT, hit, plane
from twins import stress_twin

ROUGH = {**RAFT, "slip": "no"}
PROJECTION = {"kind": "projection", "time_step": 0.001}
SYRUP = [{"name": "water", "rest_density": 1000.0, "viscosity": 30.0}]


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_rough_body_and_syrup_in_free_space_keep_their_momentum(dimension):
    """Syrup hits a light body and clings to it."""
    run = hit(dimension, -0.1, 40.0, 60, "no", phase=SYRUP)
    assert run.solids["raft"].velocities[-1, 0] > 0.7 and run.diagnostics["viscous_iterations"].max() < 30


def friction_of(simulation):
    """The friction of its implicit viscous solve, and the accelerations by that alone."""
    solver = simulation.solver
    force = next(one for one in solver.forces if hasattr(one, "solve"))
    found = solver.accelerations[-1].numpy() - solver.accelerations[-2].numpy()
    order = solver.search.order.numpy()[: len(found)]
    of_scene = np.empty_like(found)
    of_scene[order] = found
    return force.free, of_scene[:, : simulation.dimension]


def test_the_solve_is_that_of_a_twin():
    """Dense, of all particles and the body, after steps whose pressures count: forces on the body are those on wall
    particles, at the surface below each particle."""
    few = box([0.1, 0.1], [0.55, 0.4], phase="water")
    scene = plane({**ROUGH, "density": 60.0}, phase=SYRUP, fluid=[few])
    simulation = Simulation(scene, precision="float64")
    state = simulation.run(3).last_state
    simulation.run(1, state=state)
    solver, h = simulation.solver, scene.solver.time_step
    walls = {name: solver.search.walls[f"wall_{name}"].numpy() for name in ("positions", "weights", "solids")}
    walls = walls["positions"][:, :2], walls["weights"] * (walls["solids"] == 0)  # the container slips freely
    stress, twin = stress_twin(simulation, *walls, sticks=True), Projection.of(simulation)
    x, n = state["positions"], len(state["positions"])
    middle, held = solver.search.moving.named["after"].numpy()[0, 0, :2], twin.bodies[0]
    mobility, twin = held.mobility[np.ix_([0, 1, 5], [0, 1, 5])], replace(twin, bodies=(replace(held, middle=middle),))
    pushed = np.einsum("in,n->i", twin.body_rows(x)[0], state["pressure_impulse"])[[0, 1, 5]]
    begun = np.array([*np.ravel(state["raft.velocity"])[:2], *np.ravel(state["raft.angular_velocity"])])
    start = begun + [0.0, -9.81 * h, 0.0] + mobility @ pushed
    u = state["velocities"]  # gravity is left out of what is resisted

    def slope(y):
        apart, _, g = twin.pairs(x, y)
        square = (apart**2).sum(-1)
        return (apart * g).sum(-1) / np.where(square == 0.0, 1.0, square) / stress.volume

    slopes, wall_slopes = slope(x), slope(walls[0])

    def forces(z):
        """Of velocities of particles and of the body, forces on all of these."""
        v, (a, b, w) = z[: 2 * n].reshape(n, 2), z[2 * n :]

        def surface(places):
            arms = places - middle
            return np.stack([a - w * arms[..., 1], b + w * arms[..., 0]], axis=-1)

        pull, places = stress.pulls(x, v, slopes, wall_slopes, np.full(n, 30.0), surface)
        on_fluid, on_walls, arms = pull[:, :n].sum(0) - pull.sum(1), pull[:, n:], places - middle
        torque = (arms[..., 0] * on_walls[..., 1] - arms[..., 1] * on_walls[..., 0]).sum()
        return np.concatenate([on_fluid.ravel(), on_walls.sum((0, 1)), [torque]])

    size = 2 * n + 3
    matrix = np.array([forces(row) for row in np.eye(size)]).T
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-10 * np.abs(matrix).max())
    inverse_mass = np.zeros((size, size))
    inverse_mass[: 2 * n, : 2 * n] = np.eye(2 * n) / 1000.0
    inverse_mass[2 * n :, 2 * n :] = mobility
    z = np.linalg.solve(np.eye(size) - h * inverse_mass @ matrix, np.concatenate([u.ravel(), start]))
    friction, found = friction_of(simulation)
    rubbed = (z[: 2 * n] - u.ravel()).reshape(n, 2) / h
    np.testing.assert_allclose(found, rubbed, atol=1e-9 * np.abs(rubbed).max())
    impulse = friction.own["raft"].impulse["impulse"].numpy()[0][[0, 1, 5]]
    wanted = h * forces(z)[2 * n :]
    np.testing.assert_allclose(impulse, wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(friction.own["raft"].arrays["V"].numpy()[0, :2], z[2 * n : 2 * n + 2], rtol=1e-9)


@pytest.mark.parametrize("law", [None, {"kind": "power_law", "flow_index": 0.5, "least_shear_rate": 0.1}])
def test_a_derivative_in_float32_is_near_that_in_float64(law):
    phase = [{**SYRUP[0], "rheology": law}] if law else SYRUP
    scene, loss = plane(ROUGH, {**BALL, "centre": [0.8, 0.5], "slip": "no"}, phase=phase), SolidPose("raft", [0.3, 0.2])
    found, exact = (
        Problem(Simulation(scene, precision=precision), 4, loss).value_and_gradient({"raft.density": 400.0})[1]
        for precision in ("float32", "float64")
    )
    assert found["raft.density"] == pytest.approx(exact["raft.density"], rel=0.01)


@pytest.mark.parametrize("density", [20.0, 5000.0])
def test_bodies_of_any_density_rest_in_syrup(density):
    """Light ones rise and heavy ones sink, both slowly and without a swing."""
    ball = {**BALL, "centre": [0.3, 0.2], "density": density, "slip": "no"}
    scene = plane(ball, phase=SYRUP, container=box([0.0, 0.0], [0.6, 1.0], slip="no"))
    run = Simulation(scene, precision="float64").run(120, record_every=1)
    velocities = run.solids["ball"].velocities[:, 1]
    assert np.abs(velocities).max() < 0.6 and np.abs(np.diff(velocities[60:], n=2)).max() < 0.01


def test_a_turning_cylinder_stops_as_syrup_lets_it():
    assert stopping_cylinder(16)["rate over the exact one"] == pytest.approx(1.0, abs=0.03)


def test_a_disc_sinks_in_the_longest_step_as_syrup_lets_it():
    """Faxen (1946). In steps four times as long it is 25 % too fast."""
    found = settling_disc(8, 0.25 * 0.0125**2 / 0.1, 0.08)
    assert found["speed over the exact one"] == pytest.approx(1.0, abs=0.08) and found["swing"] < 0.02


def test_steps_are_bounded_by_friction_where_bodies_do_not_slip():
    for slip in ("no", "free"):
        disc = {"name": "disc", "shape": "sphere", "centre": [0.5, 0.5], "radius": 0.2, "slip": slip}
        disc |= {"motion": "free", "density": 2000.0}
        scene = bodies(2, [box([0.0, 0.0], [1.0, 1.0])], viscosity=100.0, solid=[disc], solver=PROJECTION)
        limits = stability_limits(scene)
        assert limits.get("friction") == (pytest.approx(0.25 * 0.05**2 / 0.1) if slip == "no" else None)


def test_an_explicit_solve_is_refused():
    with pytest.raises(SceneError, match=r'viscous_solve is .explicit., but must be "implicit" or "automatic", as the'):
        plane(ROUGH, forces={"viscous_solve": "explicit"})


def test_bodies_that_slip_beside_those_that_do_not():
    """Fluid that turns round a slippery one leaves it as it is."""
    quiet = {"forces": {"gravity": [0.0, 0.0]}, "container": {"shape": "none"}, "phase": SYRUP}
    wheels = [
        {**BALL, "name": name, "centre": [x, 0.2], "slip": slip, "angular_velocity": 2.0}
        for name, x, slip in (("a", 0.15, "no"), ("b", 0.45, "free"))
    ]
    run = Simulation(plane(*wheels, **quiet), precision="float64").run(10)
    turning = {name: run.solids[name].angular_velocities[-1] for name in "ab"}
    assert abs(turning["a"]) < 1.0 and turning["b"] == pytest.approx(2.0, rel=0.02)
