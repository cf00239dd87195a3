"""Shaded pictures, a film and a view of one run."""

from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.files.progress import announce
from cortado.pictures.film import film
from cortado.pictures.image_files import write_picture
from cortado.pictures.pace import pace_of
from cortado.pictures.page import Page, alone
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.scale import Scale
from cortado.pictures.scene_view import scene_view
from cortado.pictures.scenery import State
from cortado.pictures.space import SpacePainter
from cortado.pictures.stage import upright
from cortado.runs.emitted import is_out, those
from cortado.runs.report import Figures
from cortado.runs.solid_motion import SolidMotion, posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.camera_paths import Moment
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene
from cortado.version import __version__

ENOUGH = 100
"""Frames that tell where solids come to."""


def run_pictures(
    scene: Scene, trajectory: Trajectory, folder: Path, device: Any, values: NDArray | None = None
) -> Figures:
    """Draw the first and the last state of a run, and a film of it, into a folder; (caption, path) of each. ``values``
    as those of `run_page`."""
    page, last = run_page(scene, trajectory, device, values), len(trajectory) - 1
    stills: Figures = []
    for k, name, words in ((0, "first", "at the start"), (last, "last", "at the end")):
        path = folder / f"{name}.png"
        write_picture(path, page.image(k))
        stills.append((f"The fluid {words}, t = {trajectory.times[k]:.4g} s.", path))
    picture = scene.picture or Picture()
    if picture.film_frames == 0 or not last:
        return stills
    made = film(folder / "film.mp4", page, range(last + 1), pace_of(trajectory.times, picture))
    announce(str(made))
    return [(f"The run, {made.pace.in_words}.", made.path), *stills]


def run_page(
    scene: Scene, trajectory: Trajectory, device: Any, values: NDArray | None = None, unit: str | None = None
) -> Page:
    """The frames of a run by their number. ``values`` (frames, n): what the scene colours its particles by; ``unit``
    of what all scenes do not have."""
    picture, motions = scene.picture or Picture(), solid_motions(scene, trajectory.others)
    scale = None if values is None else Scale.of(picture.colour, values, unit)
    out = [is_out(scene, frame.others.get("emitted"), trajectory.particles) for frame in trajectory]
    stride = max(len(trajectory) // ENOUGH, 1)
    poses = [posed(scene, motions, k) for k in range(0, len(trajectory), stride)] if motions else []
    draws = painter(sized(scene, motions), _places(trajectory, out), device, poses)

    def state(k: int) -> State:
        frame, shown = trajectory[k], those(out[k])
        colours = colours_of(scene, frame.mass_fractions, trajectory.particles)
        if scale is not None and values is not None:
            colours = scale.colours(values[k])
        pose = posed(scene, motions, k) if motions else None
        view = None
        if picture.camera_path is not None and isinstance(draws, SpacePainter):
            home = draws.stage.home_around if picture.camera_path.goes_around else draws.stage.home
            view = picture.camera_path.view(home, _moment(scene, trajectory, motions, k))
        fractions = None if frame.mass_fractions is None else frame.mass_fractions[shown]
        return State(frame.positions[shown], colours[shown], pose, view, fractions)

    composed = alone if scale is None else partial(_beside, scale)
    return Page(draws, [state], composed, _fingerprint(scene, trajectory))


def _places(trajectory: Trajectory, out: list[NDArray[np.bool_]]) -> Points:
    """(frames, n, d) [m] where particles are that are shown; those that wait in an emitter are counted at its
    opening."""
    if all(one.all() for one in out):
        return trajectory.positions
    return np.where(np.array(out)[..., None], trajectory.positions, trajectory.others["outlet"])


def _moment(scene: Scene, trajectory: Trajectory, motions: Mapping[str, SolidMotion], k: int) -> Moment:
    places = {table.name: table.middle() for table in scene.solid}
    places |= {name: motion.positions[k] for name, motion in motions.items()}
    up = upright(np.asarray(scene.forces.gravity))[1]
    return Moment(k / max(len(trajectory) - 1, 1), float(trajectory.times[k]), up, places)


def _beside(scale: Scale, images: list[Points]) -> Points:
    return scale.beside(alone(images))


def _fingerprint(scene: Scene, trajectory: Trajectory) -> str:
    """A checksum of what the pictures of a run are made of."""
    found = sha256(f"{__version__} {scene.to_json()}".encode())
    for array in (trajectory.times, trajectory.positions[:1], trajectory.positions[-1:]):
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def trajectory_view(scene: Scene, trajectory: Trajectory) -> str:
    """HTML that shows a run; see `scene_view`."""
    return scene_view(scene, {scene.name: list(trajectory)}, trajectory.times)
