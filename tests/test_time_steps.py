"""Time steps that are chosen before each step, recorded, and taken again as they were."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import cortado
from cortado import InputError, SceneError, Simulation, Trajectory
from cortado.rollout.step_sizes import Retaken
from cortado.scene.restart import Clock
from cortado.scene.solid_shapes import PolygonSolid
from cortado.scene.stability import chosen_limits, is_implicit, stability_limits, viscous_limit
from cortado.sensors import PressureProbe
from scenes import box, jet, plane, pool, pool_text, two_layers

EXAMPLES = Path(__file__).parents[1] / "examples"
STEPS = 24
CHOSEN = {"time_step": "auto"}
SOLVERS = {"pcisph": {}, "projection": {"kind": "projection"}}
each_solver = pytest.mark.parametrize(("kind", "precision"), [("pcisph", "float32"), ("projection", "float64")])
COURSES = {
    "gravity": (plane, {"times": [0.0, 0.1], "values": [[0.0, -9.81], [4.0, -9.0]]}),
    "tilt": (plane, {"times": [0.0, 0.1], "values": [[0.0], [15.0]]}),
    "nozzle.path": (jet, {"times": [0.0, 0.1], "values": [[0.3, 0.26], [0.33, 0.26]]}),
}


def changing(name, **changes):
    maker, course = COURSES[name]
    return maker(**({"path": course} if maker is jet else {"schedule": {name: course}}), **changes)


def drop(solver, **changes):
    """A block in the plane, off the lattice's axes, that falls and moves sideways."""
    block = {"shape": "box", "lower": [0.1, 0.1], "upper": [0.5, 0.5], "velocity": [0.4, -0.3], "phase": "water"}
    return plane(fluid=[block], solver=solver, **changes)


def chosen_and_fixed(kind="pcisph", precision="float64"):
    """A scene that chooses its steps, and the same with steps that are given."""
    own = SOLVERS[kind]
    return (Simulation(drop({**own, **step}), precision=precision) for step in (CHOSEN, {"time_step": 0.001}))


def sizes_of(run):
    return run.diagnostics["time_steps"]


# ---- the choice --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", SOLVERS)
def test_steps_are_as_long_as_the_speed_lets_them(kind):
    scene = plane(solver={**SOLVERS[kind], **CHOSEN, "courant": 0.15})
    run = Simulation(scene, precision="float64").run(80)
    sizes, bound = sizes_of(run), min(chosen_limits(scene).values())
    speeds = np.linalg.norm(run.velocities, axis=2).max(axis=1)[:-1]
    length = 0.15 * 0.5 * scene.discretisation.support_radius
    with np.errstate(divide="ignore"):
        wanted = np.minimum(bound, length / speeds)
    wanted[1:] = np.minimum(wanted[1:], 1.1 * sizes[:-1])
    np.testing.assert_allclose(sizes, wanted, rtol=1e-12)
    assert sizes[0] == bound and sizes.min() < 0.5 * bound  # at rest, and where it is fast
    np.testing.assert_array_equal(run.times, np.concatenate([[0.0], np.cumsum(sizes)]))
    short = replace(run[:1].last_state, clock=Clock(time_step=1e-4))
    grown = sizes_of(Simulation(scene, precision="float64").run(3, state=short))
    np.testing.assert_allclose(grown, 1e-4 * 1.1 ** np.arange(1, 4), rtol=1e-12)


def test_a_fall_that_no_fixed_step_of_its_first_size_survives():
    with pytest.warns(cortado.CortadoWarning, match="limit of stability"):
        fixed = plane(solver={"time_step": min(chosen_limits(plane(solver=CHOSEN)).values())})
    with pytest.raises(cortado.DivergedError):
        Simulation(fixed).run(60)
    run = Simulation(plane(solver=CHOSEN)).run(time=1.0)
    assert run.times[-2] < 1.0 <= run.times[-1] and run.not_converged == 0
    assert np.isfinite(run.positions).all() and np.ptp(run.positions[-1][:, 0]) > 0.6  # it lies on the floor


def test_honey_is_bounded_by_its_viscosity():
    made = plane(solver=CHOSEN, phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 400.0}])
    thick = made.replaced('forces.viscosity="pairwise"')
    limit = viscous_limit(thick, {})
    simulation = Simulation(thick, precision="float64")
    np.testing.assert_array_equal(sizes_of(simulation.run(5)), np.full(5, limit))
    np.testing.assert_allclose(sizes_of(simulation.run(5, {"viscosity": 800.0})), 0.5 * limit, rtol=1e-12)
    assert is_implicit(made) and not is_implicit(made.replaced("phase.water.viscosity=0.05"))
    assert sizes_of(Simulation(made).run(2))[0] > 5.0 * limit  # at the end of a step it bears any


def test_each_row_of_a_gravity_bounds_its_own_step():
    simulation = Simulation(drop({**CHOSEN, "greatest_time_step": 0.004}), precision="float64")
    gravity = np.array([[0.0, -9.81], [0.0, -9000.0], [0.0, 0.0]])
    first, second, third = sizes_of(simulation.run(3, {"gravity": gravity}))
    assert first == 0.004 and second < 0.001 and second < third <= 1.1 * second
    assert sizes_of(simulation.run(2, {"gravity": [0.0, 0.0]}))[0] == 0.004


@pytest.mark.parametrize("rest", [[0.0, -9.81], [0.0, 0.0]])
def test_a_scheduled_gravity_bounds_the_steps_that_it_acts_in(rest):
    """A knock of 5 ms leaves the steps before it as they are, but for the last, which ends at it."""
    knock = {"times": [0.0, 0.1, 0.1001, 0.105, 0.1051], "values": [rest, rest, [0.0, -900.0], [0.0, -900.0], rest]}
    forces = {"gravity": rest, "viscosity": "none"}
    still, knocked = (
        plane(solver={**CHOSEN, "greatest_time_step": 0.008}, forces=forces, schedule=schedule)
        for schedule in ({}, {"gravity": knock})
    )
    plain, run = (Simulation(one, precision="float64").run(time=0.12) for one in (still, knocked))
    before, sizes = np.flatnonzero(run.times <= 0.1)[-1], sizes_of(run)
    assert plain.positions[:before].tobytes() == run.positions[:before].tobytes()
    strong = plane(solver=CHOSEN, forces={"gravity": [0.0, -900.0]})
    bound = min(min(chosen_limits(strong).values()), 0.008)
    during = (run.times[1:] > 0.1001 + 1e-9) & (run.times[:-1] < 0.105 - 1e-9)
    assert during.any() and sizes[during].max() <= bound < 0.3 * sizes[:before].max()
    assert run.times[before] >= 0.1 - 0.008 and (sizes > 0.0).all()


def test_a_scheduled_tilt_bounds_each_step_by_the_depth_that_it_makes():
    column = [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.1, 0.6], "phase": "water"}]
    made = {"solver": CHOSEN, "fluid": column}
    lying = {"times": [0.0, 0.05, 0.06], "values": [[90.0], [90.0], [0.0]]}
    upright, along = (plane(**made, forces={"gravity": g}) for g in ([0.0, -9.81], [9.81, 0.0]))
    sizes = sizes_of(Simulation(plane(**made, schedule={"tilt": lying}), precision="float64").run(2))
    found, least = (min(chosen_limits(one).values()) for one in (along, upright))
    assert sizes[0] == pytest.approx(found) and found > 1.2 * least


# ---- the same bits -----------------------------------------------------------------------------------------------
@each_solver
def test_fixed_steps_of_the_same_lengths_have_the_same_bits(kind, precision):
    chosen, fixed = chosen_and_fixed(kind, precision)
    run, state = chosen.run(STEPS), fixed.state()
    for k, size in enumerate(sizes_of(run)):
        state = fixed.step(state, {"time_step": size})
        assert state["positions"].tobytes() == run.positions[k + 1].tobytes()


@each_solver
def test_a_run_that_goes_on_has_the_bits_of_one_that_did_not_stop(kind, precision, tmp_path):
    simulation, _ = chosen_and_fixed(kind, precision)
    whole, first = simulation.run(40), simulation.run(20, record_every=3)
    first.save(tmp_path / "first.vtkhdf")
    stepped = simulation.step(simulation.step(simulation.state(), steps=13), steps=7)
    device = simulation.on_host(simulation.step(simulation.on_device(), steps=20))
    loaded = Trajectory.load(tmp_path / "first.vtkhdf")
    for state in (first.last_state, loaded.last_state, loaded[2:].last_state, whole[3:21].last_state, stepped, device):
        assert (state.clock.time, state.clock.time_step) == (whole.times[20], sizes_of(whole)[19])
        rest = simulation.run(20, state=state)
        for read in (lambda run: run.positions, lambda run: run.times, sizes_of):
            assert read(rest).tobytes() == read(whole)[20:].tobytes()
        middle = rest[3:11].last_state
        assert (middle.clock.steps, middle.clock.time_step) == (30, sizes_of(whole)[29])
        on_device = simulation.step(simulation.on_device(middle), steps=10)
        assert simulation.on_host(on_device)["positions"].tobytes() == whole.positions[40].tobytes()


@pytest.mark.parametrize("made", ["plane", "layers", "jet", *COURSES])
def test_a_scene_of_a_batch_has_the_bits_of_its_single_run(made):
    makers = {"plane": drop, "layers": two_layers, "jet": jet}
    scene = makers[made](solver=CHOSEN) if made in makers else changing(made, solver=CHOSEN)
    values = np.outer([0.05, 0.1], np.ones(len(scene.phase))).squeeze()
    single = Simulation(scene)
    for value, found in zip(values, Simulation(scene, batch=2).run(STEPS, {"viscosity": values}), strict=True):
        own = {"viscosity": value}
        wanted = single.run(STEPS, own)
        for read in (lambda run: run.positions, lambda run: run.times, sizes_of):
            assert read(found).tobytes() == read(wanted).tobytes()
        rest = single.run(STEPS - 9, own, state=wanted[:10].last_state)
        assert rest.positions.tobytes() == wanted.positions[9:].tobytes()


@pytest.mark.parametrize("name", COURSES)
def test_a_schedule_is_read_at_the_true_times(name):
    scene, maker = changing(name, solver=CHOSEN), COURSES[name][0]
    course = scene.emitter[0].path.knots if scene.emitter else scene.schedule.courses[name]
    run = Simulation(scene, precision="float64").run(STEPS)
    fixed = Simulation(maker(solver={"kind": "pcisph", "time_step": 0.001}), precision="float64")
    state = fixed.state()
    for time, size in zip(run.times, sizes_of(run), strict=False):
        at = time + (1.0 if name == "nozzle.path" else 0.5) * size
        state = fixed.step(state, {name: course.at(np.array([at]))[0], "time_step": size})
    assert state["positions"].tobytes() == run.positions[-1].tobytes()


def test_a_lost_scene_leaves_the_others_as_they_are():
    batch, single = (Simulation(drop({**CHOSEN, "courant": 0.4}), batch=size) for size in (2, None))
    velocities = np.stack([np.full_like(single.velocities, 30.0), single.velocities])
    with pytest.warns(cortado.CortadoWarning, match="1 of 2 scenes of the batch were lost"):
        found = batch.run(STEPS, {"initial_velocities": velocities})
    assert list(found.lost) == [1] and len(sizes_of(found[1])) == STEPS
    wanted = single.run(STEPS, {"initial_velocities": velocities[0]})
    assert found[0].positions.tobytes() == wanted.positions.tobytes()
    with pytest.raises(cortado.DivergedError, match=r"try a smaller solver\.courant"):
        single.run(STEPS)


def test_quantities_and_sensors_are_of_the_step_that_follows():
    simulation, fixed = chosen_and_fixed()
    probe = {"probe": PressureProbe([0.3, 0.05])}
    run = simulation.run(STEPS, record=["pressure"], sensors=probe)
    assert run.sensors["probe"].times.tobytes() == run.times.tobytes()
    for k in (0, 5, STEPS - 1):
        state = run[: k + 1].last_state
        wanted = simulation.quantity("pressure", state)
        assert run.quantity("pressure")[k].tobytes() == wanted.tobytes()
        held = replace(state, clock=replace(state.clock, time_step=0.0))
        assert wanted.tobytes() == fixed.quantity("pressure", held, {"time_step": sizes_of(run)[k]}).tobytes()


# ---- derivatives -------------------------------------------------------------------------------------------------
class Spread:
    """A loss of last positions and velocities."""

    def value(self, end):
        return float((end.positions**2).mean() + 0.1 * (end.velocities**2).mean())

    def adjoint(self, end):
        return 2.0 * end.positions / end.positions.size, 0.2 * end.velocities / end.velocities.size


def parameters_of(simulation, scheduled):
    rng = np.random.default_rng(3)
    values = {"viscosity": 0.05, "initial_velocities": simulation.velocities + 0.0}
    along = {"viscosity": 0.03, "initial_velocities": 0.3 * rng.normal(size=simulation.velocities.shape)}
    if not scheduled:
        values["gravity"], along["gravity"] = np.array([0.2, -9.81]), np.array([0.5, 0.3])
    return values, along


@pytest.mark.parametrize("scheduled", [False, True])
def test_the_gradient_is_the_limit_of_differences_with_the_steps_held(scheduled):
    course = {"schedule": {"gravity": COURSES["gravity"][1]}} if scheduled else {}
    iterations = {"minimum_iterations": 5, "maximum_iterations": 5}
    chosen, fixed = (
        Simulation(drop({**iterations, **step}, **course), precision="float64")
        for step in (CHOSEN, {"time_step": 0.001})
    )
    values, along = parameters_of(chosen, scheduled)
    problem = cortado.Problem(chosen, STEPS, Spread())
    loss, gradient = problem.value_and_gradient(values)
    sizes = problem.diagnostics["time_steps"]
    times = np.concatenate([[0.0], np.cumsum(sizes)])

    def held(by):
        moved = {name: value + by * along[name] for name, value in values.items()}
        state = fixed.state({"initial_velocities": moved.pop("initial_velocities")})
        for size, time in zip(sizes, times, strict=False):
            middle = np.array([time + 0.5 * size])
            course = {"gravity": chosen.scene.schedule.courses["gravity"].at(middle)[0]} if scheduled else {}
            state = fixed.step(state, {**moved, **course, "time_step": size})
        return Spread().value(SimpleNamespace(**{name: state[name] for name in ("positions", "velocities")}))

    assert held(0.0) == loss
    reverse = sum(float((gradient[name] * along[name]).sum()) for name in along)
    assert abs((held(1e-6) - held(-1e-6)) / 2e-6 - reverse) < 1e-6 * abs(reverse)
    assert abs(problem.tangent(values, along) - reverse) < 1e-10 * abs(reverse)


@each_solver
def test_a_backward_pass_goes_through_the_recorded_steps(kind, precision):
    """It has the bits of one through fixed steps of these lengths, whatever is kept and what comes in between."""
    chosen, fixed = chosen_and_fixed(kind, precision)
    stepper, states, residuals = chosen.stepper(8), [chosen.state()], []
    for _ in range(3):
        state, residual = stepper.step(states[-1], {"viscosity": 0.07})
        states.append(state)
        residuals.append(residual)
    sizes = sizes_of(chosen.run(STEPS, {"viscosity": 0.07}))
    up = bar = {"positions": np.random.default_rng(0).normal(size=states[0]["positions"].shape)}
    for residual in reversed(residuals):
        bar, _ = stepper.vjp(residual, bar)
    begun, state = [], fixed.state()
    for size in sizes:
        begun.append(state)
        state = fixed.step(state, {"viscosity": 0.07, "time_step": size})
    held = up
    for state, size in zip(reversed(begun), reversed(sizes), strict=True):
        held, _ = fixed.vjp(state, {"viscosity": 0.07, "time_step": size}, held)
    assert np.abs(held["velocities"]).max() > 0.0
    assert held["velocities"].tobytes() == bar["velocities"].tobytes()
    first = {"viscosity": 0.07, "initial_velocities": chosen.velocities}
    kept, again = (
        cortado.Problem(chosen, STEPS, Spread(), memory_budget=budget).value_and_gradient(first)[1]
        for budget in (2**30, 0)
    )
    assert kept["initial_velocities"].tobytes() == again["initial_velocities"].tobytes()
    velocities = np.random.default_rng(1).normal(size=up["positions"].shape)
    end = stepper.jvp(residuals[0], {"velocities": velocities})
    before, _ = stepper.vjp(residuals[0], up)
    forward, reverse = (end["positions"] * up["positions"]).sum(), (before["velocities"] * velocities).sum()
    assert abs(forward - reverse) < {"float32": 1e-4, "float64": 1e-10}[precision] * abs(reverse)


def test_warps_tape_goes_through_the_recorded_steps():
    simulation, _ = chosen_and_fixed()
    problem = cortado.Problem(simulation, STEPS, Spread())
    found = [
        problem.value_and_gradient({"viscosity": 0.05}, gradient=gradient)[1]["viscosity"]
        for gradient in (cortado.gradients.Exact(), cortado.gradients.Tape())
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-8)


# ---- what is refused ---------------------------------------------------------------------------------------------
def test_what_cannot_be_is_said_in_a_sentence(tmp_path):
    simulation, still = Simulation(drop(CHOSEN)), {"gravity": [0.0, 0.0], "viscosity": "none"}
    held = "time_step is given, but must be left out, as the scene chooses its time steps, .* hold them constant"
    series = cortado.losses.Series(PressureProbe([0.3, 0.1]), [0.0, 0.1], [0.0, 1.0], 0.001)
    path, one_place = {"nozzle.path": np.tile(jet().emitter[0].outlet, (3, 1))}, "one place if time steps are adaptive"
    for call, what in [
        (lambda: simulation.run(3, {"time_step": 0.001}), held),
        (lambda: simulation.jvp(simulation.state(), {}, {}, {"time_step": 1.0}), held),
        (lambda: cortado.Problem(simulation, 3, Spread()).tangent({}, {"time_step": 1.0}), held),
        (lambda: cortado.Problem(simulation, 90, series), "loss is a Series with the time step 0.001 s"),
        (lambda: cortado.certify(simulation, ["viscosity"], steps=3), "seconds for a certificate"),
        (lambda: Simulation(jet(solver=CHOSEN)).run(3, path), f"nozzle.path has a row for each .* must be {one_place}"),
        (lambda: simulation.run(), "steps is left out, but must be given, as no time"),
        (lambda: simulation.run(3, time=1.0), "time is given, but must be left out, as steps is given"),
        (lambda: simulation.run(time=-1.0), "time is -1, but must be a number of seconds greater than 0"),
        (lambda: simulation.run(time=1.0, controls={"gravity": np.zeros((9, 2))}), r"but must be \(2,\)"),
        (lambda: Simulation(drop(CHOSEN), batch=2).run(time=1.0), "time is given, but must be left out"),
        (
            lambda: simulation.run(time=1e300),
            r"time is 1e\+300 s, but must be less, as .*e\+30\d steps",
        ),
    ]:
        with pytest.raises(InputError, match=what):
            call()
    for tables, what in [
        ({"solver": {"time_step": "fast"}}, 'time_step is .fast., but must be a finite number, .* or "auto"'),
        ({"solver": {"time_step": 0.001, "courant": 0.2}}, "courant is 0.2, but must be left out"),
        ({"solver": {**CHOSEN, "courant": 1.5}}, "courant is 1.5, but must be"),
        ({"solver": CHOSEN, "forces": still}, "step is missing, but must be given, as .*nothing else"),
    ]:
        with pytest.raises(SceneError, match=what):
            plane(**tables)


def test_commands_that_need_a_fixed_step_say_so(cortado_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    shutil.copy(EXAMPLES / "recover_gravity_small.toml", "task.toml")
    for words, what in [
        ("sweep scene.toml --set solver.courant=0.1,0.2 --steps 3", "a number of seconds for a sweep."),
        ("optimise task.toml --set solver.time_step=auto", "a number of seconds in a task, whose runs are compared"),
        ("gradients check scene.toml --steps 3", "for a certificate, whose finite differences need fixed time steps."),
    ]:
        code, _, err = cortado_command(*words.split())
        assert (code, len(err.strip().splitlines())) == (2, 1) and what in err


def test_the_reference_engine_refuses_steps_that_are_chosen():
    reference = pytest.importorskip("cortado_reference")
    with pytest.raises(InputError, match='is "auto", but must be a number of seconds for the ref'):
        reference.Simulation(drop(CHOSEN, forces={"gravity": [0.0, -9.81], "viscosity": "pairwise"}))


# ---- a time in the place of steps --------------------------------------------------------------------------------
def test_a_run_of_so_many_seconds():
    chosen, fixed = chosen_and_fixed(precision="float32")
    run = chosen.run(time=0.1, record_every=7)
    steps = int(run.steps[-1])
    assert run.times[-1] >= 0.1 > run.times[-1] - sizes_of(run)[-1] and len(run.converged) == steps
    assert run.positions.tobytes() == chosen.run(steps, record_every=7).positions.tobytes()
    on = chosen.run(time=0.02, state=run.last_state)
    assert on.times[0] == run.times[-1] and on.times[-1] >= run.times[-1] + 0.02
    assert [len(fixed.run(time=time)) - 1 for time in (0.0104, 0.011, 0.0111)] == [11, 11, 12]
    assert len(fixed.run(time=0.01, controls={"time_step": 0.002})) == 6


SCENE = pool_text([0.3, 0.4], [0.6, 0.6], 'time_step = "auto"', viscosity=0.05, lower=[0.0, 0.1])


@pytest.fixture
def run_command(cortado_command, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    return lambda *words: cortado_command("run", tmp_path / "scene.toml", "--out", tmp_path / "out", *words)


def test_a_run_whose_steps_become_too_short_says_so(monkeypatch):
    monkeypatch.setattr("cortado.rollout.parameter_space.expected_steps", lambda scene, time, values: 3)
    with pytest.warns(cortado.CortadoWarning, match="the run ended at 0.1.* s, before the requested time"):
        run = Simulation(drop(CHOSEN)).run(time=10.0)
    assert len(run.converged) == 12


@pytest.mark.filterwarnings("error::cortado.CortadoWarning")
def test_a_run_with_parameters_that_shorten_its_steps_reaches_its_time():
    fast, thick = {"initial_velocities": np.full((64, 2), [80.0, 60.0])}, {"forces": {"viscosity": "pairwise"}}
    for changes, values in [({}, {"gravity": [0.0, -2000.0]}), ({}, fast), (thick, {"viscosity": 500.0})]:
        simulation = Simulation(drop(CHOSEN, **changes), precision="float64")
        longest = sizes_of(simulation.run(1)).max()
        assert simulation.run(time=longest, controls=values, record_every=1000).times[-1] >= longest * (1.0 - 1e-9)


def test_a_bound_that_float32_does_not_hold_is_refused():
    scene = drop({**CHOSEN, "greatest_time_step": 1e-20})
    with pytest.raises(
        InputError, match="time step is at most 1e-20 s, but must be at least 1e-12 s in this precision"
    ):
        Simulation(scene).run(3)
    assert Simulation(scene, precision="float64").run(3).times[-1] == pytest.approx(3e-20, rel=1e-12)


def test_describe_says_which_limit_decides_the_first_step(cortado_command, tmp_path, monkeypatch):
    monkeypatch.setattr("cortado.cli.describe.MOST_STEPS", 4)  # to time more of them takes long
    (tmp_path / "scene.toml").write_text(SCENE)
    for words, limit, size in [
        ((), "depth", 0.0117),
        (("solver.kind=pcisph", "forces.viscosity=pairwise", "phase.water.viscosity=500"), "viscosity", 0.000497),
        (("solver.greatest_time_step=0.003",), "greatest_time_step", 0.003),
    ]:
        sets = [word for one in words for word in ("--set", one)]
        code, out, _ = cortado_command("describe", tmp_path / "scene.toml", *sets)
        assert code == 0 and f"chosen before each step: the first is {size:.3g} s, by {limit}; limits: {limit}" in out
    found = json.loads(cortado_command("describe", tmp_path / "scene.toml", "--json", *sets)[1])
    assert (found["time_step_chosen_by"], found["simulated_time_s"]) == (limit, None)
    assert found["time_step_s"] == pytest.approx(size, rel=1e-2)


def test_the_command_runs_until_a_time(run_command, tmp_path):
    code, out, _ = run_command("--time", "0.1", "--record-every", "4", "--no-pictures")
    assert code == 0 and " steps of 0.0" in out
    found = Trajectory.load(tmp_path / "out" / "trajectory.vtkhdf")
    wanted = Simulation(tmp_path / "scene.toml").run(time=0.1, record_every=4)
    for read in (lambda run: run.positions, lambda run: run.times, sizes_of):
        assert read(found).tobytes() == read(wanted).tobytes()
    on = Simulation(tmp_path / "scene.toml").run(3, state=found.last_state)
    assert on.positions[0].tobytes() == found.positions[-1].tobytes() and on.times[0] == found.times[-1]


@pytest.mark.parametrize("free, code", [(0.3, 0), (0.1, 1)])
def test_the_disk_must_have_room_for_the_frames_that_are_expected(run_command, monkeypatch, free, code):
    """There is room for four times as many in the file, which takes none before they come."""
    usage = SimpleNamespace(free=int(free * 1e6))
    monkeypatch.setattr("cortado.files.vtkhdf.shutil", SimpleNamespace(disk_usage=lambda path: usage))
    found, _, err = run_command("--time", "0.5", "--no-pictures")
    assert found == code and ("free on its disk" in err) == (code == 1), err


# ---- steps that are taken again ----------------------------------------------------------------------------------
def wedge(gap, **tables):
    """A column in the plane that collapses and flows under a disc, so far above the floor [m]."""
    disc = {"name": "disc", "shape": "sphere", "centre": [0.75, 0.14 + gap], "radius": 0.14}
    return pool([0.4, 0.6], [1.1, 1.0], 0.03, solid=[disc], solver={"kind": "projection", **CHOSEN}, **tables)


def test_a_step_that_presses_particles_between_walls_is_taken_again_shorter(unpacked):
    simulation = Simulation(wedge(0.012), precision="float64")
    whole = simulation.run(65)
    sizes = sizes_of(whole)
    again = np.flatnonzero(sizes[1:] < 0.3 * sizes[:-1]) + 1
    assert len(again) > 0
    before = int(again[0])
    rest = simulation.run(65 - before, state=whole[: before + 1].last_state)  # of which the first step is taken again
    assert rest.positions.tobytes() == whole.positions[before:].tobytes()
    pair = Simulation(wedge(0.012), precision="float64", batch=2).run(65, {"viscosity": np.array([0.001, 0.1])})
    assert pair[0].positions.tobytes() == whole.positions.tobytes()
    assert whole.diagnostics["greatest_density_errors"].max() < 0.3


def test_what_waits_in_a_wall_is_no_reason_to_shorten_steps():
    """The column of the nozzle reaches through a side of the container, whose wall particles press on it."""
    slot = {"phase": "water", "outlet": [0.15, 0.45], "direction": [1.0, 0.0], "radius": 0.075, "length": 0.5}
    scene = jet(emitter=[{**slot, "flow_rate": 0.05}], solver={"kind": "projection", **CHOSEN})
    run = Simulation(scene, precision="float64").run(12)
    assert np.median(run.diagnostics["greatest_density_errors"]) > 0.5
    assert (sizes_of(run)[1:] > 0.6 * sizes_of(run)[:-1]).all()


def test_what_was_compressed_before_is_no_reason_to_shorten_steps():
    simulation = Simulation(plane(solver={"kind": "projection", **CHOSEN}), precision="float64")
    begun = simulation.state()
    packed = replace(begun, fields={**begun.fields, "positions": 0.85 * begun["positions"] + 0.015})
    run = simulation.run(4, state=packed)
    assert run.diagnostics["greatest_density_errors"][0] > 0.2
    assert sizes_of(run)[0] == sizes_of(simulation.run(1))[0]


def test_a_step_is_shortened_where_that_helps():
    for added, sizes, wanted in [
        ([0.19], [8.0], []),  # nothing is pressed
        ([0.9, 0.4, 0.19], [8.0, 2.0, 0.5], [2.0, 0.5]),  # each helped
        ([0.9, 0.8], [8.0, 2.0], [2.0, 8.0]),  # the second did not: the first stays
        ([np.inf, 0.9, 0.8], [8.0, 2.0, 0.5], [2.0, 0.5, 2.0]),  # the first lost a particle
        ([0.9, 0.44, 0.21], [8.0, 2.0, 0.5], [2.0, 0.5]),  # no third
        ([0.9], [0.3], []),  # a quarter is less than a hundredth of 8
        ([0.9, 0.4], [0.4, 0.1], [0.1]),
    ]:
        retaken, asked = Retaken(), []
        for more, size in zip(added, sizes, strict=True):
            lost = {0: 5} if np.isinf(more) else {}
            tried, longest = np.array([[0.0], [more], [9.0]]), np.array([[8.0], [size if asked else 8.0], [8.0]])
            again = retaken.found(4, tried[:2], np.array([[8.0], [size]]), longest[:2], lost)
            asked += [again[5, 0]] if again else []
        assert asked == wanted


def lowered(gap, kind="projection", **changes):
    """A plate that is lowered to so many spacings above the floor, in water."""
    path = {"motion": "path", "times": [0.0, 0.2, 0.3], "positions": [[0.3, 0.2], [0.3, 0.03 + gap * 0.03], [0.3, 0.2]]}
    plate = {"name": "plate", "shape": "box", "lower": [0.15, 0.17], "upper": [0.45, 0.23], **path}
    return pool([0.6, 0.12], [0.6, 0.6], 0.03, solid=[plate], solver={"kind": kind, **CHOSEN}, **changes)


@pytest.mark.parametrize("gap", [0.0, 0.3, 0.5])
def test_between_walls_that_close_to_less_than_a_spacing_the_projection_loses_nothing(gap):
    assert Simulation(lowered(gap), precision="float64").run(time=0.3).times[-1] >= 0.3


def test_walls_that_close_to_less_than_a_spacing_are_the_cause_that_is_named():
    simulation = Simulation(lowered(0.5, "pcisph"), precision="float64")
    with pytest.raises(cortado.DivergedError) as found:
        simulation.run(time=0.3)
    assert "fluid is shut in by the container and the solid 'plate'" in str(found.value)
    sizes = simulation.run(found.value.step - 1).diagnostics["time_steps"]
    assert sizes.min() > 1e-9 * sizes.max()


def test_derivatives_go_through_steps_that_were_taken_again():
    """Reverse, forward and as differences of runs whose steps are held at the lengths that were taken in the end."""
    made = wedge(0.012)
    chosen, fixed = (Simulation(one, precision="float64") for one in (made, made.replaced("solver.time_step=0.001")))
    whole, steps = chosen.run(70), 6
    sizes = sizes_of(whole)
    before = int(np.flatnonzero(sizes[1 : 2 - steps] < 0.3 * sizes[: 1 - steps])[0])
    first = whole[: before - 1].last_state
    stepper = chosen.stepper(steps)
    end, residual = stepper.step(first, {"viscosity": 0.001})
    rng = np.random.default_rng(0)
    along, up = (rng.normal(size=end["positions"].shape) for _ in range(2))
    adjoint, of_viscosity = stepper.vjp(residual, {"positions": up})

    def held(by, viscosity=0.001):
        state = replace(first, fields={**first.fields, "velocities": first["velocities"] + by * along})
        state = replace(state, clock=replace(state.clock, time_step=0.0))
        for size in sizes[before - 2 : before - 2 + steps]:
            state = fixed.step(state, {"viscosity": viscosity, "time_step": size})
        return state["positions"]

    assert held(0.0).tobytes() == end["positions"].tobytes()
    reverse, forward = (adjoint["velocities"] * along).sum(), stepper.jvp(residual, {"velocities": along})["positions"]
    assert (forward * up).sum() == pytest.approx(reverse, rel=1e-9)
    assert ((held(1e-6) - held(-1e-6)) * up).sum() / 2e-6 == pytest.approx(reverse, rel=1e-5)
    changed = held(0.0, 0.001 + 1e-6) - held(0.0, 0.001 - 1e-6)
    assert (changed * up).sum() / 2e-6 == pytest.approx(of_viscosity["viscosity"], rel=1e-4)


BLOCK = {"name": "block", "shape": "box", "lower": [0.5, 0.1], "upper": [0.6, 0.6]}
OUTLET = {"phase": "water", "outlet": [0.2, 0.7], "radius": 0.1, "flow_rate": 0.1, "length": 0.3}
TURNING = {"gravity": {"times": [0.0, 1.0], "values": [[0.0, -9.81], [0.0, -9.0]]}}
FALLS = {
    "rests": (0.3, {}, {}),
    "reaches beneath the floor": (0.4, {"lower": [0.5, -0.1]}, {}),
    "stays where it is": (0.3, {"motion": "path", "velocity": [0.0, 0.0]}, {}),
    "beneath an outlet": (0.6, {}, {"emitter": [OUTLET]}),
    "moves": (0.8, {"motion": "path", "velocity": [0.0, 0.1]}, {}),
    "is free": (0.8, {"motion": "free", "density": 900.0}, {}),
    "conveys": (0.8, {"surface_velocity": [0.0, 1.0]}, {}),
    "while gravity changes": (0.8, {}, {"schedule": TURNING}),
}


def test_fluid_falls_to_the_foot_of_a_solid_from_where_it_is_highest_at_the_start():
    """And through the whole container where something raises it or takes the solid down."""
    for name in FALLS:
        fall, changes, tables = FALLS[name]
        scene = plane(solid=[{**BLOCK, **changes}], solver={"kind": "projection", "time_step": 1e-4}, **tables)
        speed = np.sqrt(2.0 * 9.81 * fall) + (0.1 / 0.2 if "emitter" in tables else 0.0)
        assert stability_limits(scene)["solids"] == pytest.approx(0.25 * min(0.1, 1.6 * 0.05) / speed)


def test_each_solid_bounds_the_step_by_its_own_thickness_and_its_own_foot():
    """None does above all fluid."""
    thin = {**BLOCK, "name": "thin", "lower": [0.5, 0.3], "upper": [0.56, 0.6]}
    above = {**BLOCK, "name": "above", "lower": [0.1, 0.45], "upper": [0.16, 0.6]}
    limits = [stability_limits(plane(solid=solids))["solids"] for solids in ([BLOCK], [thin], [BLOCK, thin], [above])]
    steps = [0.4 * 0.05 / np.sqrt(2.0 * 9.81 * 0.3), 0.25 * 0.06 / np.sqrt(2.0 * 9.81 * 0.1)]
    assert limits == pytest.approx([*steps, min(steps), np.inf])


def funnel(thickness, kind):
    """Two slanted sides, three spacings apart below, that water runs through, with the greatest step."""
    low, high = np.array([0.03, 0.0]), np.array([0.4, 0.5])
    along = (high - low) / np.linalg.norm(high - low)
    out = thickness * np.array([along[1], -along[0]])
    corners = np.array([low, low + out, high + out, high])
    scene = plane(
        discretisation={"spacing": 0.02},
        container={"shape": "none"},
        fluid=[box([-0.18, 0.275], [0.18, 0.575], phase="water")],
        solid=[
            {"name": name, "shape": "polygon", "corners": (corners * [side, 1.0]).tolist()}
            for name, side in (("left", -1.0), ("right", 1.0))
        ],
        solver={"kind": kind, "time_step": 1e-4},
    )
    size = min(stability_limits(scene).values())
    return scene.replaced(f"solver.time_step={size}"), low, along, out / thickness


@pytest.mark.parametrize("thickness", [0.03, 0.1])
@pytest.mark.parametrize("kind", SOLVERS)
def test_no_water_goes_through_the_walls_of_a_funnel_with_the_greatest_step_there_is(kind, thickness):
    """At the limit of the speed alone it did: walls may be passed where a step takes fluid half way through."""
    scene, low, along, out = funnel(thickness, kind)
    size = scene.solver.time_step
    assert stability_limits(scene)["solids"] == size < 0.65 * stability_limits(scene)["speed"]
    run = Simulation(scene).run(round(0.7 / size), record_every=4)
    places = np.abs(run.positions) * [1.0, 0.0] + run.positions * [0.0, 1.0] - low
    beside = (places @ along > 0.04) & (places @ along < 0.6)
    depths = places @ out
    assert not (beside & (depths > 0.4 * 0.02) & (depths < thickness)).any()
    assert np.count_nonzero(run.positions[-1][:, 1] < 0.0) > 100  # it runs out below


def test_the_thickness_of_a_polygon_is_that_between_sides_that_face_each_other(tmp_path):
    bar = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.2], [0.0, 0.2]])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    cup = [[0, 0], [1, 0], [1, 1], [0.9, 1], [0.9, 0.3], [0.1, 0.3], [0.1, 1], [0, 1]]
    taper, wedge = [[0, 0], [1, 0], [1, 0.2], [0, 0.1]], [[0, 0], [1, 0], [1, 0.05]]
    for corners, wanted in [(bar @ turn, 0.2), (bar[::-1], 0.2), (cup, 0.1), (taper, 0.1), (wedge, np.inf)]:
        solid = PolygonSolid(name="one", corners=np.asarray(corners, dtype=float).tolist())
        assert solid.thinnest(0.01) == pytest.approx(wanted)
    with pytest.raises(SceneError, match=r"only 0\.008 m thick, but must be at least half a spacing, 0\.01 m, thick"):
        funnel(0.008, "pcisph")
