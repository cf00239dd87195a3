"""Every option of every command, given alone, changes what the command says or leaves, or is refused."""

import hashlib
import re
import shutil

import pytest

from bad_scenes import assert_one_sentence
from bad_tasks import GOOD_TASK, TINY_SCENE
from every_key import numbers, same

SCENE, TASK, SHORT = "scene.toml", "task.toml", ("--steps", "3")
NOWHERE = "cuda:99"
COMMANDS = {
    "new": (("dam.toml",), {"template": ["drop"], "dimension": ["3"]}),
    "examples": ((), {"copy": ["first_gradient"], "to": ["there"]}),
    "describe": (
        (SCENE, "--json", "--set", "picture.film_frames=0"),
        {
            **{"steps": ["7"], "time": ["0.1"], "record-every": ["3"], "fps": ["9"], "picture": ["a.png"]},
            **{"set": ["solver.time_step=0.001"], "device": [NOWHERE], "precision": ["float64"]},
        },
    ),
    "run": (
        (SCENE, "--out", "out", "--no-pictures"),
        {
            **{"steps": ["3"], "time": ["0.01"], "set": ["solver.time_step=0.001"], "device": [NOWHERE]},
            **{"precision": ["float64"], "record-every": ["2"], "fps": ["100"], "state": ["run"], "resume": []},
            **{"record": ["density"], "out": ["other"]},
        },
    ),
    "compare": (("run", "finer"), {"json": []}),
    "optimise": (
        (TASK, "--no-pictures"),
        {
            **{"out": ["other"], "set": ["optimise.iterations=3"], "device": [NOWHERE], "precision": ["float64"]},
            **{"resume": [], "scheduler": ["tcp://127.0.0.1:1"], "workers": ["2"]},
        },
    ),
    "picture": (
        ("run",),
        {
            **{"frame": ["0"], "film": ["--out", "film.webp"], "lines": ["90"], "camera": ["orbit"]},
            **{"colour": ["speed"], "out": ["b.png"], "set": ["picture.width=100"], "device": [NOWHERE]},
        },
    ),
    "export": (
        ("run", "--to", "vtp"),
        {"to": ["ply"], "out": ["there"], "every": ["2"], "set": ["picture.colour=speed"]},
    ),
    "convergence": (("run", "finer", "finest"), {"quantity": ["absent.py:f"], "json": []}),
    "dataset": (
        (TASK, "--runs", "3"),
        {
            **{"runs": ["4"], "out": ["other"], "set": ["dataset.seed=4"], "device": [NOWHERE]},
            **{"precision": ["float64"]},
        },
    ),
    "sweep": (
        (SCENE, "--set", "solver.time_step=0.001,0.002", *SHORT, "--no-pictures"),
        {
            **{"set": ["phase.0.viscosity=0.1,0.2"], "zip": ["phase.0.viscosity=0.1,0.2"], "steps": ["4"]},
            **{"time": ["0.1"], "out": ["other"], "device": [NOWHERE], "precision": ["float64"]},
            **{"record-every": ["2"], "fps": ["100"]},
        },
    ),
    "gradients check": (
        (SCENE, *SHORT, "--json"),
        {
            **{"steps": ["2"], "parameters": ["viscosity"], "loss": ["centre-of-mass"], "perturbation": ["0.1"]},
            **{"out": ["there"], "set": ["solver.time_step=0.001"], "device": [NOWHERE], "seed": ["1"]},
        },
    ),
}
"""The arguments of each command, and values of its options."""
ASIDE = {
    "help": "words",
    "quiet": "what it keeps back are lines of progress: tests/test_cli.py",
    "run overwrite": "only where there is a run: tests/test_cli.py",
    "run no-pictures": "given in all runs here",
    "optimise overwrite": "only where there is one: tests/test_cli.py",
    "optimise no-pictures": "given here",
    "describe json": "given here",
    "sweep no-pictures": "given here",
    "sweep scheduler": "the same comes out: tests/test_sweep.py",
    "dataset scheduler": "the same comes out: tests/test_datasets.py",
    "sweep workers": "the same comes out: tests/test_sweep.py",
    "dataset workers": "the same comes out: tests/test_datasets.py",
    "gradients check json": "given here",
}
CASES = [(command, option) for command, (_, options) in COMMANDS.items() for option in options]


@pytest.fixture
def effects(tmp_path, monkeypatch, cortado_command, unrendered):
    """How a command ends in a folder that has only what it asks for, what it says, and what it leaves."""
    monkeypatch.chdir(tmp_path)

    def seen(command, *arguments):
        (tmp_path / SCENE).write_text(TINY_SCENE)
        vary = '[dataset]\nsteps = 2\nvary."phase.0.viscosity" = [0.1, 0.2]\n'
        (tmp_path / TASK).write_text(GOOD_TASK.replace("iterations = 6", "iterations = 1") + vary)
        for name, steps in (("run", 1), ("finer", 2), ("finest", 4)):
            if name in arguments:
                step = ("--set", f"solver.time_step={0.002 / steps}")
                cortado_command("run", SCENE, *step, "--steps", steps, "--no-pictures", "--out", name)
        before = {path for path in tmp_path.rglob("*") if path.is_file()}
        code, out, err = cortado_command(*command.split(), *arguments)
        said = [line for line in (out + err).splitlines() if not re.search(r"\d m?s\b|seconds|bytes", line)]
        made = sorted(path for path in tmp_path.rglob("*") if path.is_file() and path not in before)
        found = code, said, {str(path.relative_to(tmp_path)): content(path) for path in made}
        for path in tmp_path.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return found

    return seen


def content(path):
    """The numbers in a file, or the bits of a picture or a surface."""
    if path.suffix in (".png", ".vtp", ".ply", ".toml", ".py", ".webp"):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    if path.suffix == ".vtkhdf":
        return path.stat().st_size
    return numbers(path)


@pytest.fixture(scope="module")
def known():
    return {}


@pytest.mark.parametrize("command", COMMANDS)
def test_no_option_is_forgotten(command, cortado_command):
    shown = set(re.findall(r"^│ (?:-h, )?--([a-z-]+)", cortado_command(*command.split(), "--help")[1], re.MULTILINE))
    aside = {name.removeprefix(f"{command} ") for name in ASIDE}
    missing = shown - aside - set(COMMANDS[command][1])
    assert shown and not missing, f"give {missing} above"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_given_twice_has_the_same_effects(command, effects):
    """Or all options would act."""
    arguments, _ = COMMANDS[command]
    found = effects(command, *arguments)
    assert found[0] in (0, 1), found
    assert same(effects(command, *arguments), found)


@pytest.mark.parametrize("command, option", CASES, ids=[f"{command}-{option}" for command, option in CASES])
def test_an_option_given_alone_acts_or_is_refused(command, option, effects, known):
    arguments, options = COMMANDS[command]
    if command not in known:
        known[command] = effects(command, *arguments)
    found = effects(command, *arguments, f"--{option}", *options[option])
    if found[0] == 2:
        assert_one_sentence(found[1][-1])
    else:
        assert not same(found, known[command])
