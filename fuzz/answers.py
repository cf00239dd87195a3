"""What is wrong with what a run or a search left on the disk, in sentences; none if all is well."""

import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cortado.errors import CortadoError, CortadoWarning
from cortado.pictures.film import is_out
from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import Scene

TOLERANCE = 0.5
"""How far outside of its container a particle may be, in spacings: up to there it has not passed the wall particles."""


def run_complaints(folder: Path, finished: bool, steps: int | None = None, record_every: int = 1) -> list[str]:
    """About the folder of a run: its trajectory opens, and if the run has finished, it is complete and plausible."""
    path = folder / "trajectory.vtkhdf"
    if not path.exists():
        return ["exit code 0, but there is no trajectory"] if finished else []
    try:
        trajectory = Trajectory.load(path)
    except Exception as error:
        return [f"the trajectory does not open: {type(error).__name__}: {error}"]
    if not finished:
        return []
    try:
        with warnings.catch_warnings(action="ignore", category=CortadoWarning):
            scene = Scene.from_json((folder / "scene.json").read_text(encoding="utf-8"))
    except (OSError, CortadoError) as error:
        return [f"scene.json cannot be read: {error}"]
    found = trajectory_complaints(scene, trajectory)
    if steps is not None:
        wanted = [*range(0, steps, record_every), steps]
        if trajectory.steps.tolist() != wanted:
            found.append(f"{len(trajectory.steps)} frames, but {len(wanted)} were asked for")
    return found


def trajectory_complaints(scene: Scene, trajectory: Trajectory) -> list[str]:
    """About particles that are nowhere, or not where the container keeps them."""
    for name in ("positions", "velocities", "mass_fractions"):
        values = getattr(trajectory, name)
        if values is not None and not np.isfinite(values).all():
            frame = int(np.argwhere(~np.isfinite(values))[0][0])
            return [f"exit code 0, but {name} are not finite in frame {frame}"]
    if not scene.forces.pressure:
        return []
    spacing, precision = scene.discretisation.spacing, np.finfo(trajectory.positions.dtype).eps
    positions = trajectory.positions.astype(np.float64)
    tolerance = TOLERANCE * spacing + 4.0 * float(precision) * float(np.abs(positions).max())
    region = scene.container.region(scene.dimension).opened(scene.container.periods(scene.dimension)[1])
    waiting = (_waiting(scene, x, frame.others) for x, frame in zip(positions, trajectory, strict=True))
    lost = [~region.contains(points, tolerance) & ~held for points, held in zip(positions, waiting, strict=True)]
    first = next((k for k, outside in enumerate(lost) if outside.any()), None)
    if first is None:
        return []
    return [
        f"exit code 0, but {np.count_nonzero(lost[-1])} of {trajectory.particles} particles end outside of the "
        f"container, the first of them in frame {first} of {len(lost) - 1}"
    ]


def _waiting(scene: Scene, points: np.ndarray, others: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n,) whether a particle of the nozzle has not come out yet, or by less than a spacing, or is in a drain."""
    waiting = ~is_out(scene, others, len(points))
    if scene.emitter:
        spacing = scene.discretisation.spacing
        along = (points - scene.emitter[0].outlet) @ np.array(scene.emitter[0].direction)
        held = len(scene.emitter[0].particles(spacing))
        waiting[-held:] |= along[-held:] < spacing
    return waiting


def search_complaints(folder: Path, finished: bool) -> list[str]:
    """About the folder of a search: its metrics can be read, and its losses are numbers."""
    path = folder / "metrics.jsonl"
    if not path.exists():
        return ["exit code 0, but there are no metrics"] if finished else []
    try:
        lines = [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]
    except ValueError as error:
        return [f"metrics.jsonl cannot be read: {error}"]
    if not all(math.isfinite(line["loss"]) for line in lines):
        return ["metrics.jsonl has a loss that is not finite"]
    return []


def same_frames(part: Trajectory, whole: Trajectory) -> str | None:
    """What differs between the frames of a run that was killed and those of the same run undisturbed."""
    frames = len(part.times)
    for name in ("times", "steps", "positions", "velocities", "mass_fractions"):
        found, wanted = getattr(part, name), getattr(whole, name)
        if found is not None and found.tobytes() != wanted[:frames].tobytes():
            return name
    return None


def leftovers(folder: Path) -> list[str]:
    """Names of temporary files in a run folder."""
    names = (path.relative_to(folder) for path in folder.rglob("*"))
    return sorted(str(n) for n in names if n.name.startswith(".") or n.suffix in (".tmp", ".partial", ".new"))
