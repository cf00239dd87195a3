"""`python -m benchmarks bench` and what it is made of: its numbers add up."""

import importlib
import json
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.__main__ import BENCH
from benchmarks.bench.dam_break import ESTIMATED, measure_dam_break, with_floors
from benchmarks.bench.environment import OtherProcesses
from benchmarks.bench.floor import copy_bandwidth, least_bytes, sums_over_neighbours
from benchmarks.bench.learners import bench_learners
from benchmarks.bench.passes import AGAIN, PassTimer
from benchmarks.bench.pictures import bench_pictures
from benchmarks.bench.run import bench_dam_break
from benchmarks.bench.scene import ITERATIONS, dam_break
from benchmarks.bench.text import as_text
from benchmarks.bench.timing import BATCH, LaunchTimer, median_seconds
from cortado import Simulation
from cortado.device.launching import KernelLauncher, watched
from cortado.environments import FluidEnv
from cortado.environments.catalogue import Splash
from scenes import plane

STEP = [
    *("sort by cell", "neighbour list", "density", "wall relaxation", "gravity", "viscosity", "pressure"),
    *("pressure force", "error sums", "the rest"),
]


@pytest.fixture(scope="module")
def found():
    """What the command prints for the smallest block."""
    return json.loads(bench_dam_break([8, 27], 2, 1, "cpu", "float32", "pcisph", as_json=True))


def test_every_size_and_every_pass_of_a_step_has_a_time_and_a_floor(found):
    assert [row["particles"] for row in found["sizes"]] == [8, 27]
    assert found["environment"].keys() >= {"device", "cores", "warp", "date", "cores_busy_elsewhere"}
    assert found["copy_bandwidth_gb_per_s"] > 0.0 and found["empty_launch_us"] > 0.0
    for row in found["sizes"]:
        assert sorted(one["name"] for one in row["passes"]) == sorted(STEP)
        assert row["passes"][-1]["name"] == "the rest"
        for one in [*row["passes"], *row["adjoint_passes"], row["step"], row["rollout"], row["gradient"]]:
            assert one["ms"] > 0.0 and one["floor_ms"] > 0.0
    text = as_text(found)
    assert all(text.count(f"\n{name} ") >= 2 for name in [*STEP, "step", "rollout", "gradient"])
    assert "27 particles" in text and "GB/s" in text


def test_passes_occur_as_often_as_a_step_launches_them(found):
    launches = {one["name"]: one["launches"] for one in found["sizes"][1]["passes"]}
    assert launches["pressure"] == launches["pressure force"] == ITERATIONS
    assert launches["density"] == launches["viscosity"] == launches["neighbour list"] == 1
    back = {one["name"]: one["launches"] for one in found["sizes"][1]["adjoint_passes"]}
    assert back["pressure adjoint"] == back["pressure force adjoint"] == ITERATIONS and back["viscosity adjoint"] == 1
    assert AGAIN in back


def test_floors_are_those_of_the_passes_and_only_sums_over_neighbours_have_pairs(found):
    row = found["sizes"][1]
    step = sum(one["floor_ms"] for one in row["passes"])
    back = sum(one["floor_ms"] for one in row["adjoint_passes"])
    assert row["step"]["floor_ms"] == pytest.approx(step) == row["rollout"]["floor_ms"]
    assert row["gradient"]["floor_ms"] == pytest.approx(step + back)
    one = row["passes"][0]
    assert one["floor_ms"] == pytest.approx(1e3 * one["bytes"] / (1e9 * found["copy_bandwidth_gb_per_s"]))
    pairs = {one["name"]: one.get("pairs_per_second") for one in row["passes"]}
    assert all(pairs[name] > 0.0 for name in ("density", "pressure", "viscosity", "neighbour list"))
    assert not any(pairs[name] is not None for name in ("sort by cell", "gravity", "error sums", "the rest"))
    memory = row["memory"]
    assert memory["how"] == ESTIMATED
    assert 0.0 < memory["forward_bytes_per_particle"] < memory["gradient_bytes_per_particle"]


def test_bytes_of_a_launch_are_its_entries_and_of_a_sum_over_neighbours_its_list():
    x, y = wp.zeros(10, dtype=wp.vec3f, device="cpu"), wp.zeros(20, dtype=wp.int32, device="cpu")
    assert least_bytes([x, y, 3.0], 10, 10, 0) == 10 * 12 + 10 * 4
    assert least_bytes([x, x], 10, 10, 0) == 120, "an array counts once"
    assert least_bytes([x, y], 1, 10, 0) == 12 + 4, "one thread, one entry"
    solver = Simulation(dam_break(27)).solver
    neighbourhood = solver.context(solver.new_parameters(1)).neighbourhood
    x = solver.fields["x"]
    assert sums_over_neighbours([neighbourhood, x]) and not sums_over_neighbours([x]) and not sums_over_neighbours([])
    assert least_bytes([neighbourhood, x], 27, 27, 500) == 27 * 12 + 4 * 500 + 8 * 27


def test_listed_neighbours_are_those_of_the_first_state():
    simulation = Simulation(dam_break(64))
    rollout = simulation.rollout(2)
    rollout.forward(keep=False)
    timer = PassTimer(rollout, simulation.solver.search, 1)
    x = np.concatenate([simulation.positions, simulation.walls])
    reach = 1.03 * simulation.scene.discretisation.support_radius
    distances = np.linalg.norm(x[None] - simulation.positions[:, None], axis=2)
    assert timer.pairs == np.count_nonzero(distances < reach) - simulation.particles
    assert timer.pairs <= timer.listed < timer.pairs + 4 * simulation.particles


def test_a_run_has_the_same_bits_after_its_passes_were_timed():
    simulation = Simulation(dam_break(64))
    before = simulation.run(3).positions
    rollout = simulation.rollout(3)
    rollout.forward(keep=False)
    with simulation.turn:
        timer = PassTimer(rollout, simulation.solver.search, 1)
        timer.step_passes()
        timer.adjoint_passes()
    assert np.array_equal(simulation.run(3).positions, before)


def test_a_watcher_sees_every_launch_and_only_within_its_block():
    simulation = Simulation(dam_break(8))
    solver, seen = simulation.solver, []
    rollout = simulation.rollout(1)

    def watch(name, threads, arguments, launch):
        seen.append(name.rpartition("__")[2])
        launch()

    with simulation.turn, watched(watch):
        solver.step(rollout.initial, solver.new_state(), rollout.parameters, rollout.log)
    assert seen.count("pressure") == ITERATIONS and {"cell_sort", "fill", "record"} <= set(seen)
    number = len(seen)
    simulation.run(1)
    assert len(seen) == number


def test_medians_leave_the_first_two_times_out():
    calls = []
    assert median_seconds(lambda: calls.append("work"), 3, before=lambda: calls.append("before")) >= 0.0
    assert calls == ["before", "work"] * 5


def test_a_long_launch_is_not_repeated_often():
    launcher, calls = KernelLauncher(10**6, wp.get_device("cpu"), record_tape=False), []

    def work() -> None:
        calls.append(1)
        time.sleep(1.2 * BATCH)

    assert LaunchTimer(launcher, 2)(work) >= BATCH
    assert len(calls) == 9  # one to begin, three that are timed alone, one for the graph, two to warm up, two repeats


@pytest.mark.skipif(not Path("/proc/stat").exists(), reason="the system does not say how busy it is")
def test_ones_own_time_is_not_that_of_others():
    others, every = OtherProcesses(), OtherProcesses(lambda: 0.0)
    end = time.perf_counter() + 0.3
    while time.perf_counter() < end:
        pass
    others_busy, all_busy = others.busy_cores(), every.busy_cores()
    assert all_busy is not None and others_busy is not None and 0.0 <= others_busy < all_busy


def test_the_bandwidth_is_that_of_memory():
    assert 1e8 < copy_bandwidth(wp.get_device("cpu"), 1) < 1e13


def test_float64_moves_more_bytes():
    single, double = (with_floors(measure_dam_break(8, 1, "cpu", p, 1), 1e9) for p in ("float32", "float64"))
    assert single["step"]["floor_ms"] < double["step"]["floor_ms"]


@pytest.fixture
def benchmarks_command(cortado_command):
    return partial(cortado_command, program=BENCH)


def test_bench_speaks_json_and_words(benchmarks_command):
    code, out, err = benchmarks_command("bench", "--particles", 8, 100, "--steps", 2, "--repeats", 5, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "") and [row["particles"] for row in found["sizes"]] == [8, 125]
    assert all(row["steps"] == 2 and row["gradient"]["ms"] > 0.0 < row["rollout"]["ms"] for row in found["sizes"])
    code, out, _ = benchmarks_command("bench", "--particles", 100, "--steps", 2, "--repeats", 1, "--solver", "pcisph")
    assert code == 0 and "125 particles" in out and "\npressure force adjoint" in out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--engine steam", "--engine is 'steam', but must be one of 'warp', 'reference'"),
        ("--particles -5", "--particles is -5"),
        ("--particles 8 --steps 0", "steps is 0"),
        ("--particles 8 0", "--particles is 0"),
        ("--particles", "--particles"),
        ("--particles 8 --repeats 0", "--repeats is 0"),
        ("--particles 8 --repeats 1e12", "--repeats"),
        ("--particles 8 --repeats 1000000000000", "but must be at most 100,000"),
        ("--engine reference --repeats 10000000", "but must be at most 100,000"),
        ("--particles 8 --device tpu", "device is 'tpu'"),
        ("--particles 8 --precision float16", "precision is 'float16'"),
    ],
)
def test_wrong_arguments_are_refused(benchmarks_command, options, words):
    code, out, err = benchmarks_command("bench", *options.split())
    assert (code, out) == (2, "") and words in err and err.count("\n") == 1


def test_batches_are_timed_beside_the_first(benchmarks_command, monkeypatch):
    """In the plane, for which others compile the kernels too."""
    flat = plane(solver={"kind": "projection", "time_step": 0.002})
    monkeypatch.setattr("benchmarks.bench.batches.dam_break", lambda *_: flat)
    code, out, err = benchmarks_command("batches", "--scenes", 1, 2, "--steps", 2, "--repeats", 1, "--json")
    first, second = json.loads(out)["rows"]
    assert (code, err) == (0, "") and first["forward_gain"] == first["gradient_gain"] == 1.0
    assert second["gradient_gain"] == pytest.approx(2.0 * first["gradient"] / second["gradient"])


@pytest.fixture
def page(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module("page")


def test_pages_have_what_their_commands_print(page, tmp_path, monkeypatch, capsys):
    (tmp_path / "docs").mkdir()
    place = "<!-- measured by: python -c 'print({})'{} -->\nold\n<!-- end of measured -->\n"
    text = place.format("6 * 7", "") + place.format("8 * 9", " --device cuda:0")
    (tmp_path / "docs" / "one.md").write_text(text)
    monkeypatch.setattr(page, "ROOT", tmp_path)
    monkeypatch.setattr("sys.argv", ["page.py", "--commit", "abc"])
    page.main()
    text = (tmp_path / "docs" / "one.md").read_text()
    assert "```text\n42\n```" in text and "commit abc" in text and text.count("old") == 1 and "72" not in text
    said = capsys.readouterr().out
    assert said.startswith("python -c 'print(6 * 7)'\n") and said.count("python -c") == 1


def test_the_commands_of_pages_are_there(page, benchmarks_command):
    root = Path(__file__).parents[1]
    commands = [place[1] for file in (root / "docs").glob("*.md") for place in page.PLACE.findall(file.read_text())]
    assert len(commands) >= 9
    for command in commands:
        _, first, *words = command.split()
        if first == "-m":
            assert words[0] == "benchmarks" and benchmarks_command(words[1], "--help")[0] == 0, command
        else:
            assert (root / first).exists(), command


def test_pictures_are_timed(monkeypatch):
    found = json.loads(bench_pictures([216], 64, 1, "cpu", as_json=True))
    (row,) = found["sizes"]
    assert found["lines"] == 64 and 50 < row["particles"] < 216 * 1.5 and row["s"] > 0.0
    assert {"trace", "illuminate", "find_levels"} <= row["ms_of_kernels"].keys()
    monkeypatch.setattr("benchmarks.bench.pictures._measured", lambda *_: row)
    assert f"{row['particles']} particles: " in bench_pictures([216], 64, 1, "cpu", as_json=False)


def test_controllers_of_an_environment_are_judged_by_its_own_returns(monkeypatch):
    """In the same episode: to do nothing has the return of a single environment, and searches find more."""
    monkeypatch.setattr(Splash, "horizon", 6)
    (row,) = json.loads(bench_learners(["Splash"], 32, 3, "small", "cpu", False, True))["returns"]
    env = FluidEnv("Splash")
    env.reset(seed=3)
    assert np.isclose(row["nothing"], sum(env.step(np.zeros(2))[1] for _ in range(6)), rtol=1e-6)
    assert row["cem"] > row["nothing"] + 0.01 and row["gradient"] > row["nothing"] + 0.01
    assert bench_learners(["Splash"], 16, 3, "small", "cpu", False, False).split()[:4] == [*row]
