"""Positions from files: read from where the scene is, and a sentence where they cannot be used."""

import numpy as np
import pytest

from bad_scenes import GOOD_SCENE, assert_one_sentence, plane
from cortado.errors import SceneError
from cortado.scene import Scene, load_scene


def test_positions_are_read_from_beside_the_scene(tmp_path, monkeypatch):
    scene_file = tmp_path / "scene.toml"
    scene_file.write_text(GOOD_SCENE)
    points = np.array([[0.1, 0.4, 0.1], [0.2, 0.45, 0.1], [0.2, 0.45, 0.15]])
    np.save(tmp_path / "drop.npy", points)
    monkeypatch.chdir("/")
    scene = load_scene(scene_file, ['fluid.1={shape="points", file="drop.npy", phase="water"}'])
    np.testing.assert_array_equal(scene.fluid[1].particles(0.05), points)
    np.testing.assert_array_equal(Scene.from_json(scene.to_json()).fluid[1].particles(0.05), points)
    np.save(tmp_path / "drop.npy", points[:2])  # a file that changes is read again
    assert len(scene.fluid[1].particles(0.05)) == 2


@pytest.mark.parametrize("suffix", [".vtk", ".vtp"])
def test_positions_are_read_from_vtk(tmp_path, suffix):
    vtk = pytest.importorskip("vtk")
    points, data = vtk.vtkPoints(), vtk.vtkPolyData()
    points.SetDataTypeToDouble()
    for x in (0.0, 0.1, 0.25):
        points.InsertNextPoint(x, 0.5 * x, 0.0)
    data.SetPoints(points)
    writer = vtk.vtkPolyDataWriter() if suffix == ".vtk" else vtk.vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / f"drop{suffix}"))
    writer.SetInputData(data)
    writer.Write()
    fluid = {"shape": "points", "file": str(tmp_path / f"drop{suffix}"), "phase": "water"}
    particles = Scene(**plane(fluid=[fluid])).fluid[0].particles(0.1)
    np.testing.assert_allclose(particles, [[0.0, 0.0], [0.1, 0.05], [0.25, 0.125]], atol=1e-12)


@pytest.mark.parametrize(
    "array, trouble",
    [
        (np.zeros(3), "shape"),
        (np.zeros((4, 3)), "shape"),
        (np.zeros((0, 2)), "cannot be used"),
        (np.array([["a", "b"]]), "shape"),
        (np.array([[0.0, np.nan]]), "finite"),
        (np.array([[None, 1.0]], dtype=object), "NumPy"),
        (np.zeros((1000, 2)), "overlapping itself"),
        (np.array([[0.0, 0.0], [0.0, 0.04], [0.0, 1.0]]), "overlapping itself"),
        (np.array([[0.0, 1e20]]), "origin"),
    ],
)
def test_bad_positions_are_a_sentence(tmp_path, array, trouble):
    np.save(tmp_path / "bad.npy", array)
    fluid = {"shape": "points", "file": str(tmp_path / "bad.npy"), "phase": "water"}
    with pytest.raises(SceneError, match=trouble) as caught:
        Scene(**plane(fluid=[fluid]))
    assert_one_sentence(str(caught.value))


@pytest.mark.parametrize("name", ["bad.npy", "bad.vtk", "bad.vtp", "bad.vtkhdf"])
def test_files_of_rubbish_are_a_sentence(tmp_path, name, capfd):
    (tmp_path / name).write_bytes(b"rubbish\n\x00\xff")
    fluid = {"shape": "points", "file": str(tmp_path / name), "phase": "water"}
    with pytest.raises(SceneError, match="cannot be used") as caught:
        Scene(**plane(fluid=[fluid]))
    assert_one_sentence(str(caught.value))
    assert capfd.readouterr().err == ""
