"""Pictures of the frames of one run or of several runs side by side, and films of them.

A `ShownRun` provides a run's stage, and for each frame the state to draw.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from hashlib import sha256
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.errors import InputError
from cortado.files.image_encoding import moving_picture
from cortado.files.terminal import track
from cortado.pictures.painter import Scale, colours_of, painter_on, stage_of
from cortado.pictures.plane import PlanePainter, PlaneStage
from cortado.pictures.stage import Stage, upright
from cortado.pictures.tracing.space import SpacePainter, State
from cortado.pictures.tracing.steady import WINDOW
from cortado.runs.frames import Film, Pace, SolidMotions, posed, sized, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.appearance import Moment, Picture, View
from cortado.scene.emitter_table import emitted_name, outlet_name, samples, waits
from cortado.scene.fluid_particles import resting_places
from cortado.scene.parameters import sizes
from cortado.scene.scene import Scene
from cortado.simulation import Simulation
from cortado.version import __version__

Ahead = Callable[[Iterator[Points]], Iterator[Points]]
Around = tuple[tuple[int, ...], tuple[int, ...]]
"""Numbers of the frames that a film shows before and after a frame, nearest first."""
ALONE: Around = (), ()
Panel = Callable[[int, Around], Points]
"""A function from a frame's number and the frames around it to a picture (rows, columns, 3), linear from 0 to 1."""


MOST_PICTURES = 9
"""Greatest number of pictures side by side; more would be too small."""
LEAST_PIXELS = 64
"""Least number of pixels along each side of each picture."""
AIR = 1.25
"""Least ratio of a picture's height to the height of its contents at the picture's width."""
SLOW = 0.1
"""Film speed (simulated seconds per second) below which fluid at rest is not averaged over frames, because its motion
is slow enough to follow."""
TELLING_FRAMES = 100
"""Number of frames from which the range of the solids' motion is found."""


def alone(images: list[Points]) -> Points:
    """Return the only picture of a list."""
    (image,) = images
    return image


@dataclass(frozen=True)
class Page:
    """The contents of each frame of a film: the picture of one panel, or several panels' pictures combined."""

    panels: Sequence[Panel]
    composed: Callable[[list[Points]], Points] = alone
    """Combines the panels' pictures to one picture."""
    fingerprint: str = ""
    """A checksum of all data shown in the pictures; empty if unknown."""
    notes: str = ""
    """A sentence for viewers of the film, or an empty text."""

    def image(self, frame: int) -> Points:
        """Return the picture (rows, columns, 3) of a frame, linear from 0 to 1."""
        return self.composed([panel(frame, ALONE) for panel in self.panels])

    def images(
        self, frames: Sequence[int], ahead: Ahead = iter, begin: int = 0, window: int = WINDOW
    ) -> Iterator[Points]:
        """Yield the pictures of a film's frames in order, from ``begin`` on, each drawn with ``window`` frames before
        and after it; ``ahead`` may draw panels' pictures early."""
        shown = range(begin, len(frames))
        drawn = ahead(panel(frames[n], _around(frames, n, window)) for n in shown for panel in self.panels)
        return (self.composed(list(islice(drawn, len(self.panels)))) for _ in shown)


def _around(frames: Sequence[int], n: int, window: int) -> Around:
    return tuple(frames[max(n - window, 0) : n][::-1]), tuple(frames[n + 1 : n + 1 + window])


class FilmedRun:
    """A `Panel` that draws the states of one run; in 3-D it keeps fluid at rest from flickering."""

    def __init__(self, artist: PlanePainter | SpacePainter, state: Callable[[int], State]):
        """Take a painter, and a function from the number of a frame to its ``state``."""
        self._artist, self._state, self._stills = artist, state, dict[int, Any]()

    def __call__(self, frame: int, around: Around) -> Points:
        """Return the picture of a frame."""
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
    """Fit several stages of one dimension, at one scale, into a page of the first stage's picture size minus ``spare``
    columns. Every camera sees all that any stage shows. Return the stages and the number of pictures in a row; raise
    `InputError` if pictures are too small."""
    whole, count = stages[0].picture, len(stages)
    page = whole.model_copy(update={"width": max(whole.width - spare, 1)})
    lower, upper = (np.array(ends) for ends in zip(*(stage.ends for stage in stages), strict=True))
    ends = lower.min(axis=0), upper.max(axis=0)
    shown = stages[0].framed(ends, page).seen_size
    across = in_a_row(count, shown, page)
    width, height = page.width // across, page.height // -(-count // across)
    size = {"width": width, "height": min(height, round(AIR * width * shown[1] / shown[0]))}
    if min(size.values()) < LEAST_PIXELS:
        found = f"{count} pictures of {size['width']} x {size['height']} pixels fit into {page.width} x {page.height}"
        least = f"{LEAST_PIXELS} x {LEAST_PIXELS}"
        raise InputError(f"{found}, but each must have {least}: ask for more lines, or for fewer runs.")
    return [stage.framed(ends, stage.picture.model_copy(update=size)) for stage in stages], across


def in_a_row(count: int, size: Points, page: Picture) -> int:
    """Return how many of ``count`` pictures to place in a row of a page, so that contents of width and height ``size``
    (2,) are large and few places stay empty."""

    def gain(across: int) -> float:
        down = -(-count // across)
        scale = min(page.width / across / size[0], page.height / down / size[1])
        return float(scale * count / (across * down))

    return max(range(1, count + 1), key=gain)


def lacking(scene: Scene) -> str | None:
    """Return a sentence on a missing package that shaded pictures of the scene need; None if all are installed."""
    picture = scene.picture or Picture()
    needed = {"av": "PyAV"} if picture.film_frames != 0 else {}
    missing = [name for module, name in needed.items() if find_spec(module) is None]
    if not missing:
        return None
    verb = "which is" if len(missing) == 1 else "which are"
    return f"Shaded pictures need {' and '.join(missing)}, {verb} not installed: pip install av."


def film(path: Path, page: Page, frames: Sequence[int], pace: Pace) -> Film:
    """Write a film of the frames that ``pace`` chooses. After an interruption the drawn frames are kept, and the next
    call for the same film continues after them."""
    shown = [frames[k] for k in pace.frames]
    note = page.fingerprint and f"{page.fingerprint} {len(shown)} {pace.speed}"
    with moving_picture(path, pace.frames_per_second, note, len(shown)) as video:
        there = video.frames
        with track(len(shown) - there, "film") as advance:
            window = 0 if pace.speed is not None and pace.speed < SLOW else WINDOW
            images = page.images(shown, partial(_ahead, len(page.panels)), there, window)
            for image, time in zip(images, pace.times[there:], strict=True):
                video.add(image, time)
                advance()
    return Film(path, pace, page.notes)


def _ahead(count: int, images: Iterator[Points]) -> Iterator[Points]:
    """Yield images in order; up to ``count`` images are drawn ahead while earlier ones are used."""
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
    """A run prepared for pictures and films: its scene, and the values that colour its particles."""

    scene: Scene
    trajectory: Trajectory
    values: NDArray | None = None
    """(frames, n) values that a colour scale converts to colours; None for the colours of phases."""
    unit: str | None = None
    """Unit of the values, if the quantity exists only in some scenes."""

    @cached_property
    def stage(self) -> PlaneStage | Stage:
        """Return the stage of the run, with a camera that sees all of the fluid in every frame."""
        stride = max(len(self.trajectory) // TELLING_FRAMES, 1)
        poses = [self._pose(k) for k in range(0, len(self.trajectory), stride)] if self._motions else []
        return stage_of(
            sized(self.scene, self._motions),
            shown_places(self.scene, self.trajectory),
            [pose for pose in poses if pose is not None],
        )

    def panel(self, stage: PlaneStage | Stage, device: object, scale: Scale | None) -> Panel:
        """Return the panel that draws the run's frames, on ``stage``: the run's own stage with perhaps another
        camera."""
        return FilmedRun(painter_on(stage, device), lambda k: self._state(k, stage, scale))

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """Return the times (frames,) [s] of the states that are shown; see `Trajectory.due`."""
        return self.trajectory.due

    @property
    def fingerprint(self) -> str:
        """Return a checksum of all data shown in the pictures."""
        trajectory, found = self.trajectory, sha256(f"{__version__} {self.scene.to_json()}".encode())
        for array in (trajectory.due, trajectory.positions[:1], trajectory.positions[-1:]):
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()

    def _state(self, k: int, stage: PlaneStage | Stage, scale: Scale | None) -> State:
        frame = self.trajectory[k].moved(float(self.times[k] - self.trajectory.times[k]))
        shown = those(self._out[k])
        colours = colours_of(self.scene, frame.mass_fractions, self.trajectory.particles)
        if scale is not None and self.values is not None:
            colours = scale.colours(self.values[k])
        fractions = None if frame.mass_fractions is None else frame.mass_fractions[shown]
        return State(frame.positions[shown], colours[shown], self._pose(k), self._view(k, stage), fractions)

    @cached_property
    def _motions(self) -> SolidMotions:
        known = self.trajectory.times
        return solid_motions(self.scene, self.trajectory.others).at(
            self.scene, known, np.arange(len(known)), self.times
        )

    @cached_property
    def _out(self) -> list[NDArray[np.bool_]]:
        """Return masks (frames, n), True for particles in the fluid."""
        return [is_out(self.scene, frame.others, self.trajectory.particles) for frame in self.trajectory]

    def _pose(self, k: int) -> Scene | None:
        return posed(self.scene, self._motions, k) if self._motions else None

    def _view(self, k: int, stage: PlaneStage | Stage) -> View | None:
        """Return the view of a moving camera in frame k; None for a camera at rest."""
        path = (self.scene.picture or Picture()).camera_path
        if path is None or isinstance(stage, PlaneStage):
            return None
        return path.view(stage.home_around if path.goes_around else stage.home, self._moment(k))

    def _moment(self, k: int) -> Moment:
        places = {table.name: table.middle() for table in self.scene.solid}
        places |= {name: motion.positions[k] for name, motion in self._motions.items()}
        domain = self.scene.domain
        places = {name: domain.wrapped(place) for name, place in places.items()}
        up = upright(np.asarray(self.scene.forces.gravity))[1]
        return Moment(k / max(len(self.trajectory) - 1, 1), float(self.times[k]), up, places)


def is_out(scene: Scene, others: Mapping[str, Any], particles: int) -> NDArray[np.bool_]:
    """Return a mask (n,) of the particles that have left emitters and are in no drain, given `Frame.others`. If there
    is no fluid yet, the first layers of emitters count as out from the start."""
    found = ~waits(scene, others, particles)
    for _, first, sample in () if found.any() else samples(scene, particles):
        found[first : first + sample.layer] = True
    return found & (np.ravel(others["drained"]) == 0.0) if "drained" in others else found


def drawn_for_each(scene: Scene, positions: NDArray) -> NDArray[np.int64]:
    """Return for each particle at positions (n, d) [m] the number (n,) of the particle drawn in its place: its own
    number, or the first visible particle's if it is stored far away, in an emitter's reserve or taken by a drain."""
    count = len(positions)
    if not (scene.drain or scene.emitter):
        return np.arange(count)
    off = np.abs(positions - resting_places(scene, count)).max(axis=1)
    there = ~(off <= scene.discretisation.spacing)  # places are NaN where all axes are periodic
    return np.where(there, np.arange(count), np.argmax(there))


def shown_places(scene: Scene, trajectory: Trajectory) -> NDArray:
    """Return the places (frames, n, d) [m] of particles in pictures. Particles waiting in an emitter are placed at its
    opening, and particles taken by a drain in the drain's middle."""
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
    """Return an index that selects the particles with ``out`` (n,) from arrays (n, ...), without a copy if all are
    out."""
    return slice(None) if out.all() else out


def ages(scene: Scene, trajectory: Trajectory) -> NDArray:
    """Return the times (frames, n) [s] since particles left an emitter, assuming constant emission between frames.
    Other particles have the time since the start of the run; waiting particles have 0."""
    since, count = np.full(trajectory.positions.shape[:2], float(trajectory.times[0])), trajectory.particles
    for name, first, sample in samples(scene, count):
        if emitted_name(name) in trajectory.others:
            came = np.reshape(trajectory.others[emitted_name(name)], (len(trajectory), -1))[:, 0].astype(np.float64)
            line = np.array([sample.in_line(name, first, frame.others, count) for frame in trajectory])
            since = np.where(line > 0.0, np.interp(line, came, trajectory.times, right=np.inf), since)
    return np.maximum(trajectory.times[:, None] - since, 0.0)


def coloured_by(
    scene: Scene, trajectory: Trajectory, simulation: Callable[[], Simulation] | None = None
) -> NDArray | None:
    """Return the values (frames, n) that colour particles in pictures: recorded, computed from records, or else
    computed with a simulation. None for the colours of phases.

    Raises:
        InputError: the quantity was not recorded and cannot be computed.
    """
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
    raise InputError(f"{name} was not recorded, and does not follow from positions and velocities: {advice}.")
