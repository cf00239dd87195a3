"""Pictures and films of a run, as the table [picture] of its scene and settings of a call ask for them."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticCustomError

from cortado.arrays import whole_number
from cortado.device.warp_start import device_named, start_warp
from cortado.discretise.shapes import Points, corners
from cortado.errors import InputError, SceneError, shown
from cortado.files.image_encoding import ShadedPicture
from cortado.files.input_files import as_path
from cortado.files.terminal import announce
from cortado.particles.fields import Entry
from cortado.pictures.film import LEAST, Page, alone, film, lacking
from cortado.pictures.image_files import write_picture
from cortado.pictures.labels import Scale
from cortado.pictures.particle_view import scene_view
from cortado.pictures.plane import PlaneStage
from cortado.pictures.report import Figures
from cortado.pictures.shown_run import ShownRun, coloured_by
from cortado.pictures.stage import Stage
from cortado.runs.frame_file import common_rate
from cortado.runs.pace import Film, pace_of
from cortado.runs.trajectory import Frame, Trajectory
from cortado.scene.appearance import CameraPath, Picture
from cortado.scene.parameters import Axis
from cortado.scene.quantity_names import NAMES
from cortado.scene.scene import Scene, as_scene
from cortado.scene.tables import field_name
from cortado.simulation import Simulation


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
    pace = pace_of(trajectory.due, picture, common_rate([trajectory.marks]))
    made = film(folder / "film.mp4", page, range(last + 1), pace)
    announce(str(made))
    return [(f"The run, {made.pace.in_words}.", made.path), *stills]


def run_page(
    scene: Scene, trajectory: Trajectory, device: Any, values: NDArray | None = None, unit: str | None = None
) -> Page:
    """The frames of a run by their number. ``values`` (frames, n): what the scene colours its particles by; ``unit``
    of what all scenes do not have."""
    run, picture = ShownRun(scene, trajectory, values), scene.picture or Picture()
    if values is None:
        return Page([run.panel(run.stage, device, None)], fingerprint=run.fingerprint)
    scale = Scale.of(picture.colour, values, unit)
    stage, composed = _with_scale(run.stage, scale)
    return Page([run.panel(stage, device, scale)], lambda images: composed(alone(images)), run.fingerprint)


def _with_scale(stage: PlaneStage | Stage, scale: Scale) -> tuple[PlaneStage | Stage, Callable[[Points], Points]]:
    """Where a picture has a scale at its right edge: on it, or beside a narrower one if it would cover what is
    shown."""
    free = stage.picture.width - scale.columns(stage.picture.height)
    is_covered = stage.on_screen(corners(*stage.ends))[:, 0].max() > free
    if not is_covered or free < LEAST:
        return stage, scale.on
    return stage.framed(stage.ends, stage.picture.model_copy(update={"width": free})), scale.beside


def trajectory_view(scene: Scene, trajectory: Trajectory) -> str:
    """HTML that shows a run; see `scene_view`."""
    return scene_view(scene, {scene.name: list(trajectory)}, trajectory.times)


Units = Mapping[str, str]
"""Those of fields that not all scenes have, by their names."""


def page_of(
    trajectory: Trajectory,
    scene: Scene,
    device: Any,
    settings: Mapping[str, Any],
    units: Units | None = None,
    simulation: Callable[[], Simulation] | None = None,
) -> Page:
    """The frames of a run as pictures, with keys of [picture] replaced; ``simulation`` computes what was not
    recorded."""
    known = dict.fromkeys(trajectory.others, "") if units is None else units
    pictured = shown_as(scene, settings, known)
    colour = (pictured.picture or Picture()).colour
    return run_page(pictured, trajectory, device, coloured_by(pictured, trajectory, simulation), known.get(colour))


def film_of(
    trajectory: Trajectory,
    scene: Scene,
    path: str | Path,
    device: Any,
    settings: Mapping[str, Any],
    units: Units | None = None,
    simulation: Callable[[], Simulation] | None = None,
) -> Film:
    """Write a film of a run; as `page_of`."""
    if not len(trajectory):
        raise InputError("The trajectory has no frames, but must have one to be filmed.")
    pictured = shown_as(scene, settings, trajectory.others if units is None else units)
    missing = lacking(pictured)
    if missing:
        raise InputError(missing)
    page = page_of(trajectory, scene, device, settings, units, simulation)
    pace = pace_of(trajectory.due, pictured.picture or Picture(), common_rate([trajectory.marks]))
    return film(Path(as_path("path", path)), page, range(len(trajectory)), pace)


def simulation_picture(simulation: Simulation, frame: Frame, settings: Mapping[str, Any]) -> ShadedPicture:
    """See `Simulation.picture`."""
    if not isinstance(frame, Frame):
        raise InputError(f"frame is {shown(frame)}, but must be one frame of a trajectory, such as trajectory[-1].")
    units = _units_of_fields(simulation)
    if (shown_as(simulation.scene, settings, units).picture or Picture()).colour == "age":
        raise InputError('One frame does not tell how old its fluid is: take trajectory.picture(k, colour="age").')
    return ShadedPicture.of(page_of(_alone(frame), simulation.scene, simulation.device, settings, units).image(0))


def simulation_film(
    simulation: Simulation, trajectory: Trajectory, path: str | Path, settings: Mapping[str, Any]
) -> Film:
    """See `Simulation.film`."""
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"trajectory is {shown(trajectory)}, but must be one, as simulation.run returns it.")
    units = _units_of_fields(simulation)
    return film_of(trajectory, simulation.scene, path, simulation.device, settings, units, lambda: simulation)


def trajectory_picture(
    trajectory: Trajectory, k: int, scene: Scene | str | Path | None, device: str, settings: Mapping[str, Any]
) -> ShadedPicture:
    """See `Trajectory.picture`."""
    count = len(trajectory)
    if k not in range(-count, count):
        raise InputError(f"k is {shown(k)}, but must be the number of one of {count} frames, such as 0 or -1.")
    page = page_of(trajectory, _scene_of(trajectory, scene), device_of(device), settings)
    return ShadedPicture.of(page.image(k % count))


def trajectory_film(
    trajectory: Trajectory, path: str | Path, scene: Scene | str | Path | None, device: str, settings: Mapping[str, Any]
) -> Film:
    """See `Trajectory.film`."""
    return film_of(trajectory, _scene_of(trajectory, scene), path, device_of(device), settings)


def device_of(name: str) -> Any:
    """Warp's device of that name; raises `InputError` where there is none."""
    start_warp()
    return device_named(name)


def _scene_of(trajectory: Trajectory, given: Scene | str | Path | None) -> Scene:
    found = trajectory.scene if given is None else as_scene(given)
    if found is None:
        raise InputError("The trajectory does not know its scene, as it was loaded: give it, as scene=scene.")
    return found


def _units_of_fields(simulation: Simulation) -> dict[str, str]:
    """The units of the fields of particles that a part of one's own keeps, by their names."""
    drawn = (Entry.NUMBER, Entry.VECTOR)
    known = (field for field in simulation.initial.fields if field.entry in drawn and field.axis is Axis.PARTICLE)
    return {field.name: field.unit for field in known if field.name not in NAMES}


def _alone(frame: Frame) -> Trajectory:
    """The trajectory of one frame."""
    arrays = {"positions": frame.positions, "velocities": frame.velocities, "mass_fractions": frame.mass_fractions}
    return Trajectory(
        times=np.array([frame.time]),
        steps=np.zeros(1, dtype=int),
        diagnostics={"converged": np.zeros(0, dtype=bool)},
        others={name: values[None] for name, values in frame.others.items()},
        quantities={name: values[None] for name, values in frame.quantities.items()},
        **{name: None if array is None else array[None] for name, array in arrays.items()},  # type: ignore[arg-type]
    )


WIDE = 16.0 / 9.0
"""Columns over rows of pictures of so many lines."""


def shown_as(scene: Scene, settings: Mapping[str, Any], fields: Collection[str] = ()) -> Scene:
    """The scene with keys of [picture] replaced. ``lines`` sets width and height, and ``camera`` takes a path too, such
    as `pictures.Orbit`; ``colour`` may name one of ``fields``, which not all scenes have.

    Raises:
        SceneError: settings that do not fit.
    """
    given = {} if scene.picture is None else scene.picture.model_dump()
    wanted = {**given, **settings}
    if "lines" in settings:
        lines = whole_number("lines", wanted.pop("lines"), 64)
        wanted |= {"width": 2 * round(0.5 * WIDE * lines), "height": lines}
    if isinstance(wanted.get("camera"), CameraPath):
        wanted |= {"camera": given.get("camera"), "camera_path": wanted["camera"].model_dump()}
    own = wanted.get("colour")
    is_field = isinstance(own, str) and own in fields
    try:
        table = Picture(**{**wanted, "colour": "phase"} if is_field else wanted)
        table = table.in_scene(scene.dimension, [one.name for one in scene.solid], ("picture",))
    except SceneError as problem:
        raise SceneError(None, f"picture.{problem.field}", *problem.args[2:]) from None
    except PydanticCustomError as problem:
        error = (problem.context or {})["error"]
        raise SceneError(None, field_name(error.path), error.found, error.wanted) from None
    return scene.model_copy(update={"picture": table.model_copy(update={"colour": own}) if is_field else table})
