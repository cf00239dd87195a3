"""The README does what it says: its code runs as printed, its commands are commands, its files are there."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import cortado.cli.commands.check
import cortado.cli.commands.describe
import cortado.cli.commands.new
import cortado.cli.commands.optimise
import cortado.cli.commands.run
import cortado.cli.commands.sweep
from cortado.cli import main
from cortado.optimisation.inverse.task import load_task
from cortado.scene.scene import load_scene

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LOADERS = {"optimise": load_task, "sweep": load_task}
COMMANDS = re.findall(r"^    cortado (.*)$", README, re.MULTILINE)


@pytest.fixture(autouse=True)
def root(monkeypatch):
    """The working directory that the README assumes."""
    monkeypatch.chdir(ROOT)


@pytest.mark.filterwarnings("error:.*limit of stability:cortado.errors.CortadoWarning")
def test_the_code_runs_as_printed(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code.splitlines()) <= 25
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    shape, ratio, _ = [line for line in capsys.readouterr().out.splitlines() if line[0] in "([0123456789"]
    assert re.fullmatch(r"\(21, \d+, 3\)", shape)
    assert float(ratio) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(names["result"].parameters["tilt"], names["true_tilt"]["tilt"], atol=0.01)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_one(command, monkeypatch):
    for module, function in (
        (cortado.cli.commands.new, "new_scene"),
        (cortado.cli.commands.describe, "describe_scene"),
        (cortado.cli.commands.run, "run_scene"),
        (cortado.cli.commands.optimise, "optimise_task"),
        (cortado.cli.commands.check, "check_scene"),
        (cortado.cli.commands.sweep, "run_sweep"),
    ):
        monkeypatch.setattr(module, function, lambda *arguments: "done")
    words = shlex.split(command)
    main(words)
    load = next((LOADERS[word] for word in words if word in LOADERS), load_scene)
    for word in words:
        if word.endswith(".toml"):
            assert load(word) is not None


def test_there_are_commands():
    wanted = {"new", "describe", "run", "optimise", "sweep", "gradients"}
    assert {command.split()[0] for command in COMMANDS} == wanted


def test_its_files_are_there():
    linked = re.findall(r"\]\(([^):]+)\)", README)
    named = re.findall(r"\b(?:docs|examples|tests|validation)/[\w/.]+\w", README)
    assert len(linked) >= 3 and len(named) >= 8
    assert [name for name in [*linked, *named] if not (ROOT / name).exists()] == []


def test_its_targets_are_in_the_makefile():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^    make (\w+)$", README, re.MULTILINE)
    assert targets == ["demo", "test"]
    assert set(targets) <= set(re.search(r"^TASKS := (.*)$", makefile, re.MULTILINE)[1].split())


def test_it_names_no_path_of_a_machine():
    assert re.findall(r"(?<![\w.:/])/(?:home|root|work|tmp|Users|mnt)\b", README) == []
