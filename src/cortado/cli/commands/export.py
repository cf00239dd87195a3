"""``cortado export``: a run as files of other programs."""

from pathlib import Path

from cortado.cli.commands.picture import scene_of_run
from cortado.errors import InputError
from cortado.pictures.exports.formats import export
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory
from cortado.simulation import Simulation


def export_run(run: Path, to: str, out: Path | None, every: int, overrides: list[str]) -> str:
    """Write every so many frames of a run that is there in a format; returns a sentence that says where they are."""
    folder = RunFolder.open(run)
    if not folder.trajectory.exists():
        raise InputError(f"{folder.path} has no trajectory, but must be the folder of a run of a scene.")
    trajectory, scene = Trajectory.load(folder.trajectory)[::every], scene_of_run(folder, overrides)
    found = export(trajectory, folder.path / to if out is None else out, to, scene, lambda: Simulation(scene))
    return f"The run is in {found}."
