"""Draws trajectories, for `Trajectory.picture` and `film`, and those of `Simulation`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.files.input_files import as_path
from cortado.pictures.film import Film, film, lacking
from cortado.pictures.pace import pace_of
from cortado.pictures.page import Page
from cortado.runs.colouring import coloured_by
from cortado.runs.frame import Frame
from cortado.runs.marks import common_rate
from cortado.runs.measuring import Measuring
from cortado.runs.picture_settings import shown_as
from cortado.runs.run_pictures import run_page
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene

Units = Mapping[str, str]
"""Those of fields that not all scenes have, by their names."""


def page_of(
    trajectory: Trajectory,
    scene: Scene,
    device: Any,
    settings: Mapping[str, Any],
    units: Units | None = None,
    simulation: Callable[[], Measuring] | None = None,
) -> Page:
    """The frames of a run as pictures, with keys of [picture] replaced; ``simulation`` computes what was not
    recorded."""
    known = dict.fromkeys(trajectory.others, "") if units is None else units
    shown = shown_as(scene, settings, known)
    colour = (shown.picture or Picture()).colour
    return run_page(shown, trajectory, device, coloured_by(shown, trajectory, simulation), known.get(colour))


def film_of(
    trajectory: Trajectory,
    scene: Scene,
    path: str | Path,
    device: Any,
    settings: Mapping[str, Any],
    units: Units | None = None,
    simulation: Callable[[], Measuring] | None = None,
) -> Film:
    """Write a film of a run; as `page_of`."""
    if not len(trajectory):
        raise InputError("The trajectory has no frames, but must have one to be filmed.")
    shown = shown_as(scene, settings, trajectory.others if units is None else units)
    missing = lacking(shown)
    if missing:
        raise InputError(missing)
    page = page_of(trajectory, scene, device, settings, units, simulation)
    pace = pace_of(trajectory.due, shown.picture or Picture(), common_rate([trajectory.marks]))
    return film(Path(as_path("path", path)), page, range(len(trajectory)), pace)


def alone(frame: Frame) -> Trajectory:
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
