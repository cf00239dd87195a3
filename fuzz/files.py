"""Every reader of files meets hostile ones."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cortado.runs.trajectory import Trajectory
from experiments.experiment_files import load_experiment
from fuzz import bases
from fuzz.answers import run_complaints, same_frames, search_complaints
from fuzz.cases import Case
from fuzz.hostile import make_hostile
from fuzz.processes import Outcome, by_fork, call
from fuzz.toml_text import to_toml

PLANE = {
    "dimension": 2,
    "discretisation": {"spacing": 0.05},
    "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
    "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8]},
    "solver": {"time_step": 0.002},
}
READERS = (
    *("points.npy", "points.vtk", "points.vtp", "points.vtkhdf", "trajectory.vtkhdf", "picture.png"),
    *("scene.toml", "task.toml", "experiment.toml"),
    *("scene.json", "environment.json", "metrics.jsonl", "checkpoint/replay.log"),
)
"""Good files, made by `prepare`; those of the last line are of a search."""
SEARCH = "search"
"""The folder of a search that is over."""


def prepare(folder: Path) -> list[Outcome]:
    """One good file for every reader."""
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water"}
    (folder / "scene.toml").write_text(to_toml({**PLANE, "fluid": [block]}))
    (folder / "task.toml").write_text(to_toml(bases.tasks()["ensemble_search"]))
    experiment = (bases.ROOT / "experiments" / "lyapunov.toml").read_text()
    scene = bases.ROOT / "experiments" / "scenes" / "splash.toml"
    (folder / "experiment.toml").write_text(experiment.replace("scenes/splash.toml", str(scene)))
    outcomes = [
        by_fork(["run", "scene.toml", "--no-pictures", "--steps", "6", "--out", "run"], folder),
        by_fork(["optimise", "task.toml", "--no-pictures", "--out", SEARCH], folder),
        call(lambda: _write_points(folder), ("points",), folder),
    ]
    for outcome in outcomes:
        if outcome.code:
            raise RuntimeError(f"{outcome.arguments} fails with good files: {outcome.err}")
    shutil.copy(folder / "run" / "trajectory.vtkhdf", folder)
    shutil.copy(folder / "run" / "figures" / "particles.png", folder / "picture.png")
    return outcomes


def read_hostile(case: Case) -> None:
    """One reader, and one file that is not what it should be."""
    reader = READERS[case.number % len(READERS)]
    good = case.folder.parent / "prepared" / "files"
    if reader in READERS[-4:]:
        _resume(case, good, reader)
        return
    others = [(good / name).read_bytes() for name in READERS[:9] if name != reader]
    path = case.folder / reader
    case.notes += [reader, make_hostile(path, (good / reader).read_bytes(), others, case.random)]
    if reader.startswith("points"):
        fluid = {"shape": "points", "file": reader, "phase": "water"}
        (case.folder / "scene.toml").write_text(to_toml({**PLANE, "fluid": [fluid]}))
        _run(case)
    elif reader == "scene.toml":
        _run(case)
    elif reader == "task.toml":
        _search(case)
    elif reader == "picture.png":
        task = bases.tasks()["match_image"]
        task["problem"]["picture"] = reader
        (case.folder / "task.toml").write_text(to_toml(task))
        _search(case)
    elif reader == "experiment.toml":
        case.read(load_experiment, path)
    else:
        _load(case, path, good / reader)


def _run(case: Case) -> None:
    outcome = case.cortado("run", "scene.toml", "--no-pictures", "--steps", "2", "--out", "out")
    case.complaints += run_complaints(case.folder / "out", outcome.code == 0, 2)


def _search(case: Case) -> None:
    outcome = case.cortado("optimise", "task.toml", "--no-pictures", "--out", "out")
    case.complaints += search_complaints(case.folder / "out", outcome.code == 0)


def _load(case: Case, path: Path, good: Path) -> None:
    """A damaged trajectory is refused, or it is read with the numbers that were written."""
    whole = Trajectory.load(good)

    def load(path: Path) -> None:
        part = Trajectory.load(path)
        if part.positions.shape[1:] != whole.positions.shape[1:] or len(part.times) > len(whole.times):
            raise SystemExit(3)
        if same_frames(part, whole) is not None:
            raise SystemExit(3)

    outcome = case.read(load, path, codes=(0, 1, 3))
    if outcome.code == 3:
        case.complaints.append("a damaged trajectory is read with other numbers")


def _resume(case: Case, good: Path, name: str) -> None:
    """A search with a damaged folder is refused, or goes on with the same bits."""
    shutil.copy(good / "task.toml", case.folder)
    out = case.folder / "out"
    shutil.copytree(good / SEARCH, out)
    wanted = (good / SEARCH / "checkpoint" / "replay.log").read_bytes()
    others = [(good / SEARCH / other).read_bytes() for other in READERS[-4:] if other != name]
    content = (out / name).read_bytes()
    (out / name).unlink()
    case.notes += [name, make_hostile(out / name, content, others, case.random)]
    outcome = case.cortado("optimise", "task.toml", "--no-pictures", "--out", "out", "--resume")
    if outcome.code == 0 and _content(out / "checkpoint" / "replay.log") != wanted:
        case.complaints.append("a search with a damaged folder went on with other bits")


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _write_points(folder: Path) -> None:
    """A block of 64 particles in all formats."""
    import vtk

    grid = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2) + 0.5) * 0.05
    np.save(folder / "points.npy", grid)
    points, data = vtk.vtkPoints(), vtk.vtkPolyData()
    points.SetDataTypeToDouble()
    for x, y in grid.tolist():
        points.InsertNextPoint(x, y, 0.0)
    data.SetPoints(points)
    writers: Sequence[tuple[str, type]] = (
        ("vtk", vtk.vtkPolyDataWriter),
        ("vtp", vtk.vtkXMLPolyDataWriter),
        ("vtkhdf", vtk.vtkHDFWriter),
    )
    for suffix, make in writers:
        writer = make()
        writer.SetFileName(str(folder / f"points.{suffix}"))
        writer.SetInputData(data)
        writer.Write()
