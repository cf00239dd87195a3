"""The tiers name files and tests that there are, and what is short has every value of what is long."""

import ast
from pathlib import Path

import pytest

from conftest import SLOW, SLOW_TESTS, VALIDATION, tier
from short import LONG, chosen, values_of

TESTS = Path(__file__).parent


def test_a_file_is_in_one_tier():
    assert not VALIDATION & SLOW and not (VALIDATION | SLOW) & SLOW_TESTS.keys()


def names_in(file):
    tree = ast.parse((TESTS / f"{file}.py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("file", LONG)
def test_in_the_place_of_what_is_long_something_is_left(file):
    listed = {name.partition("[")[0] for name in LONG[file]}
    assert listed < names_in(file)


@pytest.mark.parametrize("file", sorted({*VALIDATION, *SLOW, *SLOW_TESTS}))
def test_what_is_listed_is_there(file):
    listed, there = SLOW_TESTS.get(file, set()), names_in(file)
    assert listed <= there, listed - there
    assert all(tier(file, test) == "slow" for test in listed)


def test_the_marks_are_set(request):
    """Of all tests of this run."""
    for item in request.session.items:
        found = tier(item.path.stem, getattr(item, "originalname", item.name))
        marks = {mark.name for mark in item.iter_markers()} & {"slow", "validation"}
        assert marks == ({found} - {"unit"}), item.nodeid


def test_every_value_is_in_a_chosen_case():
    cases = [{("a", (i,)), ("b,c", (j, 0)), ("d", (i + j,))} for i in range(3) for j in range(5)]
    found = chosen(cases)
    assert set().union(*(cases[k] for k in found)) == set().union(*cases) and found == sorted(found)
    cases = [{("a", (i,)), ("b", (j,))} for i in range(3) for j in range(60)]
    found = chosen(cases)
    assert len(found) == 60 and all(sum(("a", (i,)) in cases[k] for k in found) == 20 for i in range(3))


@pytest.mark.parametrize(("one", "other"), [(1, 2), (1, 3)])
@pytest.mark.parametrize("third", [4])
def test_what_is_set_together_is_one_value(request, one, other, third):
    assert values_of(request.node) == {("one,other", (id(one), id(other))), ("third", (id(third),))}
