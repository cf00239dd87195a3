"""Trajectories on disk: what is saved comes back, VTK sees it, and a killed writer leaves its frames."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

import cortado.files.vtkhdf
from cortado import ComputationError, InputError, Trajectory
from cortado.files.vtkhdf import TrajectoryWriter, read
from full_disk import largest_file

WRITER = """
import sys
import numpy as np
from cortado.files.vtkhdf import TrajectoryWriter

rows = np.arange(50.0)[:, None] * np.ones(3)
times = 0.25 * np.arange(100_000)
options = {"others": {"emitted": np.zeros(1)}, "diagnostics": {"iterations": int, "density_errors": float}}
with TrajectoryWriter(sys.argv[1], times=times, particles=50, dimension=3, steps=100_000, **options) as writer:
    for k in range(100_000):
        writer.append_steps(iterations=k, density_errors=0.5 * k)
        writer.append(rows + k, rows - k, step=k + 1, others={"emitted": [0.1 * k]})
"""


def example(dimension: int, dtype: type = np.float64) -> Trajectory:
    generator = np.random.default_rng(7)
    positions, velocities = generator.normal(size=(2, 4, 6, dimension)).astype(dtype)
    diagnostics = {"iterations": [5, 4, 3, 9, 2], "density_errors": [0.1, 0.02, 0.03, 0.2, 0.01]}
    diagnostics["converged"] = [True, True, True, False, True]
    diagnostics = {name: np.array(values) for name, values in diagnostics.items()}
    others, constants = {"emitted": 0.1 * np.arange(4.0)[:, None]}, {"reference_density": np.full(6, 1000.0)}
    times, steps = np.array([0.0, 0.1, 0.2, 0.25]), np.array([0, 2, 4, 5])
    return Trajectory(times, steps, positions, velocities, diagnostics, others=others, constants=constants)


def require_same(found: Trajectory, wanted: Trajectory) -> None:
    """Every array of one is that of the other, also those by name."""
    for name, values in vars(wanted).items():
        if isinstance(values, dict):
            assert getattr(found, name).keys() == values.keys()
        for key, value in values.items() if isinstance(values, dict) else [(None, values)]:
            array = getattr(found, name) if key is None else getattr(found, name)[key]
            np.testing.assert_array_equal(array, value, err_msg=f"{name} {key}")


def frames_seen_by_vtk(path: Path, chosen: list[int] | None = None) -> tuple[list[float], list[tuple]]:
    """Times, and (positions, velocities, number of vertices) of the chosen frames (all when None)."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    assert reader.CanReadFile(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or ()
    frames = []
    for frame in range(reader.GetNumberOfSteps()) if chosen is None else chosen:
        reader.SetStep(frame)
        reader.Update()
        output = reader.GetOutput()
        points = vtk_to_numpy(output.GetPoints().GetData()).copy()
        velocities = vtk_to_numpy(output.GetPointData().GetArray("velocity")).copy()
        frames.append((points, velocities, output.GetNumberOfVerts()))
    return list(times), frames


@pytest.mark.parametrize(("dimension", "dtype"), [(2, np.float32), (3, np.float64)])
def test_saved_trajectory_comes_back(tmp_path, dimension, dtype):
    saved = example(dimension, dtype)
    saved.save(tmp_path / "a.vtkhdf")
    loaded = Trajectory.load(tmp_path / "a.vtkhdf")
    require_same(loaded, saved)
    assert loaded.positions.dtype == dtype
    assert (loaded.dimension, loaded.particles, loaded.not_converged) == (dimension, 6, 1)
    assert os.listdir(tmp_path) == ["a.vtkhdf"]


def test_file_can_be_read_while_it_grows(tmp_path):
    rows, file = np.ones((5, 2)), tmp_path / "a.vtkhdf"
    options = {"particles": 5, "dimension": 2, "precision": "float64", "scalars": ["pressure", "density"]}
    with TrajectoryWriter(file, times=np.arange(9), **options) as writer:
        assert not file.exists()
        for k in range(3):
            writer.append(k * rows, rows, density=1000.0 + np.arange(5) + k, pressure=np.full(5, k))
            arrays = read(file)
            assert arrays["times"].tolist() == list(range(k + 1)) == arrays["steps"].tolist()
            assert arrays["positions"].shape == (k + 1, 5, 2)
            np.testing.assert_array_equal(arrays["positions"][k], k * rows)
            np.testing.assert_array_equal(arrays["density"][k], 1000.0 + np.arange(5) + k)
            np.testing.assert_array_equal(arrays["pressure"][k], np.full(5, k))
            times, frames = frames_seen_by_vtk(file)
            assert times == list(range(9)) and (frames[k][0] == [k, k, 0.0]).all() and (frames[k][1] == [1, 1, 0]).all()
            assert [vertices for *_, vertices in frames] == [5] * (k + 1) + [0] * (8 - k)


def test_killed_writer_leaves_its_frames(tmp_path):
    paths = [tmp_path / f"{k}.vtkhdf" for k in range(3)]
    rows = np.arange(50.0)[:, None] * np.ones(3)
    for path in paths:
        writer = subprocess.Popen([sys.executable, "-c", WRITER, path])
        deadline = time.monotonic() + 20
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.0005)
        time.sleep(random.uniform(0.0, 0.05))
        writer.send_signal(signal.SIGKILL)
        assert writer.wait() == -signal.SIGKILL

        arrays = read(path)
        frames = len(arrays["times"])
        assert 0 < frames < 100_000
        counts = np.arange(frames)
        np.testing.assert_array_equal(arrays["times"], 0.25 * counts)
        np.testing.assert_array_equal(arrays["steps"], counts + 1)
        np.testing.assert_array_equal(arrays["positions"], rows + counts[:, None, None])
        np.testing.assert_array_equal(arrays["velocities"], rows - counts[:, None, None])
        np.testing.assert_array_equal(arrays["others"]["emitted"], 0.1 * counts[:, None])
        iterations, errors = (arrays["diagnostics"][name] for name in ("iterations", "density_errors"))
        assert len(iterations) in (frames, frames + 1)
        np.testing.assert_array_equal(errors, 0.5 * iterations)

        chosen = sorted({0, frames // 2, frames - 1})
        times, seen = frames_seen_by_vtk(path, chosen)
        assert len(times) == 100_000
        for k, (points, velocities, vertices) in zip(chosen, seen, strict=True):
            np.testing.assert_array_equal(points, rows + k)
            np.testing.assert_array_equal(velocities, rows - k)
            assert vertices == 50


def test_unfinished_file_stays_small_on_disk(tmp_path):
    with TrajectoryWriter(tmp_path / "a.vtkhdf", times=np.arange(1000), particles=10_000, dimension=3) as writer:
        writer.append(np.ones((10_000, 3)), np.ones((10_000, 3)))
        assert (tmp_path / "a.vtkhdf").stat().st_blocks * 512 < 2e6


def test_missing_foreign_and_damaged_files_are_sentences(tmp_path):
    good, foreign, text, cut = (tmp_path / name for name in ("good.hdf", "foreign", "text", "cut"))
    example(3).save(good)
    with h5py.File(foreign, "w") as file:
        file["x"] = 1.0
    text.write_text("not a trajectory")
    cut.write_bytes(good.read_bytes()[:3000])
    said = {tmp_path / "absent": "no trajectory file", tmp_path: "no trajectory file"}
    said |= {foreign: "not a trajectory that Cortado wrote", text: "cannot be read", cut: "cannot be read"}
    for path, words in said.items():
        with pytest.raises(InputError, match=words):
            Trajectory.load(path)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_damaged_file_gives_the_same_arrays_or_an_input_error(tmp_path, dimension):
    saved = example(dimension)
    saved.save(tmp_path / "good.vtkhdf")
    content = (tmp_path / "good.vtkhdf").read_bytes()
    generator = random.Random(dimension)
    refused = 0
    for _ in range(200):
        damaged = bytearray(content)
        first, length = generator.randrange(len(content)), generator.choice([1, 1, 1, 4, 8, 64, 512])
        for k in range(first, min(first + length, len(content))):
            damaged[k] = generator.choice([0, 255, generator.randrange(256), damaged[k] ^ 1])
        (tmp_path / "bad").write_bytes(damaged)
        try:
            loaded = Trajectory.load(tmp_path / "bad")
        except InputError as problem:
            refused += 1
            assert "\n" not in str(problem)
            continue
        require_same(loaded, saved)
    assert 25 < refused < 175


@pytest.mark.parametrize("name", ["dimension", "format"])
def test_a_number_that_says_how_to_read_is_covered_too(tmp_path, name):
    example(3).save(tmp_path / "a.vtkhdf")
    with h5py.File(tmp_path / "a.vtkhdf", "r+") as file:
        file["cortado"].attrs[name] -= 1
    with pytest.raises(InputError, match="damaged"):
        read(tmp_path / "a.vtkhdf")


def test_a_disk_without_room_is_a_sentence_before_anything_is_computed(tmp_path):
    options = {"times": np.arange(1000), "dimension": 2, "particles": 1000}
    with largest_file(100_000), pytest.raises(ComputationError, match="a cannot be written: File too large"):
        TrajectoryWriter(tmp_path / "a", **options)
    with pytest.raises(ComputationError, match=r"a needs .* MB for 1000 frames, but .* MB are free"):
        TrajectoryWriter(tmp_path / "a", **options | {"particles": 10**12})
    assert os.listdir(tmp_path) == []


def test_a_disk_that_fills_up_leaves_the_frames_before(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    rows = np.ones((5, 2))
    sizes = {"particles": 5, "dimension": 2, "steps": 9, "diagnostics": {"iterations": int}}
    with TrajectoryWriter(tmp_path / "a", times=np.arange(9), **sizes) as writer:
        writer.append(rows, rows)
        writer.append_steps(iterations=3)
        with monkeypatch.context() as patch:
            patch.setattr(cortado.files.vtkhdf, "write_fully", refuse)
            with pytest.raises(ComputationError, match="No space left on device; the 1 frames so far are kept"):
                writer.append(2 * rows, rows)
            with pytest.raises(ComputationError, match="No space left on device"):
                writer.append_steps(iterations=4)
        writer.append(3 * rows, rows)
        writer.append_steps(iterations=5)
    assert [frame[0, 0] for frame in read(tmp_path / "a")["positions"]] == [1.0, 3.0]
    assert read(tmp_path / "a")["diagnostics"]["iterations"].tolist() == [3, 5]


@pytest.mark.parametrize("name", ["run.npz", "run", "run.mp4"])
def test_a_trajectory_has_the_suffix_of_its_format(name, tmp_path):
    with pytest.raises(InputError, match=r"must be a VTKHDF file, whose name ends in \.vtkhdf or \.hdf\.$"):
        example(2).save(tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_a_frame_is_taken_by_its_number():
    trajectory = example(2)
    assert len(trajectory) == 4
    for k in range(-4, 4):
        frame = trajectory[k]
        np.testing.assert_array_equal(frame.positions, trajectory.positions[k])
        np.testing.assert_array_equal(frame.velocities, trajectory.velocities[k])
        assert (frame.mass_fractions, frame.time) == (None, trajectory.times[k])
    assert trajectory[np.int64(2)].time == 0.2
    assert [frame.time for frame in trajectory] == [*trajectory.times]
    assert [frame.time for frame in reversed(trajectory)] == [*trajectory.times[::-1]]
    with pytest.raises(IndexError, match=r"^There is no frame 4, as the trajectory has 4 frames\.$"):
        trajectory[4]
    with pytest.raises(InputError, match=r"^The number of a frame is 0.5, but must be a whole number or a slice\.$"):
        trajectory[0.5]


@pytest.mark.parametrize("chosen", [slice(1, 3), slice(None, None, 2), slice(-1, None), slice(None, None, -1)])
def test_some_frames_are_a_trajectory(chosen, tmp_path):
    trajectory = example(3)
    some = trajectory[chosen]
    for name in ("times", "steps", "positions", "velocities"):
        np.testing.assert_array_equal(getattr(some, name), getattr(trajectory, name)[chosen])
    np.testing.assert_array_equal(some.others["emitted"], trajectory.others["emitted"][chosen])
    assert some.iterations is trajectory.iterations
    if chosen.step != -1:  # as files go forwards in time
        some.save(tmp_path / "some.vtkhdf")
        np.testing.assert_array_equal(Trajectory.load(tmp_path / "some.vtkhdf").positions, some.positions)
