"""Packages form a tree: none imports one that imports it; who may launch, what stays light. And the tiers of the tests:
they name files and tests that there are, and what is short has every value of what is long."""

import ast
import os
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import cortado
from compiling_notice import SAME_KERNELS
from conftest import COLLECTED, VALIDATION, tier
from cortado.lazy import FUNCTIONS, on_top
from module_graph import all_before, loaded_before, sources
from short import KEPT, MEASURED, SLOW, chosen, short, values_of, write_seconds
from skips import complaints

ROOT = Path(cortado.__file__).parent


def modules() -> dict[str, Path]:
    """Every module by its name within the package."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[-1] != "__init__":
            found[".".join(parts)] = path
    return found


@cache
def import_nodes(source: str) -> list[ast.AST]:
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, (ast.Import, ast.ImportFrom))]


def imports(source: str, module: str, known: set[str]) -> set[str]:
    """Modules of the package that a module's source imports, by their names within the package."""
    found = set()
    for node in import_nodes(source):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            package = ["cortado", *module.split(".")][: -node.level] if node.level else []
            base = ".".join(package + ([node.module] if node.module else []))
            names = [f"{base}.{alias.name}" for alias in node.names]
        for name in names:
            if name.startswith("cortado."):
                inner = name.removeprefix("cortado.")
                parent = inner.rpartition(".")[0]
                found.add(inner if inner in known else parent or "cortado")
    return found


MODULES = modules()
SOURCES = {module: path.read_text(encoding="utf-8") for module, path in MODULES.items()}
MOST_PACKAGES = 17
MOST_LINES = 450
ON_TOP = ("pictures", "environments", "certificate", "cli", "runs.run_folder", "__main__", "measured")
ON_TOP += tuple(f"optimisation.{name}" for name in ("datasets", "fitting"))
ON_TOP += tuple(f"optimisation.{name}" for name in ("solved_task", "task_files", "task_tables", "transforms"))
"""Packages, and modules, that lie on top of the core; `cortado` itself has the names of all."""


def above(sources: dict[str, str]) -> dict[str, set[str]]:
    """Of each package, or module that is in none, those that it imports, given sources by module: for types too."""
    packages: dict[str, set[str]] = {}
    for module, source in sources.items():
        own = module.split(".")[0]
        packages.setdefault(own, set()).update(name.split(".")[0] for name in imports(source, module, set(sources)))
        packages[own].discard(own)
    return packages


def test_packages_form_a_tree_and_no_file_imports_one_that_imports_it():
    """On no way, within functions and for types too."""
    list(TopologicalSorter(above(SOURCES)).static_order())
    assert len(list(ROOT.glob("*/__init__.py"))) <= MOST_PACKAGES
    known = set(SOURCES)
    files = {module: imports(source, module, known) - {module} for module, source in SOURCES.items()}
    list(TopologicalSorter(files).static_order())
    for source in ("from cortado.upper import a", "if TYPE_CHECKING:\n    from ..upper.a import b"):
        with pytest.raises(CycleError, match="lower"):
            list(TopologicalSorter(above({"upper.a": "from cortado.lower import b", "lower.b": source})).static_order())


def is_on_top(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in ON_TOP)


def on_top_of_the_core(sources: dict[str, str]) -> list[tuple[str, str]]:
    """Imports, within functions and for types too, of what is on top of the core by a module of the core."""
    known = set(sources)
    core = [module for module in known if not is_on_top(module)]
    return [(module, name) for module in core for name in imports(sources[module], module, known) if is_on_top(name)]


def test_the_core_imports_nothing_on_top_of_it_and_what_it_asks_of_that_is_there():
    assert not on_top_of_the_core(SOURCES)
    late = {"problem": "def f():\n    from cortado.pictures.film import film", "pictures.film": ""}
    assert on_top_of_the_core(late) == [("problem", "pictures.film")]
    for name, home in FUNCTIONS.items():
        assert is_on_top(home) and callable(on_top(name)), f"{home}.{name}"


STANDING_ALONE = """
import importlib, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        inner = name.removeprefix("cortado.")
        if any(inner == one or inner.startswith(one + ".") for one in {on_top}):
            raise AssertionError(f"{name} is imported")

sys.meta_path.insert(0, Refuse())
from cortado.errors import ExtraMissingError, LibraryMissingError
sys.modules["torch"] = sys.modules["jax"] = None  # which take longer to import than all else
for module in {core}:
    try:
        importlib.import_module(f"cortado.{module}")
    except (ModuleNotFoundError, ExtraMissingError, LibraryMissingError) as missing:  # such as JAX
        assert not str(missing.name).startswith("cortado"), missing
import cortado
from scenes import plane
simulation = cortado.Simulation(plane(), precision="float64")
problem = cortado.Problem(simulation, 4, cortado.losses.FinalPositions(simulation.positions + 0.01))
assert cortado.optimise(problem, {"gravity": [0.1, -9.0]}, cortado.optimisers.GradientDescent(1.0), 2).evaluations
"""


def test_the_core_stands_alone():
    """All of it is imported, and used, where nothing that lies on top of it can be."""
    core = [name for name in MODULES if not is_on_top(name) and name != "reference"]
    program = SAME_KERNELS + STANDING_ALONE.replace("{on_top}", repr(ON_TOP)).replace("{core}", repr(core))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT.parent), str(Path(__file__).parent)])}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_any_module_can_be_the_first_to_be_imported():
    """As no module imports, as it is loaded, one that imports it."""
    before = loaded_before(sources(ROOT))
    list(TopologicalSorter(before).static_order())
    known = all_before(before, "cortado.problem")
    assert {"cortado.errors", "cortado.gradients", "cortado.gradients.estimator"} <= known
    assert len(before) > 200 and sum(map(len, before.values())) > 3 * len(before)
    found = {"cortado": "", "cortado.a": "import cortado.b", "cortado.b": "class B:\n    from cortado import a"}
    with pytest.raises(CycleError, match=r"cortado\.b"):
        list(TopologicalSorter(loaded_before(found)).static_order())
    list(TopologicalSorter(loaded_before({**found, "cortado.a": "def f():\n    import cortado.b"})).static_order())


def test_nothing_but_the_command_line_imports_the_package_itself():
    """`cortado` has the names of all packages, so that whoever imports it imports them all."""
    users = {module for module, source in SOURCES.items() if "cortado" in imports(source, module, set(MODULES))}
    assert {user.split(".")[0] for user in users} <= {"cli", "__main__"}


def warp_names(module: str) -> set[str]:
    """Names of Warp that a module uses: ``kernel`` for ``wp.kernel`` and for ``from warp import kernel``."""
    found = set()
    for node in ast.walk(ast.parse(SOURCES[module])):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("wp", "warp"):
            found.add(node.attr)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "warp":
            found |= {alias.name for alias in node.names}
    return found


def test_kernels_are_launched_by_name():
    """`cortado.device.launching` binds arguments by their names and checks them; nobody goes around it."""
    launching = [name for name, source in SOURCES.items() if "launch" in source]
    assert [name for name in launching if warp_names(name) & {"launch", "launch_tiled"}] == ["device.launching"]


MOST_ARGUMENTS = 14
"""Of a kernel: more can hardly be read."""
LOOPS = {f"particles.{name}" for name in ("pair_sums", "wall_terms", "neighbours")}
"""Modules that may count neighbours: three write loops, the other lists neighbours and images."""


def test_kernels_can_be_read():
    """Sums over neighbours are made by cortado.particles.pair_sums."""
    for source in SOURCES.values():
        for node in ast.walk(ast.parse(source)) if "wp.kernel" in source else ():
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(a) for a in node.decorator_list):
                assert len(node.args.args) <= MOST_ARGUMENTS, f"{node.name} takes too many arguments: bundle some"
    assert {module for module, source in SOURCES.items() if "s.fluid_count[" in source} <= LOOPS


LIGHT = """
import importlib, sys
import cortado
heavy = {"warp", "matplotlib", "scipy", "jax", "torch"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
for module in "errors", "scene.parameter_values", "discretise.smoothing", "scene.discrete_scene", "reference":
    importlib.import_module(f"cortado.{module}")
    assert "warp" not in sys.modules, module
"""


def test_import_is_light_and_the_discretisation_is_without_warp():
    """On which an engine without Warp stands."""
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_file_has_more_than_one_topic():
    """By its length; the longest ones hold one."""
    assert [name for name, source in SOURCES.items() if len(source.splitlines()) > MOST_LINES] == []


TESTS = Path(__file__).parent


def names_in(file):
    tree = ast.parse((TESTS / f"{file}.py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_what_is_listed_is_there():
    for file in {*VALIDATION, *KEPT, *(file for file, _ in MEASURED)}:
        listed = KEPT.get(file, set()) | {test for of, test in MEASURED if of == file}
        assert {test.partition("[")[0] for test in listed} <= names_in(file), file


def test_only_what_is_slow_has_to_be_kept():
    slow = {*MEASURED, *((file, test.partition("[")[0]) for file, test in MEASURED)}
    assert {(file, test.partition("[")[0]) for file, tests in KEPT.items() for test in tests} <= slow


def test_times_are_of_cases_that_there_are(request):
    """Of files that are collected whole: a case that has another name by now would no longer be left out."""
    config = request.config
    if not (config.option.keyword or config.option.markexpr or any("::" in one for one in config.args)):
        there = config.stash[COLLECTED]
        files = {file for file, _ in there}
        assert [key for key in MEASURED if key[0] in files and key not in there] == []


def test_the_marks_are_set(request):
    """Of all tests of this run."""
    for item in request.session.items:
        marks = {mark.name for mark in item.iter_markers()} & {"slow", "validation"}
        assert marks == ({tier(item)} - {"unit"}), item.nodeid


def test_what_is_slow_is_left_out_of_what_is_short():
    class Item:
        def __init__(self, file, name):
            self.path, self.name, self.originalname = TESTS / f"{file}.py", name, name.partition("[")[0]

    kept, quick = Item("test_cli", "test_run_writes_its_folder"), Item("test_terms", "test_of_a_second")
    case = Item("test_docs", "test_the_code_runs_as_printed[solids.md]")
    assert short([kept, Item("test_plants", "test_every_plant_is_found[x]"), quick, case]) == [kept, quick]


def test_seconds_are_those_of_a_report(tmp_path, monkeypatch):
    table = tmp_path / "seconds.csv"
    monkeypatch.setattr("short.SECONDS", table)
    monkeypatch.setattr("short.MEASURED", {("test_a", "test_one"): 4.0, ("test_b", "test_two[x]"): 5.0})
    times = {"test_one": 1.0, "test_two[x]": 6.0, "test_two[y]": 7.0, "test_three[x]": SLOW, "test_three[y]": 1.0}
    case = '<testcase classname="tests.test_{}" name="{}" time="{}"/>'
    cases = [case.format("a" if name == "test_one" else "b", name, time) for name, time in times.items()]
    report = tmp_path / "suite.xml"
    report.write_text(f"<testsuites><testsuite>{''.join(cases)}</testsuite></testsuites>")
    write_seconds(report)
    assert table.read_text() == "file,test,seconds\ntest_b,test_three[x],3\ntest_b,test_two,7\n"


def test_every_value_is_in_a_chosen_case():
    cases = [{("a", (i,)), ("b,c", (j, 0)), ("d", (i + j,))} for i in range(3) for j in range(5)]
    found = chosen(cases)
    assert set().union(*(cases[k] for k in found)) == set().union(*cases) and found == sorted(found)
    cases = [{("a", (i,)), ("b", (j,))} for i in range(3) for j in range(60)]
    found = chosen(cases)
    assert len(found) == 60 and all(sum(("a", (i,)) in cases[k] for k in found) == 20 for i in range(3))


@pytest.mark.parametrize(("one", "other"), [(1, 2)])
@pytest.mark.parametrize("third", [4])
def test_what_is_set_together_is_one_value(request, one, other, third):
    assert values_of(request.node) == {("one,other", (id(one), id(other))), ("third", (id(third),))}


def test_a_skip_that_a_package_would_cure_is_told():
    assert complaints(["there is no CUDA device"] * 300 + ["root may write anywhere"]) == []
    assert complaints(["PyTorch is not installed"]) == ["1 skipped, at most 0 may be: PyTorch is not installed"]
    assert complaints(["root may write anywhere"] * 99)[0].startswith("99 skipped")
