"""The tiers name files and tests that there are."""

import ast
from pathlib import Path

import pytest

from conftest import SLOW, SLOW_TESTS, VALIDATION, tier

TESTS = Path(__file__).parent


def test_a_file_is_in_one_tier():
    assert not VALIDATION & SLOW and not (VALIDATION | SLOW) & SLOW_TESTS.keys()


@pytest.mark.parametrize("file", sorted({*VALIDATION, *SLOW, *SLOW_TESTS}))
def test_what_is_listed_is_there(file):
    tree = ast.parse((TESTS / f"{file}.py").read_text())
    there = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    listed = SLOW_TESTS.get(file, set())
    assert listed <= there, listed - there
    assert all(tier(file, test) == "slow" for test in listed)


def test_the_marks_are_set(request):
    """Of all tests of this run."""
    for item in request.session.items:
        found = tier(item.path.stem, getattr(item, "originalname", item.name))
        marks = {mark.name for mark in item.iter_markers()} & {"slow", "validation"}
        assert marks == ({found} - {"unit"}), item.nodeid
