"""Which tier a test belongs to: validation, slow, or the unit tier, which is neither; and how tests run commands."""

import gc
import json
import math
import os
import re
import shutil
from collections import Counter
from functools import cache, wraps
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imsave

from compiling_notice import FLAGS, compile_fast, without_compiling
from cortado.cli import main
from cortado.cli.subcommands import CORTADO
from cortado.device.threads import CORES, usable_cores
from cortado.discretise import packing
from cortado.scene import discrete_scene
from short import is_slow, seconds_of, short
from skips import complaints, reason_of

WITHOUT_ENGINE = find_spec("cortado_reference") is None and shutil.which("c++") is None
collect_ignore = ["test_reference.py", "test_reference_projection.py", "test_study.py"]
collect_ignore += ["test_study_figures.py", "test_study_growth.py"]
collect_ignore = collect_ignore if WITHOUT_ENGINE else []

compile_fast(FLAGS)
gc.set_threshold(100_000, 20, 20)
"""Launches make so many small objects that looking for those in circles takes a tenth of the tests' time otherwise."""


packing._packed = cache(packing._packed.__wrapped__)
"""All results are kept, not the last few: the same scenes come back in other tests."""


ELSEWHERE = {"emitter", "fluid", "forces", "hinge", "phase", "schedule", "solver", "spring"}
"""Tables of a scene that its walls do not depend on."""


def key_of(scene, aside=()):
    told = {name: part for name, part in json.loads(scene.computed_json()).items() if name not in aside}
    return json.dumps(told), type(scene.container).shortened


def once(make, key):
    """What is made of a scene, which many simulations of a file have, is made once for the contents of its files."""
    known = {}

    @wraps(make)
    def kept(*given):
        files = [Path(name) for name in re.findall(r"(?:file|path)='(.*?)'", repr(given[0]))]
        if not all(file.is_file() for file in files):
            return make(*given)
        found = key(*given), *(file.read_bytes() for file in files)
        return known[found] if found in known else known.setdefault(found, make(*given))

    return kept


KEYS = {
    "walls_of": lambda scene, lattice: key_of(scene, ELSEWHERE),
    "_alone": lambda table, *others: (table.model_dump_json(), *map(repr, others)),
    "fluid_particles": key_of,
    "_settled": lambda scene, *others: key_of(scene),
}
for name, key in KEYS.items():
    setattr(discrete_scene, name, once(getattr(discrete_scene, name), key))

os.environ.setdefault(CORES, str(max(usable_cores() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")), 1)))
"""Each worker of pytest has its share of the cores: threads beyond it wait for each other. What several cores do is
tested where a test asks for them."""


def pytest_report_header():
    return "There is no C++ compiler: nothing of the reference engine is tested." if WITHOUT_ENGINE else None


VALIDATION = {
    "test_containment",
    "test_plants",
    "test_study_figures",
    "test_study_growth",
    "test_surface_tension",
    "test_validation",
    "test_validation_flows",
    "test_validation_mixture",
    "test_validation_rayleigh_taylor",
}
"""Files: physics against published data and closed forms, studies, walls that hold, and every plant."""

COLLECTED = pytest.StashKey[set[tuple[str, str]]]()
"""Files and names of all cases, and of their tests, before any is left out."""


def tier(item: pytest.Item) -> str:
    if item.path.stem in VALIDATION:
        return "validation"
    return "slow" if is_slow(item) else "unit"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--short", action="store_true", help="as make test does: without what make test-all alone runs")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks tests by their tier, and leaves out with ``--short`` what only `make test-all` runs. Long files come first,
    so that no core ends with one while the others have nothing to do; ``--no-loadscope-reorder`` in pyproject.toml
    keeps this order."""
    names = ((item, name) for item in items for name in (item.name, getattr(item, "originalname", item.name)))
    config.stash[COLLECTED] = {(item.path.stem, name) for item, name in names}
    if config.getoption("--short"):
        run = {id(item) for item in short(items)}
        config.hook.pytest_deselected(items=[item for item in items if id(item) not in run])
        items[:] = [item for item in items if id(item) in run]
    spent = Counter()
    for item in items:
        spent[item.path] -= seconds_of(item)
        found = tier(item)
        if found != "unit":
            item.add_marker(getattr(pytest.mark, found))
    items.sort(key=lambda item: spent[item.path])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fails a run that skips what a package would cure, where `CORTADO_REQUIRE_ALL` is set."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or os.environ.get("CORTADO_REQUIRE_ALL", "") in ("", "0"):
        return
    for complaint in complaints(reason_of(report) for report in reporter.stats.get("skipped", [])):
        reporter.write_line(complaint, red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture
def cortado_command(capfd, monkeypatch):
    """Runs a command in this process: (exit code, stdout, stderr), with what C code writes. There are no lines of
    progress, however slow the machine is."""
    monkeypatch.setattr("cortado.files.terminal.LINE_INTERVAL", math.inf)

    def run(*arguments, program=CORTADO):
        capfd.readouterr()
        try:
            main([str(argument) for argument in arguments], program)
            code = 0
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        return code, out, without_compiling(err)

    return run


@pytest.fixture(scope="module")
def jax():
    """In float64, as long as tests of a file run, and compiled quickly: programs are small and run once."""
    import jax

    changed = ("jax_enable_x64", "jax_disable_most_optimizations")
    for name in changed:
        jax.config.update(name, True)
    yield jax
    for name in changed:
        jax.config.update(name, False)


@pytest.fixture
def unpacked(monkeypatch):
    """Water beside solids begins on its lattice: to pack a few particles takes longer than to simulate them."""
    monkeypatch.setattr(packing.Packing, "packed", lambda _, particles, stays: (particles, np.arange(len(particles))))


@pytest.fixture
def unrendered(request, monkeypatch):
    """Figures are made, but saved as a white square: to render them takes longer than all else that such tests are
    about, and is what tests/test_figures.py does. Tests that ask for `rendered` too have them as they are."""
    if "rendered" not in request.fixturenames:
        white = np.ones((4, 4, 3))
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _, file, **options: imsave(file, white))


@pytest.fixture
def rendered():
    """Asks for figures as they are in a file whose tests have them `unrendered`."""
