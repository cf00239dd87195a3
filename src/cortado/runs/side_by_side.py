"""Several runs side by side in a picture or a film: with one clock, one camera and one scale of colours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import public
from cortado.discretise.shapes import Points
from cortado.errors import InputError, shown
from cortado.files.input_files import as_path
from cortado.pictures.film import Film, film, lacking
from cortado.pictures.grid import MOST, framed_together
from cortado.pictures.labels import labelled, side_by_side
from cortado.pictures.pace import pace_of
from cortado.pictures.page import Around, Page, Panel
from cortado.pictures.scale import Scale
from cortado.runs.colouring import coloured_by
from cortado.runs.common_clock import SAME, ShownFrames, common_times, interval_of
from cortado.runs.differences import labels
from cortado.runs.marks import common_rate
from cortado.runs.picture_settings import shown_as
from cortado.runs.showing import device_of
from cortado.runs.shown_run import ShownRun
from cortado.runs.trajectory import Trajectory
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene, as_scene


@public
def film_side_by_side(
    runs: Mapping[str, Trajectory] | Iterable[Trajectory],
    path: str | Path,
    *,
    scenes: Sequence[Scene | str | Path] | None = None,
    device: str = "cpu",
    **settings: Any,
) -> Film:
    """Write a film of up to nine runs side by side, an mp4 or a webp as of `Trajectory.film`, and return it.

    All have one clock, one camera and one scale of colours, and the table [picture] of the first one's scene. At each
    time a run is shown by its recorded frame nearest to it; one that has ended stands still.

    Args:
        runs: by the labels that they have; without labels they have the values in which their scenes differ.
        path: ends in .mp4 or in .webp.
        scenes: those of the runs, or the paths of their files; needed of trajectories that were loaded from files.
        device: of the rays, "cpu" or "cuda:0".
        settings: as of `Trajectory.film`, of which ``lines``, ``width`` and ``height`` are those of the whole film.

    Raises:
        SceneError: settings that do not fit.
        InputError: no runs or more than nine, some in 2-D and some in 3-D, a run without frames or a scene, a package
            that is missing, or what ``colour`` names was not recorded and cannot be computed.
    """
    each = _trajectories(runs)
    if scenes is not None and len(scenes) != len(each):
        raise InputError(f"scenes has {len(scenes)} scenes, but must have one for each of {len(each)} runs.")
    known = [run.scene for run in each] if scenes is None else [as_scene(one) for one in scenes]
    if None in known:
        raise InputError("A trajectory does not know its scene, as it was loaded: give all scenes, as scenes=[...].")
    there = [scene for scene in known if scene is not None]
    pictured = shown_alike(there, each, settings)
    numbers = [f"run {k}" for k in range(1, len(each) + 1)]
    names = [str(name) for name in runs] if isinstance(runs, Mapping) else labels(there, numbers)
    values = [coloured_by(scene, run) for scene, run in zip(pictured, each, strict=True)]
    page, times = runs_page(
        [ShownRun(*one) for one in zip(pictured, each, values, strict=True)], names, device_of(device)
    )
    picture = pictured[0].picture or Picture()
    pace = pace_of(times, picture, common_rate(run.marks for run in each))
    return film(Path(as_path("path", path)), page, range(len(times)), pace)


def _trajectories(runs: Any) -> list[Trajectory]:
    """Those that were given, with labels or without; raises `InputError` for anything else."""
    each = runs.values() if isinstance(runs, Mapping) else runs
    if not isinstance(each, Iterable) or isinstance(runs, Trajectory):
        raise InputError(f"runs is {shown(runs)}, but must be several trajectories, with labels or without.")
    found = list(each)
    for run in found:
        if not isinstance(run, Trajectory):
            raise InputError(f"runs has {shown(run)}, but must have trajectories, as simulation.run returns them.")
    return found


def shown_alike(
    scenes: Sequence[Scene], trajectories: Sequence[Trajectory], settings: Mapping[str, Any]
) -> list[Scene]:
    """The scenes of runs with the table [picture] of the first one, of which keys are replaced as by `shown_as`. Raises
    `InputError` for runs that cannot be side by side, and where a package is missing."""
    if not 0 < len(scenes) <= MOST:
        raise InputError(f"There are {len(scenes)} runs, but from 1 to {MOST} can be side by side.")
    if len({scene.dimension for scene in scenes}) > 1:
        raise InputError("Some runs are in 2-D and some in 3-D, but all that are side by side must be in one of them.")
    for scene, run in zip(scenes, trajectories, strict=True):
        if not len(run):
            raise InputError(f"The run of {scene.name} has no frames, but must have one to be shown.")
    look = {"picture": scenes[0].picture}
    found = [
        shown_as(scene.model_copy(update=look), settings, run.others)
        for scene, run in zip(scenes, trajectories, strict=True)
    ]
    missing = lacking(found[0])
    if missing:
        raise InputError(missing)
    return found


def runs_page(runs: Sequence[ShownRun], names: Sequence[str], device: Any) -> tuple[Page, NDArray[Any]]:
    """Runs of scenes that are `shown_alike`, each with its name and its time; and the times of its frames [s]."""
    times = common_times([run.times for run in runs])
    values = [run.values.ravel() for run in runs if run.values is not None]
    picture = runs[0].scene.picture or Picture()
    scale = Scale.of(picture.colour, np.concatenate(values)) if values else None
    spare = 0 if scale is None else scale.columns(picture.height)
    stages, across = framed_together([run.stage for run in runs], spare)
    shown = [ShownFrames(run.times, times) for run in runs]
    panels = [
        _labelled(run.panel(stage, device, scale), name, frames)
        for run, stage, name, frames in zip(runs, stages, names, shown, strict=True)
    ]
    notes = [note for name, frames in zip(names, shown, strict=True) for note in frames.notes(name)]
    off = max(frames.off for frames in shown)
    if off > SAME * interval_of(times):
        notes.append(f"each run shows its recorded frame nearest in time, at most {off:.2g} s away")
    composed = partial(_composed, across, scale)
    told_apart = " ".join([*(run.fingerprint for run in runs), *names])
    return Page(panels, composed, told_apart, "; ".join(notes)), times


def _labelled(panel: Panel, name: str, shown: ShownFrames) -> Panel:
    """The pictures of a panel of the frames that are shown, with a name and a time on them."""

    def drawn(k: int, around: Around) -> Points:
        before, after = (tuple(int(shown.nearest[n]) for n in side) for side in around)
        return labelled(panel(int(shown.nearest[k]), (before, after)), name, shown.time_in_words(k))

    return drawn


def _composed(across: int, scale: Scale | None, images: list[Points]) -> Points:
    """The page, with the scale beside it."""
    page = side_by_side(images, across)
    return page if scale is None else scale.beside(page)
