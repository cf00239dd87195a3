"""`python -m benchmarks bench` and what it is made of: its numbers add up."""

import importlib
import json
from functools import partial
from pathlib import Path

import pytest
import warp as wp

from benchmarks.__main__ import BENCH
from benchmarks.bench.dam_break import ESTIMATED
from benchmarks.bench.floor import least_bytes, sums_over_neighbours
from benchmarks.bench.passes import AGAIN
from benchmarks.bench.pictures import bench_pictures
from benchmarks.bench.run import bench_dam_break
from benchmarks.bench.scene import ITERATIONS, dam_break
from benchmarks.bench.text import as_text
from cortado import Simulation
from scenes import plane

STEP = [
    *("sort by cell", "neighbour list", "density", "wall relaxation", "gravity", "viscosity", "pressure"),
    *("pressure force", "error sums", "the rest"),
]


@pytest.fixture(scope="module")
def found():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.bench.floor.COPIED", 2**20)
        return json.loads(bench_dam_break([27], 2, 1, "cpu", "float64", "pcisph", as_json=True))


def test_every_size_and_every_pass_of_a_step_has_a_time_and_a_floor(found):
    assert [row["particles"] for row in found["sizes"]] == [27]
    assert found["environment"].keys() >= {"device", "cores", "warp", "date", "cores_busy_elsewhere"}
    assert found["copy_bandwidth_gb_per_s"] > 0.0 and found["empty_launch_us"] > 0.0
    for row in found["sizes"]:
        assert sorted(one["name"] for one in row["passes"]) == sorted(STEP)
        assert row["passes"][-1]["name"] == "the rest"
        for one in [*row["passes"], *row["adjoint_passes"], row["step"], row["rollout"], row["gradient"]]:
            assert one["ms"] > 0.0 and one["floor_ms"] > 0.0
    text = as_text(found)
    assert all(f"\n{name} " in text for name in [*STEP, "step", "rollout", "gradient"])
    assert "27 particles" in text and "GB/s" in text


def test_passes_occur_as_often_as_a_step_launches_them(found):
    launches = {one["name"]: one["launches"] for one in found["sizes"][0]["passes"]}
    assert launches["pressure"] == launches["pressure force"] == ITERATIONS
    assert launches["density"] == launches["viscosity"] == launches["neighbour list"] == 1
    back = {one["name"]: one["launches"] for one in found["sizes"][0]["adjoint_passes"]}
    assert back["pressure adjoint"] == back["pressure force adjoint"] == ITERATIONS and back["viscosity adjoint"] == 1
    assert AGAIN in back


def test_floors_are_those_of_the_passes_and_only_sums_over_neighbours_have_pairs(found):
    row = found["sizes"][0]
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
        ("--particles 8 0", "--particles is 0"),
        ("--particles 8 --repeats 0", "--repeats is 0"),
        ("--particles 8 --repeats 1000000000000", "but must be at most 100,000"),
        ("--particles 8 --device tpu", "device is 'tpu'"),
    ],
)
def test_wrong_arguments_are_refused(benchmarks_command, options, words):
    code, out, err = benchmarks_command("bench", *options.split())
    assert (code, out) == (2, "") and words in err and err.count("\n") == 1


def test_batches_are_timed_beside_the_first(benchmarks_command, monkeypatch):
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
