"""What a scene's schedule changes: a run with it is one with a row for each step, and so are its derivatives."""

import warnings

import numpy as np
import pytest

from bad_scenes import one_sentence
from cortado import CortadoWarning, InputError, Problem, SceneError, Simulation, losses, reference
from cortado.cli.run_report import Energy, RunSummary
from cortado.scene.motions import Course
from cortado.scene.parameter_values import Tilt
from finite_differences import both_modes, central_difference
from scenes import jet, plane, scene, stability_limit

STEPS, DT = 12, 0.004
SWAY = {"times": [0.003, 0.02, 0.03], "values": [[0.0, -9.81], [6.0, -5.0], [-3.0, -12.0]]}
LEAN = {"times": [0.0, 0.02, 0.03], "values": [[0.0], [40.0], [-20.0]]}


def nozzle(made, **changes):
    outlet = np.array(made.emitter[0].outlet)
    values = [outlet, outlet + [0.03, 0.0], outlet - [0.02, 0.0]]
    return {"times": [0.005, 0.02, 0.04], "values": [row.tolist() for row in values], **changes}


def jetting(**schedule):
    made = jet()
    return jet(path=nozzle(made), schedule=schedule)


def test_a_course_is_linear_between_its_times_and_constant_beyond():
    course = Course(**SWAY).knots
    np.testing.assert_allclose(course.at(np.array([0.0, 0.003, 0.0115, 0.02, 0.025, 9.0])), [
        [0.0, -9.81], [0.0, -9.81], [3.0, -7.405], [6.0, -5.0], [1.5, -8.5], [-3.0, -12.0]
    ])  # fmt: skip
    times = np.array([0.001, 0.01, 0.024, 0.5])
    slope = (course.at(times + 1e-7) - course.at(times - 1e-7)) / 2e-7
    np.testing.assert_allclose(course.rates(times), slope, atol=1e-6)
    np.testing.assert_array_equal(Course(times=[1.0], values=[[2.0]]).knots.rates(times), np.zeros((4, 1)))


@pytest.mark.parametrize(
    ("schedule", "words"),
    [
        ({"gravity": {**SWAY, "times": [0.0, 0.2]}}, "schedule.gravity.values is a list of 3, but must be a list of 2"),
        ({"gravity": {**SWAY, "times": [0.0, 0.2, 0.2]}}, "schedule.gravity.times[2] is 0.2, but must be greater than"),
        ({"gravity": {**SWAY, "times": [-1.0, 0.2, 0.3]}}, "gravity.times[0] is -1.0, but must be at least 0 s"),
        ({"gravity": {"times": [0.0], "values": [[0.0, 1.0, 2.0]]}}, "schedule.gravity.values[0] is [0.0, 1.0, 2.0]"),
        ({"gravity": {"times": [0.0], "values": [[0.0, np.nan]]}}, "schedule.gravity.values[0][1] is nan"),
        ({"gravity": SWAY, "tilt": LEAN}, "schedule.gravity is given, but must be left out, as the tilt says"),
        ({"tilt": {"times": [0.0], "values": [[0.0, 1.0]]}}, "schedule.tilt.values[0] is [0.0, 1.0]"),
        ({"gravty": SWAY}, "schedule.gravty is not a key of [schedule]; did you mean gravity?"),
    ],
)
def test_what_is_wrong_is_a_sentence(schedule, words):
    with one_sentence(error=SceneError) as error:
        plane(schedule=schedule)
    assert words in str(error.value)


def test_a_nozzle_begins_at_its_outlet_and_stays_inside_and_a_tilt_needs_a_gravity():
    made = jet()
    first, *others = nozzle(made)["values"]
    for values, words in [
        ([[0.0, 0.0], *others], r"path\.values\[0\] is .* but must be emitter\[0\]\.outlet"),
        ([first, [9.0, 9.0], first], r"path\.values\[1\] is \[9\.0, 9\.0\], but must be where all of the ope"),
    ]:
        with pytest.raises(SceneError, match=words):
            jet(path=nozzle(made, values=values))
    with pytest.raises(SceneError, match=r"schedule\.tilt is given, but must be left out, as the scene has no gravity"):
        plane(forces={"gravity": [0.0, 0.0]}, schedule={"tilt": LEAN})


def test_the_limit_of_stability_is_that_of_the_strongest_gravity():
    strong = {"gravity": {"times": [0.0, 1.0], "values": [[0.0, -9.81], [0.0, -9.81e4]]}}
    with pytest.warns(CortadoWarning, match="limit of stability"):
        made = plane(schedule=strong)
    assert stability_limit(made) == pytest.approx(stability_limit(plane()) * 0.01, rel=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(made).rollout(2, {"gravity": [0.0, -9.81]})  # in its place


def rows(table, moment, steps=STEPS, time_step=None):
    made = plane()
    return Course(**table).knots.at((np.arange(steps) + moment) * (time_step or made.solver.time_step))


def assert_same_run(one, other):
    assert one.positions.tobytes() == other.positions.tobytes()
    assert one.velocities.tobytes() == other.velocities.tobytes()


def test_a_scheduled_gravity_is_a_row_for_each_step():
    simulation, constant = Simulation(plane(schedule={"gravity": SWAY})), Simulation(plane())
    scheduled = simulation.run(STEPS)
    assert_same_run(scheduled, constant.run(STEPS, {"gravity": rows(SWAY, 0.5)}))
    assert np.abs(scheduled.positions - constant.run(STEPS).positions).max() > 1e-4
    given = {"gravity": [0.0, -9.81]}
    assert_same_run(simulation.run(STEPS, given), constant.run(STEPS, given))
    other = {"time_step": 0.5 * plane().solver.time_step}
    table = rows(SWAY, 0.5, time_step=other["time_step"])
    assert_same_run(simulation.run(STEPS, other), constant.run(STEPS, {**other, "gravity": table}))


def test_a_scheduled_tilt_is_gravity_that_leans():
    made = plane(schedule={"tilt": LEAN})
    gravity = Tilt(made.forces.gravity).gravity(rows(LEAN, 0.5))
    simulation, constant = Simulation(made), Simulation(plane())
    assert_same_run(simulation.run(STEPS), constant.run(STEPS, {"gravity": gravity}))
    for given in ({"tilt": [10.0]}, {"gravity": [1.0, -9.0]}):
        assert_same_run(simulation.run(STEPS, given), constant.run(STEPS, given))


def test_in_free_fall_fluid_gains_what_gravity_gives():
    """The gravity of a step is that of its middle, its mean where it is linear: what is gained is the integral."""
    times = [0.0, 2 * DT, 6 * DT]
    table = {"times": times, "values": [[0.0, -9.81], [8.0, 0.0], [0.0, 4.0]]}
    free = {"container": {"shape": "none"}, "forces": {"viscosity": "none", "pressure": False}}
    made = plane(**free, solver={"time_step": DT}, schedule={"gravity": table})
    gained = np.diff(Simulation(made, precision="float64").run(6).velocities[[0, -1]], axis=0)[0]
    integral = np.trapezoid(table["values"], times, axis=0)
    np.testing.assert_allclose(gained, np.broadcast_to(integral, gained.shape), rtol=1e-12, atol=1e-14)


def test_a_nozzle_is_where_its_path_is_at_the_end_of_each_step():
    made = jetting()
    trajectory = Simulation(made, precision="float64").run(STEPS)
    wanted = Course(**nozzle(made)).knots.at(trajectory.times)
    np.testing.assert_allclose(trajectory.others["nozzle.outlet"][:, 0], wanted, rtol=1e-12)
    assert np.ptp(wanted, axis=0).max() > 0.02


def test_a_restart_goes_on_with_the_schedule():
    simulation = Simulation(jetting(gravity=SWAY))
    whole = simulation.run(STEPS)
    rest = simulation.run(STEPS - 5, state=simulation.run(5).last_state)
    assert rest.positions.tobytes() == whole.positions[5:].tobytes()
    assert rest.others["nozzle.outlet"].tobytes() == whole.others["nozzle.outlet"][5:].tobytes()


def test_scenes_of_a_batch_go_on_each_at_its_own_time():
    made = plane(schedule={"gravity": SWAY})
    one, batch = Simulation(made), Simulation(made, batch=2)
    whole, states = one.run(STEPS), [one.run(3).last_state, one.run(6).last_state]
    for found, start in zip(batch.run(4, state=states), (3, 6), strict=True):
        assert found.positions.tobytes() == whole.positions[start : start + 5].tobytes()


@pytest.mark.parametrize("last, turned", [(-9.81, False), (-5.0, True)])
def test_a_run_says_whether_gravity_changed(last, turned):
    course = {"times": [0.0, 0.01], "values": [[0.0, -9.81], [0.0, last]]}
    simulation = Simulation(plane(schedule={"gravity": course}))
    rollout = simulation.rollout(steps=10)
    summary = RunSummary(simulation, rollout, rollout.forward(), 1.0, {})
    assert ("in the gravity of that time" in str(summary)) is turned


def test_energies_are_in_the_gravity_of_their_time():
    simulation = Simulation(plane(schedule={"gravity": {"times": [0.01, 0.02], "values": [[0.0, -9.81], [0.0, 0.0]]}}))
    rollout = simulation.rollout(STEPS)
    assert Energy.of(simulation, rollout, rollout.initial, 0).potential > 0.0
    assert Energy.of(simulation, rollout, rollout.initial, STEPS - 1).potential == 0.0


def problem_of(made, batch=None):
    simulation = Simulation(made, precision="float64", batch=batch)
    return Problem(simulation, STEPS, losses.FinalPositions(simulation.positions))


SCHEDULES = {
    "gravity": lambda: plane(schedule={"gravity": SWAY}),
    "tilt": lambda: plane(schedule={"tilt": LEAN}),
    "nozzle": lambda: jetting(gravity=SWAY),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_the_time_step_moves_the_schedule(name):
    """A longer step meets another gravity: reverse mode, forward mode and differences have it in them."""
    problem, along = problem_of(SCHEDULES[name]()), {"time_step": np.array(1.0)}
    at = {"time_step": np.array(0.97 * problem.simulation.scene.solver.time_step)}
    _, tangent = both_modes(problem, at, along, 1e-9)
    assert tangent == pytest.approx(central_difference(problem.value, at, along, 1e-8), rel=1e-5)
    fixed = {**problem_rows(problem, at), **at}
    assert abs(problem.tangent(fixed, along) / tangent - 1.0) > 1e-3


def problem_rows(problem, at):
    return problem._space._one.scheduled(problem._space.checked(at))


def test_each_scene_of_a_batch_has_the_schedule_at_its_time_step():
    made = plane(schedule={"gravity": SWAY})
    one, batch = problem_of(made), problem_of(made, batch=2)
    time_steps = np.array([0.9, 1.0]) * made.solver.time_step
    values, gradients = batch.value_and_gradient({"time_step": time_steps})
    for b, time_step in enumerate(time_steps):
        value, gradient = one.value_and_gradient({"time_step": time_step})
        assert (value, gradient["time_step"]) == (values[b], gradients["time_step"][b])


def test_a_tilt_of_a_scheduled_gravity_has_no_direction():
    problem = problem_of(plane(schedule={"gravity": SWAY}))
    with pytest.raises(InputError, match="direction tilt is given, but must be left out, as the scene's schedule"):
        problem.tangent({}, {"tilt": [1.0]})
    assert np.isfinite(problem.tangent({"tilt": [3.0]}, {"tilt": [1.0]}))


def test_the_reference_engine_refuses_them():
    with pytest.raises(InputError, match="scene has a schedule, but must leave it out for the reference engine"):
        reference.Simulation(scene(schedule={"gravity": {"times": [0.0], "values": [[0.0, -9.0, 0.0]]}}))
