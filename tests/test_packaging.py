"""How Cortado is built: its own wheel is pure Python, that of the reference engine needs a compiler."""

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
ENGINE = ROOT / "reference"
needs_cmake = pytest.mark.skipif(shutil.which("cmake") is None, reason="CMake is not installed")


def build(backend: str, hook: str, source: Path, out: Path, **environment: str) -> subprocess.CompletedProcess:
    """Call a hook of a build backend, as pip does."""
    code = f"from {backend} import {hook}; {hook}({str(out)!r})"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=source, env={**os.environ, **environment}, capture_output=True, text=True
    )


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
    shutil.copytree(ENGINE, source)
    built = build("scikit_build_core.build", "build_wheel", source, tmp_path / "dist", CXX="/nonexistent/c++")
    assert built.returncode != 0 and "/nonexistent/c++" in built.stderr
    assert not list((tmp_path / "dist").glob("*.whl"))


@pytest.mark.parametrize(
    ("backend", "root", "patterns"),
    [
        ("hatchling.build", ROOT, ("src/cortado/**/*.py", "examples/*.toml", "reference/cpp/**/*.*pp")),
        ("scikit_build_core.build", ENGINE, ("cpp/**/*.*pp", "cpp/CMakeLists.txt", "src/**/*.py")),
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
    """It is not there, and another project has the name cortado."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == "cortado-sph"
    pages = [ROOT / "README.md", ROOT / "requirements-tested.txt", *(ROOT / "docs").rglob("*.md")]
    files = [*pages, *(ROOT / "docs").rglob("*.ipynb"), *(ROOT / "src").rglob("*.py")]
    told = {file: re.findall(r"pip install[^\n]*?\bcortado[\w-]*", file.read_text()) for file in files}
    assert not {file: found for file, found in told.items() if found}
