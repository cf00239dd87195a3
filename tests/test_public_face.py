"""What a user sees: the names of the package and its modules, and what is shown of results."""

import importlib
import importlib.util
import json
import pickle
import re
import shutil
import subprocess
import sys
from base64 import b64decode
from functools import reduce
from html import unescape
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import cortado
from cortado import Problem, Simulation, losses
from module_graph import all_before, loaded_before, sources
from scenes import plane, plane_of_three

MODULES = ("executors", "gradients", "image_losses", "losses", "optimisers", "pictures", "render", "sensors")
ROOT = Path(__file__).parents[1]
NAMED = {
    name
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.py"))
    if path.parent.name != "records"
    for name in re.findall(r"\bcortado(?:\.[A-Za-z_]\w*)+", path.read_text(encoding="utf-8"))
} - {"cortado.sph.drag"} | {f"cortado.{name}" for name in cortado.__all__}
if find_spec("torch") is None:
    NAMED = {name for name in NAMED if not name.startswith("cortado.torch")}
"""Dotted names in the documents, and those of the package; not the module that docs/adding_parts.md adds, and none of
records, where some are gone."""


def by_import(name):
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        module = ".".join(parts[:end])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if not module.startswith(error.name):
                raise
            continue
        return reduce(getattr, parts[end:], found)


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
    there = importlib.util.find_spec("stable_baselines3") is not None  # which no test needs but its own
    named = [name for name in sorted(NAMED) if there or not name.startswith("cortado.environments.stable_baselines")]
    imported = {name: by_import(name) for name in named}
    without_what_imports_leave(monkeypatch)
    for name, found in imported.items():
        assert reduce(getattr, name.split(".")[1:], cortado) == found, name


def test_types_are_checked_where_cortado_is_used(tmp_path):
    """As the package says that it has types, and its names are found though they are imported late. What the check of
    all types has kept (`python -m tasks types`) spares the time that NumPy's take."""
    lines = ["import cortado", 'trajectory = cortado.Simulation("scene.toml").run(3)', "reveal_type(trajectory[-1])"]
    lines += ["reveal_type(trajectory[1:])", "cortado.Simulation(3)"]
    (tmp_path / "use.py").write_text("\n".join(lines))
    if (ROOT / ".mypy_cache").is_dir():
        shutil.copytree(ROOT / ".mypy_cache", tmp_path / ".mypy_cache")
    command = [sys.executable, "-m", "mypy", f"--config-file={ROOT / 'pyproject.toml'}", "use.py"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
    assert 'Revealed type is "cortado.runs.trajectory.Frame"' in found
    assert 'Revealed type is "cortado.runs.trajectory.Trajectory"' in found
    assert '"Simulation" has incompatible type "int"' in found


@pytest.fixture(scope="module")
def simulation():
    return Simulation(plane())


@pytest.fixture(scope="module")
def trajectory(simulation):
    return simulation.run(4)


@pytest.fixture(scope="module")
def problem(simulation):
    return Problem(simulation, 4, losses.FinalPositions(0.9 * simulation.positions))


@pytest.fixture(scope="module")
def result(problem):
    start = {"gravity": np.array([0.0, -9.0]), "viscosity": 0.05}
    return cortado.optimise(problem, start, "adam", learning_rate=0.01, iterations=2)


@pytest.fixture(scope="module")
def certificate(problem):
    return cortado.certify(problem)


def test_what_runs(simulation, problem):
    assert repr(simulation) == "Simulation(64 particles, 1 phase, cpu, float32)"
    three = Simulation(plane_of_three(), precision="float64")
    assert repr(three) == "Simulation(64 particles, 3 phases, cpu, float64)"
    assert repr(problem) == f"Problem(4 steps of {simulation!r}, judged by FinalPositions)"

    def height(positions, velocities, loss):
        """Never called."""

    assert repr(Problem(simulation, 1, height)) == f"Problem(1 step of {simulation!r}, judged by height)"
    assert repr(simulation.renderer(resolution=(20, 10))) == "Renderer(TopView, 20 x 10 pixels, 64 particles)"


def test_what_a_run_leaves(trajectory, problem):
    assert repr(trajectory) == "Trajectory(5 frames of 64 particles, 0 to 0.0084 s)"
    assert repr(trajectory[:0]) == "Trajectory(0 frames of 64 particles)"
    assert repr(trajectory[-1]) == "Frame(64 particles, t = 0.0084 s)"
    assert repr(problem.end({})) == "Snapshot(64 particles, float32)"
    restart = repr(trajectory.last_state)
    names = "positions: array (64, 2), velocities: array (64, 2), mass_fractions: array (64, 1), reference_density: "
    assert restart.startswith(f"RestartState(fields={{{names}array (64,)}}, clock=Clock(steps=4, time=0.0084")


def test_what_a_search_finds(result, problem):
    words = r"Result\(gravity \(2,\), viscosity: loss [\d.e-]+ after 3 evaluations; Adam made all its 2 updates\)"
    assert re.fullmatch(words, repr(result))
    exact = repr(problem.estimate({"gravity": [0.0, -9.0], "viscosity": 0.05}))
    assert re.fullmatch(r"Estimate\(loss [\d.e-]+, gradient of gravity \(2,\), viscosity\)", exact)
    assert re.fullmatch(r"Record\(iteration 0: loss [\d.e-]+, gradient norm [\d.e-]+\)", repr(result.history[0]))


def test_a_certificate_is_a_table_and_the_same_text_in_a_notebook(certificate, monkeypatch):
    assert repr(certificate) == "Certificate(64 particles, 4 steps, right, horizon 4, use gradients.Exact())"
    assert re.search(r"│ gravity +│ \d\.\d{3}e-\d\d +│ right +│", str(certificate))
    assert "array(" not in repr(certificate.consistency) and "array(" not in repr(certificate.horizons)
    html = certificate._repr_html_()
    assert html.startswith("<pre>") and html.endswith("</pre>") and "│ gravity" in html
    text = str(certificate)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(certificate) == text and "adjoint" in text.splitlines()[2]


def pictures(html: str) -> list[np.ndarray]:
    """(rows, columns) greys of every picture in a page."""
    found = re.findall(r'src="data:image/png;base64,([^"]*)"', html)
    return [np.asarray(Image.open(BytesIO(b64decode(one))).convert("L")) for one in found]


def cells(html: str) -> list[list[str]]:
    rows = re.findall("<tr>(.*?)</tr>", html)[1:]
    return [[unescape(cell) for cell in re.findall("<td[^>]*>(.*?)</td>", row)] for row in rows]


@pytest.mark.parametrize("name", ["simulation", "trajectory"])
def test_a_notebook_shows_a_picture(name, request):
    found = request.getfixturevalue(name)
    html = found._repr_html_()
    (pixels,) = pictures(html)
    assert pixels.shape[1] >= 1000 and 0.001 < np.mean(pixels < 200) < 0.9
    assert html.startswith(f"<p>{repr(found)[:10]}")


def test_a_notebook_shows_what_a_search_found(result, problem, simulation):
    before = problem.value({})
    html = result._repr_html_()
    ends, losses = pictures(html)
    assert min(ends.shape[1], losses.shape[1]) >= 1000
    thirds = np.array_split(ends < 200, 3, axis=1)
    assert all(0.02 < np.mean(one) < 0.5 for one in thirds)  # first, found and target
    (name, unit, first, found), (_, other_unit, _, number) = cells(html)
    assert (name, unit, first, other_unit) == ("gravity", "m/s²", "0, -9", "Pa s")
    assert found == ", ".join(f"{g:.4g}" for g in result.parameters["gravity"]) and float(number) > 0.0
    assert problem.value({}) == before and pickle.loads(pickle.dumps(result)).problem is None


def test_a_search_of_a_function_shows_its_losses(monkeypatch):
    def square(parameters):
        return float(parameters["gravity"] ** 2), {"gravity": 2.0 * parameters["gravity"]}

    result = cortado.optimise(square, {"gravity": 3.0}, "adam", learning_rate=0.1, iterations=2)
    html = result._repr_html_()
    assert len(pictures(html)) == 1 and cells(html) == [["gravity", "-", "3", f"{result.parameters['gravity']:.4g}"]]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert pictures(result._repr_html_()) == [] and "Result(gravity" in result._repr_html_()


def test_a_first_guess_that_diverges_has_no_picture(result, monkeypatch):
    def lost(*_):
        raise cortado.DivergedError(1, 2, "try less")

    monkeypatch.setattr(Problem, "states", lost)
    assert len(pictures(result._repr_html_())) == 1


def test_a_notebook_plays_a_trajectory_and_nothing_of_none(trajectory):
    (page,) = re.findall(r'<iframe srcdoc="([^"]*)"', trajectory._repr_html_())
    data = json.loads(unescape(page).partition('"application/json">')[2].partition("</script>")[0])
    assert len(data["times"]) == len(trajectory) and data["particles"] == 64
    assert data["radius"] == pytest.approx(0.56 * 0.05, rel=0.3)
    assert trajectory[:0]._repr_html_() == "<pre>Trajectory(0 frames of 64 particles)</pre>"
