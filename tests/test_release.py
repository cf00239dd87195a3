"""What a release consists of: one version, how its wheels are built, and tasks without make."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from contextlib import nullcontext
from pathlib import Path

import pytest
import yaml

import cortado
import tasks

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
ENGINE = tomllib.loads((ROOT / "reference/pyproject.toml").read_text("utf-8"))


def test_the_version_stands_in_one_place():
    assert PROJECT["project"]["dynamic"] == ["version"] and "version" not in PROJECT["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == cortado.__version__ and citation["license"] == PROJECT["project"]["license"]
    assert f"## {cortado.__version__}, of " in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_wheels_are_for_the_pythons_that_are_promised():
    promised = {line.rpartition(" ")[2] for line in PROJECT["project"]["classifiers"] if ":: 3." in line}
    built = {f"3.{one[3:-2]}" for one in ENGINE["tool"]["cibuildwheel"]["build"].split()}
    assert built == promised == {"3.11", "3.12", "3.13", "3.14"}
    assert PROJECT["project"]["requires-python"] == ENGINE["project"]["requires-python"] == ">=3.11"


def test_what_was_tested_is_pinned():
    lines = (ROOT / "requirements-tested.txt").read_text("utf-8").splitlines()
    pinned = {re.sub("[-_.]+", "-", line.partition("==")[0]).lower() for line in lines if "==" in line}
    wanted = {re.split("[>=]", one)[0] for one in PROJECT["project"]["dependencies"]}
    assert wanted and wanted <= pinned
    assert not any("@" in line or "://" in line for line in lines)


def test_make_has_all_tasks():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    (names,) = re.findall(r"^TASKS := (.*)$", makefile, re.MULTILINE)
    assert {*names.split(), "fuzz", "format"} == {*tasks.SEVERAL, "sanitize"}
    assert {name for name, parts in tasks.SEVERAL.items() if "docs" in parts} == {"docs", "docs-browser"}


ALL = ["mypy", "pytest", "ruff", "ruff"]


@pytest.mark.parametrize(("fails", "wanted"), [("format", ALL[2:]), ("mypy", ALL), ("pytest", ALL)])
def test_a_task_ends_with_the_first_failure(monkeypatch, fails, wanted):
    ran = []
    monkeypatch.setattr(tasks, "set_up", lambda extra: None)
    monkeypatch.setattr(tasks, "run", lambda command: ran.append(command[0]) or (3 if fails in command else 0))
    assert tasks.main(["test"]) == 3 and sorted(ran) == wanted
    assert tasks.main(["lint", "--fix"]) == 0


@pytest.fixture
def installs(tmp_path, monkeypatch):
    """A folder in the place of the repository, the commands that are run in it, and what they end with."""
    (tmp_path / "reference/cpp").mkdir(parents=True)
    for name in INSTALLED:
        (tmp_path / name).touch()
    ran, failing = [], []
    monkeypatch.setattr(tasks, "ROOT", tmp_path)
    monkeypatch.setattr(tasks, "STAMPS", {"test": tmp_path / "ready", "pictures": tmp_path / "demo"})
    monkeypatch.setattr(tasks, "BIN", tmp_path)
    monkeypatch.setattr(tasks, "run", lambda command, quiet=False: ran.append(command) or int(command in failing))
    return tmp_path, ran, failing


INSTALLED = ["pyproject.toml", "reference/pyproject.toml", "reference/cpp/CMakeLists.txt"]


@pytest.mark.parametrize("required", ["", "1"])
def test_without_a_compiler_all_but_the_engine_is_installed(installs, monkeypatch, capsys, required):
    folder, _, failing = installs
    failing.append(tasks.ENGINE)
    monkeypatch.setenv("CORTADO_REQUIRE_ENGINE", required)
    with pytest.raises(SystemExit) if required else nullcontext():
        tasks.set_up("test")
    assert required or "Installed without the reference engine" in capsys.readouterr().err
    assert (folder / "ready").exists() != bool(required)


ENGINE_FOLDER = ROOT / "reference"
needs_cmake = pytest.mark.skipif(shutil.which("cmake") is None, reason="CMake is not installed")


def build(backend: str, hook: str, source: Path, out: Path, **environment: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", f"from {backend} import {hook}; {hook}({str(out)!r})"]
    return subprocess.run(command, cwd=source, env={**os.environ, **environment}, capture_output=True, text=True)


def test_the_wheel_is_pure_python_and_holds_all_that_is_read(tmp_path):
    built = build("hatchling.build", "build_wheel", ROOT, tmp_path)
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"cortado_sph-{cortado.__version__}-py3-none-any.whl"
    held = set(zipfile.ZipFile(wheel).namelist())
    sources = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src/cortado").rglob("*.*") if path.is_file()}
    wanted = {name for name in sources if "__pycache__" not in name}
    assert {"cortado/py.typed", "cortado/scene.schema.json", "cortado/pictures/particle_view.js"} <= wanted <= held
    assert "cortado/examples/pour.toml" in held
    folders = {name.split("/")[0] for name in held}
    assert folders == {"cortado", f"cortado_sph-{cortado.__version__}.dist-info"}


@needs_cmake
def test_whoever_wants_the_engine_without_a_compiler_is_told(tmp_path):
    source = tmp_path / "source"
    shutil.copytree(ENGINE_FOLDER, source)
    built = build("scikit_build_core.build", "build_wheel", source, tmp_path / "dist", CXX="/nonexistent/c++")
    assert built.returncode != 0 and "/nonexistent/c++" in built.stderr
    assert not list((tmp_path / "dist").glob("*.whl"))


@pytest.mark.parametrize(
    ("backend", "root", "patterns"),
    [
        ("hatchling.build", ROOT, ("src/cortado/**/*.py", "examples/*.toml", "reference/cpp/**/*.*pp")),
        ("scikit_build_core.build", ENGINE_FOLDER, ("cpp/**/*.*pp", "cpp/CMakeLists.txt", "src/**/*.py")),
    ],
)
def test_the_source_distribution_holds_every_source(tmp_path, backend, root, patterns):
    built = build(backend, "build_sdist", root, tmp_path)
    assert built.returncode == 0, built.stderr
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as contents:
        held = {name.partition("/")[2] for name in contents.getnames()}
    sources = {str(path.relative_to(root)) for pattern in patterns for path in root.glob(pattern)}
    assert len(sources) > 10 and sources <= held, sources - held


def test_nobody_is_told_to_install_cortado_from_the_package_index():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == "cortado-sph"
    pages = [ROOT / "README.md", ROOT / "requirements-tested.txt", *(ROOT / "docs").rglob("*.md")]
    files = [*pages, *(ROOT / "docs").rglob("*.ipynb"), *(ROOT / "src").rglob("*.py")]
    told = {file: re.findall(r"pip install[^\n]*?\bcortado[\w-]*", file.read_text()) for file in files}
    assert not {file: found for file, found in told.items() if found}
