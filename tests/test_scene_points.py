"""Files that a scene is made of: positions, and hostile TOML; a sentence where they cannot be used."""

import os
import struct
import time

import numpy as np
import pytest

from bad_scenes import GOOD_SCENE, assert_one_sentence, one_sentence, plane
from cortado import InputError, Scene, SceneError, load_scene
from cortado.files.vtkhdf import TrajectoryWriter
from cortado.scene.point_files import read_points
from cortado.scene.scene import MOST_BYTES, read_toml


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


@pytest.mark.parametrize(
    "suffix, writer", [(".vtk", "vtkPolyDataWriter"), (".vtp", "vtkXMLPolyDataWriter"), (".vtkhdf", "vtkHDFWriter")]
)
def test_positions_are_read_from_vtk(tmp_path, suffix, writer):
    vtk, wanted, file = pytest.importorskip("vtk"), [[0.0, 0.0], [0.5, 0.25], [0.25, 0.125]], tmp_path / f"drop{suffix}"
    points, data, writer = vtk.vtkPoints(), vtk.vtkPolyData(), getattr(vtk, writer)()
    points.SetDataTypeToDouble()
    for x, y in wanted:
        points.InsertNextPoint(x, y, 0.0)
    data.SetPoints(points)
    writer.SetFileName(str(file))
    writer.SetInputData(data)
    writer.Write()
    np.testing.assert_allclose(drop(file).fluid[0].particles(0.1), wanted, atol=1e-12)
    np.testing.assert_allclose(read_points(str(file), 3), np.pad(wanted, ((0, 0), (0, 1))), atol=1e-12)


def drop(file):
    return Scene(**plane(fluid=[{"shape": "points", "file": str(file), "phase": "water"}]))


def test_bad_positions_are_a_sentence(tmp_path):
    for array, trouble in [
        (np.zeros(3), "shape"),
        (np.zeros((4, 3)), "shape"),
        (np.zeros((0, 2)), "cannot be used"),
        (np.array([["a", "b"]]), "shape"),
        (np.array([[0.0, np.nan]]), "finite"),
        (np.array([[None, 1.0]], dtype=object), "object of shape"),
        (np.zeros((1000, 2)), "overlapping itself"),
        (np.array([[0.0, 0.0], [0.0, 0.04], [0.0, 1.0]]), "overlapping itself"),
        (np.array([[0.0, 1e20]]), "origin"),
    ]:
        np.save(tmp_path / "bad.npy", array)
        with one_sentence(trouble, error=SceneError):
            drop(tmp_path / "bad.npy")


def test_files_of_rubbish_are_a_sentence(tmp_path, capfd):
    for name in ["bad.npy", "bad.vtk", "bad.vtp", "bad.vtkhdf"]:
        (tmp_path / name).write_bytes(b"rubbish\n\x00\xff")
        with one_sentence("cannot be used", error=SceneError):
            drop(tmp_path / name)
        assert capfd.readouterr().err == ""


def npy(header: str, numbers: int = 2) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(8 * numbers)


def header(shape: str, kind: str = "'<f8'") -> str:
    return f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}"


@pytest.mark.parametrize(
    "content, words",
    [
        (npy(header("(5, 2)")), r"says that it holds float64 of shape \(5, 2\), which takes 147 bytes, but it has 83"),
        (npy(header("(1000000000000, 2)")), "holds 1000000000000 points, but must hold at most"),
        (npy(header("(-1, 2)")), r"shape \(-1, 2\), but must hold numbers of shape \(n, 2\)"),
        (npy(header("(1, 2)", "'<c16'")), "holds complex128"),
        (npy(header("(1, 2)", "[('x', '<f8')]")), "but must hold numbers"),
        (npy(header("(1, 2)", "'\\q'")), "no array that NumPy can read"),
        (npy("[" * 60_000), "no array that NumPy can read"),
        (npy("-" * 9_000 + "1"), "no array that NumPy can read"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{", "no array that NumPy can read"),
        (b"", "no array that NumPy can read"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_an_array_whose_header_lies_is_a_sentence(tmp_path, content, words):
    (tmp_path / "a.npy").write_bytes(content)
    with one_sentence(words):
        read_points(str(tmp_path / "a.npy"), 2)


def test_arrays_by_columns_and_of_other_types_are_read(tmp_path):
    wanted = np.arange(12.0).reshape(4, 3)
    for k, array in enumerate((np.asfortranarray(wanted), wanted.astype(">f4"), wanted.astype(np.int16))):
        np.save(tmp_path / f"{k}.npy", array)
        np.testing.assert_array_equal(read_points(str(tmp_path / f"{k}.npy"), 3), wanted)


LEGACY = b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n"
POLY_DATA = """<VTKFile type="PolyData" version="1.0"><PolyData><Piece NumberOfPoints="100000000000"><Points>
<DataArray type="Float64" NumberOfComponents="3" format="ascii">1 2 3</DataArray></Points></Piece></PolyData></VTKFile>
"""


def test_what_ends_vtk_is_a_sentence(tmp_path, capfd):
    """Some of these take the process with them that reads them."""
    for name, content in [
        ("much.vtp", POLY_DATA.encode()),
        ("much.vtk", LEGACY + b"POINTS 100000000000 double\n1 2 3\n"),
        ("bytes.vtk", LEGACY + b"POINTS 2 \xff\xfe\n1 0 1 0 1 0\n"),
    ]:
        pytest.importorskip("vtkmodules")
        (tmp_path / name).write_bytes(content)
        with one_sentence("holds no points that"):
            read_points(str(tmp_path / name), 3)
        assert capfd.readouterr().err == ""


def test_the_first_frame_of_a_trajectory_is_read_and_a_damaged_one_is_a_sentence(tmp_path, capfd):
    first, path = np.random.default_rng(2).random((40, 2)), tmp_path / "run.vtkhdf"
    with TrajectoryWriter(path, times=[0.0, 0.1, 0.2], particles=40, dimension=2, precision="float64") as writer:
        for k in range(3):
            writer.append(first + k, first)
    np.testing.assert_array_equal(read_points(str(path), 2), first)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[whole.index(first[7].tobytes()) + 6] ^= 0x10
    damaged = {
        "cut": (whole[: len(whole) // 2], "holds no points that can be read; it may be damaged"),
        "names": (whole.replace(b"NumberOfPoints", b"NumberOfJoints"), "is a damaged trajectory"),
        "numbers": (flipped, "is a damaged trajectory, or one of another version of Cortado"),
    }
    for name, (content, words) in damaged.items():
        (tmp_path / f"{name}.vtkhdf").write_bytes(content)
        with pytest.raises(InputError, match=words):
            read_points(str(tmp_path / f"{name}.vtkhdf"), 2)
    assert capfd.readouterr().err == ""


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.npy")
    (tmp_path / "zero.vtp").symlink_to("/dev/zero")
    for name, words in (("pipe.npy", "it is a pipe"), ("zero.vtp", "it is a device")):
        with pytest.raises(InputError, match=rf"cannot be opened \({words}, but must be a regular file\)"):
            read_points(str(tmp_path / name), 3)


def test_a_file_that_takes_for_ever_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("cortado.scene.point_files.SECONDS", 0.01)
    (tmp_path / "a.vtk").write_bytes(LEGACY)
    with pytest.raises(InputError, match="was not read within 0 s; it may be damaged"):
        read_points(str(tmp_path / "a.vtk"), 3)


DEEP = "a." * 30_000 + "b"


def test_a_key_of_very_many_parts_is_refused_at_once(tmp_path):
    for text in [
        f"{DEEP} = 1",
        f"[{DEEP}]",
        f"x = {{ {DEEP} = 1 }}",
        "'a' . " * 30_000 + "b = 1",
        f'y = {{ a = """\n\'""", {DEEP} = 1 }}',
        f'y = {{ a = """x"""", {DEEP} = 1 }}',
    ]:
        path = tmp_path / "deep.toml"
        path.write_text(text)
        begin = time.monotonic()
        with pytest.raises(SceneError, match="has a key of more than 10 parts") as caught:
            read_toml(path)
        assert time.monotonic() - begin < 5.0
        assert_one_sentence(str(caught.value))


def test_a_mark_of_notepad_is_left_out(tmp_path):
    (tmp_path / "scene.toml").write_bytes("name = 'Tasse à café'".encode("utf-8-sig"))
    assert read_toml(tmp_path / "scene.toml") == {"name": "Tasse à café"}


def test_an_entry_is_called_by_its_name(tmp_path):
    (tmp_path / "scene.toml").write_text('[[phase]]\nname = "water"\n[[phase]]\nname = "oil"\n')
    data = read_toml(tmp_path / "scene.toml", ["phase.oil.viscosity=0.1"])
    assert data["phase"] == [{"name": "water"}, {"name": "oil", "viscosity": 0.1}]
    for unknown in ("milk", "2"):
        words = f"is '{unknown}', but must be an index from 0 to 1, or the name water or oil"
        with pytest.raises(SceneError, match=words):
            read_toml(tmp_path / "scene.toml", [f"phase.{unknown}.viscosity=0.1"])


def test_large_files_and_pipes_are_not_read(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"")
    os.truncate(path, MOST_BYTES + 1)
    with pytest.raises(SceneError, match="cannot be read: it has 1,000,001 bytes, but must have at most 1,000,000"):
        read_toml(path)
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(SceneError, match="scene cannot be read: it is a pipe, but must be a regular file"):
        read_toml(tmp_path / "pipe.toml")
    path.write_text("[fluid]\nshape = 'box'\n[fluid]\nshape = 'box'\n")
    with pytest.raises(SceneError, match=r"twice; entries of a list are written \[\[fluid\]\] \(at line 3"):
        read_toml(path)


def test_dots_elsewhere_are_no_parts(tmp_path):
    for text in ["# 1.2.3.4.5.6.7.8.9.10.11.12", 'x = "1.2.3.4.5.6.7.8.9.10.11.12"', "x = [1.5, 2.5]"]:
        (tmp_path / "fine.toml").write_text(text * 2 if text[0] == "#" else text)
        read_toml(tmp_path / "fine.toml")


def test_hostile_overrides_are_sentences(tmp_path):
    """And short ones, which do not repeat them."""
    for override, words in [
        (f"{DEEP}=1", "has a key of more than 10 parts"),
        (f"x={{{DEEP}=1}}", "has a key of more than 10 parts"),
        ("x" + "[0]" * 3000 + "=1", "has a key of more than 10 parts"),
        (f"fluid[{'9' * 5000}].file=1", "an index from 0 to 0"),
        (f"x={'[' * MOST_BYTES}", "an override must have at most 1000000"),
        (".=" + "é" * 5000, "is not an override of the form key=value"),
    ]:
        (tmp_path / "scene.toml").write_text("[[fluid]]")
        with one_sentence(words, error=SceneError) as caught:
            read_toml(tmp_path / "scene.toml", [override])
        assert len(str(caught.value)) < 300 + len(str(tmp_path))
