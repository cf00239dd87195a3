"""Several runs side by side in a picture or a film, with a common clock, camera and colour scale."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, log10
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import public
from cortado.discretise.shapes import Points
from cortado.errors import InputError, shown
from cortado.files.disk import as_path
from cortado.pictures.film import Around, Page, Panel, ShownRun, coloured_by, film, framed_together, lacking
from cortado.pictures.painter import Scale, labelled, side_by_side
from cortado.pictures.run_pictures import device_of, shown_as
from cortado.runs.frames import Film, common_rate, pace_of
from cortado.runs.run_folder import computed, differences
from cortado.runs.trajectory import Trajectory
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene, as_scene
from cortado.scene.schema_words import unit_of

SAME = 0.01
MOST_PICTURES = 9


@public
def film_side_by_side(
    runs: Mapping[str, Trajectory] | Iterable[Trajectory],
    path: str | Path,
    *,
    scenes: Sequence[Scene | str | Path] | None = None,
    device: str = "cpu",
    **settings: Any,
) -> Film:
    """Write and return a film of up to nine runs side by side, an mp4 or webp file as in `Trajectory.film`.

    All runs share the clock, the camera, the colour scale and the table [picture] of the first scene. At each time of
    the film, each run shows its recorded frame with the nearest time. An ended run shows its last frame.

    Args:
        runs: trajectories by label, or a list of trajectories. The labels of a list are made of the values that differ
            between the scenes.
        path: path that ends in .mp4 or in .webp.
        scenes: scenes of the runs or paths of scene files, needed for trajectories loaded from files.
        device: device that traces the rays, "cpu" or "cuda:0".
        settings: as in `Trajectory.film`. ``lines``, ``width`` and ``height`` are the size of the whole film.

    Raises:
        SceneError: settings are invalid.
        InputError: there are no runs or more than nine, 2-D and 3-D runs are mixed, a run has no frames or no scene, a
            package is missing, or a ``colour`` was not recorded and cannot be computed.

    Example: ``cortado.film_side_by_side({"thin": first, "thick": second}, "both.mp4")``
    """
    given = runs.values() if isinstance(runs, Mapping) else runs
    if not isinstance(given, Iterable) or isinstance(runs, Trajectory):
        raise InputError(f"runs is {shown(runs)}, but must be several trajectories, in a list or by label.")
    each = list(given)
    for run in each:
        if not isinstance(run, Trajectory):
            raise InputError(f"runs contains {shown(run)}, but must contain trajectories from simulation.run.")
    if scenes is not None and len(scenes) != len(each):
        raise InputError(f"scenes has {len(scenes)} scenes, but must have one for each of {len(each)} runs.")
    known = [run.scene for run in each] if scenes is None else [as_scene(one) for one in scenes]
    if None in known:
        raise InputError("A trajectory from a file has no scene: give all scenes, as scenes=[...].")
    there = [scene for scene in known if scene is not None]
    pictured = shown_alike(there, each, settings)
    numbers = [f"run {k}" for k in range(1, len(each) + 1)]
    names = [str(name) for name in runs] if isinstance(runs, Mapping) else labels(there, numbers)
    shown_runs = [ShownRun(scene, run, coloured_by(scene, run)) for scene, run in zip(pictured, each, strict=True)]
    page, times = runs_page(shown_runs, names, device_of(device))
    pace = pace_of(times, pictured[0].picture or Picture(), common_rate(run.marks for run in each))
    return film(Path(as_path("path", path)), page, range(len(times)), pace)


def shown_alike(scenes: Sequence[Scene], runs: Sequence[Trajectory], settings: Mapping[str, Any]) -> list[Scene]:
    """Return scenes with the same table [picture]. Raises `InputError` for runs that one film cannot show."""
    if not 0 < len(scenes) <= MOST_PICTURES:
        raise InputError(f"There are {len(scenes)} runs, but 1 to {MOST_PICTURES} runs fit into a film.")
    if len({scene.dimension for scene in scenes}) > 1:
        raise InputError("Some runs are in 2-D and some in 3-D, but all must have the same dimension.")
    for scene, run in zip(scenes, runs, strict=True):
        if not len(run):
            raise InputError(f"The run of {scene.name} has no frames, but a picture needs at least one.")
    alike = [scene.model_copy(update={"picture": scenes[0].picture}) for scene in scenes]
    found = [shown_as(scene, settings, run.others) for scene, run in zip(alike, runs, strict=True)]
    if missing := lacking(found[0]):
        raise InputError(missing)
    return found


def runs_page(runs: Sequence[ShownRun], names: Sequence[str], device: Any) -> tuple[Page, NDArray[Any]]:
    """Return a page of runs, and the times of its frames [s]. `shown_alike` prepares the scenes of the runs."""
    times = common_times([run.trajectory.due for run in runs])
    values = [run.values.ravel() for run in runs if run.values is not None]
    picture = runs[0].scene.picture or Picture()
    scale = Scale.of(picture.colour, np.concatenate(values)) if values else None
    spare = 0 if scale is None else scale.columns(picture.height)
    stages, across = framed_together([run.stage for run in runs], spare)
    shown = [ShownFrames(run.trajectory.due, times) for run in runs]
    drawn = [run.panel(stage, device, scale) for run, stage in zip(runs, stages, strict=True)]
    panels = [_labelled(*one) for one in zip(drawn, names, shown, strict=True)]
    notes = [note for name, frames in zip(names, shown, strict=True) for note in frames.notes(name)]
    off = max(float(np.abs(one.own[one.nearest] - times)[one.during].max(initial=0.0)) for one in shown)
    if off > SAME * interval_of(times):
        notes.append(f"each run shows its recorded frame nearest in time, at most {off:.2g} s away")

    def composed(images: list[Points]) -> Points:
        page = side_by_side(images, across)
        return page if scale is None else scale.beside(page)

    told_apart = " ".join([*(run.fingerprint for run in runs), *names])
    return Page(panels, composed, told_apart, "; ".join(notes)), times


def _labelled(panel: Panel, name: str, shown: ShownFrames) -> Panel:
    def drawn(k: int, around: Around) -> Points:
        before, after = (tuple(int(shown.nearest[n]) for n in side) for side in around)
        return labelled(panel(int(shown.nearest[k]), (before, after)), name, shown.time_in_words(k))

    return drawn


def common_times(each: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the times (frames,) [s] of a film. The interval between frames is the shortest interval of any run."""
    found = np.zeros(0)
    for times in sorted(each, key=lambda own: (interval_of(own), -len(own))):
        if not len(found):
            found = np.asarray(times, dtype=np.float64)
            continue
        apart = 0.5 * interval_of(times)
        outside = (times < found[0] - apart) | (times > found[-1] + apart)
        found = np.sort(np.concatenate([found, times[outside]]))
    return found


def interval_of(times: NDArray[Any]) -> float:
    """Return the median time between two frames [s], or infinity for a single frame."""
    return float(np.median(np.diff(times))) if len(times) > 1 else np.inf


@dataclass(frozen=True, eq=False)
class ShownFrames:
    """The recorded frames that a film shows for one run."""

    own: NDArray[Any]
    """Times of the recorded frames [s]."""
    times: NDArray[Any]
    """Times of the film (frames,) [s]."""

    @cached_property
    def nearest(self) -> NDArray[np.int64]:
        return np.rint(np.interp(self.times, self.own, np.arange(len(self.own)))).astype(np.int64)

    @cached_property
    def during(self) -> NDArray[np.bool_]:
        """Mask (frames,) of film times between the first and the last recorded frame."""
        near = SAME * interval_of(self.times)
        return (self.times > self.own[0] - near) & (self.times < self.own[-1] + near)

    def time_in_words(self, k: int) -> str:
        interval = interval_of(self.times)
        digits = max(ceil(-log10(interval)), 0) if 0.0 < interval < np.inf else 3
        time = f"{self.own[self.nearest[k]]:.{digits}f} s"
        return time if self.during[k] else f"stands still at {time}"

    def notes(self, name: str) -> list[str]:
        ends = f'"{name}" ends at {self.own[-1]:.4g} s and stands still from then on'
        begins = f'"{name}" begins at {self.own[0]:.4g} s'
        return [note for note, is_on in ((begins, self.during[0]), (ends, self.during[-1])) if not is_on]


def labels(scenes: Sequence[Scene], otherwise: Sequence[str]) -> list[str]:
    """Return scene names if they differ, else differing values such as ``viscosity = 0.1 Pa s``, else ``otherwise``."""
    tables = [computed(json.loads(scene.to_json())) for scene in scenes]
    keys = list(dict.fromkeys(key for table in tables[1:] for key in differences(tables[0], table, "missing")))
    short = [key.rpartition(".")[2] for key in keys]
    names = short if len(set(short)) == len(keys) else keys
    named = [(name.replace("_", " "), key) for name, key in zip(names, keys, strict=True)]
    by_value = [", ".join(f"{name} = {_value(table, key)}" for name, key in named) for table in tables]
    few = len(keys) <= 3 and max(map(len, by_value)) <= 64
    for found in ([scene.name for scene in scenes], by_value if few else []):
        if len(set(found)) == len(scenes):
            return found
    return list(otherwise)


def _value(table: Any, key: str) -> str:
    for part in key.split("."):
        try:
            table = table[int(part)] if isinstance(table, list) else table[part]
        except (LookupError, TypeError, ValueError):
            return "none"
    if table is None or isinstance(table, str):
        return table or "none"
    text = f"{table:g}" if isinstance(table, float) else shown(table)
    return f"{text} {unit_of(key)}".rstrip()
