"""What a user sees who asks for the names of the package and of its public modules."""

import importlib
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import cortado
from module_graph import all_before, loaded_before, sources

MODULES = ("executors", "gradients", "image_losses", "losses", "optimisers", "pictures", "render", "sensors")
ROOT = Path(__file__).parents[1]
NAMED = {
    name
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.py"))
    for name in re.findall(r"\bcortado(?:\.[A-Za-z_]\w*)+", path.read_text(encoding="utf-8"))
} - {"cortado.sph.drag"} | {f"cortado.{name}" for name in cortado.__all__}
if find_spec("torch") is None:
    NAMED = {name for name in NAMED if not name.startswith("cortado.torch")}
"""Dotted names in the documents, and those of the package; not the module that docs/adding_parts.md adds."""


def by_import(name):
    """With the longest part of a dotted name that is a module's."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        module = ".".join(parts[:end])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if not module.startswith(error.name):
                raise
            continue
        for part in parts[end:]:
            found = getattr(found, part)
        return found


def by_attribute(name):
    found = cortado
    for part in name.split(".")[1:]:
        found = getattr(found, part)
    return found


def without_what_imports_leave(monkeypatch):
    """Packages as they are where nothing else was imported: a module that is leaves its name in its package."""
    before = loaded_before(sources(Path(cortado.__file__).parent))
    for name in [name for name in sys.modules if name.startswith("cortado.")]:
        package, _, last = name.rpartition(".")
        if name not in all_before(before, package):
            monkeypatch.delattr(sys.modules[package], last, raising=False)


@pytest.mark.parametrize("name", MODULES)
def test_a_public_module_shows_what_is_public_and_no_more(name):
    module = getattr(cortado, name)
    assert dir(module) == sorted(module.__all__) and len(set(module.__all__)) == len(module.__all__) >= 4
    for public in module.__all__:
        assert not public.startswith("_")
        home = getattr(getattr(module, public), "__module__", "cortado")
        assert home.startswith("cortado"), f"cortado.{name}.{public} is of {home}"


def test_the_package_shows_what_is_public_and_no_more():
    """Also before anything was used, and after all of it was."""
    names = dir(cortado)
    assert set(names) == {*cortado.__all__, "__version__"} and {"Simulation", "optimise", *MODULES} <= set(names)
    assert all(getattr(cortado, name) is not None for name in names)
    assert dir(cortado) == names
    program = "import cortado; print(*dir(cortado))"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout.split() == names


def test_what_documents_name_is_there_as_an_attribute_and_to_import(monkeypatch):
    """Each in packages that know no module by what was used before. That a module can be the first of all to be
    imported is tests/test_layers.py's."""
    assert {"cortado.optimisers.Adam", "cortado.pictures.read_picture", "cortado.losses.Image"} <= NAMED
    imported = {name: by_import(name) for name in sorted(NAMED)}
    without_what_imports_leave(monkeypatch)
    for name, found in imported.items():
        assert by_attribute(name) == found, name


def test_the_renderer_of_the_documents_is_there():
    """Also its views and cameras."""
    names = {"Renderer", "TopView", "Volume", "Orthographic", "Perspective"}
    text = (ROOT / "docs" / "rendering.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text and isinstance(getattr(cortado.render, name), type) for name in names)


def test_types_are_checked_where_cortado_is_used(tmp_path):
    """As the package says that it has types, and its names are found though they are imported late. What the check of
    all types has kept (`python -m tasks types`) spares the time that NumPy's take."""
    (tmp_path / "use.py").write_text(
        "import cortado\n"
        'trajectory = cortado.Simulation("scene.toml").run(3)\n'
        "reveal_type(trajectory[-1])\n"
        "reveal_type(trajectory[1:])\n"
        "cortado.Simulation(3)\n"
    )
    if (ROOT / ".mypy_cache").is_dir():
        shutil.copytree(ROOT / ".mypy_cache", tmp_path / ".mypy_cache")
    command = [sys.executable, "-m", "mypy", f"--config-file={ROOT / 'pyproject.toml'}", "use.py"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
    assert 'Revealed type is "cortado.runs.trajectory.Frame"' in found
    assert 'Revealed type is "cortado.runs.trajectory.Trajectory"' in found
    assert '"Simulation" has incompatible type "int"' in found
