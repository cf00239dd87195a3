"""What `make test` runs of all tests, which are those of `make test-all`.

Of a test with several parameters it runs so many cases that every value of each parameter is in one of them, not all
combinations; and in the place of a test that takes more than 20 s it runs one that is shorter (`LONG`).
"""

from collections import Counter
from collections.abc import Iterable, Sequence

LONG = {
    "test_examples": {
        "test_an_example_ends_well[flipped_bottle.py]",
        "test_an_example_ends_well[poured_jug.py]",
        "test_an_example_ends_well[steered_raft.py]",
        "test_an_example_ends_well[stirred_tank.py]",
        "test_an_example_ends_well[struck_pillar.py]",
        "test_its_check_can_fail[carried_cup.py]",
    },
    "test_plants": {
        "test_every_kernel_on_the_way_back_is_planted",
        "test_every_plant_is_found",
        "test_the_copy_without_a_plant_is_right",
    },
}
"""Tests of files, or cases of them, that only `make test-all` runs. In their place `make test` runs the same examples
with one update, to a check that fails, or to their end without a mistake, and plants in the adjoints of one scene."""
Value = tuple[str, tuple[int, ...]]
"""Names of parameters that are set together, and the identities of their values."""


def is_long(item) -> bool:
    return not LONG.get(item.path.stem, set()).isdisjoint((item.name, getattr(item, "originalname", item.name)))


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
