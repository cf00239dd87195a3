"""The certificate: no false alarm, horizons that can be foreseen, and advice. What it catches: `test_plants`."""

import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import cortado
from cortado import DivergedError, InputError, Problem, Simulation, load_scene, losses
from cortado.certificate import Consistency, certify
from cortado.certificate.consistency import LossHistory, balanced, in_float64
from cortado.certificate.horizon import Alignment, Horizon, Judged, growth
from cortado.pictures.run_pictures import gradient_check
from cortado.problem import ProblemForwardPass
from cortado.render.renderer import scene_renderer
from cortado.sph.free_energy import FREE_ENERGIES
from scenes import box, jet, plane, plane_of_three, pour, scene, splash, two_layers

C4 = {"spacing": 0.05, "support": 2.6, "kernel": "wendland_c4"}
BY_TOLERANCE = {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 2, "maximum_iterations": 30}
NO_SLIP = box([0.0] * 3, [0.4, 0.6, 0.25], slip="no")
PAIRWISE = {"gravity": [0.0, -9.81, 0.0], "viscosity": "pairwise"}


RIGHT = {
    "3-D, cubic spline, splash": splash,
    "3-D, Wendland C4, pairwise, no slip": lambda: scene(discretisation=C4, forces=PAIRWISE, container=NO_SLIP),
    "3-D, without walls": lambda: scene(container={"shape": "none"}),
    "3-D, two fluids from a nozzle": pour,
    "2-D, iterations by tolerance": lambda: plane(solver={**BY_TOLERANCE, "density_tolerance": 0.001}),
    "2-D, periodic, pairwise": lambda: plane(
        container=box([0.0, 0.0], [0.4, 0.8], periodic=[True, False]), forces={**PAIRWISE, "gravity": [1.0, -9.81]}
    ),
    "2-D, three fluids that mix": plane_of_three,
}


def problem_of(made, steps, loss=None):
    simulation = Simulation(made, precision="float64")
    return Problem(simulation, steps, losses.FinalPositions(simulation.positions) if loss is None else loss(simulation))


@pytest.mark.parametrize("name", RIGHT)
def test_right_gradients_are_found_right(name):
    found = certify(problem_of(RIGHT[name](), 30))
    c = found.consistency
    assert found.right, (found.wrong, c.disagreement, c.miss)
    assert c.disagreement < 1e-10 and c.last_converged == 30 and c.miss < 1e-4
    assert "gravity" in found.loss_changes and found.loss_changes["time_step"] > 0.0
    json.dumps(found.as_dict(), allow_nan=False)


def centre(simulation):
    return losses.CentreOfMass([0.3, 0.1])


@cache
def long():
    """235 steps of a splash in the plane, long beyond its horizon; after 300 no estimator agrees by more than 0.75."""
    forces = {"gravity": [0.0, -9.81], "viscosity": "pairwise"}
    return certify(problem_of(plane(forces=forces), 235, centre), ["gravity"])


def test_beyond_the_horizon_another_estimator_is_advised():
    found = long()
    (horizon,) = found.horizons
    assert found.right and not horizon.lasts
    assert 0.6 < horizon.predicted / horizon.measured < 1.6
    assert found.growth > 0.02
    exact, *others = found.alignment.estimators
    best = max(others, key=lambda judged: judged.merit)
    assert found.estimator == best.estimator and best.cosine > 0.9 and 0.1 < best.size < 10.0
    assert exact.size > 3.0


def test_averages_are_tried_where_no_single_run_is_good(monkeypatch):
    monkeypatch.setattr("cortado.certificate.horizon.GOOD_COSINE", 2.0)
    problem = problem_of(plane(), 20)
    found = certify(problem)
    names = [judged.estimator for judged in found.alignment.estimators]
    assert names[2:] == ["EnsembleMean(spread)", "Guided(spread)"] and found.estimator == "Exact()"
    assert all(judged.cosine > 0.99 for judged in found.alignment.estimators[2:])
    late = replace(found, horizons=tuple(replace(one, exact=10.0 * one.exact) for one in found.horizons))
    guided = tuple(one for one in late.alignment.estimators if one.estimator != "EnsembleMean(spread)")[::2]
    advised = replace(late, alignment=replace(late.alignment, estimators=guided))
    assert "use gradients.Guided(spread) with spread = {'gravity': 0." in str(advised)


def test_within_the_horizon_the_exact_gradient_is_advised():
    found = certify(problem_of(plane(), 40))
    assert found.estimator == "Exact()" and found.horizon == 40
    exact, *_ = found.alignment.estimators
    assert exact.estimator == "Exact()" and exact.cosine > 0.99 and exact.size == pytest.approx(1.0, abs=0.1)
    assert found.horizons[0].predicted is None


# ---- in float32 --------------------------------------------------------------------------------------------------
class Spread:
    """Mean of the fourth power of the distance to a place and of the square of the speed, in float32."""

    def __init__(self, sign=1.0):
        self.sign = sign

    def value(self, end):
        x, v = end.state.positions.numpy(), end.state.velocities.numpy()
        assert x.dtype == v.dtype == np.float32
        return float((((x - np.float32(0.1)) ** 2).sum(axis=1) ** 2).mean() + np.float32(0.01) * (v**2).mean())

    def adjoint(self, end):
        x, v = end.positions - 0.1, end.velocities
        z = 0.1**2 if end.dimension == 2 else 0.0
        x_bar = 4.0 * ((x**2).sum(axis=1, keepdims=True) + z) * x / len(x)
        return self.sign * x_bar, 0.02 / (3 * len(v)) * v


def recorded(positions, velocities, loss):
    """A function of arrays in float32."""
    wp.launch(squares_of_single, len(positions), inputs=[positions, loss], device=positions.device)


@wp.kernel
def squares_of_single(x: wp.array(dtype=wp.vec3f), loss: wp.array(dtype=wp.float32)):
    wp.atomic_add(loss, 0, wp.dot(x[wp.tid()], x[wp.tid()]))


def picture(simulation):
    renderer = scene_renderer(simulation)
    return losses.Image(renderer, np.random.default_rng(1).random(renderer.shape))


IN_SINGLE = {
    "3-D, two fluids, a picture": (lambda: two_layers(render={"view": "top", "resolution": [12, 10]}), picture),
    "2-D, three fluids, a loss of one's own": (plane_of_three, lambda simulation: Spread()),
    "2-D, nozzle, two frames": (
        jet,
        lambda made: losses.Frames({3: losses.FinalPositions(0.9 * made.positions), 8: Spread()}),
    ),
    "3-D, a function of Warp arrays": (scene, lambda simulation: recorded),
}


def certified_in_single(name):
    made, loss = IN_SINGLE[name]
    simulation = Simulation(made())
    assert simulation.precision.name == "float32"
    return certify(Problem(simulation, 8, loss(simulation)))


@pytest.mark.parametrize("name", IN_SINGLE)
def test_right_gradients_are_found_right_in_float32(name):
    found = certified_in_single(name)
    c = found.consistency
    assert found.right, (found.wrong, c.disagreement, c.miss)
    assert c.disagreement < 1e-10 and c.last_converged == 8 and c.miss < 1e-4
    assert found.horizon == 8


@pytest.mark.parametrize("name", ["3-D, two fluids, a picture", "2-D, three fluids, a loss of one's own"])
def test_a_sign_flipped_is_found_in_float32(name, monkeypatch):
    """In the gradient with respect to one parameter, as a wrong adjoint would."""
    back = ProblemForwardPass.back

    def wrong(*arguments):
        gradient = back(*arguments)
        return {**gradient, "viscosity": -gradient["viscosity"]}

    monkeypatch.setattr(ProblemForwardPass, "back", wrong)
    assert certified_in_single(name).wrong == ("viscosity",)


def test_a_wrong_adjoint_of_a_loss_is_found_in_float32():
    assert not certify(Problem(Simulation(plane()), 8, Spread(sign=1.2))).right


def test_what_is_certified_in_float32_is_what_is_in_float64():
    simulation = Simulation(two_layers(), free_energy=FREE_ENERGIES["miscible"])
    twin = in_float64(Problem(simulation, 3, picture(simulation), memory_budget=1000))
    assert twin.simulation.precision.name == "float64" and twin.simulation.free_energy == simulation.free_energy
    assert (twin.steps, twin.memory_budget, twin.simulation.scene) == (3, 2000, simulation.scene)
    assert in_float64(twin) is twin
    point = {"gravity": [1.0, -9.0, 0.5]}
    single = Problem(simulation, 3, picture(simulation)).value_and_gradient(point)
    double = twin.value_and_gradient(point)
    assert double[0] == pytest.approx(single[0], rel=1e-5)
    np.testing.assert_allclose(double[1]["gravity"], single[1]["gravity"], rtol=1e-3, atol=1e-6)


# ---- what is asked, and answered ---------------------------------------------------------------------------------
def test_parameters_may_be_values_and_many_numbers():
    problem = problem_of(plane(), 20)
    velocities = problem.simulation.velocities + [0.3, 0.0]
    found = certify(problem, {"initial_velocities": velocities, "gravity": np.tile([0.5, -9.0], (20, 1))})
    assert found.right and found.alignment is None
    assert [horizon.parameter for horizon in found.horizons] == ["initial_velocities", "gravity"]
    assert found.loss == problem.value({"initial_velocities": velocities, "gravity": [0.5, -9.0]})


def test_frames_are_judged_where_they_are():
    def frames(simulation):
        return losses.Frames({step: losses.FinalPositions(simulation.positions) for step in (5, 9, 12)})

    found = certify(problem_of(plane(), 15, frames))
    assert found.right and found.consistency.sample_steps.tolist() == [5, 9, 12]
    assert found.consistency.losses[-1] == pytest.approx(found.loss)


def test_a_scene_needs_only_a_number_of_steps():
    path = Path(__file__).parents[1] / "docs/figures/dam_break_plane.toml"
    dam = load_scene(path)
    whole = certify(problem_of(dam, 6, lambda simulation: losses.FinalPositions(simulation.positions)))
    for subject in (path, str(path), dam, Simulation(dam)):
        assert certify(subject, steps=6).as_dict() == whole.as_dict()
    with pytest.raises(InputError, match=r"^steps is left out, but must be given, as a \w+ has no number of"):
        certify(dam)


def test_without_steps_nothing_is_claimed():
    found = certify(problem_of(plane(), 0, lambda simulation: losses.FinalPositions(0.9 * simulation.positions)))
    assert found.right and found.alignment is None and found.consistency.sample_steps.tolist() == [0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"parameters": ["gravitas"]}, "parameter 'gravitas' is unknown, but must be one of gravity, "),
        ({"parameters": []}, "parameters is empty, but must have at least one of gravity, "),
        ({"parameters": {"gravity": [1.0, 2.0, 3.0]}}, r"parameter gravity has shape \(3,\), but must be"),
        ({"steps": 4}, "steps is 4, but must be left out, as the problem has 3 steps."),
        ({"perturbation": 0.0}, "perturbation is 0.0, but must be greater than 0 and less than 1."),
    ],
)
def test_wrong_arguments_are_sentences(arguments, words):
    with pytest.raises(InputError, match=words):
        certify(problem_of(plane(), 3), **arguments)


def test_water_that_falls_is_found_right():
    """As a whole it is on the corner of the projection's clamp, whose rounding is narrower than the differences."""
    falling = plane(solver={"kind": "projection", "time_step": 0.002}, discretisation={"spacing": 0.05, "jitter": 0.1})
    assert certify(Simulation(falling, precision="float64"), steps=60).right
    moving = certify(problem_of(plane(), 10))
    assert moving.right and moving.consistency.corner[-1] < 1e-4 and "corner" not in str(moving)


def resists_approach(x_ij, v_ij, k):
    """An own force, as of an artificial viscosity: fluid at rest is on the corner of each pair."""
    return -k * wp.min(wp.dot(v_ij, x_ij), 0.0) * x_ij


def corners(seed):
    force = cortado.forces.Pair(resists_approach, name="own", k=2e4)
    simulation = Simulation(plane(), precision="float64", forces=[force])
    goal = simulation.positions + [0.02, 0.0]
    return certify(Problem(simulation, 16, losses.FinalPositions(goal)), {"own.k": 2e4}, seed=seed)


ON_ITS_CORNERS = 8
"""A seed with which the slopes to both sides are nearer to each other than to the derivative."""


def test_a_corner_of_an_own_force_is_no_error():
    found = corners(ON_ITS_CORNERS)
    assert found.right and not found.consistency.right and found.beside.right
    assert "on a corner of the loss" in str(found) and "beside it" in str(found)
    assert found.as_dict()["beside"]["steps"]


@pytest.mark.parametrize("in_both_modes", [False, True])
def test_a_sign_flipped_is_found_on_a_corner(in_both_modes, monkeypatch):
    back, tangent = ProblemForwardPass.back, LossHistory.tangent

    def flipped(values):
        return {name: -value if name == "viscosity" else value for name, value in values.items()}

    monkeypatch.setattr(ProblemForwardPass, "back", lambda *arguments: flipped(back(*arguments)))
    if in_both_modes:
        monkeypatch.setattr(LossHistory, "tangent", lambda self, at, along: tangent(self, at, flipped(along)))
    found = corners(ON_ITS_CORNERS)
    assert "viscosity" in found.wrong and found.beside is None


# ---- verdicts ----------------------------------------------------------------------------------------------------
def comparison(adjoint=1.0, tangents=(0.5, 1.0), differences=((0.5, 1.0),) * 3, loss=1.0, sides=0.0):
    return Consistency(
        sample_steps=np.array([1, 2]),
        losses=np.array([0.5 * loss, loss]),
        adjoint=adjoint,
        size=1e-3 * abs(tangents[-1]),
        tangents=np.array(tangents),
        differences=np.array(differences),
        sides=np.full((len(differences), 2), sides),
        steps=np.array([1e-2, 1e-3, 1e-4])[: len(differences)],
    )


OFF = ((0.5, 2.0), (0.5, -1.0), (0.5, 0.3))
"""Differences that agree with nothing."""
JUDGED = [
    (True, {}),
    (True, {"adjoint": 1.0 + 1e-10}),
    (True, {"tangents": (0.5, 7.0), "adjoint": 7.0, "differences": OFF}),
    (True, {"adjoint": 1e-16, "tangents": (0.0, -1e-16), "differences": ((0.0, 3e-13), (0.0, 2e-12), (0.0, 1e-11))}),
    (True, {"differences": ((0.5, 1.1), (0.5, 1.001), (0.5, 1.0001))}),
    (True, {"differences": ((0.5, 1.0001), (0.5, 1.0001), (0.5, 1.0))}),  # beside a kink
    (True, {"differences": ((0.5, 1.01),) * 3, "sides": 0.02}),  # on it
    (False, {"differences": ((0.5, 1.01),) * 3, "sides": 0.005}),
    *((False, {"adjoint": adjoint}) for adjoint in (np.nan, -1.0, 0.0, 1.0 + 1e-6)),
    (False, {"adjoint": 1.00001, "tangents": (0.5, 1.00001)}),
    (False, {"differences": ((0.5, 1.0001), (0.5, 1.0001), (0.5, 1.0002))}),
    (False, {"tangents": (0.6, 7.0), "adjoint": 7.0, "differences": OFF}),
    (False, {"tangents": (0.5, np.nan)}),
]


@pytest.mark.parametrize(("right", "found"), JUDGED)
def test_what_is_right_and_what_is_wrong(right, found):
    assert comparison(**found).right == right


def horizon(exact, difference, strain=(0.1, 0.2, 0.4)):
    exact, difference, strain = map(np.array, (exact, difference, strain))
    return Horizon("gravity", np.array([10, 20, 30]), exact, difference, strain)


def test_the_measured_and_the_predicted_horizon():
    ways = {30: (1.0, 2.1, 3.0), 20: (1.0, 2.0, 9.0), 10: (1.0, 9.0, 3.0), 0: (9.0, 9.0, 3.0)}
    for step, exact in (*ways.items(), (20, (1.0, 2.0, np.nan))):
        found = horizon(exact, (1.0, 2.0, 3.0))
        assert found.measured == step and found.lasts == (step == 30)
    same = (1.0, 1.0, 1.0)
    assert horizon(same, same).predicted == 30
    assert horizon(same, same, strain=(0.1, 0.1, 0.2)).predicted is None


def test_the_advice():
    far = horizon((1.0, 9.0, 9.0), (1.0, 1.0, 1.0))
    found = replace(long(), horizons=(far,))
    judged = [Judged("Exact()", 0.99, 9.0), Judged("AdjointViscosity()", 0.8, 1.0)]
    advised = ((0.9, 1.0, "EnsembleMean(spread)"), (0.9, 3.0, "AdjointViscosity()"), (0.7, 1.0, "AdjointViscosity()"))
    for cosine, size, wanted in advised:
        both = (*judged, Judged("EnsembleMean(spread)", cosine, size))
        assert replace(found, alignment=Alignment(0.1, both)).estimator == wanted
    lost = (judged[0], Judged("AdjointViscosity()", 0.1, 1.0), Judged("EnsembleMean(spread)", 0.2, 1.0))
    assert replace(found, alignment=Alignment(0.1, lost)).estimator == "RandomizedSmoothing()"
    assert replace(found, alignment=None).estimator == "AdjointViscosity()"


def losing(monkeypatch, step, is_copy):
    """Runs of copies lose a particle in a step."""
    ends = Problem._ends

    def lost(self, values, *arguments, **options):
        if self.simulation.batch is None and self.steps >= step and is_copy(self, values):
            raise DivergedError(step, 3, "try a smaller time step", "left the container")
        return ends(self, values, *arguments, **options)

    monkeypatch.setattr(Problem, "_ends", lost)


def test_beyond_the_step_in_which_a_moved_copy_loses_a_particle_there_is_no_answer(monkeypatch, tmp_path):
    """But before it there is the same one."""
    whole = certify(problem_of(plane(), 16), ["gravity"])
    losing(monkeypatch, 11, lambda _, values: np.abs(np.ravel(values["gravity"])[1] + 9.81) > 0.1)
    found = certify(problem_of(plane(), 16), ["gravity"])
    (horizon,), (wanted,) = found.horizons, whole.horizons
    assert found.right and found.horizon == 10 and found.consistency.last_converged == 16
    seen = horizon.sample_steps <= 10
    np.testing.assert_array_equal(horizon.difference[seen], wanted.difference[seen])
    assert seen.sum() > 5 and np.isnan(horizon.difference[~seen]).all()
    sentence = "Beyond step 10 nothing is known about gravity: a run with a changed gravity loses"
    assert sentence in str(found) and "Up to step 10 of 16" in str(found) and found.estimator != "Exact()"
    json.dumps(found.as_dict(), allow_nan=False)
    assert gradient_check(found, tmp_path / "certificate.png").stat().st_size


@pytest.mark.parametrize("step", [1, 8])
def test_copies_that_are_moved_little_lose_a_particle_too(step, monkeypatch):
    losing(monkeypatch, step, lambda _, values: "time_step" in values and values["time_step"] != 0.0021)
    found = certify(problem_of(plane(), 12))
    assert found.right and found.consistency.last_converged == (7 if step > 1 else None)
    assert "7" in str(found) if step > 1 else "no difference is reliable here" in str(found)


@pytest.mark.parametrize(("step", "reached"), [(1, 0), (9, 8)])
def test_beside_a_corner_a_copy_may_lose_a_particle(step, reached, monkeypatch):
    losing(monkeypatch, step, lambda _, values: np.abs(values.get("initial_velocities", 0.0)).max() > 1e-3)
    found = corners(ON_ITS_CORNERS)
    assert found.right and not found.consistency.right
    assert f"Beside the corner, nothing is checked beyond step {reached}: the changed run loses a particle." in str(
        found
    )
    assert (found.beside is None) == (reached == 0) and (not reached or found.beside.last_converged == 8)


def test_the_copy_in_float64_may_lose_a_particle(monkeypatch):
    simulation = Simulation(plane())
    problem = Problem(simulation, 12, losses.FinalPositions(simulation.positions))
    losing(monkeypatch, 9, lambda one, values: one.simulation.precision.name == "float64")
    found = certify(problem)
    assert found.right and found.steps == 8 and found.horizon == 8
    assert "Nothing is checked beyond step 8: certificates use float64, in which the run loses" in str(found)
    losing(monkeypatch, 3, lambda *_: True)
    with pytest.raises(DivergedError, match="diverged in step 3"):
        certify(problem)


def test_growth_is_in_e_folds():
    steps, dt = 100, 0.01
    back = steps - np.arange(steps + 1)
    assert growth(np.stack([np.exp(0.05 * back), 0 * back], axis=1), dt) == pytest.approx(5.0)
    flight = np.stack([np.ones(steps + 1), back * dt], axis=1)
    assert 0.0 < growth(flight, dt) < 0.5
    assert growth(np.zeros((steps + 1, 2)), dt) == 0.0
    assert growth(np.full((steps + 1, 2), np.inf), dt) == np.inf


def test_wrong_signs_of_two_parameters_do_not_cancel():
    right = {"x": np.array(3.0), "y": np.array(-0.5), "z": np.array(7.0)}
    along = balanced(right, {name: np.array(1.0) for name in right})
    changes = {name: float(right[name] * along[name]) for name in right}
    assert all(0.5 <= abs(change) <= 1.0 for change in changes.values())
    for one, other in itertools.combinations(right, 2):
        assert abs(changes[one] + changes[other]) > 0.1 * abs(changes[one])
