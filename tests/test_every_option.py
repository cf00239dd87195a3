"""Every option of every command and every key of tasks, fits and data sets, alone: it acts, or is refused."""

import hashlib
import json
import re
import shutil
from typing import Any

import numpy as np
import pytest

from bad_scenes import assert_one_sentence
from bad_tasks import GOOD_TASK, TINY_SCENE
from cortado import Simulation, load_scene
from cortado.optimisation.datasets import DatasetTables
from cortado.optimisation.task_tables import FitTables, TaskTables
from cortado.pictures.image_files import write_picture
from every_key import key_at, keys_of, numbers, places, put, same

SCENE, TASK = "scene.toml", "task.toml"
COMMANDS = {
    "new": ("dam.toml", "template drop, dimension 3"),
    "examples": ("", "copy first_gradient, to there"),
    "describe": (
        "scene.toml --json --set picture.film_frames=0 --set picture.width=128 --set picture.height=72",
        "steps 7, time 0.1, record-every 3, fps 9, picture a.png, set solver.time_step=0.001, device cuda:99, "
        "precision float64",
    ),
    "run": (
        "scene.toml --out out --no-pictures",
        "steps 3, time 0.01, set solver.time_step=0.001, device cuda:99, precision float64, record-every 2, fps 100, "
        "state run, resume, record density, out other",
    ),
    "compare": ("run finer", "json"),
    "optimise": (
        "task.toml --no-pictures",
        "out other, set optimise.iterations=3, device cuda:99, precision float64, resume, workers 2, "
        "scheduler tcp://127.0.0.1:1",
    ),
    "picture": (
        "run --set picture.width=128 --set picture.height=72",
        "frame 0, film --out film.webp --set picture.film_frames=3, lines 90, camera orbit, colour speed, out b.png, "
        "set picture.width=100, device cuda:99",
    ),
    "export": ("run --to vtp", "to ply, out there, every 2, set picture.colour=speed"),
    "convergence": ("run finer finest", "quantity absent.py:f, json"),
    "dataset": ("task.toml --runs 3", "runs 4, out other, set dataset.seed=4, device cuda:99, precision float64"),
    "sweep": (
        "scene.toml --set solver.time_step=0.001,0.002 --steps 3 --no-pictures",
        "set phase.0.viscosity=0.1,0.2, zip phase.0.viscosity=0.1,0.2, steps 4, time 0.1, out other, device cuda:99, "
        "precision float64, record-every 2, fps 100",
    ),
    "gradients check": (
        "scene.toml --steps 3 --json",
        "steps 2, parameters viscosity, loss centre-of-mass, perturbation 0.1, out there, "
        "set solver.time_step=0.001, device cuda:99, seed 1",
    ),
}
"""The arguments of each command, and its options with values."""
OPTIONS = {
    command: {option.split()[0]: option.split()[1:] for option in options.split(", ")}
    for command, (_, options) in COMMANDS.items()
}
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
KNOWN: dict[str, Any] = {}
"""What commands do without a further option."""
CASES = [(command, option) for command, options in OPTIONS.items() for option in options]


@pytest.fixture
def effects(tmp_path, monkeypatch, cortado_command, unrendered):
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
    if path.suffix in (".png", ".vtp", ".ply", ".toml", ".py", ".webp"):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    if path.suffix == ".vtkhdf":
        return path.stat().st_size
    return numbers(path)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_option_is_forgotten(command, cortado_command):
    shown = set(re.findall(r"^│ (?:-h, )?--([a-z-]+)", cortado_command(*command.split(), "--help")[1], re.MULTILINE))
    aside = {name.removeprefix(f"{command} ") for name in ASIDE}
    missing = shown - aside - set(OPTIONS[command])
    assert shown and not missing, f"give {missing} above"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_given_twice_has_the_same_effects(command, effects):
    arguments = COMMANDS[command][0].split()
    found = effects(command, *arguments)
    assert found[0] in (0, 1), found
    assert same(effects(command, *arguments), found)


@pytest.mark.parametrize("command, option", CASES, ids=[f"{command}-{option}" for command, option in CASES])
def test_an_option_given_alone_acts_or_is_refused(command, option, effects):
    arguments = COMMANDS[command][0].split()
    found = effects(command, *arguments, f"--{option}", *OPTIONS[command][option])
    if found[0] == 2:
        assert_one_sentence(found[1][-1])
        return
    if command not in KNOWN:
        KNOWN[command] = effects(command, *arguments)
    assert not same(found, KNOWN[command])


SENSOR = {"name": "gauge", "kind": "wave_gauge", "position": [0.2, 0.0], "radius": 0.2}
RENDER = {"resolution": [16, 16]}
ROWS = [[1.5, -9.81], [1.0, -9.0]]
TRACKS = {"name": "tracers", "kind": "tracks", "file": "tracks.csv", "start": 0.0, "noise": 1e-4}
MEASURED = [
    {"name": "level", "kind": "sensor", "sensor": "gauge", "file": "level.csv", "noise": 0.01, "calibrate": ["start"]},
    {**TRACKS, "calibrate": ["start"]},
    {
        **{"name": "film", "kind": "video", "file": "frames", "frame_rate": 476.19, "every": 1, "noise": 0.1},
        **{"crop": [0, 0, 16, 16], "mask": "mask.png", "calibrate": ["extinction"]},
    },
]
SEARCH = {"optimiser": "adam", "learning_rate": 0.5, "iterations": 2}
BASES: dict[str, dict[str, Any]] = {
    "positions": {
        "problem": {"steps": 5, "frames": 2, "target": {"gravity": ROWS, "viscosity": 0.08}},
        "optimise": {
            **{"start": {"gravity": [[0.0, -7.0], [0.0, -8.0]], "viscosity": 0.05}, "knots": 3},
            **{"bounds": {"viscosity": [0.05, 0.06]}, "logarithmic": ["viscosity"], **SEARCH, "optimiser": "lbfgs"},
            **{"tolerance": 0.5, "check": {"loss_reduction": 1e9, "parameter_error": 1e-9}},
        },
    },
    "images": {
        "render": RENDER,
        "problem": {"steps": 2, "loss": "image", "distance": "pyramid", "target": {"gravity": [1.5, -9.81]}},
        "optimise": {
            **{"start": {"gravity": [0.0, -7.0]}, **SEARCH, "extinction_schedule": [0.5, 1.0], "check": {"psnr": 99.0}},
            "gradient": {
                **{"name": "adjoint_viscosity", "coefficient": 2.0, "samples": 4, "spread": {"gravity": 0.1}},
                "position_noise": 0.01,
            },
        },
    },
    "picture": {
        "render": RENDER,
        "problem": {"steps": 2, "loss": "image", "picture": "heart"},
        "optimise": {"start": {"gravity": [0.0, -7.0]}, **SEARCH},
    },
    "fit": {
        "problem": {"steps": 8, "measured": [TRACKS]},
        "fit": {"start": {"gravity": [2.0, -5.0]}, "bounds": {"gravity": [-9.5, 3.0]}, "iterations": 1, "profiles": 1},
    },
    "measured": {
        "render": RENDER,
        "sensor": [SENSOR],
        "problem": {"steps": 5, "measured": MEASURED, "also": ["other.toml"]},
        "fit": {"start": {"gravity": [0.0, -9.0]}, "iterations": 1, "starts": 1, "profiles": 0},
    },
    "dataset": {
        "dataset": {
            **{"steps": 4, "write_every": 2, "vary": {"phase.0.viscosity": [0.05, 0.1]}, "seed": 3},
            **{"logarithmic": ["phase.0.viscosity"], "position_noise": 0.01, "velocity_noise": 0.01},
            **{"valid": 0.16, "test": 0.25, "walls": True, "tangents": 1, "tangent_frames": "all"},
        }
    },
}
MODELS = {"fit": FitTables, "measured": FitTables, "dataset": DatasetTables}
KEYS_ASIDE = {("OptimiseTable", "tolerance"): "only where a search is at its end: tests/test_task.py"}
"""Keys that others look at, or that cannot show here."""


def tables_of(base: str) -> Any:
    model = MODELS.get(base, TaskTables)
    return model.model_validate({name: BASES[base][name] for name in model.model_fields})


PLACES = [(base, path) for base in BASES for path in places(tables_of(base))]
FIRST = {key_at(tables_of(base), path): (base, path) for base, path in reversed(PLACES)}
KEYS = [place for key, place in FIRST.items() if key not in KEYS_ASIDE]
"""The first place of each key."""


def test_no_key_of_a_task_is_forgotten():
    missing = keys_of(TaskTables, FitTables, DatasetTables) - set(FIRST) - set(KEYS_ASIDE)
    assert not missing, f"give {missing} in one of the tasks above"


def written(folder, tables):
    scene = TINY_SCENE.splitlines(keepends=True)
    file = folder / "task.toml"
    top = "".join(f"{name} = {toml(value)}\n" for name, value in tables.items())
    file.write_text(top + "".join(scene))
    return file


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(name)} = {toml(one)}" for name, one in value.items()) + "}"
    return f"[{', '.join(map(toml, value))}]" if isinstance(value, list) else json.dumps(value)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("measured")
    run = Simulation(load_scene(written(folder, {"sensor": [SENSOR], "render": RENDER}))).run(8)
    heights = run.sensors["gauge"].values
    lines = [f"{time},{height}" for time, height in zip(run.sensors["gauge"].times, heights.ravel(), strict=True)]
    (folder / "level.csv").write_text("\n".join(["time,height", *lines, ""]))
    rows = [f"{run.times[k]},{n},{x},{y}" for k in range(len(run)) for n in (20, 40) for x, y in [run.positions[k][n]]]
    (folder / "tracks.csv").write_text("\n".join(["time,tracer,x,y", *rows, ""]))
    (folder / "frames").mkdir()
    random = np.random.default_rng(0)
    for k in range(6):
        write_picture(folder / "frames" / f"{k}.png", random.uniform(0.0, 1.0, (20, 20, 3)))
    write_picture(folder / "mask.png", random.integers(0, 2, (20, 20, 1)) * np.ones(3))
    (folder / "other.toml").write_text(
        written(folder, {"sensor": [SENSOR], "problem": {"steps": 4, "measured": MEASURED[:1]}}).read_text()
    )
    return folder


@pytest.fixture
def outcome(cortado_command, unrendered, measured, tmp_path_factory):
    def ended(base, tables):
        folder = tmp_path_factory.mktemp("task")
        for path in measured.iterdir():
            (folder / path.name).symlink_to(path)
        (folder / "task.toml").unlink()
        words = ("--runs", 10) if base == "dataset" else ("--no-pictures",) if base not in MODELS else ()
        name = {FitTables: "fit", DatasetTables: "dataset"}.get(MODELS.get(base), "optimise")
        code, out, err = cortado_command(name, written(folder, tables), "--out", folder / "out", *words)
        said = (out + err).replace(str(folder), "")
        return code, said, {path.name: numbers(path) for path in sorted((folder / "out").rglob("*"))}

    return ended


def known(base, outcome):
    key = "task", base  # as a command has the name of one
    if key not in KNOWN:
        KNOWN[key] = outcome(base, BASES[base])
    return KNOWN[key]


@pytest.mark.parametrize("base", BASES)
def test_a_task_as_it_is_runs(base, outcome):
    code, said, _ = known(base, outcome)
    assert code in (0, 1), said


@pytest.mark.parametrize("base, path", KEYS, ids=[f"{base}-{'.'.join(map(str, path))}" for base, path in KEYS])
def test_a_key_of_a_task_changed_alone_acts_or_is_refused(base, path, outcome):
    tables = json.loads(json.dumps(BASES[base]))
    put(tables, path, tables_of(base))
    found = outcome(base, tables)
    print(found[:2])
    assert found[0] == 2 or not same(found, known(base, outcome))
