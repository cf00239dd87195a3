"""Pictures and films of one run, or of several runs side by side."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import sha256
from importlib.util import find_spec
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.files.terminal import track
from cortado.pictures.painter import Scale, colours_of, stage_of
from cortado.pictures.plane import PlanePainter, PlaneStage
from cortado.pictures.stage import Stage, upright
from cortado.pictures.tracing.space import SpacePainter, State
from cortado.pictures.tracing.steady import WINDOW
from cortado.pictures.video_files import moving_picture
from cortado.runs.frames import Film, Pace, SolidMotions, posed, sized
from cortado.runs.trajectory import Trajectory
from cortado.scene.appearance import Moment, Picture, View
from cortado.scene.emitter_table import emitted_name, outlet_name, samples, waits
from cortado.scene.parameters import sizes
from cortado.scene.scene import Scene
from cortado.simulation import Simulation
from cortado.version import __version__

Computed = Callable[[], Simulation] | None
"""A function that returns a simulation, which computes colours that the run did not record."""
Around = tuple[tuple[int, ...], tuple[int, ...]]
"""Frame numbers before a frame, and after the frame, both in order of distance from the frame."""
ALONE: Around = (), ()
Panel = Callable[[int, Around], Points]
"""A function that draws a frame as a linear picture (rows, columns, 3) from 0 to 1."""
LEAST_PIXELS = 64
SLOW = 0.1
"""Speed of a film [simulated seconds per second]. In films at this speed or faster, fluid at rest is an average over
frames."""


@dataclass(frozen=True)
class Page:
    panels: Sequence[Panel]
    composed: Callable[[list[Points]], Points] = itemgetter(0)
    fingerprint: str = ""
    """Checksum of all data in the pictures, or an empty text if unknown."""
    notes: str = ""

    def image(self, frame: int) -> Points:
        return self.composed([panel(frame, ALONE) for panel in self.panels])

    def images(self, frames: Sequence[int], begin: int = 0, window: int = WINDOW) -> Iterator[Points]:
        """Yield pictures of ``frames``. A thread draws the next picture in advance."""
        shown, count = range(begin, len(frames)), len(self.panels)
        drawn = _ahead(count, (panel(frames[n], _around(frames, n, window)) for n in shown for panel in self.panels))
        return (self.composed(list(islice(drawn, count))) for _ in shown)


def _around(frames: Sequence[int], n: int, window: int) -> Around:
    return tuple(frames[max(n - window, 0) : n][::-1]), tuple(frames[n + 1 : n + 1 + window])


class FilmedRun:
    def __init__(self, artist: PlanePainter | SpacePainter, state: Callable[[int], State]):
        self._artist, self._state, self._stills = artist, state, dict[int, Any]()

    def __call__(self, frame: int, around: Around) -> Points:
        artist, state = self._artist, self._state(frame)
        if not any(around) or isinstance(artist, PlanePainter):
            return artist.image(*state)
        known = self._stills
        self._stills = {k: known[k] if k in known else artist.still(self._state(k)) for k in {frame, *sum(around, ())}}
        own = self._stills[frame]
        if own is None:
            return artist.image(*state)
        before, after = ([self._stills[k] for k in side if self._stills[k] is not None] for side in around)
        return artist.steady_image(state, own, before, after)


def framed_together(stages: Sequence[PlaneStage | Stage], spare: int = 0) -> tuple[list[PlaneStage | Stage], int]:
    """Return stages with a common scale that fit into one page, and the number of pictures per row. The last ``spare``
    columns of pixels stay free. Raises `InputError` if the pictures would be too small."""
    whole, count = stages[0].picture, len(stages)
    page = whole.model_copy(update={"width": max(whole.width - spare, 1)})
    lower, upper = (np.array(ends) for ends in zip(*(stage.ends for stage in stages), strict=True))
    ends = lower.min(axis=0), upper.max(axis=0)
    shown = stages[0].framed(ends, page).seen_size
    across = in_a_row(count, shown, page)
    width, height = page.width // across, page.height // -(-count // across)
    size = {"width": width, "height": min(height, round(1.25 * width * shown[1] / shown[0]))}
    if min(size.values()) < LEAST_PIXELS:
        found = f"{count} pictures of {size['width']} x {size['height']} pixels fit into {page.width} x {page.height}"
        least = f"{LEAST_PIXELS} x {LEAST_PIXELS}"
        raise InputError(f"{found}, but each must have {least}: set more lines, or show fewer runs.")
    return [stage.framed(ends, stage.picture.model_copy(update=size)) for stage in stages], across


def in_a_row(count: int, size: Points, page: Picture) -> int:
    """Return the number of pictures per row at which contents of width and height ``size`` appear largest."""

    def gain(across: int) -> float:
        down = -(-count // across)
        scale = min(page.width / across / size[0], page.height / down / size[1])
        return float(scale * count / (across * down))

    return max(range(1, count + 1), key=gain)


def lacking(scene: Scene) -> str | None:
    """Return an error message if a package for shaded pictures of the scene is missing, else None."""
    if (scene.picture or Picture()).film_frames == 0 or find_spec("av"):
        return None
    return "Shaded pictures need PyAV, which is not installed: pip install av."


def film(path: Path, page: Page, frames: Sequence[int], pace: Pace) -> Film:
    """Write a film, or continue an interrupted film."""
    shown = [frames[k] for k in pace.frames]
    note = page.fingerprint and f"{page.fingerprint} {len(shown)} {pace.speed}"
    with moving_picture(path, pace.frames_per_second, note, len(shown)) as video:
        there = video.frames
        with track(len(shown) - there, "film") as advance:
            images = page.images(shown, there, 0 if pace.speed < SLOW else WINDOW)
            for image, time in zip(images, pace.times[there:], strict=True):
                video.add(image, time)
                advance()
    return Film(path, pace, page.notes)


def _ahead(count: int, images: Iterator[Points]) -> Iterator[Points]:
    """Draw up to ``count`` further images in advance in a thread."""
    painter = ThreadPoolExecutor(1, thread_name_prefix="cortado-film")
    try:
        coming = deque(painter.submit(next, images, None) for _ in range(count))
        while True:
            with WARP.lent():  # the painter needs it
                image = coming.popleft().result()
            if image is None:
                return
            coming.append(painter.submit(next, images, None))
            yield image
    finally:
        with WARP.lent():
            painter.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class ShownRun:
    scene: Scene
    trajectory: Trajectory
    values: NDArray | None = None
    """Values for a colour scale (frames, n), or None to use the colours of phases."""
    unit: str | None = None

    @cached_property
    def stage(self) -> PlaneStage | Stage:
        count, scene = len(self.trajectory), sized(self.scene, self._motions)
        frames = range(0, count, max(count // 100, 1)) if self._motions else ()
        poses = [posed(self.scene, self._motions, k) for k in frames]
        return stage_of(scene, shown_places(self.scene, self.trajectory), poses)

    def panel(self, stage: PlaneStage | Stage, device: object, scale: Scale | None) -> Panel:
        artist = PlanePainter(stage) if isinstance(stage, PlaneStage) else SpacePainter(stage, device)
        return FilmedRun(artist, lambda k: self._state(k, stage, scale))

    @property
    def fingerprint(self) -> str:
        trajectory, found = self.trajectory, sha256(f"{__version__} {self.scene.to_json()}".encode())
        for array in (trajectory.due, trajectory.positions[:1], trajectory.positions[-1:]):
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()

    def _state(self, k: int, stage: PlaneStage | Stage, scale: Scale | None) -> State:
        frame = self.trajectory[k].moved(float(self.trajectory.due[k] - self.trajectory.times[k]))
        shown = those(is_out(self.scene, frame.others, self.trajectory.particles))
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        if scale is not None and self.values is not None:
            colours = scale.colours(self.values[k])
        fractions = None if frame.mass_fractions is None else frame.mass_fractions[shown]
        pose = posed(self.scene, self._motions, k) if self._motions else None
        return State(frame.positions[shown], colours[shown], pose, self._view(k, stage), fractions)

    @cached_property
    def _motions(self) -> SolidMotions:
        known, motions = self.trajectory.times, SolidMotions.of(self.trajectory.others, self.scene.dimension)
        return motions.at(self.scene, known, np.arange(len(known)), self.trajectory.due)

    def _view(self, k: int, stage: PlaneStage | Stage) -> View | None:
        scene, path = self.scene, (self.scene.picture or Picture()).camera_path
        if path is None or isinstance(stage, PlaneStage):
            return None
        places = {table.name: table.middle() for table in scene.solid}
        places |= {name: motion.positions[k] for name, motion in self._motions.items()}
        places = {name: scene.domain.wrapped(place) for name, place in places.items()}
        up = upright(np.asarray(scene.forces.gravity))[1]
        moment = Moment(k / max(len(self.trajectory) - 1, 1), float(self.trajectory.due[k]), up, places)
        return path.view(stage.home_around if path.goes_around else stage.home, moment)


def is_out(scene: Scene, others: Mapping[str, Any], particles: int) -> NDArray[np.bool_]:
    """Return a mask (n,) of the particles outside emitters and drains. Without fluid, the mask includes the first layer
    of each emitter, so that pictures are not empty. ``others`` are the fields of `Frame.others`."""
    found = ~waits(scene, others, particles)
    for _, first, sample in () if found.any() else samples(scene, particles):
        found[first : first + sample.layer] = True
    return found & (np.ravel(others["drained"]) == 0.0) if "drained" in others else found


def shown_places(scene: Scene, trajectory: Trajectory) -> NDArray:
    """Return positions (frames, n, d) [m]. Particles that wait in an emitter are at the emitter's opening."""
    places, others, count = trajectory.positions, trajectory.others, trajectory.particles
    out = np.array([is_out(scene, frame.others, count) for frame in (trajectory if scene.emitter else ())])
    for name, first, sample in samples(scene, count):
        if outlet_name(name) in others:
            waiting = np.array([sample.waits(name, first, frame.others, count) for frame in trajectory]) & ~out
            places = np.where(waiting[..., None], others[outlet_name(name)], places) if waiting.any() else places
    for number, drain in enumerate(scene.drain, 1):
        places = np.where((others["drained"] == number)[..., None], drain.middle(scene.dimension), places)
    return places


def those(out: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """Convert a mask (n,) to an index. If all entries are True, the index is a slice, which copies nothing."""
    return slice(None) if out.all() else out


def ages(scene: Scene, trajectory: Trajectory) -> NDArray:
    """Return the times (frames, n) [s] since particles left an emitter, or since the start of the run."""
    since, count = np.full(trajectory.positions.shape[:2], float(trajectory.times[0])), trajectory.particles
    for name, first, sample in samples(scene, count):
        if emitted_name(name) in trajectory.others:
            came = np.reshape(trajectory.others[emitted_name(name)], (len(trajectory), -1))[:, 0].astype(np.float64)
            line = np.array([sample.in_line(name, first, frame.others, count) for frame in trajectory])
            since = np.where(line > 0.0, np.interp(line, came, trajectory.times, right=np.inf), since)
    return np.maximum(trajectory.times[:, None] - since, 0.0)


def coloured_by(scene: Scene, trajectory: Trajectory, simulation: Computed = None) -> NDArray | None:
    """Return values (frames, n) for a colour scale, or None for the colours of phases. Raises `InputError` for a
    quantity that was not recorded and cannot be computed."""
    name = (scene.picture or Picture()).colour
    if name == "phase":
        return None
    if name == "age":
        return ages(scene, trajectory)
    if name == "speed" or name in (*trajectory.quantities, *trajectory.others):
        return np.array([sizes(name, frame[name], scene.dimension) for frame in trajectory])
    if simulation is None and name == "vorticity":
        simulation = partial(Simulation, scene)  # whose parts have no say in it
    if simulation is not None:
        return sizes(name, simulation().quantity(name, trajectory), scene.dimension)
    advice = f'record it, as in simulation.run(steps, record=["{name}"]), or use simulation.film(trajectory, path)'
    raise InputError(f"{name} was not recorded, and cannot be computed from positions and velocities: {advice}.")
