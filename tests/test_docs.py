"""The code in the documents runs as printed, and what they link to is there."""

import re
import runpy
import shlex
import shutil
from pathlib import Path

import matplotlib.pyplot
import pytest

from cortado.cli import main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DOCUMENTS = {path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
BLOCK = re.compile(r"```(?:python|\{code-cell\} python)\n(?:---\n.*?\n---\n)?(.*?)```", re.DOTALL)
"""Code, in a tutorial a cell, which may begin with what is said about its picture."""
CODE = {name: BLOCK.findall(text) for name, text in DOCUMENTS.items()}
COMMANDS = {
    command
    for text in DOCUMENTS.values()
    for found in re.findall(r"^    cortado (.*)$|`cortado ([^`\n]+)`", text, re.MULTILINE)
    for command in found
    if command
}
TUTORIALS = [name for name in CODE if name.startswith("tutorials/")]


@pytest.mark.filterwarnings("error:.*limit of stability:cortado.errors.CortadoWarning")
@pytest.mark.parametrize("name", [name for name, blocks in CODE.items() if blocks])
def test_the_code_runs_as_printed(name, tmp_path, monkeypatch):
    """All of a document in one go, in a folder that has the examples."""
    if name == "torch.md":
        pytest.importorskip("torch", reason="PyTorch is not installed", exc_type=ImportError)
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    shutil.copytree(ROOT / "docs" / "figures", tmp_path / "docs" / "figures")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: shown.append(matplotlib.pyplot.gcf()))
    shown = []
    exec(compile("\n".join(CODE[name]), name, "exec"), {"__name__": "__main__"})
    matplotlib.pyplot.close("all")
    assert len(shown) == (1 if name in TUTORIALS else 0)


def test_the_force_with_kernels_runs_as_printed(tmp_path, monkeypatch):
    """From a file, as Warp wants the text of kernels."""
    (program,) = re.findall(r"^```py\n(.*?)^```$", DOCUMENTS["adding_parts.md"], re.DOTALL | re.MULTILINE)
    file = tmp_path / "follow.py"
    file.write_text(program, encoding="utf-8")
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(file), run_name="__main__")


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_is_short_and_ends_in_a_picture(name):
    """That it is drawn without an error is the test before."""
    assert "plt.show()" in CODE[name][-1] and "alt: " in DOCUMENTS[name]
    assert len(DOCUMENTS[name].splitlines()) <= 90


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_a_command_is_one(command, capsys):
    """It has the options that are written, and files that are named are there."""
    words = shlex.split(command, comments=True)
    name = words[: 2 if words[0] == "gradients" else 1]
    with pytest.raises(SystemExit) as end:
        main([*name, "--help"])
    known = capsys.readouterr().out
    assert end.value.code == 0
    assert [word for word in words if word.startswith("--") and word not in known] == []
    files = [word for word in words if word.endswith(".toml") and "/" in word]
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_links_lead_to_files():
    paths = {*ROOT.glob("*.md"), *(path for name in ("docs", "experiments") for path in (ROOT / name).rglob("*.md"))}
    links = [(path, link) for path in paths for link in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))]
    assert links
    missing = [(path.name, link) for path, link in links if "://" not in link and not (path.parent / link).exists()]
    assert not missing


def test_paths_in_backticks_are_there():
    texts = [
        *DOCUMENTS.values(),
        *((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "CONTRIBUTING.md")),
    ]
    found = {
        path
        for text in texts
        for path in re.findall(r"`((?:src|tests|docs|examples|reference|fuzz|validation)/[^` *]*)`", text)
    }
    assert len(found) > 50
    assert not {path for path in found if not (ROOT / path).exists()}


def test_names_in_files_are_there():
    """Of "`NAME` of `path`" and the like, in what contributors read."""
    text = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("CONTRIBUTING.md", "docs/adding_parts.md"))
    found = re.findall(r"`(\w+)`\s+(?:of|in|there in)\s+`((?:src|tests)/\S+\.py)`", text)
    assert len(found) > 15
    assert not [(name, path) for name, path in found if not re.search(rf"\b{name}\b", (ROOT / path).read_text("utf-8"))]


def test_there_is_code():
    assert CODE["runs.md"]
    assert len(TUTORIALS) == 8 and len(COMMANDS) > 15
