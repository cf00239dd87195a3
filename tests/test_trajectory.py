"""Trajectories on disk: what is saved comes back, VTK sees it, and a killed writer leaves its frames."""

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

from cortado.errors import CortadoError, InputError
from cortado.trajectory import Trajectory
from cortado.vtkhdf import TrajectoryWriter, read

WRITER = """
import sys
import numpy as np
from cortado.vtkhdf import TrajectoryWriter

rows = np.arange(50.0)[:, None] * np.ones(3)
with TrajectoryWriter(sys.argv[1], frames=100_000, particles=50, dimension=3, steps=100_000) as writer:
    for k in range(100_000):
        writer.append_steps(k, 0.5 * k)
        writer.append(0.25 * k, rows + k, rows - k, step=k + 1)
"""


def example(dimension: int, dtype: type = np.float64) -> Trajectory:
    generator = np.random.default_rng(7)
    positions, velocities = generator.normal(size=(2, 4, 6, dimension)).astype(dtype)
    return Trajectory(
        times=np.array([0.0, 0.1, 0.2, 0.25]),
        steps=np.array([0, 2, 4, 5]),
        positions=positions,
        velocities=velocities,
        iterations=np.array([5, 4, 3, 9, 2]),
        density_errors=np.array([0.1, 0.02, 0.03, 0.2, 0.01]),
        converged=np.array([True, True, True, False, True]),
    )


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


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_saved_trajectory_comes_back(tmp_path, dimension, dtype):
    saved = example(dimension, dtype)
    saved.save(tmp_path / "a.vtkhdf")
    loaded = Trajectory.load(tmp_path / "a.vtkhdf")
    for name, values in vars(saved).items():
        np.testing.assert_array_equal(getattr(loaded, name), values, err_msg=name)
    assert loaded.positions.dtype == dtype
    assert (loaded.dimension, loaded.particles, loaded.not_converged) == (dimension, 6, 1)
    assert os.listdir(tmp_path) == ["a.vtkhdf"]


@pytest.mark.parametrize("dimension", [2, 3])
def test_vtk_sees_every_frame(tmp_path, dimension):
    saved = example(dimension)
    saved.save(tmp_path / "a.vtkhdf")
    times, frames = frames_seen_by_vtk(tmp_path / "a.vtkhdf")
    assert times == saved.times.tolist() and len(frames) == 4
    for k, (points, velocities, vertices) in enumerate(frames):
        np.testing.assert_array_equal(points[:, :dimension], saved.positions[k])
        np.testing.assert_array_equal(velocities[:, :dimension], saved.velocities[k])
        assert not points[:, dimension:].any() and vertices == 6


def test_file_can_be_read_while_it_grows(tmp_path):
    rows = np.ones((5, 2))
    with TrajectoryWriter(
        tmp_path / "a.vtkhdf", frames=9, particles=5, dimension=2, precision="float64", scalars=["density"]
    ) as writer:
        assert not (tmp_path / "a.vtkhdf").exists()
        for k in range(3):
            writer.append(k, k * rows, rows, density=1000.0 + np.arange(5) + k)
            arrays = read(tmp_path / "a.vtkhdf")
            assert arrays["times"].tolist() == list(range(k + 1)) == arrays["steps"].tolist()
            assert arrays["positions"].shape == (k + 1, 5, 2)
            np.testing.assert_array_equal(arrays["positions"][k], k * rows)
            np.testing.assert_array_equal(arrays["density"][k], 1000.0 + np.arange(5) + k)
            assert len(frames_seen_by_vtk(tmp_path / "a.vtkhdf")[1]) == k + 1


def test_killed_writer_leaves_its_frames(tmp_path):
    paths = [tmp_path / f"{k}.vtkhdf" for k in range(8)]
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
        assert len(arrays["iterations"]) in (frames, frames + 1)
        np.testing.assert_array_equal(arrays["density_errors"], 0.5 * arrays["iterations"])

        with h5py.File(path) as file:
            assert file["VTKHDF/Steps"].attrs["NSteps"] == frames
        chosen = sorted({0, frames // 2, frames - 1})
        times, seen = frames_seen_by_vtk(path, chosen)
        assert len(times) == frames or frames == 1
        for k, (points, velocities, vertices) in zip(chosen, seen, strict=True):
            np.testing.assert_array_equal(points, rows + k)
            np.testing.assert_array_equal(velocities, rows - k)
            assert vertices == 50


def test_unfinished_file_stays_small_on_disk(tmp_path):
    with TrajectoryWriter(tmp_path / "a.vtkhdf", frames=1000, particles=10_000, dimension=3) as writer:
        writer.append(0.0, np.ones((10_000, 3)), np.ones((10_000, 3)))
        assert (tmp_path / "a.vtkhdf").stat().st_blocks * 512 < 2e6


def test_missing_foreign_and_damaged_files_are_sentences(tmp_path):
    good, foreign, text, cut = (tmp_path / name for name in ("good", "foreign", "text", "cut"))
    example(3).save(good)
    with h5py.File(foreign, "w") as file:
        file["x"] = 1.0
    text.write_text("not a trajectory")
    cut.write_bytes(good.read_bytes()[:3000])
    for path, words in {
        tmp_path / "absent": "no trajectory file",
        tmp_path: "no trajectory file",
        foreign: "not a trajectory that Cortado wrote",
        text: "cannot be read",
        cut: "cannot be read",
    }.items():
        with pytest.raises(InputError, match=words):
            Trajectory.load(path)


def test_any_damaged_byte_gives_arrays_or_an_input_error(tmp_path):
    example(2).save(tmp_path / "good")
    content = (tmp_path / "good").read_bytes()
    generator = random.Random(3)
    for _ in range(100):
        damaged = bytearray(content)
        damaged[generator.randrange(len(damaged))] ^= 1 << generator.randrange(8)
        (tmp_path / "bad").write_bytes(damaged)
        try:
            Trajectory.load(tmp_path / "bad")
        except CortadoError as problem:
            assert "\n" not in str(problem)


def test_writer_refuses_what_was_not_announced(tmp_path):
    rows = np.zeros((3, 2))
    with pytest.raises(InputError, match="cannot be written"):
        TrajectoryWriter(tmp_path / "no" / "a", frames=1, particles=3, dimension=2)
    with pytest.raises(InputError, match="at least 1 frame"):
        TrajectoryWriter(tmp_path / "a", frames=0, particles=3, dimension=2)
    with TrajectoryWriter(tmp_path / "a", frames=1, particles=3, dimension=2, steps=1) as writer:
        with pytest.raises(InputError, match=r"positions of shape \(3, 2\)"):
            writer.append(0.0, np.zeros((3, 3)), rows)
        with pytest.raises(InputError, match="pressure"):
            writer.append(0.0, rows, rows, pressure=np.zeros(3))
        writer.append(0.0, rows, rows)
        with pytest.raises(InputError, match="1 frames, and one more"):
            writer.append(0.1, rows, rows)
        with pytest.raises(InputError, match="1 steps, and 2 came"):
            writer.append_steps([5, 5], [0.1, 0.1])
    with TrajectoryWriter(tmp_path / "b", frames=1, particles=3, dimension=2):
        pass
    assert os.listdir(tmp_path) == ["a"]
