"""How Cortado is built: with the C++ engine where there is a compiler, and without it where there is none."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import cortado

ROOT = Path(__file__).parent.parent

PACKAGE = (
    "src/cortado/__init__.py",
    "src/cortado/version.py",
    "src/cortado/py.typed",
    "src/cortado/scene.schema.json",
    "src/cortado/pictures/particle_view.js",
)
EXAMPLE = "examples/pour.toml"
needs_cmake = pytest.mark.skipif(shutil.which("cmake") is None, reason="CMake is not installed")


def build(hook: str, source: Path, out: Path, **environment: str) -> subprocess.CompletedProcess:
    """Call a hook of the build backend, as pip does."""
    code = f"from scikit_build_core.build import {hook}; {hook}({str(out)!r})"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=source, env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.fixture
def small(tmp_path):
    """A project of one module, with a marker that it has types, a schema and an example, built as Cortado is."""
    source = tmp_path / "source"
    (source / "src/cortado/pictures").mkdir(parents=True)
    (source / "cpp").mkdir()
    (source / "examples").mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "cpp/CMakeLists.txt", *PACKAGE, EXAMPLE):
        shutil.copy(ROOT / name, source / name)
    return source


@needs_cmake
@pytest.mark.parametrize("hook", ["build_wheel", "build_editable"])
def test_without_a_compiler_the_wheel_is_pure_python(small, tmp_path, hook):
    built = build(hook, small, tmp_path / "dist", CXX="/nonexistent/c++", CORTADO_REQUIRE_ENGINE="")
    assert built.returncode == 0, built.stdout + built.stderr
    assert "retrying due to override" in built.stdout
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert wheel.name == f"cortado_sph-{cortado.__version__}-py3-none-any.whl"
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"cortado/{EXAMPLE}", *(name.removeprefix("src/") for name in PACKAGE)}
    assert wanted <= held if hook == "build_wheel" else wanted.isdisjoint(held)


@needs_cmake
def test_whoever_requires_the_engine_is_told_that_it_failed(small, tmp_path):
    built = build("build_wheel", small, tmp_path / "dist", CXX="/nonexistent/c++", CORTADO_REQUIRE_ENGINE="1")
    assert built.returncode != 0
    assert "/nonexistent/c++" in built.stderr
    assert not list((tmp_path / "dist").glob("*.whl"))


def test_the_source_distribution_holds_every_source(tmp_path):
    built = build("build_sdist", ROOT, tmp_path)
    assert built.returncode == 0, built.stderr
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as contents:
        held = {name.partition("/")[2] for name in contents.getnames()}
    sources = [*(ROOT / "cpp").rglob("*.*pp"), *(ROOT / "src/cortado").rglob("*.py"), ROOT / "cpp/CMakeLists.txt"]
    assert {str(source.relative_to(ROOT)) for source in sources} <= held


def test_one_name_stands_wherever_cortado_is_installed():
    """Another project has the name cortado on the package index."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == "cortado-sph"
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "src").rglob("*.py"), ROOT / "pyproject.toml"]
    named = {name for file in files for name in re.findall(r"([\w-]+)\[(?:video|test)\]", file.read_text())}
    assert named == {"cortado-sph"}


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("changed", ["pyproject.toml", "cpp/CMakeLists.txt"])
def test_a_change_of_the_build_installs_again(tmp_path, changed):
    ready = tmp_path / ".ready"
    ready.touch()

    def is_current(*options: str) -> bool:
        return subprocess.run(["make", "-q", f"VENV={tmp_path}", *options, ready], cwd=ROOT).returncode == 0

    assert is_current()
    assert not is_current(f"--what-if={changed}")
