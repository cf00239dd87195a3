"""The tables of `validation/README.md`: every row names a command that is there."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "validation"
HEAD = "| claim | setting | measured | off | command |"
ROWS = re.findall(r"^\| (?!claim \|)(.*\S) \|$", (FOLDER / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
COMMANDS = [row.split(" | ")[-1] for row in ROWS]


@pytest.fixture(scope="module")
def cases():
    """Names of the cases of scripts that have ``--only``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        found = {}
        for name in ("projection", "solids"):
            spec = importlib.util.spec_from_file_location(f"validation_{name}", FOLDER / f"{name}.py")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            found[f"{name}.py"] = list(module.CASES if name == "projection" else module.cases("cpu"))
    return found


def fault(command: str, cases: dict[str, list[str]]) -> str | None:
    """What a command lacks, if it lacks something."""
    file, *words = shlex.split(command)
    path = ROOT / file if "/" in file else FOLDER / file
    if not path.exists():
        return f"there is no {file}"
    text = path.read_text(encoding="utf-8")
    if file.startswith("tests/"):
        test = not words or (words[0] == "-k" and re.search(rf"^def test_\w*{words[1]}", text, re.MULTILINE))
        return None if test else f"{file} has no test {words[1]}"
    if words == ["OUT"]:
        return None if 'add_argument("folder"' in text else f"{file} takes no folder"
    if words and f'"{words[0]}"' not in text:
        return f"{file} has no option {words[0]}"
    if words[:1] == ["--only"] and not any(name.startswith(words[1]) for name in cases[file]):
        return f"{file} has no case {words[1]}"
    return None


def test_rows_are_whole():
    assert len(ROWS) > 50
    assert [row for row in ROWS if row.count(" | ") != HEAD.count(" | ")] == []


@pytest.mark.parametrize("command", sorted(set(COMMANDS)))
def test_the_command_of_a_row_is_there(command, cases):
    assert re.fullmatch(r"`[^`]+`", command), "a row ends with its command"
    assert fault(command.strip("`"), cases) is None


@pytest.mark.parametrize(
    "command",
    [
        "absent.py",
        "projection.py --onl jet",
        "projection.py --only absent",
        "tests/test_solids.py -k absent",
        "walls.py OUT",
    ],
)
def test_a_command_that_is_not_there_is_found(command, cases):
    assert fault(command, cases)
