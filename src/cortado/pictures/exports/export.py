"""A trajectory as files of other programs, in one of several formats."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path

from cortado.errors import InputError, shown
from cortado.files.atomic import sentences
from cortado.files.input_files import as_path
from cortado.files.progress import announce, track
from cortado.pictures.exports.by_trimesh import Advance, write_glb, write_obj, write_ply
from cortado.pictures.exports.by_usd import write_usd
from cortado.pictures.exports.by_vtk import write_vtp
from cortado.pictures.exports.exported import Exported
from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import Scene, as_scene
from cortado.simulation import Simulation

FORMATS: dict[str, Callable[[Exported, Path, Advance], Path]] = {
    "ply": write_ply,
    "obj": write_obj,
    "glb": write_glb,
    "usd": write_usd,
    "vtp": write_vtp,
}


def export(
    trajectory: Trajectory,
    folder: str | PathLike[str],
    to: str,
    scene: Scene | str | PathLike[str],
    simulation: Callable[[], Simulation] | None = None,
) -> Path:
    """See `Trajectory.export`, and `Exported`; returns the file to open, or the folder of a series."""
    if to not in FORMATS:
        raise InputError(f"to is {shown(to)}, but must be one of {', '.join(FORMATS)}.")
    if not len(trajectory):
        raise InputError("The trajectory has no frame, but must have one to be exported.")
    of, into = as_scene(scene), Path(as_path("folder", folder))
    if of.dimension != trajectory.dimension or len(of.phase) != _phases(trajectory):
        raise InputError(
            f"scene has {of.dimension} dimensions and {len(of.phase)} phases, but must be that of the trajectory, with "
            f"{trajectory.dimension} and {_phases(trajectory)}."
        )
    run = Exported(trajectory, of, simulation)
    with sentences(into):
        into.mkdir(parents=True, exist_ok=True)
        if any(into.iterdir()):
            raise InputError(f"{into} is not empty; choose another folder, in which no other files get in between.")
    whole = run.whole if to == "usd" else run.series
    with track(len(trajectory if whole is None else whole.times), "export") as advance:
        path = FORMATS[to](run, into, advance)
    for said in ("" if whole is None else whole.in_words, run.in_words):
        if said:
            announce(f"{path.name}: {said}.")
    return path


def _phases(trajectory: Trajectory) -> int:
    return 1 if trajectory.mass_fractions is None else trajectory.mass_fractions.shape[-1]
