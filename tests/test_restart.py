"""Runs that go on have the bits of one that did not stop: from a state, after a kill; and frames by time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cortado.cli.run as run_recording
from bad_scenes import assert_one_sentence
from cortado import InputError, Scene, Simulation, Trajectory
from cortado.runs.frames import Marks
from cortado.scene.restart import Clock
from scenes import jet, plane, plane_of_three, pool_text, pour, two_layers

FIRST, REST = 9, 12
MAKERS = {"plane": plane, "two layers": two_layers, "plane of three": plane_of_three, "jet": jet, "pour": pour}


def controls_of(simulation):
    steps, d = FIRST + REST, simulation.dimension
    sway = 0.01 * np.sin(0.3 * np.arange(steps))[:, None] * np.eye(d)[0]
    controls = {"gravity": np.array(simulation.scene.forces.gravity) + 100.0 * sway}
    if simulation.scene.emitter:
        controls["nozzle.path"] = np.array(simulation.scene.emitter[0].outlet) + sway
    return controls


@pytest.mark.parametrize(("name", "precision"), list(zip(MAKERS, 3 * ["float32", "float64"], strict=False)))
def test_a_restart_has_the_bits_of_a_run_that_did_not_stop(name, precision, tmp_path):
    simulation = Simulation(MAKERS[name](), precision=precision)
    controls = controls_of(simulation)
    whole = simulation.run(FIRST + REST, controls)
    earlier, later = ({key: own[rows] for key, own in controls.items()} for rows in (slice(FIRST), slice(FIRST, None)))
    first = simulation.run(FIRST, earlier, record_every=5)
    first.save(tmp_path / "first.vtkhdf")
    for state in (first.last_state, Trajectory.load(tmp_path / "first.vtkhdf").last_state):
        rest = simulation.run(REST, later, state=state)
        assert rest.steps.tolist() == list(range(FIRST, FIRST + REST + 1))
        assert rest.times.tobytes() == whole.times[FIRST:].tobytes()
        assert rest.others.keys() == whole.others.keys()
        for field, found in rest.others.items():
            assert found.tobytes() == whole.others[field][FIRST:].tobytes(), field
        for field in ("positions", "velocities", "mass_fractions"):
            found, wanted = getattr(rest, field), getattr(whole, field)
            assert (found is None) == (wanted is None)
            assert found is None or found.tobytes() == wanted[FIRST:].tobytes(), field
        assert rest.density_errors.tobytes() == whole.density_errors[FIRST:].tobytes()
        again = simulation.run(FIRST, earlier)
        assert again.positions.tobytes() == whole.positions[: FIRST + 1].tobytes()  # nothing of the restart stays


def test_states_that_do_not_fit_are_refused():
    simulation = Simulation(pour(), precision="float64")
    state = simulation.run(3).last_state

    x, n, wrong = state["positions"], simulation.particles, "state mass_fractions of particle 0 are"
    twice = x.copy()
    twice[7] = twice[3]

    def other(**fields):
        return replace(state, fields={**state.fields, **fields})

    emitterless = Simulation(two_layers()).run(1).last_state
    for given, controls, what in [
        (other(positions=x[:-1]), {}, "state positions has shape"),
        (other(positions=x + [0.0, 0.0, 5.0]), {}, "positions has particle 0 at .* m, outside the container of this"),
        (other(positions=twice), {}, "particles 3 and 7 at one place"),
        (other(reference_density=np.zeros(n)), {}, "state reference_density must be greater than 0"),
        (other(mass_fractions=np.full((n, 2), [2.0, -1.0])), {}, f"{wrong} 2, -1"),
        (other(mass_fractions=np.full((n, 2), [0.9, 0.2])), {}, f"{wrong} 0.9, 0.2"),
        (other(**{"nozzle.emitted": np.array([np.nan])}), {}, "state nozzle.emitted has a value that is not finite"),
        (
            emitterless,
            {},
            "state has positions, .*, but must have positions, .*, nozzle.outlet, nozzle.emitted in this",
        ),
        (simulation.initial, {}, "must be a RestartState"),
        (state, {"initial_velocities": state["velocities"]}, "must be left out, as the given state"),
    ]:
        with pytest.raises(InputError, match=what):
            simulation.run(3, controls, state=given)


def test_an_emitter_goes_on_with_another_flow():
    """What has left the nozzle is part of the state: particles that are still prescribed do not jump."""
    simulation = Simulation(jet(), precision="float64")
    given = simulation.parameters()
    first = simulation.run(4)
    faster = {"nozzle.flow_rate": 1.5 * given["nozzle.flow_rate"], "time_step": 0.5 * given["time_step"]}
    later = simulation.run(1, faster, state=first.last_state)
    waiting = slice(simulation.particles - 3, None)
    moved = later.positions[1, waiting] - first.positions[-1, waiting]
    speed = np.linalg.norm(first.velocities[-1, waiting], axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.5 * 0.5 * given["time_step"] * speed, rtol=1e-9)
    assert later.times[-1] == pytest.approx(4.5 * given["time_step"])


def test_a_run_goes_on_from_a_frame_on_the_way():
    simulation = Simulation(jet())
    path = simulation.parameters()["nozzle.path"] + np.linspace(0.0, 0.02, 6)[:, None]
    whole = simulation.run(6, {"nozzle.path": path})
    again = simulation.run(3, {"nozzle.path": path[3:]}, state=whole[:4].last_state)
    np.testing.assert_array_equal(again.positions, whole[3:].positions)
    with pytest.raises(InputError, match=r"^The trajectory has no frame"):
        _ = whole[7:].last_state


def spread_out(factor):
    tables = plane().model_dump(exclude_none=True)
    (fluid,), cut = tables["fluid"], tables["discretisation"]
    fluid["upper"] = [factor * x for x in fluid["upper"]]
    tables["container"]["upper"] = [3.0 * x for x in tables["container"]["upper"]]
    return Scene(**{**tables, "discretisation": {**cut, "spacing": factor * cut["spacing"]}})


def refused(simulation, state, controls=None):
    with pytest.raises(InputError) as caught:
        simulation.run(2, controls, state=state)
    sentence = str(caught.value)
    assert sentence.startswith("state ") and sentence.endswith(".") and "\n" not in sentence
    return sentence


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize(("factor", "known"), [(0.5, True), (1.6, False)])
def test_a_state_of_another_spacing_is_refused(factor, known):
    simulation, other = Simulation(plane()), Simulation(spread_out(factor))
    assert simulation.particles == other.particles
    state = other.run(2).last_state
    sentence = refused(simulation, state if known else replace(state, origin=None))
    assert ("spacing of" if known else "another spacing") in sentence


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("phase.0.rest_density=900", "density of 900 kg/m3, but must be of a run with a rest density of 1000 kg/m3"),
        ('discretisation.kernel="wendland_c2"', "the kernel wendland_c2"),
        ("container.periodic=[true,false]", "periods of"),
    ],
)
def test_a_state_of_other_particles_is_refused(override, words, tmp_path):
    scene = plane()
    trajectory = Simulation(scene.replaced(override)).run(2)
    trajectory.save(tmp_path / "other.vtkhdf")
    for state in (trajectory.last_state, Trajectory.load(tmp_path / "other.vtkhdf").last_state):
        assert words in refused(Simulation(scene), state)


@pytest.mark.parametrize(
    ("make", "factor", "known"),
    [(plane, 0.5, True), (plane, 1.2, False), (plane_of_three, 0.9, False), (pour, 1.2, True), (pour, 0.9, False)],
)
def test_reference_densities_of_other_fluid_are_refused(make, factor, known):
    simulation = Simulation(make())
    state = simulation.run(2).last_state
    wrong = replace(state, fields={**state.fields, "reference_density": factor * state["reference_density"]})
    assert "reference_density" in refused(simulation, wrong if known else replace(wrong, origin=None))


@pytest.mark.parametrize("make", [plane, two_layers])
def test_a_run_with_a_rest_density_goes_on_with_it_and_not_without(make):
    simulation = Simulation(make(), precision="float64")
    controls = {"rest_density": 0.9 * simulation.parameters()["rest_density"]}
    whole = simulation.run(12, controls)
    state = simulation.run(5, controls).last_state
    rest = simulation.run(7, controls, state=state)
    assert rest.positions.tobytes() == whole.positions[5:].tobytes()
    assert "give the rest density of the first run again" in refused(simulation, state)
    refused(simulation, replace(state, origin=None))
    refused(simulation, simulation.run(5).last_state, controls)


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (Clock(3, np.nan), "finite time of at least 0 s"),
        (Clock(3, -5.0), "is at -5.0 s"),
        (Clock(-1, 0.0), "has -1 steps"),
        (0.1, "must be a Clock"),
    ],
)
def test_a_clock_that_cannot_be_is_refused(clock, words):
    simulation = Simulation(plane())
    sentence = refused(simulation, replace(simulation.run(2).last_state, clock=clock))
    assert sentence.startswith("state clock") and words in sentence


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_state_goes_on_with_other_forces_time_steps_and_precisions():
    state = Simulation(plane()).run(4).last_state
    for simulation, controls in [
        (Simulation(plane(), precision="float64"), {}),
        (Simulation(plane().replaced("forces.gravity=[1,-5]", "phase.0.viscosity=0.3")), {}),
        (Simulation(plane().replaced("solver.time_step=0.0005")), {"gravity": [0.0, 2.0]}),
        (Simulation(plane().replaced("container.upper=[3,3]")), {"time_step": 0.0003}),
    ]:
        assert simulation.run(2, controls, state=state).steps.tolist() == [4, 5, 6]


def test_a_file_without_an_origin_can_still_be_read(tmp_path):
    """As earlier versions wrote it: such a state is judged by its densities and distances alone."""
    simulation = Simulation(plane())
    first = simulation.run(4)
    replace(first, origin=None).save(tmp_path / "old.vtkhdf")
    loaded = Trajectory.load(tmp_path / "old.vtkhdf")
    assert loaded.origin is None and loaded.last_state.origin is None
    found = simulation.run(3, state=loaded.last_state)
    assert found.positions.tobytes() == simulation.run(7).positions[4:].tobytes()
    first.save(tmp_path / "new.vtkhdf")
    assert Trajectory.load(tmp_path / "new.vtkhdf").origin == first.origin == first[1:3].origin
    assert first.origin.spacing == plane().discretisation.spacing


SOLVER = 'kind = "projection"\ntime_step = 0.004'
SCENE = f"""sensor = [{{ name = "gauge", kind = "wave_gauge", position = [0.25, 0.0] }}]
schedule.gravity = {{ times = [0.0, 0.2], values = [[0.0, -9.81], [3.0, -9.81]] }}
{pool_text([0.5, 0.8], [1.2, 1.0], SOLVER, spacing=0.1, viscosity=0.05)}"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cortado.cli.run.write_run_report", lambda *_: None)
    return tmp_path


def files(run):
    found = Trajectory.load(Path(run) / "trajectory.vtkhdf")
    arrays = {name: getattr(found, name) for name in ("times", "steps", "positions", "velocities")}
    arrays |= {**found.diagnostics, **found.others, **found.constants, **found.quantities}
    texts = [(Path(run) / name).read_text() for name in ("metrics.jsonl", "sensors.csv", "result.json")]
    return arrays, texts


def assert_same_files(one, other):
    (arrays, texts), (others, other_texts) = files(one), files(other)
    assert arrays.keys() == others.keys() and texts == other_texts
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, others[name], err_msg=name)


class Killed(BaseException):
    """A process that is gone: nothing is written any more."""


def killed_after(step, monkeypatch, every=0.0):
    """End the next run after a step, with notes at every step or, as in a short run, none."""
    whole = run_recording.Notes.now_and_then

    def now_and_then(notes, number):
        whole(notes, number)
        if number == step:
            monkeypatch.setattr(run_recording.Notes, "write", lambda _: None)
            monkeypatch.setattr("cortado.runs.run_folder.RunFolder.write_metrics", lambda *_: None)
            raise Killed

    monkeypatch.setattr(run_recording, "OFTEN", every)
    monkeypatch.setattr(run_recording, "SHARE", 0.0)
    monkeypatch.setattr(run_recording.Notes, "now_and_then", now_and_then)


@pytest.mark.parametrize(
    ("options", "begins"),
    [
        (["--steps", 23], "It goes on after step 12."),
        (["--steps", 23, "--record-every", 5, "--record", "pressure"], "It goes on after step 10."),
        # a chunk ends with step 12, and sensors read a state in the step after it
        (["--time", 0.4, "--set", "solver.time_step=auto"], "It goes on after step 11."),
        (["--steps", 23, "--set", "solver.time_step=auto", "--fps", 60, "--precision", "float64"], None),
        (["--steps", 23, "--set", "solver.kind=pcisph"], "It goes on after step 12."),
        (["--steps", 22], "No step of it is known: it begins anew."),
    ],
    ids=["each step", "some steps", "a time", "fps", "pcisph", "not noted"],
)
def test_a_killed_run_goes_on_bit_for_bit(cortado_command, options, begins):
    """It begins anew where its frames are there, but not what its sensors read."""
    assert cortado_command("run", "scene.toml", "--out", "whole", *options)[0] == 0
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        killed_after(12, patch, every=1e9 if begins and "anew" in begins else 0.0)
        cortado_command("run", "scene.toml", "--out", "dam", *options)
    assert len(Trajectory.load("dam/trajectory.vtkhdf")) < len(Trajectory.load("whole/trajectory.vtkhdf"))
    code, out, err = cortado_command("run", "scene.toml", "--out", "dam", *options, "--resume")
    assert (code, err) == (0, "") and ("the last " in out or "anew" in out)
    assert begins is None or out.splitlines()[0] == begins
    assert_same_files("whole", "dam")


def test_a_run_that_has_ended_goes_on_to_its_pictures(cortado_command):
    for out in ("whole", "dam"):
        cortado_command("run", "scene.toml", "--out", out, "--steps", 6)
    code, out, err = cortado_command("run", "scene.toml", "--out", "dam", "--steps", 6, "--resume")
    assert (code, err) == (0, "") and out.splitlines()[0] == "It goes on after step 6."
    assert_same_files("whole", "dam")


def test_a_run_begins_at_the_end_of_another(cortado_command):
    cortado_command("run", "scene.toml", "--out", "whole", "--steps", 10)
    cortado_command("run", "scene.toml", "--out", "first", "--steps", 6)
    code, _, err = cortado_command("run", "scene.toml", "--out", "rest", "--steps", 4, "--state", "first")
    assert (code, err) == (0, "")
    whole, rest = (Trajectory.load(f"{run}/trajectory.vtkhdf") for run in ("whole", "rest"))
    for name in ("positions", "times", "steps"):
        np.testing.assert_array_equal(getattr(rest, name), getattr(whole, name)[6:])
    again = ["--out", "rest", "--steps", 4, "--resume", "--state"]
    assert cortado_command("run", "scene.toml", *again, "first/trajectory.vtkhdf")[0] == 0
    code, _, err = cortado_command("run", "scene.toml", *again, "whole")
    assert code == 2 and "state" in err


def test_frames_come_at_a_rate(cortado_command):
    run = ("run", "scene.toml", "--out")
    cortado_command(*run, "first", "--steps", 5, "--fps", 29.97)
    for more in ([], ["--state", "first"]):
        code, _, _ = cortado_command(*run, "rest", "--time", 0.2, "--fps", 50, "--overwrite", *more)
        first, rest = (Trajectory.load(f"{name}/trajectory.vtkhdf") for name in ("first", "rest"))
        assert code == 0 and len(rest.times) == 11 and first.marks == Marks(0.0, 29.97)
        assert rest.marks == Marks(first.times[-1] if more else 0.0, 50.0)
        late = rest.times - rest.marks.at(np.arange(11))
        assert (late >= -1e-9).all() and (late < 0.004).all()
    assert json.loads(Path("rest/environment.json").read_text())["settings"]["fps"] == 50


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--resume"], ["There is no run in"]),
        (["--resume", "--overwrite"], ["--resume", "--overwrite"]),
        (["--fps", "nan"], ["--fps is nan, but must be"]),
        (["--fps", "30", "--record-every", "2"], ["--fps", "--record-every"]),
        (["--state", "nowhere"], ["There is no trajectory file nowhere"]),
        (["--state", "."], ["There is no run in", "--state must be the folder of one"]),
    ],
)
def test_wrong_arguments_are_sentences(cortado_command, options, words):
    code, out, err = cortado_command("run", "scene.toml", "--steps", 2, "--out", "dam", *options)
    assert (code, out) == (2, "") and all(word in err for word in words), err
    assert_one_sentence(err.removesuffix("\n"))
