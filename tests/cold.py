"""What tests cost where no kernel is compiled yet, as on a new clone, and which of them cost `make test` most.

    pytest --short -n 16 -p cold --cold runs/cold; python tests/cold.py runs/cold 1100

The first command measures, with an empty cache (``WARP_CACHE_PATH``); the second adds rows to `tests/seconds.csv`, so
that `make test` leaves out what saves most, until what is left takes so many seconds of one core. A test costs the
kernel modules that it alone needs. Of each file some test stays, and of each family of modules, such as the adjoints
of the projection, those of one kernel and precision at least.
"""

import csv
import json
import os
import re
import sys
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

from short import KEPT, MEASURED, SECONDS

VARIANT = re.compile(r"_(float32|float64|cubic_spline|wendland_c\d|\dd|moving|periodic|\d+_lanes|[0-9a-f]{8,})(?=_|$)")
"""In the name of a module, what tells those of one family apart."""
RARE = 3
"""A family that no more tests use need not stay."""
MOST = 60
"""Tests that are left out at once."""


class Recorder:
    """A plugin of pytest: who needs which modules, how long they take to compile, and tests without it."""

    def __init__(self, folder: Path):
        self._folder, self._test = folder, ""
        self._modules, self._compiled = defaultdict(set), defaultdict(float)
        self._seconds = Counter()
        import warp._src.context as context

        load, compile_ = context.Module.load, context.Module._compile

        def loaded(module, *arguments, **options):
            self._modules[self._test].add(module.name)
            return load(module, *arguments, **options)

        def compiled(module, *arguments, **options):
            begun = time.process_time()
            try:
                return compile_(module, *arguments, **options)
            finally:
                took = time.process_time() - begun
                self._compiled[module.name] = max(self._compiled[module.name], took)
                self._seconds[self._test] -= took

        context.Module.load, context.Module._compile = loaded, compiled

    def pytest_runtest_logstart(self, nodeid):
        self._test = nodeid

    def pytest_runtest_logreport(self, report):
        self._seconds[report.nodeid] += report.duration

    def pytest_sessionfinish(self):
        if self._seconds:
            modules = {test: sorted(own) for test, own in self._modules.items()}
            found = {"seconds": self._seconds, "modules": modules, "compiled": self._compiled}
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / f"{os.getpid()}.json").write_text(json.dumps(found))


def pytest_addoption(parser):
    parser.addoption("--cold", type=Path, help="folder for what tests cost")


def pytest_configure(config):
    if config.getoption("--cold"):
        config.pluginmanager.register(Recorder(config.getoption("--cold")))


def family(module: str) -> str:
    """What modules have in common that differ in the kernel, the precision and the like."""
    return VARIANT.sub("", module)


@dataclass
class Costs:
    """Of the tests that are left."""

    seconds: dict[str, float]
    modules: dict[str, set[str]]
    compiled: dict[str, float]

    def __post_init__(self):
        self.users = defaultdict(set)
        for test in self.seconds:
            for module in self.modules[test]:
                self.users[module].add(test)
        self.once = {module: len(tests) for module, tests in self.users.items()}
        self.families = Counter(map(family, self.users))
        self.files = Counter(map(file_of, self.seconds))

    @classmethod
    def read(cls, folder: Path) -> "Costs":
        seconds, modules, compiled = {}, defaultdict(set), Counter()
        for path in folder.glob("*.json"):
            found = json.loads(path.read_text())
            seconds |= {test: max(took, 0.02) for test, took in found["seconds"].items() if test}
            for test, own in found["modules"].items():
                modules[test] |= set(own)
            for module, took in found["compiled"].items():
                compiled[module] = max(compiled[module], took)
        return cls(seconds, modules, compiled)

    def total(self) -> float:
        return sum(self.seconds.values()) + sum(self.compiled.get(module, 0.0) for module in self.users)

    def needed_by(self, tests: set[str]) -> set[str]:
        """The modules that nobody else needs."""
        return {one for one in set().union(*(self.modules[test] for test in tests)) if self.users[one] <= tests}

    def saved(self, tests: set[str]) -> float:
        """For each of the tests; 0 if they have to stay."""
        if not tests or len(tests) > MOST or any(is_kept(test) for test in tests):
            return 0.0
        if any(self.files[file] <= count for file, count in Counter(map(file_of, tests)).items()):
            return 0.0
        modules = self.needed_by(tests)
        gone = Counter(family(one) for one in modules if self.once[one] > RARE)
        if any(self.families[name] <= count for name, count in gone.items()):
            return 0.0
        saved = sum(self.seconds[test] for test in tests) + sum(self.compiled.get(one, 0.0) for one in modules)
        return saved / (1 + len(tests))

    def leave_out(self, tests: set[str]) -> None:
        modules = self.needed_by(tests)
        self.families -= Counter(map(family, modules))
        self.files -= Counter(map(file_of, tests))
        for test in tests:
            del self.seconds[test]
            for module in self.modules[test]:
                self.users[module].discard(test)
        for module in modules:
            del self.users[module]


def file_of(test: str) -> str:
    return Path(test.partition("::")[0]).stem


def is_kept(test: str) -> bool:
    return test.partition("::")[2] in KEPT.get(file_of(test), ())


def left_out(costs: Costs, seconds: float) -> dict[tuple[str, str], float]:
    """Files and names of tests with what each saves, until the others take so long."""
    found = {}
    while costs.total() > seconds:
        most, tests = max(((costs.saved(tests), tests) for tests in costs.users.values()), key=lambda one: one[0])
        if most == 0.0:
            break
        found |= {(file_of(test), test.partition("::")[2]): most for test in tests}
        costs.leave_out(set(tests))
    return found


def main(folder: Path, seconds: float) -> None:
    costs = Costs.read(folder)
    before, found = costs.total(), left_out(costs, seconds)
    print(f"{len(found)} tests are left out, {len(costs.seconds)} stay: {before:.0f} -> {costs.total():.0f} s")
    rows = sorted({**found, **MEASURED}.items())
    with SECONDS.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("file", "test", "seconds"))
        table.writerows((*key, f"{max(value, 1.0):.0f}") for key, value in rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
