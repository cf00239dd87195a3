"""``cortado picture``: a shaded picture, or a film, of a run that is there."""

from pathlib import Path

from cortado.errors import InputError
from cortado.pictures.film import film, lacking
from cortado.pictures.image_files import write_picture
from cortado.runs.measuring import coloured_by
from cortado.runs.run_folder import RunFolder
from cortado.runs.run_pictures import run_page
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.simulation import Simulation


def draw_run(run: Path, frame: int, as_film: bool, out: Path | None, overrides: list[str], device: str) -> str:
    """Draw one recorded frame of a run, counted from the end where it is negative, or a film of all; returns a sentence
    that says where it is."""
    folder = RunFolder.open(run)
    for override in overrides:
        if not override.startswith("picture."):
            raise InputError(f"--set is {override}, but must begin with picture., as the run is there already.")
    scene = folder.read_scene(overrides)
    if not folder.trajectory.exists():
        raise InputError(f"{folder.path} has no trajectory; the pictures of a search are in {folder.figures}.")
    trajectory = Trajectory.load(folder.trajectory)
    missing = lacking(scene)
    if missing:
        raise InputError(missing)
    page = run_page(scene, trajectory, device, coloured_by(scene, trajectory, lambda: Simulation(scene, device)))
    if as_film:
        path = out or folder.figures / "film.mp4"
        film(path, page, range(len(trajectory)), (scene.picture or Picture()).film_frames or None)
        return f"The film is in {path}."
    if frame not in range(-len(trajectory), len(trajectory)):
        raise InputError(f"--frame is {frame}, but the run has {len(trajectory)} frames, from 0.")
    path = out or folder.figures / "picture.png"
    write_picture(path, page.image(frame))
    return f"The picture is in {path}."
