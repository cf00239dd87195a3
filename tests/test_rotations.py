"""Rotations by rotation vectors, and gravity that leans: sizes, derivatives, and problems that are told a tilt."""

from math import factorial

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from cortado import InputError, Problem, Simulation, losses
from cortado.device.precision import FLOAT64
from cortado.scene.parameter_values import SMALL as SMALL_TILT
from cortado.scene.parameter_values import Tilt
from cortado.sph.moving_solids import SMALL, rotations
from finite_differences import both_modes, decades, distance, plateau
from scenes import plane, scene, splash

VECTOR, REAL = FLOAT64.vector, FLOAT64.real
SPACE = rotations(FLOAT64, 3)
NEAR = SMALL**0.5
SIZES = [0.0, 1e-9, 1e-3, 0.9 * NEAR, 0.999 * NEAR, 1.001 * NEAR, 0.3, 3.0]
"""Of turns [rad]: on both sides of where a series ends."""

ROTATION = SPACE.rotation


@wp.func
def work(turn: VECTOR, arm: VECTOR, force: VECTOR) -> REAL:
    return wp.dot(ROTATION(turn) * arm, force)


@wp.kernel(enable_backward=False)
def all_of(
    turn: wp.array(dtype=VECTOR),
    arm: wp.array(dtype=VECTOR),
    force: wp.array(dtype=VECTOR),
    # out
    columns: wp.array2d(dtype=VECTOR),
    slope: wp.array(dtype=VECTOR),
):
    i = wp.tid()
    for k in range(3):
        axis = VECTOR()
        axis[k] = REAL(1.0)
        columns[i, k] = ROTATION(turn[i]) * axis
    by_turn, _by_arm, _by_force = wp.grad(work)(turn[i], arm[i], force[i])
    slope[i] = by_turn


def found(turn, arm, force):
    """(n, 3, 3) rotations, and (n, 3) the derivatives of R(w) arm . force."""
    n = len(turn)
    out = [wp.zeros(shape, dtype=VECTOR, device="cpu") for shape in ((n, 3), n)]
    given = [wp.array(values, dtype=VECTOR, device="cpu") for values in (turn, arm, force)]
    wp.launch(all_of, n, [*given, *out], device="cpu")
    columns, slope = (array.numpy() for array in out)
    return columns.transpose(0, 2, 1), slope


def jacobian(w):
    """J(w) = sum_k [w]^k / (k + 1)!."""
    cross, power, total = np.cross(w, np.eye(3)).T, np.eye(3), np.zeros((3, 3))
    for k in range(40):
        total += power / factorial(k + 1)
        power = power @ cross
    return total


def test_a_rotation_and_its_changes():
    for size in SIZES:
        random = np.random.default_rng(4)
        turn, arm, force = random.normal(size=(3, 20, 3))
        turn *= size / np.linalg.norm(turn, axis=1, keepdims=True)
        matrices, slope = found(turn, arm, force)
        torque = np.cross(np.einsum("nab,nb->na", matrices, arm), force)
        wanted = np.einsum("nab,na->nb", [jacobian(w) for w in turn], torque)
        np.testing.assert_allclose(matrices, Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)
        np.testing.assert_allclose(slope, wanted, atol=2e-14)


def test_the_series_is_that_of_a_rotation():
    """R(w + w') R(w)^T turns by J(w) w'."""
    random = np.random.default_rng(5)
    w, change, h = random.normal(size=3), random.normal(size=3), 1e-5
    ahead, behind = (Rotation.from_rotvec(w + sign * h * change) for sign in (1.0, -1.0))
    np.testing.assert_allclose((ahead * behind.inv()).as_rotvec() / (2.0 * h), jacobian(w) @ change, atol=1e-9)


RESTS = {
    "down": (0.0, -9.81, 0.0),
    "down in the plane": (0.0, -9.81),
    "askew": (3.0, -9.0, 1.0),
    "askew in the plane": (3.0, -9.0),
    "along z": (0.0, 0.0, 1.6),
    "along a diagonal": (1.0, 1.0, 1.0),
}
ANGLES = [0.0, 1e-9, *(np.degrees(SMALL_TILT) * np.array([1.0 / 3.0, 0.999, 1.001])), 25.0, 130.0]
"""Of tilts [degrees]: on both sides of where a series ends."""


def random_angles(rest, size, *shape, seed=0):
    """(..., d - 1) [degrees], each row of that size."""
    a = np.random.default_rng(seed).standard_normal((*shape, len(rest) - 1))
    return size * a / np.linalg.norm(a, axis=-1, keepdims=True)


@pytest.mark.parametrize("rest", RESTS.values(), ids=RESTS)
def test_gravity_keeps_its_size_and_leans_by_the_angle_and_has_derivatives(rest):
    """Of tangents as limits of differences, of second order; adjoints are their transposes."""
    tilt, whole = Tilt(rest), np.linalg.norm(rest)
    for size in ANGLES:
        angles, along = random_angles(rest, size, 20), random_angles(rest, 1.0, 20, seed=1)
        gravity = tilt.gravity(angles)
        np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), whole, rtol=1e-15)
        lean = np.linalg.norm(gravity - np.array(rest), axis=1) / whole  # the chord
        np.testing.assert_allclose(lean, 2.0 * np.sin(np.radians(size) / 2.0), rtol=1e-6, atol=1e-15)
        wanted, errors = tilt.tangent(angles, along), []
        for h in decades(0.0, 4.5, apart=0.25):
            ahead, behind = (tilt.gravity(angles + sign * h * along) for sign in (1.0, -1.0))
            errors.append(np.linalg.norm((ahead - behind) / (2.0 * h) - wanted) / np.linalg.norm(wanted))
        assert plateau(errors) < 1e-10, size
        assert errors[4] < 1.1e-2 * errors[0] and errors[8] < 1.1e-2 * errors[4], size
        bar = np.random.default_rng(2).standard_normal((20, len(rest)))
        backward = (along * tilt.adjoint(angles, bar)).sum(axis=1)
        np.testing.assert_allclose(backward, (bar * wanted).sum(axis=1), rtol=1e-12, atol=1e-15)


def test_angles_are_towards_the_other_axes():
    tilt, sine, cosine = Tilt((0.0, -2.0, 0.0)), np.sin(np.pi / 6), np.cos(np.pi / 6)
    np.testing.assert_allclose(tilt.gravity(np.array([30.0, 0.0])), [2.0 * sine, -2.0 * cosine, 0.0], atol=1e-15)
    np.testing.assert_allclose(tilt.gravity(np.array([0.0, -30.0])), [0.0, -2.0 * cosine, -2.0 * sine], atol=1e-15)
    np.testing.assert_allclose(Tilt((0.0, -2.0)).gravity(np.array([30.0])), [2.0 * sine, -2.0 * cosine], atol=1e-15)
    assert (tilt.towards, Tilt((0.0, -2.0)).towards, Tilt((0.0, 0.1, 9.0)).towards) == ("xz", "x", "xy")
    np.testing.assert_array_equal(tilt.gravity(np.zeros(2)), [0.0, -2.0, 0.0])


STEPS = 12


def problem_of(made):
    simulation = Simulation(made, precision="float64")
    target = simulation.positions + 0.1 * np.random.default_rng(3).random(simulation.positions.shape)
    return Problem(simulation, STEPS, losses.FinalPositions(target))


@pytest.mark.parametrize("made", [splash, plane], ids=["3-D", "2-D"])
@pytest.mark.parametrize("rows", [(), (STEPS,)], ids=["constant", "over time"])
def test_a_problem_takes_a_tilt_in_the_place_of_gravity(made, rows):
    problem = problem_of(made())
    rest = problem.simulation.scene.forces.gravity
    angles = random_angles(rest, 20.0, *rows)
    point, gravity = {"tilt": angles, "viscosity": 0.1}, {"gravity": Tilt(rest).gravity(angles), "viscosity": 0.1}
    loss, gradient = problem.value_and_gradient(point)
    wanted, by_gravity = problem.value_and_gradient(gravity)
    assert loss == problem.value(point) == wanted
    assert gradient["tilt"].shape == angles.shape and gradient["viscosity"] == by_gravity["viscosity"]
    frames = problem.simulation.run(STEPS, point).positions
    np.testing.assert_array_equal(frames, problem.simulation.run(STEPS, gravity).positions)

    along = {"tilt": random_angles(rest, 1.0, *rows, seed=1)}
    _, slope = both_modes(problem, point, along, 1e-11)
    assert distance(problem.value, point, along, slope, decades(1.0, 4.0), enough=1e-8) < 1e-8


def test_one_tilt_may_vary_where_there_is_a_row_for_each_step():
    problem = problem_of(splash())
    angles, along = random_angles((0, -1, 0), 20.0, STEPS), {"tilt": np.array([1.0, -0.5])}
    gradient = problem.value_and_gradient({"tilt": angles})[1]["tilt"]
    assert problem.tangent({"tilt": angles}, along) == pytest.approx((gradient @ along["tilt"]).sum(), rel=1e-11)
    at_rest = problem.value_and_gradient({"tilt": np.zeros(2)})[1]["tilt"] @ along["tilt"]
    assert problem.tangent({"viscosity": 0.05}, along) == pytest.approx(at_rest, rel=1e-11)


WEIGHTLESS = scene(forces={"gravity": [0.0, 0.0, 0.0]})
BOTH = {"tilt": [0.0, 0.0], "gravity": [0.0, -9.81, 0.0]}


def test_a_wrong_tilt_is_a_sentence():
    for made, values, along, words in [
        (splash(), BOTH, None, "gravity is given, but must be left out, as tilt is"),
        (splash(), {"tilt": [0.0, 0.0, 0.0]}, None, r"tilt has shape \(3,\), but must be \(2,\) or \(12, 2\) in °"),
        (WEIGHTLESS, {"tilt": [1.0, 0.0]}, None, "tilt is given, .* as the scene has no gravity to lean"),
        (splash(), {"gravity": [0.0, -9.0, 0.0]}, {"tilt": [1.0, 0.0]}, "direction tilt is .* as gravity is given"),
        (splash(), {"tilt": [1.0, 0.0]}, {"gravity": [0.0, -1.0, 0.0]}, "direction gravity is .* as tilt is given"),
    ]:
        problem = problem_of(made)
        with pytest.raises(InputError, match=words):
            problem.value(values) if along is None else problem.tangent(values, along)
