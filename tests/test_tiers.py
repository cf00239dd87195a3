"""The tiers name files and tests that there are, and what is short has every value of what is long."""

import ast
from pathlib import Path

import pytest

from conftest import COLLECTED, VALIDATION, tier
from short import KEPT, MEASURED, SLOW, chosen, short, values_of, write_seconds
from skips import complaints

TESTS = Path(__file__).parent


def names_in(file):
    tree = ast.parse((TESTS / f"{file}.py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("file", sorted({*VALIDATION, *KEPT, *(file for file, _ in MEASURED)}))
def test_what_is_listed_is_there(file):
    listed = KEPT.get(file, set()) | {test for of, test in MEASURED if of == file}
    missing = {test.partition("[")[0] for test in listed} - names_in(file)
    assert not missing


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

    kept, quick = Item("test_examples", "test_the_code_runs_as_printed"), Item("test_terms", "test_of_a_second")
    whole, case = (
        Item("test_plants", "test_every_plant_is_found[x]"),
        Item("test_docs", "test_the_code_runs_as_printed[solids.md]"),
    )
    assert short([kept, whole, quick, case]) == [kept, quick]


def test_seconds_are_those_of_a_report(tmp_path, monkeypatch):
    table = tmp_path / "seconds.csv"
    monkeypatch.setattr("short.SECONDS", table)
    monkeypatch.setattr("short.MEASURED", {("test_a", "test_one"): 4.0, ("test_b", "test_two[x]"): 5.0})
    times = {"test_one": 1.0, "test_two[x]": 6.0, "test_two[y]": 7.0, "test_three[x]": SLOW, "test_three[y]": 1.0}
    files = ["test_a", "test_b", "test_b", "test_b", "test_b"]
    cases = "".join(
        f'<testcase classname="tests.{file}" name="{name}" time="{time}"/>'
        for file, (name, time) in zip(files, times.items(), strict=True)
    )
    report = tmp_path / "suite.xml"
    report.write_text(f"<testsuites><testsuite>{cases}</testsuite></testsuites>")
    write_seconds(report)
    assert table.read_text() == "file,test,seconds\ntest_b,test_three[x],3\ntest_b,test_two,7\n"


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


def test_a_skip_that_a_package_would_cure_is_told():
    assert complaints(["there is no CUDA device"] * 300 + ["root may write anywhere"]) == []
    assert complaints(["PyTorch is not installed"]) == ["1 skipped, at most 0 may be: PyTorch is not installed"]
    assert complaints(["root may write anywhere"] * 99)[0].startswith("99 skipped")
