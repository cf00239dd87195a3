"""The tables of `validation/README.md` are those of `validation/measured.csv`, and commands of rows are there."""

import re
import shlex
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest

from program_texts import sources

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "validation"
with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(str(FOLDER))
    import measured_rows as rows
    import projection
    import solids
ROWS = rows.read()
COMMANDS = {row.command for row in ROWS.values()}
CASES = {"projection.py": list(projection.CASES), "solids.py": list(solids.cases("cpu"))}
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")


def fault(command: str) -> str | None:
    """What a command lacks, if it lacks something."""
    file, *words = shlex.split(command)
    path = ROOT / file if "/" in file else FOLDER / file
    if not path.exists():
        return f"there is no {file}"
    text = sources(path)
    if file.startswith("tests/"):
        test = not words or (words[0] == "-k" and re.search(rf"^def test_\w*{words[1]}", text, re.MULTILINE))
        return None if test else f"{file} has no test {words[1]}"
    if words == ["OUT"]:
        return None if 'add_argument("folder"' in text else f"{file} takes no folder"
    if words and f'"{words[0]}"' not in text:
        return f"{file} has no option {words[0]}"
    if words[:1] == ["--only"] and not any(name.startswith(words[1]) for name in CASES[file]):
        return f"{file} has no case {words[1]}"
    return None


def test_the_tables_are_those_of_the_file():
    """A figure that differs from the file is found, and so is a row too few."""
    assert len(ROWS) > 50
    assert rows.page(PAGE, ROWS) == PAGE
    block = ROWS["block"]
    assert rows.page(PAGE, ROWS | {"block": replace(block, measured=block.measured.replace("0.9", "0.8"))}) != PAGE
    assert rows.page(PAGE, {name: row for name, row in ROWS.items() if name != "block"}) != PAGE


def test_a_script_prints_the_rows_that_name_it():
    """Those whose cells mark figures as measured by their command."""
    printed = {name: script for script in SCRIPTS for name in written(script)}
    assert printed == {name: row.command.split()[0] for name, row in ROWS.items() if row.figures}


SCRIPTS = sorted({command.split()[0] for command in COMMANDS if "/" not in command})


def written(script: str) -> set[str]:
    """Names of the rows in `ROWS` of a script."""
    module = {"projection.py": projection, "solids.py": solids}.get(script)
    if module:
        return set(module.ROWS)
    text = re.search(r"^ROWS = \(([^)]*)\)$", (FOLDER / script).read_text(encoding="utf-8"), re.MULTILINE)
    return set(re.findall(r'"(\w+)"', text[1]))


@pytest.mark.parametrize("module", [projection, solids])
def test_rows_come_from_cases_that_are_there(module):
    names = CASES[f"{module.__name__}.py"]
    beginnings = {case for measure in module.ROWS.values() for case in measure.cases}
    assert [case for case in beginnings if not any(name.startswith(case) for name in names)] == []


def test_a_row_measured_anew_is_that_of_the_file(capsys):
    """Of a block that falls from a lid, in half a second."""
    cases = {name: lambda case=case: case("cpu") for name, case in projection.CASES.items()}
    rows.run_cases(cases, projection.ROWS, Namespace(only="block", write=False))
    found = re.search(r"measured: .*?: ([\d.]+) \| exact: 1 \| off by: ([\d.e-]+)", capsys.readouterr().out)
    assert float(found[1]) == pytest.approx(float(ROWS["block"].figures[0]), abs=2e-4)
    assert float(found[2]) < 1e-3


def test_figures_are_rounded_as_the_file_has_them():
    row = replace(ROWS["block"], measured="a {0.10, -1.5}; b {1,000} c", exact="0, -1, 1000")
    anew = row.measured_anew([0.126, -1.24, 2345.6])
    assert (anew.measured, anew.off_by()) == ("a {0.13, -1.2}; b {2,346} c", "1.35")
    with pytest.raises(ValueError, match="3 figures, and more"):
        row.measured_anew([0.0, 0.0, 0.0, 0.0])


def test_commands_of_rows_are_there_and_others_are_found():
    assert {command: fault(command) for command in COMMANDS if fault(command)} == {}
    absent = ["absent.py", "projection.py --onl jet", "projection.py --only absent", "tests/test_solids.py -k absent"]
    assert all(fault(command) for command in [*absent, "walls.py OUT"])
