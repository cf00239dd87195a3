"""`cortado describe`: what it says of a scene is what the scene has; and the closing line of `cortado run`."""

import json
from pathlib import Path

import numpy as np
import pytest

import cortado
from bad_scenes import assert_one_sentence
from bad_tasks import GOOD_TASK, PARTICLES, TINY_LATTE, TINY_SCENE
from cortado.cli import main
from cortado.cli.describe import RunLength, seconds_of_picture
from cortado.cli.run import RunRequest, run_scene
from cortado.cli.run_report import Energy, RunSummary
from cortado.discretise.smoothing import KERNELS, SLACK
from cortado.optimisation.task_files import load_task, task_in_words
from cortado.pictures.image_files import read_picture
from cortado.pictures.plane import PlanePainter
from cortado.runs.recording import EverySteps, FramesPerSecond
from scenes import box, jet, plane, pool, stability_limit, two_layers


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, unrendered):
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    monkeypatch.chdir(tmp_path)
    times = {"traced": 0.5, "quick": 0.2}  # drawing takes long
    monkeypatch.setattr("cortado.cli.describe.seconds_of_picture", lambda _, quality: times[quality])
    monkeypatch.setattr("cortado.cli.describe.MOST_STEPS", 4)  # and so do 100 steps that are timed
    return tmp_path


def told(capsys, *arguments):
    main(["describe", *arguments])
    return capsys.readouterr().out


def described(capsys, *arguments):
    return json.loads(told(capsys, *arguments, "--json"))


def test_it_says_what_the_scene_has(capsys, monkeypatch):
    monkeypatch.setattr("cortado.cli.describe.MOST_STEPS", 12)
    found, scene = described(capsys, "scene.toml", "--steps", "30"), cortado.load_scene("scene.toml")
    simulation = cortado.Simulation(scene)
    assert found["particles"] == PARTICLES and found["wall_particles"] == len(simulation.walls)
    limits = {name: limit for name, limit in found["time_step_limits_s"].items() if limit is not None}
    assert min(limits.values()) == pytest.approx(stability_limit(scene))
    assert found["simulated_time_s"] == pytest.approx(30 * found["time_step_s"])
    assert found["expected_seconds"] == pytest.approx(30 * 1e-3 * found["milliseconds_per_step"])
    assert found["measured_steps"] >= 4
    assert 0 < found["memory_bytes"] < found["gradient_memory_bytes"]


def test_another_mass_than_was_asked_for_is_told(capsys):
    """A box of 6.6 x 6.6 cells is packed, and lacks some of its mass; in one of 20.5 x 40 cells a lattice has it."""
    whole = ["--set", "fluid.0.upper=[1.025,2]", "--set", "container.upper=[2,2]"]
    for upper, mass in ((["--set", "fluid.0.upper=[0.33,0.33]"], 108.9), (whole, 2050.0)):
        found = described(capsys, "scene.toml", "--steps", "2", *upper)
        given, asked = found["mass_of_phase_kg"]["water"], found["mass_asked_of_phase_kg"]["water"]
        assert asked == pytest.approx(mass, rel=1e-3) and ("asked" in found["mass_in_words"][0]) == (upper is not whole)
        assert (given == pytest.approx(asked, rel=0.003)) == (upper is whole)
    main(["run", "scene.toml", "--steps", "2", "--no-pictures", "--set", "fluid.0.upper=[0.33,0.33]"])
    assert "where 108.9 kg were asked for" in "".join(capsys.readouterr())


def test_a_cubic_metre_of_water_is_a_tonne():
    """With every kernel and support."""
    cubes = [f"{one}.{end}" for one in ("fluid.0", "container") for end in ("upper=[1,1]", "lower=[0,0]")]
    for kernel in KERNELS:
        for support in (1.2, 3.0):
            cut = ["discretisation.spacing=0.2", f"discretisation.kernel={kernel}", f"discretisation.support={support}"]
            found = cortado.Simulation(cortado.load_scene("scene.toml", [*cubes, *cut])).masses
            assert sum(found.given.values()) == pytest.approx(1000.0, rel=1e-6)


@pytest.mark.parametrize(
    "time, steps, choice",
    [
        *((time, None, FramesPerSecond(rate)) for time, rate in ((0.049, 100.0), (0.05, 5000.0))),
        (None, 20, EverySteps(3)),
    ],
)
def test_a_run_has_the_steps_and_the_frames_that_were_told(time, steps, choice):
    told = RunLength(cortado.Simulation("scene.toml"), steps, time, choice)
    run_scene(Path("scene.toml"), RunRequest(Path("run"), steps, time, frames=choice, report=False))
    trajectory = cortado.Trajectory.load("run/trajectory.vtkhdf")
    assert len(trajectory) == told.frames and len(trajectory.converged) == told.steps
    assert trajectory.times[-1] == pytest.approx(told.time)
    assert told.trajectory == pytest.approx(Path("run/trajectory.vtkhdf").stat().st_size, rel=0.2)


def test_the_run_and_its_film_are_told(capsys):
    out = told(capsys, "scene.toml", "--time", "1.05", "--set", "picture.film_speed=0.5")
    assert "500 steps, 1.05 s of motion: about" in out and "film        53 frames, 2.1 s, at 0.5 x; 448 of" in out
    assert "; about 26 s to draw, 0.5 s for the first state; splashes take up to twice as long\n" in out
    none = cortado.Simulation(cortado.load_scene("scene.toml", ["picture.film_frames=0"]))
    assert RunLength(none, 10, None, EverySteps(1)).film is None


def test_a_picture_is_timed_where_there_is_something_to_draw(monkeypatch):
    drawn, ticks = [], iter([3.0, 5.5])
    monkeypatch.setattr("cortado.cli.describe.time.perf_counter", lambda: next(ticks))
    monkeypatch.setattr(PlanePainter, "image", lambda _, *state: drawn.append(len(state[0])))
    simulation = cortado.Simulation("scene.toml")
    assert seconds_of_picture(simulation, "traced") == 2.5 and drawn == 2 * [simulation.particles]
    shooting = cortado.Simulation(jet())
    assert shooting.free_particles < shooting.particles
    ticks = iter([0.0, 1.0])
    assert seconds_of_picture(shooting, "quick") == 1.0 and drawn[-1] == (shooting.free_particles or shooting.particles)


def test_steps_that_are_chosen_are_estimated():
    simulation = cortado.Simulation(plane(solver={"kind": "pcisph", "time_step": "auto"}))
    told, taken = RunLength(simulation, None, 0.2, EverySteps(1)), len(simulation.run(time=0.2).converged)
    assert told.is_about and told.time == 0.2 and told.frames == told.steps + 1 and told.film is not None
    assert 0.5 * taken < told.steps < 2.5 * taken
    unknown = RunLength(simulation, 10, None, FramesPerSecond(50.0))
    assert unknown.frames is unknown.trajectory is unknown.film is None and unknown.steps == 10


def test_memory_grows_with_what_is_kept(capsys):
    none, some, many = (described(capsys, "scene.toml", "--steps", steps) for steps in ("1", "11", "1001"))
    for name in ("trajectory_bytes", "gradient_memory_bytes", "memory_bytes"):
        assert many[name] - none[name] == pytest.approx(100 * (some[name] - none[name])) != 0.0


def test_phases_and_an_emitter_are_told(capsys):
    Path("latte.toml").write_text(TINY_LATTE)
    found = described(capsys, "latte.toml")
    each = found["particles_of_phase"].values()
    assert sum(each) == found["particles"] and min(each) > 0
    course = "schedule.gravity={times=[0,0.2],values=[[0,-9.81],[3,-9]]}"
    assert "gravity changes until 0.2 s, and is constant from then on" in told(capsys, "scene.toml", "--set", course)
    out = told(capsys, "latte.toml", "--steps", "20")
    assert "as a quick look, about" in out and "to draw with its light traced, 0.2 s and 0.5 s for the first" in out
    assert "milk" in out and "in 3-D" in out and "limits: " in out and "ms a step on cpu in float32" in out


def test_an_emitter_that_runs_dry_and_an_opening_that_is_no_whole_number_of_cells_are_told(capsys):
    """The flow rate is kept, and the speed is not that of the opening."""
    template = str(Path(cortado.__file__).parent / "cli/templates/jet.toml")
    asked = [template, "--precision", "float64", "--time", "2", "--set", "emitter[0].flow_rate=0.12"]
    found = told(capsys, *asked)
    assert "of nozzle at 1.2 m/s" in found and "an opening of" not in found and "has fluid for 2.7" in found
    found = told(capsys, *asked, "--set", "emitter[0].radius=0.0575", "--set", "emitter[0].volume=0.18")
    assert "at 1.2 m/s, through 0.1 m of cells, where an opening of 0.115 m was asked for" in found
    assert "runs dry at 1.5" in found and "before the end of the run at 2 s" in found


@pytest.mark.usefixtures("rendered")
def test_the_first_state_is_drawn(capsys):
    found = described(capsys, "scene.toml", "--picture", "a/first.png")
    picture = read_picture(found["picture"])
    blue = (picture[..., 2] > picture[..., 0] + 0.2).mean()
    assert picture.shape[2] == 3 and 0.01 < blue < 0.9


def test_a_scene_that_does_not_bear_its_first_steps(capsys, monkeypatch):
    monkeypatch.setattr("cortado.cli.describe.MOST_STEPS", 100)
    found = described(capsys, "scene.toml", "--set", "fluid.0.velocity=[10,25]")
    assert "diverged in step" in found["diverged"] and "milliseconds_per_step" not in found


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("absent.toml", "cannot be read"),
        ("scene.toml --steps 0", "steps is 0"),
        ("scene.toml --steps 5 --time 1", "--time is given, but must be left out"),
        ("scene.toml --time 1e30", "must be less, as such a run takes about"),
        ("scene.toml --fps -1", "--fps is -1"),
        ("scene.toml --picture scene.toml/a.png", "cannot be written"),
        ("scene.toml --picture .", "--picture is '.', but must be the name of a PNG file"),
    ],
)
def test_mistakes_are_sentences(cortado_command, line, words):
    code, out, err = cortado_command("describe", *line.split())
    assert_one_sentence(err.splitlines()[-1])
    assert (code, out) == (2, "") and words in err


# ---- the closing line --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("make", [plane, two_layers])
def test_energies_are_those_of_the_particles(make):
    simulation = cortado.Simulation(make(), precision="float64")
    rollout = simulation.rollout(3)
    summary = RunSummary(simulation, rollout, rollout.forward(keep=False), 0.3, {})
    trajectory, scene = simulation.run(3), simulation.scene
    masses = simulation.lattice.cell * trajectory.constants["reference_density"]
    kinetic = 0.5 * (masses * (trajectory.velocities[-1] ** 2).sum(axis=1)).sum()
    assert summary.last.kinetic == pytest.approx(kinetic, rel=1e-12) and summary.first.kinetic < summary.last.kinetic
    lower, gravity = np.array(scene.container.extent()[0]), np.array(scene.forces.gravity)
    height = -(trajectory.positions[0] - lower) @ gravity
    assert summary.first.potential == pytest.approx((masses * height).sum(), rel=1e-12)
    assert summary.milliseconds == pytest.approx(100.0)
    assert f"energy {summary.last.total:.4g} J" in str(summary)
    still = cortado.Simulation(plane(forces={"gravity": [0, 0]}, container={"shape": "none"}))
    rollout = still.rollout(1)
    assert Energy.of(still, rollout, rollout.initial, 0).total == 0.0


LIGHT = {"name": "water", "rest_density": 800.0, "viscosity": 0.1}


def test_densities_are_those_of_the_rest_lattice():
    """Fluid that fills a periodic box has its rest density everywhere, less a slack."""
    room = box([0.0, 0.0], [0.5, 0.5], periodic=[True, True])
    tables = {"container": room, "forces": {"gravity": [0, 0]}, "solver": {"kind": "pcisph", "time_step": 0.001}}
    scene = pool([0.5, 0.5], [0.5, 0.5], phase=[LIGHT], **tables)
    simulation = cortado.Simulation(scene, precision="float64")
    rollout = simulation.rollout(2)
    last = rollout.forward(keep=False)
    found = RunSummary(simulation, rollout, last, 1.0, {}).densities
    assert found == pytest.approx([800.0 * (1.0 - SLACK)] * 2, rel=1e-9)
    at = last.numpy(2)["positions"]
    at[7] += 0.02
    last.set({"positions": at})
    densities = simulation.solver.densities(last, rollout.parameters)
    assert 7 in np.argsort(np.abs(densities - 800.0))[-4:]


def test_densities_leave_out_what_waits_in_an_emitter():
    """A column may wait in the wall of its container, where no fluid could be."""
    room = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.4]}
    simulation = cortado.Simulation(jet(container=room))
    rollout = simulation.rollout(2)
    last = rollout.forward(keep=False)
    rest = simulation.scene.phase[0].rest_density
    assert simulation.solver.densities(last, rollout.parameters).max() > 1.5 * rest
    assert RunSummary(simulation, rollout, last, 1.0, {}).densities[1] < 1.1 * rest


def test_densities_at_the_end_are_those_beside_solids_where_they_are_then():
    """And not where they were at the start, where fluid is by now: as frames record them of a solid that came to
    rest."""
    path = {"motion": "path", "times": [0.0, 0.2], "positions": [[0.2, 0.3], [0.4, 0.3]]}
    paddle = box([0.15, 0.0], [0.25, 0.6], name="paddle", **path)
    tables = {"phase": [LIGHT], "solid": [paddle], "solver": {"kind": "projection", "time_step": 0.004}}
    simulation = cortado.Simulation(pool([0.8, 0.4], [0.8, 0.8], **tables))
    steps = 60
    rollout = simulation.rollout(steps)
    found = RunSummary(simulation, rollout, rollout.forward(keep=False), 1.0, {}).densities
    wanted = simulation.run(steps, record_every=steps, record=["density"])[-1]["density"]
    assert found == pytest.approx((wanted.min(), wanted.max()), rel=1e-6)


def test_a_run_ends_with_them(capsys):
    main(["run", "scene.toml", "--steps", "4", "--no-pictures"])
    summary, place = capsys.readouterr().out.splitlines()
    assert summary.startswith("4 steps of 0.0021 s in ") and " ms a step; energy " in summary and "kg/m3." in summary
    result = json.loads(Path("runs/run/result.json").read_text())
    assert result["density"]["least"] < result["density"]["greatest"] and result["energy"]["last"]["kinetic"] > 0.0
    assert place.startswith("The results are in ")
    assert "time that a step took" in Path("runs/run/report.html").read_text()


CUP = """
dimension = 3
discretisation = {spacing = 0.01}
phase = [{name = "coffee", rest_density = 1000.0, viscosity = 0.1}]
fluid = [{shape = "box", lower = [-0.015, 0.0, -0.015], upper = [0.015, 0.02, 0.015], phase = "coffee"}]
container = {shape = "cylinder", base = [0.0, 0.0, 0.0], radius = 0.03, height = 0.02, lid = false}
solver = {kind = "pcisph", time_step = 0.004}
"""
OVER = ["--set", "forces.gravity=[0,9.81,0]", "--set", "fluid.0.velocity=[0.5,1,0]"]


def test_what_went_over_the_rim_is_counted(folder, capsys):
    """Where gravity points out of the cup, all of it."""
    (folder / "cup.toml").write_text(CUP)
    words = ["run", "cup.toml", "--steps", "40", "--no-pictures"]
    main([*words, "--out", "spilt", *OVER])
    assert "Over the rim of the cup went 18 of 18 particles." in capsys.readouterr().out
    assert json.loads(Path("spilt/result.json").read_text())["spilt"] == 18
    assert "left the cup over its rim" in Path("spilt/report.html").read_text()
    main([*words, "--out", "held"])
    assert "Over the rim" not in capsys.readouterr().out
    main(["describe", "cup.toml", *OVER])
    size = "fluid in 0.03 x 0.02 x 0.03 m, in a container of 0.06 x 0.02 x 0.06 m; 0.018 kg of coffee"
    assert f"{size}; gravity (0, 9.81, 0) m/s2" in capsys.readouterr().out


def test_a_task_is_told_in_words(capsys):
    Path("task.toml").write_text(GOOD_TASK)
    main(["describe", "task.toml"])
    search = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("search"))
    assert "Which gravity makes the fluid come to the same positions" in search and "uses Adam" in search
    assert described(capsys, "task.toml")["search"] == task_in_words(load_task("task.toml"))
