"""Hostile TOML: what would take minutes or gigabytes is refused in a sentence before it is read."""

import os
import time

import pytest

from bad_scenes import assert_one_sentence
from cortado.errors import SceneError
from cortado.scene.toml import MOST_BYTES, read_toml

DEEP = "a." * 30_000 + "b"


@pytest.mark.parametrize(
    "text",
    [
        f"{DEEP} = 1",
        f"[{DEEP}]",
        f"x = {{ {DEEP} = 1 }}",
        "'a' . " * 30_000 + "b = 1",
        '"\\"" .' * 30_000 + "b = 1",
        f'# """\n{DEEP} = 1\n# """',
        f'y = {{ a = """\n\'""", {DEEP} = 1 }}',
        f'y = {{ a = """x"""", {DEEP} = 1 }}',
        f"y = {{ a = '''\n\"''', {DEEP} = 1 }}",
    ],
)
def test_a_key_of_very_many_parts_is_refused_at_once(tmp_path, text):
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


def test_a_table_that_is_an_entry_of_a_list_is_said(tmp_path):
    (tmp_path / "scene.toml").write_text("[fluid]\nshape = 'box'\n[fluid]\nshape = 'box'\n")
    with pytest.raises(SceneError, match=r"twice; entries of a list are written \[\[fluid\]\] \(at line 3"):
        read_toml(tmp_path / "scene.toml")


@pytest.mark.parametrize("text", ["# 1.2.3.4.5.6.7.8.9.10.11.12", 'x = "1.2.3.4.5.6.7.8.9.10.11.12"', "x = [1.5, 2.5]"])
def test_dots_elsewhere_are_no_parts(tmp_path, text):
    (tmp_path / "fine.toml").write_text(text * 2 if text[0] == "#" else text)
    read_toml(tmp_path / "fine.toml")


@pytest.mark.parametrize(
    "override, words",
    [
        (f"{DEEP}=1", "has a key of more than 10 parts"),
        (f"x={{{DEEP}=1}}", "has a key of more than 10 parts"),
        ("x" + "[0]" * 3000 + "=1", "has a key of more than 10 parts"),
        (f"fluid[{'9' * 5000}].file=1", "an index from 0 to 0"),
        (f"x={'[' * MOST_BYTES}", "an override must have at most 1000000"),
    ],
)
def test_hostile_overrides_are_sentences(tmp_path, override, words):
    (tmp_path / "scene.toml").write_text("[[fluid]]")
    with pytest.raises(SceneError, match=words) as caught:
        read_toml(tmp_path / "scene.toml", [override])
    assert_one_sentence(str(caught.value))


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


def test_a_long_override_is_not_repeated_whole(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text("")
    with pytest.raises(SceneError, match="is not an override of the form key=value") as caught:
        read_toml(file, [".=" + "é" * 5000])
    assert len(str(caught.value)) < 300 + len(str(file))
