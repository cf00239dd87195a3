"""What `make test` runs of all tests, which are those of `make test-all`.

Of cases in `tests/seconds.csv` it runs those in `KEPT` alone: they take at least 3 s, or need kernels that few others
need, so that they take long on a new clone. Of the other cases of a test it runs so many that every value of each
parameter that they have is in one of them, not all combinations. Rows of slow cases are written from pytest's report:

    pytest --short --junitxml=suite.xml; python tests/short.py suite.xml
"""

import csv
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree

SECONDS = Path(__file__).with_name("seconds.csv")
SLOW = 3.0
"""[s]"""
DIFFERENTIATED = [
    "the cubic spline", "beside a rotor, implicit", "bodies on hinges to each other", "a rubbed body", "two layers",
    "a nozzle over a pool", "a sink and a box", "surface tension by curvature", "projection, plane", "a body force",
    "a pair force that is not odd", "a force that keeps a field"
]  # fmt: skip
TAPED = ["the plane"]
KEPT = {
    "test_cli": {"test_run_writes_its_folder"},
    "test_examples": {"test_its_check_can_fail[first_gradient.py]"},
    "test_first_commands": {"test_a_new_scene_runs_at_once[2-True]"},
    "test_features": {
        *(f"test_reverse_forward_and_differences_agree[{name}]" for name in DIFFERENTIATED),
        *(f"test_the_tape_has_the_same_gradient[{name}]" for name in TAPED),
    },
    "test_free_bodies": {"test_a_body_and_fluid_in_free_space_keep_their_momentum[2]"},
    "test_freeze": {
        "test_every_stable_scene_has_its_numbers[dam_break_dataset float64]",
        "test_every_stable_scene_has_its_numbers[splash float32]",
    },
    "test_solids": {"test_a_paddle_stirs_and_nothing_enters_it"},
    "test_projection": {"test_a_step_is_that_of_the_twin[space]"},
    "test_reference_projection": {"test_it_is_the_projection_of_the_warp_engine[plane]"},
    "test_validation_flows": {
        "test_a_dam_break_makes_no_energy_and_is_not_compressed[0.0025-1.00005]",
        "test_vortices_decay_as_they_must[32-100.0-1.0-0.035]",
    },
}
"""Slow cases of files that `make test` runs, as nothing quicker guards the same."""
Value = tuple[str, tuple[int, ...]]
"""Names of parameters that are set together, and the identities of their values."""


def _measured() -> dict[tuple[str, str], float]:
    with SECONDS.open(newline="") as file:
        return {(row["file"], row["test"]): float(row["seconds"]) for row in csv.DictReader(file)}


MEASURED = _measured()


def seconds_of(item) -> float:
    """What a case takes, and 0 where it has no row. A row of a whole test is about each case of it."""
    file = item.path.stem
    return MEASURED.get((file, item.name)) or MEASURED.get((file, getattr(item, "originalname", item.name)), 0.0)


def is_slow(item) -> bool:
    return seconds_of(item) > 0.0


def short(items: Iterable) -> list:
    """What `make test` runs."""
    items = list(items)
    kept = {id(item) for item in items if item.name in KEPT.get(item.path.stem, ())}
    kept |= {id(item) for item in with_each_value([item for item in items if not is_slow(item)])}
    return [item for item in items if id(item) in kept]


def values_of(item) -> set[Value]:
    """Of a case: one for each `parametrize` of its test, and for each fixture that has parameters."""
    values = item.callspec.params
    together = [tuple(_names(mark)) for mark in item.iter_markers("parametrize")]
    together += [(name,) for name in values.keys() - set().union(*together)]
    return {(",".join(names), tuple(id(values[name]) for name in names)) for names in together}


def _names(mark) -> list[str]:
    names = mark.args[0] if mark.args else mark.kwargs["argnames"]
    return [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)


def chosen(cases: Sequence[set[Value]]) -> list[int]:
    """Indices of cases: of those that are left, one with the most values that no chosen one has comes next, and of
    these the first whose values were chosen least often, so that all values are about as often with each other."""
    if all(len(case) == 1 for case in cases):  # to look for the best of a thousand such cases takes seconds
        return sorted({case: k for k, case in reversed([*enumerate(map(frozenset, cases))])}.values())
    missing: set[Value] = set().union(*cases)
    uses: Counter[Value] = Counter()
    found: list[int] = []
    while missing:
        best = max(range(len(cases)), key=lambda k: (len(cases[k] & missing), -sum(uses[value] for value in cases[k])))
        found.append(best)
        missing -= cases[best]
        uses.update(cases[best])
    return sorted(found)


def with_each_value(items: Iterable) -> list:
    """Those of pytest's tests that are run, in the same order; a test without parameters is."""
    tests: dict[tuple, list] = {}
    for item in items:
        tests.setdefault((item.path, getattr(item, "originalname", item.name)), []).append(item)
    kept = set()
    for cases in tests.values():
        together = all(hasattr(item, "callspec") for item in cases)
        some = chosen([values_of(item) for item in cases]) if together else range(len(cases))
        kept |= {id(cases[k]) for k in some}
    return [item for item in items if id(item) in kept]


def write_seconds(report: Path) -> None:
    """The table from a report of pytest: a test all of whose cases are slow has one row."""
    tests: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        if len(case) == 0 and case.get("classname"):  # passed
            file, name = case.get("classname").rpartition(".")[2], case.get("name")
            tests[file, name.partition("[")[0]][name] = float(case.get("time"))
    again = {(file, name) for (file, test), cases in tests.items() for name in (test, *cases)}
    found = {key: value for key, value in MEASURED.items() if key not in again}
    for (file, test), cases in tests.items():
        if min(cases.values()) >= SLOW:
            found[file, test] = max(cases.values())
        else:
            found |= {(file, case): time for case, time in cases.items() if time >= SLOW}
    with SECONDS.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("file", "test", "seconds"))
        rows.writerows((*key, f"{value:.0f}") for key, value in sorted(found.items()))


if __name__ == "__main__":
    write_seconds(Path(sys.argv[1]))
