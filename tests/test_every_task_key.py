"""Every key of a task, a fit and a data set, changed alone, changes what comes out or is said, or is refused."""

import json
from typing import Any

import numpy as np
import pytest

from bad_tasks import TINY_SCENE
from cortado import Simulation, load_scene
from cortado.optimisation.datasets import DatasetTables
from cortado.optimisation.inverse.fit_tables import FitTables
from cortado.optimisation.inverse.tables import TaskTables
from cortado.pictures.image_files import write_picture
from every_key import key_at, keys_of, numbers, places, put, same

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
            **{"valid": 0.16, "test": 0.16, "walls": True, "tangents": 1, "tangent_frames": "all"},
        }
    },
}
MODELS = {"fit": FitTables, "measured": FitTables, "dataset": DatasetTables}
ASIDE = {("OptimiseTable", "tolerance"): "only where a search is at its end: tests/test_task.py"}
"""Keys that others look at, or that cannot show here."""


def tables_of(base: str) -> Any:
    model = MODELS.get(base, TaskTables)
    return model.model_validate({name: BASES[base][name] for name in model.model_fields})


PLACES = [(base, path) for base in BASES for path in places(tables_of(base))]
FIRST = {key_at(tables_of(base), path): (base, path) for base, path in reversed(PLACES)}
CASES = [place for key, place in FIRST.items() if key not in ASIDE]
"""The first place of each key."""


def test_no_key_of_a_task_is_forgotten():
    missing = keys_of(TaskTables, FitTables, DatasetTables) - set(FIRST) - set(ASIDE)
    assert not missing, f"give {missing} in one of the tasks above"


def written(folder, tables):
    """A task in a folder, with what it reads beside it."""
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
    """A folder with what was measured."""
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
    """What a command makes of tables: how it ends, what it says, and the numbers that it leaves."""

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


@pytest.fixture(scope="module")
def known():
    return {}


@pytest.mark.parametrize("base, path", CASES, ids=[f"{base}-{'.'.join(map(str, path))}" for base, path in CASES])
def test_a_key_of_a_task_changed_alone_acts_or_is_refused(base, path, outcome, known):
    if base not in known:
        known[base] = outcome(base, BASES[base])
        assert known[base][0] in (0, 1), known[base][1]
    tables = json.loads(json.dumps(BASES[base]))
    put(tables, path, tables_of(base))
    found = outcome(base, tables)
    print(found[:2])
    assert found[0] == 2 or not same(found, known[base])
