"""Data sets of varied runs: what is drawn, the layout of LagrangeBench, derivatives, and going on after a kill."""

import json
from contextlib import nullcontext
from pathlib import Path
from tomllib import loads
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import cortado
from cortado import DivergedError, InputError, SceneError, Simulation
from cortado.cli.commands import dataset as command
from cortado.discretise.shapes import wrapped
from cortado.optimisation import datasets
from cortado.optimisation.datasets import DatasetTable, Sample, one_run
from full_disk import largest_file
from scenes import pool_text

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


def test_the_first_runs_train():
    found = table(valid=0.1, test=0.2).split(20)
    assert found == {"train": range(14), "valid": range(14, 16), "test": range(16, 20)}
    assert table(valid=0.0, test=0.01).split(5) == {"train": range(4), "valid": range(4, 4), "test": range(4, 5)}


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


def test_kinds_walls_and_statistics():
    made, sample = simulation("float32"), Sample(table(), 0)
    found = one_run(made, sample)
    fluid, walls = made.particles, len(made.walls)
    assert found.arrays["position"].shape == (4, fluid + walls, 2) and found.arrays["position"].dtype == np.float32
    assert found.arrays["particle_type"].tolist() == [0] * fluid + [1] * walls
    assert (np.ptp(found.arrays["position"][:, fluid:], axis=0) == 0.0).all()
    assert one_run(made, Sample(table(walls=False), 0)).arrays["position"].shape == (4, fluid, 2)
    steps = np.diff(found.arrays["position"][:, :fluid].astype(float), axis=0).reshape(-1, 2)
    count, total, squares = found.statistics["vel"]
    assert count == 3 * fluid
    np.testing.assert_allclose(total, steps.sum(axis=0), rtol=1e-6)
    np.testing.assert_allclose(squares, (steps**2).sum(axis=0), rtol=1e-6)


def test_what_crosses_a_period_moves_the_shorter_way():
    positions = np.array([[[0.9, 0.0]], [[1.1, 0.1]], [[-0.5, 0.3]]])
    origin, periods = np.array([-0.5, 0.0]), np.array([2.0, 0.0])
    places = wrapped(positions - origin, periods)
    np.testing.assert_allclose(places[:, 0, 0], [1.4, 1.6, 0.0], atol=1e-15)
    np.testing.assert_array_equal(places[:, 0, 1], positions[:, 0, 1])
    for one in (positions, places):
        found = datasets._statistics(one, periods)
        np.testing.assert_allclose(found["vel"][1], [0.6, 0.3], atol=1e-12)
        np.testing.assert_allclose(found["acc"][1], [0.2, 0.1], atol=1e-12)


# ---- the command -------------------------------------------------------------------------------------------------


def arrays_of(path):
    """All arrays of a file by their names."""
    found = {}
    with h5py.File(path) as whole:
        whole.visititems(lambda name, one: found.update({name: one[()]}) if isinstance(one, h5py.Dataset) else None)
    return found


def test_a_data_set_has_the_layout_of_lagrangebench(file, tmp_path, cortado_command):
    code, out, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 0, err
    assert out == f"The data set is in {tmp_path / 'data'}: 4 frames each, 3 to train, 1 to validate, 1 to test.\n"
    names = {"train.h5", "valid.h5", "test.h5", "metadata.json", "dataset.json"}
    assert {one.name for one in (tmp_path / "data").iterdir()} == names
    content = json.loads((tmp_path / "data" / "metadata.json").read_text())
    train = arrays_of("data/train.h5")
    assert {name.split("/")[0] for name in train} == {"00000", "00001", "00002"}
    moved = []
    for number in range(3):
        kinds, positions = train[f"{number:05d}/particle_type"], train[f"{number:05d}/position"]
        assert positions.shape == (4, len(kinds), 2) and positions.dtype == np.float32
        assert train[f"{number:05d}/velocity"].shape == (4, (kinds == 0).sum(), 2)
        assert len(kinds) <= content["num_particles_max"]
        values = Sample(command._table(file, []), number).values
        np.testing.assert_array_equal(train[f"{number:05d}/vary/fluid.0.upper"], values["fluid.0.upper"])
        moved.append(np.diff(positions[:, kinds == 0].astype(float), axis=0))
    velocities, accelerations = moved, [np.diff(one, axis=0) for one in moved]
    for name, parts in (("vel", velocities), ("acc", accelerations)):
        rows = np.concatenate([one.reshape(-1, 2) for one in parts])
        np.testing.assert_allclose(content[f"{name}_mean"], rows.mean(axis=0), atol=1e-8)
        np.testing.assert_allclose(content[f"{name}_std"], rows.std(axis=0), rtol=1e-4)
    assert content["bounds"] == [[0.0, 1.0], [0.0, 1.0]] and content["periodic_boundary_conditions"] == [False, False]
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
        ends = {"lower": [0.0, 0.0], "upper": [1.0, 1.0], "particles": 300}
        arrays = {"position": rows, "particle_type": np.zeros(300)}
        return datasets.OneRun(arrays, {"vel": moments, "acc": moments, **ends})

    made.asked = []
    monkeypatch.setattr(command, "one_run", made)
    monkeypatch.setattr(command, "Simulation", lambda *_: None)
    made.others = others
    return made


def test_runs_that_fail_are_left_out_and_said(file, cortado_command, quick):
    quick.others[1] = DivergedError(3, 7, "take a smaller time step")
    code, out, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 0 and "2 to train, 1 to validate, 1 to test" in out
    assert "1 of 5 runs failed and are left out. The first is run 1: The simulation diverged in step 3" in err
    train = arrays_of("data/train.h5")
    assert [train[f"0000{k}/position"][0, 0, 0] for k in range(2)] == [0.0, 2.0]
    quick.others |= dict.fromkeys(range(3), InputError("no fluid fits."))
    code, _, err = cortado_command("dataset", file, "--runs", 5, "--out", "none")
    assert code == 1 and "No run of those for train could be computed. The first: no fluid fits." in err


def test_what_was_killed_goes_on(file, cortado_command, quick):
    quick.others[3] = KeyboardInterrupt()
    code, _, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 130 and "Interrupted; 3 of 5 runs are finished, in" in err
    assert "the same command goes on with the rest." in err
    quick.others.clear()
    quick.asked.clear()
    code, _, err = cortado_command("dataset", file, "--runs", 5, "--out", "data")
    assert code == 0 and quick.asked == [3, 4], err
    assert [arrays_of(f"data/{name}.h5")["00000/position"][0, 0, 0] for name in ("train", "valid", "test")] == [0, 3, 4]


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
        (varied("picture.film_speed", 0.1, 0.2), "vary has picture.film_speed, which changes nothing that is computed"),
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
        (("--runs", 6), "(runs is 5, not 6); choose another --out, as a data set does not grow"),
        (("--runs", 5, "--set", "dataset.seed=1"), "(dataset.seed is 0, not 1)"),
        (("--runs", 5, "--precision", "float64"), "(precision is 'float32', not 'float64')"),
        (("--runs", 5, "--set", "phase.0.rest_density=900.0"), "(scene.phase.0.rest_density is "),
    ):
        code, _, err = cortado_command("dataset", file, *change, "--out", "data")
        assert code == 2 and f"data holds another data set {words}" in err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    code, _, err = cortado_command("dataset", file, "--out", "mine")
    assert code == 2 and "holds notes.txt, but no data set" in err


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"vary": {}, "velocity_noise": 0.0}, "vary"),
        ({"logarithmic": ("viscosity",)}, "logarithmic"),
        ({"vary": {"a": [-1.0, 1.0]}, "logarithmic": ("a",)}, "vary.a"),
        ({"vary": {"a": [0.0, np.nan]}}, "vary.a"),
        ({"vary": {"a": [0.0, [1.0, 2.0]]}}, "vary.a"),
        ({"vary": {"a": {"b": [0.0, 1.0]}}}, "vary.a"),
        ({"valid": 0.6, "test": 0.5}, "test"),
        ({"steps": 0}, "steps"),
    ],
)
def test_wrong_tables_are_sentences(changes, field):
    with pytest.raises(SceneError) as caught:
        table(**changes)
    assert caught.value.field == field and "\n" not in str(caught.value)
