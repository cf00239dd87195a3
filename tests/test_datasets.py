"""Data sets of varied runs: what is drawn, the layout of LagrangeBench, derivatives, and going on after a kill."""

import json
import subprocess
from contextlib import nullcontext
from pathlib import Path
from tomllib import loads
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import cortado
from cortado import DivergedError, InputError, SceneError, Simulation
from cortado.cli import dataset as command
from cortado.discretise.packing import Packing
from cortado.discretise.shapes import wrapped
from cortado.optimisation import datasets
from cortado.optimisation.datasets import DatasetTable, Sample, one_run
from full_disk import largest_file
from scenes import box, pool_text

SCENE = pool_text([0.4, 0.4], [1.0, 1.0], 'kind = "pcisph"\ntime_step = 0.004', spacing=0.1)
TABLE = """
[dataset]
steps = 6
write_every = 2
vary."fluid.0.upper" = [[0.3, 0.3], [0.5, 0.6]]
vary."phase.water.viscosity" = [0.1, 10.0]
logarithmic = ["phase.water.viscosity"]
velocity_noise = 0.01
valid = 0.2
test = 0.2
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "columns.toml").write_text(SCENE + TABLE)
    return "columns.toml"


def table(**changes):
    given = {"steps": 6, "write_every": 2, "vary": {"phase.water.viscosity": [0.1, 10.0]}, "velocity_noise": 0.01}
    return DatasetTable(**{**given, **changes})


def simulation(precision="float64"):
    words = SCENE.replace("upper = [0.4, 0.4]", "upper = [0.3, 0.4]")
    return Simulation(cortado.Scene(**loads(words)), precision=precision)


# ---- what is drawn -----------------------------------------------------------------------------------------------
def test_samples_are_of_their_seed_and_number_alone():
    one = table(seed=3)
    assert Sample(one, 5).values == Sample(one, 5).values
    assert Sample(one, 5).values != Sample(one, 6).values != Sample(table(seed=4), 6).values
    start = np.zeros((3, 2))
    first = Sample(one, 5).start(start, start, 0.1)
    assert list(first) == ["initial_velocities"]
    noisy = Sample(table(seed=3, position_noise=0.1), 5).start(start, start, 0.1)
    np.testing.assert_array_equal(noisy["initial_velocities"], first["initial_velocities"])


def test_values_are_even_in_their_range_or_in_its_logarithm():
    one = table(vary={"a.b": [[0.0, 5.0], [1.0, 5.0]], "c": [0.01, 100.0]}, logarithmic=("c",))
    drawn = [Sample(one, number).values for number in range(2000)]
    pairs, logarithms = np.array([v["a.b"] for v in drawn]), np.log10([v["c"] for v in drawn])
    assert (pairs[:, 1] == 5.0).all() and pairs[:, 0].min() >= 0.0 and pairs[:, 0].max() <= 1.0
    assert pairs[:, 0].mean() == pytest.approx(0.5, abs=0.03) and pairs[:, 0].std() == pytest.approx(12**-0.5, abs=0.02)
    assert logarithms.mean() == pytest.approx(0.0, abs=0.1) and np.abs(logarithms).max() <= 2.0
    assert logarithms.std() == pytest.approx(4.0 * 12**-0.5, abs=0.05)


@pytest.mark.parametrize(("valid", "test"), [(0.1, 0.2), (0.0, 0.01), (0.45, 0.45)])
def test_the_purpose_of_a_run_does_not_depend_on_how_many_there_are(valid, test):
    one = table(valid=valid, test=test)
    parts = {"train": 1.0 - valid - test, "valid": valid, "test": test}
    purposes = sum(part > 0.0 for part in parts.values())
    most = one.split(300)
    assert sorted(number for own in most.values() for number in own) == list(range(300))
    for runs in range(purposes, 300):
        found = one.split(runs)
        for purpose, own in found.items():
            assert own == [number for number in most[purpose] if number < runs]
            assert abs(len(own) - parts[purpose] * runs) <= 2.0 and bool(own) == (parts[purpose] > 0.0)
    assert [len(own) for own in table().split(100).values()] == [80, 10, 10]


# ---- one run -----------------------------------------------------------------------------------------------------
def test_tangents_are_the_derivatives_along_their_directions():
    """Against central differences, so small that no pressure is clamped between their ends."""
    one, made = table(tangents=2, tangent_frames="all", seed=1), simulation()
    sample = Sample(one, 2)
    found = one_run(made, sample).arrays
    assert found["tangent/position"].shape == (2, 4, made.particles, 2) == found["tangent/velocity"].shape
    start = {"initial_positions": made.positions} | sample.start(made.positions, made.velocities, 0.1)
    for which in range(2):
        kinds = {"initial_positions": "position", "initial_velocities": "velocity"}
        along = {name: found[f"tangent/{kind}_direction"][which] for name, kind in kinds.items()}
        for h in (1e-6, 1e-7):
            moved = ({name: start[name] + s * h * along[name] for name in start} for s in (1, -1))
            ends = [made.run(6, one, record_every=2) for one in moved]
            for own, field in (("position", "positions"), ("velocity", "velocities")):
                differences = (getattr(ends[0], field) - getattr(ends[1], field)) / (2.0 * h)
                off = np.abs(differences - found[f"tangent/{own}"][which]).max()
                assert off < 1e-6 * np.abs(differences).max(), (own, h)
    assert not np.array_equal(found["tangent/position"][0], found["tangent/position"][1])


def test_walls_of_solids_are_where_these_are_in_every_frame():
    """Of one that turns along a path, one that falls freely, and one at rest."""
    path = {"motion": "path", "times": [0.0, 0.24], "positions": [[0.65, 0.5], [0.75, 0.55]]}
    solids = [
        box([0.55, 0.35], [0.75, 0.65], name="paddle", rotations=[[0.0], [0.6]], **path),
        box([0.1, 0.6], [0.3, 0.8], name="raft", motion="free", density=500.0),
        box([0.8, 0.0], [1.0, 0.2], name="post"),
    ]
    scene = cortado.Scene(**loads(SCENE.replace('"pcisph"', '"projection"')), solid=solids)
    found = one_run(Simulation(scene, precision="float64"), Sample(table(), 0)).arrays
    kinds, places = found["particle_type"], found["position"]
    assert {1, 2, 3} <= set(kinds.tolist())
    for kind, name in ((2, "paddle"), (3, "raft")):
        middle, angle = found[f"solids/{name}/position"], found[f"solids/{name}/rotation"]
        assert np.ptp(middle[:, 1]) > 1e-4
        c, s = np.cos(angle - angle[0]), np.sin(angle - angle[0])
        for k in np.flatnonzero(kinds == kind):
            x, y = (places[0, k] - middle[0]).T
            turned = np.stack([c * x - s * y, s * x + c * y], axis=-1)
            np.testing.assert_allclose(places[:, k], middle + turned, atol=1e-12)
    assert np.ptp(found["solids/paddle/rotation"]) == pytest.approx(0.06, rel=1e-6)
    assert (np.ptp(places[:, kinds == 1], axis=0) == 0.0).all()


def test_positions_have_bounds_from_zero_on():
    """Below them a run is refused; above them, as over the rim of a cup, they are as far as the fluid goes."""
    origin, size, periods = datasets.bounds_of(simulation().scene)
    np.testing.assert_allclose(origin, [-0.3, -0.3])
    np.testing.assert_allclose(size, [1.6, 1.6])
    assert not periods.any()
    made = simulation()
    walls = one_run(made, Sample(table(), 0)).arrays["position"][0, made.particles :]
    assert walls.min() > 0.0 and (walls.max(axis=0) < size).all()
    alone = one_run(made, Sample(table(walls=False), 0)).arrays["position"]
    assert alone.shape == (4, made.particles, 2) and len(walls) == len(made.walls)
    with pytest.raises(InputError, match=r"Particle 1 is 0.2 m below the bounds .* along axis 0 in frame 0"):
        datasets._statistics(np.zeros((1, 2, 2)), np.array([[[0.1, 0.1], [-0.2, 0.1]]]), periods)
    found = datasets._statistics(np.zeros((1, 2, 2)), np.array([[[0.1, 2.0], [0.2, 0.1]]]), periods)
    assert found["upper"] == [0.2, 2.0]


def test_particles_that_would_jump_are_refused():
    """Particles that drains took, and those that emitters have in reserve, rest metres away."""
    tap = {"phase": "water", "outlet": [0.8, 0.3], "radius": 0.1, "flow_rate": 0.1}
    hole = {"shape": "box", "name": "hole", "lower": [0.6, 0.0]}
    column = cortado.Scene(**loads(SCENE), emitter=[tap])
    datasets.bounds_of(column)
    with pytest.raises(InputError, match=r"\[\[drain\]\] is given, but must be left out"):
        datasets.bounds_of(cortado.Scene(**loads(SCENE), drain=[hole]))
    with pytest.raises(InputError, match=r"emitter\[0\] has particles in reserve, .* a length of 1.6 m has room"):
        datasets.bounds_of(column.lasting(time=2.0))


def test_what_crosses_a_period_moves_the_shorter_way():
    positions = np.array([[[0.9, 0.0]], [[1.1, 0.1]], [[-0.5, 0.3]]])
    origin, periods = np.array([-0.5, 0.0]), np.array([2.0, 0.0])
    places = wrapped(positions - origin, periods)
    np.testing.assert_allclose(places[:, 0, 0], [1.4, 1.6, 0.0], atol=1e-15)
    np.testing.assert_array_equal(places[:, 0, 1], positions[:, 0, 1])
    for one in (positions, places):
        found = datasets._statistics(one, places, periods)
        np.testing.assert_allclose(found["vel"][1], [0.6, 0.3], atol=1e-12)
        np.testing.assert_allclose(found["acc"][1], [0.2, 0.1], atol=1e-12)


# ---- the command -------------------------------------------------------------------------------------------------
def arrays_of(path):
    """All arrays of a file by their names."""
    found = {}
    with h5py.File(path) as whole:
        whole.visititems(lambda name, one: found.update({name: one[()]}) if isinstance(one, h5py.Dataset) else None)
    return found


def test_a_data_set_has_the_layout_of_lagrangebench(file, tmp_path, monkeypatch, cortado_command):
    """Of fluids that begin on a lattice: packing them, which takes most of the time, changes nothing of it."""
    monkeypatch.setattr(Packing, "packed", lambda self, particles, stays: (particles, np.arange(len(particles))))
    code, out, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 0, err
    assert out == f"The data set is in {tmp_path / 'data'}: 4 frames each, 3 to train, 1 to validate, 1 to test.\n"
    names = {"train.h5", "valid.h5", "test.h5", "metadata.json", "dataset.json"}
    assert {one.name for one in (tmp_path / "data").iterdir()} == names
    content = json.loads((tmp_path / "data" / "metadata.json").read_text())
    train = arrays_of("data/train.h5")
    assert {name.split("/")[0] for name in train} == {"00000", "00001", "00002"}
    moved = []
    for k, number in enumerate([0, 3, 4]):
        kinds, positions = train[f"{k:05d}/particle_type"], train[f"{k:05d}/position"]
        assert positions.shape == (4, len(kinds), 2) and positions.dtype == np.float32
        assert train[f"{k:05d}/velocity"].shape == (4, (kinds == 0).sum(), 2)
        assert len(kinds) <= content["num_particles_max"]
        values = Sample(command._table(file, []), number).values
        np.testing.assert_array_equal(train[f"{k:05d}/vary/fluid.0.upper"], values["fluid.0.upper"])
        moved.append(np.diff(positions[:, kinds == 0].astype(float), axis=0))
    velocities, accelerations = moved, [np.diff(one, axis=0) for one in moved]
    for name, parts in (("vel", velocities), ("acc", accelerations)):
        rows = np.concatenate([one.reshape(-1, 2) for one in parts])
        np.testing.assert_allclose(content[f"{name}_mean"], rows.mean(axis=0), atol=1e-8)
        np.testing.assert_allclose(content[f"{name}_std"], rows.std(axis=0), rtol=1e-4)
    assert content["periodic_boundary_conditions"] == [False, False] and np.allclose(content["origin"], [-0.3, -0.3])
    np.testing.assert_allclose(content["bounds"], [[0.0, 1.6], [0.0, 1.6]])
    wanted = {"dim": 2, "dx": 0.1, "dt": 0.004, "write_every": 2, "num_trajs_train": 3, "sequence_length_train": 4}
    assert {key: content[key] for key in wanted} == wanted
    again = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert again[0] == 0 and "is complete already: 4 frames each, 3 to train" in again[1]


@pytest.fixture
def quick(monkeypatch):
    """Runs that move no particle, of which some may do something else, by their numbers."""
    others = {}

    def made(simulation, sample):
        made.asked.append(sample.number)
        if sample.number in others:
            raise others[sample.number]
        rows = np.full((4, 300, 2), float(sample.number))
        moments = [9, [1.0, 2.0], [3.0, 4.0]]
        ends = {"upper": [1.0, 1.0], "particles": 300}
        arrays = {"position": rows, "particle_type": np.zeros(300)}
        return datasets.OneRun(arrays, {"vel": moments, "acc": moments, **ends})

    made.asked = []
    monkeypatch.setattr("cortado.optimisation.datasets.one_run", made)
    monkeypatch.setattr(command, "Simulation", lambda *_: None)
    made.others = others
    return made


def test_runs_that_fail_are_left_out_and_said(file, cortado_command, quick):
    quick.others[3] = DivergedError(3, 7, "take a smaller time step")
    code, out, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 0 and "2 to train, 1 to validate, 1 to test" in out
    assert "1 of 5 runs failed and are left out. The first is run 3: The simulation diverged in step 3" in err
    train = arrays_of("data/train.h5")
    assert [train[f"0000{k}/position"][0, 0, 0] for k in range(2)] == [0.0, 4.0]
    quick.others |= dict.fromkeys([0, 3, 4], InputError("no fluid fits."))
    code, _, err = cortado_command("dataset", file, "--runs", 5, "--out", "none")
    assert code == 1 and "None of the runs for train could be computed. The first: no fluid fits." in err


@pytest.mark.parametrize(("size", "there"), [(15_000, 0), (50_000, 5), (None, 5)])
def test_a_full_disk_is_a_sentence_and_keeps_what_is_there(size, there, file, cortado_command, quick, monkeypatch):
    """Full at the first run, in the midst of the file of all of them, and before it."""
    with monkeypatch.context() as patch, largest_file(size) if size else nullcontext():
        if not size:
            patch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=100))
        code, _, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 1 and "free some space" in err and err.count("\n") == 1
    assert f"{there} of 5 runs are finished" in err
    quick.asked.clear()
    assert cortado_command("dataset", file, "--runs", 5, "--out", "data")[0] == 0
    assert len(quick.asked) == 5 - there and not Path("data/runs").exists()


def varied(key, lower, upper, more=("dataset.logarithmic=[]",)):
    return [word for one in (f'dataset.vary={{"{key}"=[{lower},{upper}]}}', *more) for word in ("--set", one)]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--out", "data.h5"), "--out is data.h5, but must be a folder"),
        (("--runs", 2), "--runs is 2, but must be from 3 to 100,000: one to train and one to validate"),
        (("--set", "dataset.write_every=4"), "dataset.write_every is 4, but must be a divisor of steps, which is 6"),
        (varied("solver.time_step", 0.001, 0.002), "vary has solver.time_step, which must be the same"),
        (varied("picture.film_speed", 0.1, 0.2), "vary has picture.film_speed, which has no effect on what is com"),
        (("--set", "problem.steps=3"), "problem.steps is given, but must be left out"),
        (varied("phase.oil.viscosity", 0.1, 0.2), "oil"),
        (varied("phase.0.viscosity", 0.2, 0.1, ()), "dataset.vary.'phase.0.viscosity' is [0.2, 0.1], but must"),
        (("--set", "solver.time_step=auto"), "a data set"),
    ],
)
def test_wrong_calls_are_sentences(file, change, words, cortado_command, quick):
    Path("plain.toml").write_text(SCENE)
    for arguments, said in (((file, *change), words), (("plain.toml",), "plain.toml: dataset is missing, but must be")):
        code, _, err = cortado_command("dataset", *arguments)
        assert code == 2 and said in err and err.count("\n") == 1
    assert not quick.asked


def test_a_folder_of_something_else_is_kept(file, tmp_path, cortado_command, quick):
    assert cortado_command("dataset", file, "--runs", 5, "--out", "data")[0] == 0
    for change, words in (
        (("--runs", 4), "--runs is 4, but must be at least 5: data contains as many"),
        (("--runs", 9, "--set", "dataset.seed=1"), "columns.toml: dataset.seed is 1, but must be 0, as in the data"),
        (("--runs", 5, "--precision", "float64"), "--precision is 'float64', but must be 'float32', as in"),
        (("--runs", 5, "--set", "phase.0.rest_density=900.0"), "phase.0.rest_density is 900.0, but must be 1000.0, as"),
    ):
        code, _, err = cortado_command("dataset", file, *change, "--out", "data")
        assert code == 2 and words in err and err.count("\n") == 1
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    code, _, err = cortado_command("dataset", file, "--out", "mine")
    assert code == 2 and "holds notes.txt, but no data set" in err


# ---- growing -----------------------------------------------------------------------------------------------------
def content_of(folder):
    """All arrays and metadata of a data set, with the attributes of its runs."""
    found = {"metadata": json.loads((Path(folder) / "metadata.json").read_text())}
    for purpose in ("train", "valid", "test"):
        found |= {f"{purpose}/{name}": one for name, one in arrays_of(f"{folder}/{purpose}.h5").items()}
        with h5py.File(f"{folder}/{purpose}.h5") as whole:
            found |= {f"{purpose}/{name}": dict(one.attrs) for name, one in whole.items()}
    return found


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        if isinstance(value, np.ndarray):
            assert value.dtype == other[name].dtype and value.tobytes() == other[name].tobytes(), name
        else:
            assert value == other[name], name


def test_a_data_set_that_grows_is_the_one_made_at_once_and_keeps_its_runs(file, cortado_command, monkeypatch):
    """Made with 5 runs and then 11, or with 11; of these runs one fails. All have one box of fluid, which is quick."""
    asked, whole, again = [], one_run, ("dataset", file, *varied("phase.water.viscosity", 0.1, 10.0, ()))

    def made(simulation, sample):
        asked.append(sample.number)
        if sample.number == 3:
            raise DivergedError(3, 7, "take a smaller time step")
        return whole(simulation, sample)

    monkeypatch.setattr("cortado.optimisation.datasets.one_run", made)
    assert cortado_command(*again, "--runs", 5, "--out", "grown")[0] == 0
    before = content_of("grown")
    asked.clear()
    code, out, err = cortado_command(*again, "--runs", 11, "--out", "grown")
    assert code == 0 and asked == list(range(5, 11)), err
    assert "its first 5 runs are as they were" in out and "failed" not in err
    after = content_of("grown")
    runs = [name for name in before if name != "metadata"]
    assert_same({name: before[name] for name in runs}, {name: after[name] for name in runs})
    assert cortado_command(*again, "--runs", 11, "--out", "once")[0] == 0
    assert_same(content_of("once"), after)
    assert after["metadata"]["runs"] == 11 and list(after["metadata"]["failed"]) == ["3"]
    counts = [after["metadata"][f"num_trajs_{purpose}"] for purpose in ("train", "valid", "test")]
    assert counts == [6, 2, 2]


def grown(cortado_command, file, runs=11):
    return cortado_command("dataset", file, "--runs", runs, "--out", "data")


STOPS = {
    "in a run": None,
    "as the files are put together": (h5py.File, "copy", KeyboardInterrupt),
    "between two files": (Path, "replace", KeyboardInterrupt),
    "on a full disk": (h5py.File, "copy", RuntimeError),
}


@pytest.mark.parametrize("where", STOPS)
def test_growing_that_was_stopped_goes_on(where, file, cortado_command, quick, monkeypatch):
    assert grown(cortado_command, file, 5)[0] == 0
    before = content_of("data")
    with monkeypatch.context() as patch:
        if where == "in a run":
            quick.others[7] = KeyboardInterrupt()
        else:
            owner, name, error = STOPS[where]
            calls, whole = [], getattr(owner, name)

            def stop(*given):
                calls.append(given)
                if len(calls) == 2:
                    raise error("no space")
                return whole(*given)

            patch.setattr(owner, name, stop)
        code, _, err = grown(cortado_command, file)
    told = ("free some space", 1) if "disk" in where else ("Interrupted; ", 130)
    assert told[0] in err and told[1] == code and f"{7 if where == 'in a run' else 11} of 11 runs are finished" in err
    if where != "between two files":
        assert_same(content_of("data"), before)
    quick.others.clear()
    quick.asked.clear()
    code, _, err = grown(cortado_command, file)
    assert code == 0 and quick.asked == ([7, 8, 9, 10] if where == "in a run" else []), err
    for purpose, numbers in command._table(file, []).split(11).items():
        there = arrays_of(f"data/{purpose}.h5")
        assert [there[f"{k:05d}/position"][0, 0, 0] for k in range(len(numbers))] == numbers
    assert not [one for one in Path("data").iterdir() if one.suffix == ".tmp" or one.name == "runs"]


@pytest.mark.parametrize("harm", ["cut", "gone", "metadata", "part"])
def test_a_half_written_file_is_told_and_mended(harm, file, cortado_command, quick, monkeypatch):
    assert grown(cortado_command, file, 5)[0] == 0
    before = content_of("data")
    path = Path("data/train.h5")
    if harm == "part":
        quick.others[7] = KeyboardInterrupt()
        grown(cortado_command, file)
        quick.others.clear()
        path = Path("data/runs/00005.h5")
    if harm == "metadata":
        path = Path("data/metadata.json")
    content = path.read_bytes()
    path.unlink() if harm == "gone" else path.write_bytes(content[: len(content) // 2])
    quick.asked.clear()
    code, _, err = grown(cortado_command, file, 11 if harm == "part" else 5)
    assert code == 0
    assert quick.asked == {"metadata": [], "part": [5, 7, 8, 9, 10]}.get(harm, [0, 3, 4])
    told = harm != "gone"
    assert (f"{path.absolute()} was damaged" in err) == told == ("has been made anew" in err)
    if harm != "part":
        assert_same(content_of("data"), before)
    assert "is complete already" in grown(cortado_command, file, 11 if harm == "part" else 5)[1]


def test_a_file_of_the_scene_with_another_content_is_another_scene(tmp_path, monkeypatch, cortado_command, quick):
    monkeypatch.chdir(tmp_path)
    points = np.stack(np.meshgrid([0.15, 0.25], [0.15, 0.25]), axis=-1).reshape(-1, 2)
    np.save("points.npy", points)
    box = 'shape = "box", lower = [0.0, 0.0], upper = [0.4, 0.4]'
    given = TABLE.replace('vary."fluid.0.upper" = [[0.3, 0.3], [0.5, 0.6]]', "")
    Path("points.toml").write_text(SCENE.replace(box, 'shape = "points", file = "points.npy"') + given)
    assert grown(cortado_command, "points.toml", 5)[0] == 0
    np.save("points.npy", points + 0.01)
    code, _, err = grown(cortado_command, "points.toml")
    assert code == 2 and "points.toml: fluid.0.file content is '" in err and "choose another --out" in err


LAGRANGEBENCH = Path(__file__).parents[1] / "build" / "lagrangebench" / "bin" / "python"


@pytest.mark.parametrize("periodic", [False, True])
def test_lagrangebench_reads_a_data_set_that_has_grown(periodic, file, cortado_command):
    """Its windows, its searches for neighbours against all distances, its normalisation and its integrator."""
    if not LAGRANGEBENCH.exists():
        pytest.skip("LagrangeBench has no Python of its own")
    if periodic:
        words = SCENE.replace("upper = [1.0, 1.0] }", "upper = [1.0, 1.0], periodic = [true, false] }")
        given = TABLE.replace("[[0.3, 0.3], [0.5, 0.6]]", "[[1.0, 0.3], [1.0, 0.6]]")
        Path(file).write_text(words.replace("[solver]", "forces = { gravity = [20.0, -9.81] }\n[solver]") + given)
    for runs in (3, 6):
        code, _, err = cortado_command("dataset", file, "--runs", runs, "--out", "data", "--set", "dataset.steps=20")
        assert code == 0, err
    program = Path(__file__).with_name("lagrangebench_reader.py")
    done = subprocess.run([LAGRANGEBENCH, program, "data"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["windows"] == {"train": 4 * 9, "valid": 3, "test": 3} and found["types"] == [0, 1]
    assert found["wrong_pairs"] == {"jaxmd_vmap": 0, "jaxmd_scan": 0, "matscipy": 0}
    for name in ("vel", "acc"):
        np.testing.assert_allclose(found[name]["mean"], 0.0, atol=1e-4)
        np.testing.assert_allclose(found[name]["std"], 1.0, atol=1e-4)
    assert found["step_off"] < 1e-6


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"vary": {}, "velocity_noise": 0.0}, "vary"),
        ({"logarithmic": ("viscosity",)}, "logarithmic"),
        ({"vary": {"a": [-1.0, 1.0]}, "logarithmic": ("a",)}, "vary.a"),
        ({"vary": {"a": [0.0, np.nan]}}, "vary.a"),
        ({"vary": {"a": {"b": [0.0, 1.0]}}}, "vary.a"),
        ({"valid": 0.6, "test": 0.5}, "test"),
        ({"steps": 0}, "steps"),
    ],
)
def test_wrong_tables_are_sentences(changes, field):
    with pytest.raises(SceneError) as caught:
        table(**changes)
    assert caught.value.field == field and "\n" not in str(caught.value)
