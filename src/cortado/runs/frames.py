"""Frames of a run: when they are due, how they are written to a VTKHDF file, which frames a film shows, and the poses
of moving solids."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import floor, log10
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.calls import counted
from cortado.errors import InputError, shown, warn
from cortado.files import vtkhdf
from cortado.lazy import on_top
from cortado.scene.appearance import Picture
from cortado.scene.motions import (
    AXES,
    angular_velocity_name,
    courses,
    moving,
    position_name,
    rotation_name,
    scale_name,
    solids_in,
    told,
    turn_name,
    velocity_name,
)
from cortado.scene.parameters import QUANTITIES
from cortado.scene.restart import Origin
from cortado.scene.scene import Scene
from cortado.scene.solids import SolidTable

SAME = 1e-9
"""Relative tolerance for rounded times: a state this part of a frame interval too early still counts as due."""
FRACTION = "mass_fraction_"
SHORTEST, LONGEST = 4.0, 10.0
"""Least and greatest length of a film [s], if there are enough frames and the user sets no number of frames."""
FEW = 1.0
"""Length [s] of a film with few frames, if it then shows at least `SLOWEST` frames per second."""
SLOWEST, USUAL = 6.0, 25.0
"""Least and usual number of frames per second of a film; below the least, single frames become visible."""
SMOOTH = 12.0
"""Frames per second below which a note on the film says how to record more frames."""
SHORT = 1.5
"""Factor by which a lack of frames may speed up a film before a note says so."""
EARLY = 1e-6
"""Part of a frame interval; the last frame counts as early if it is recorded by more than this before it is due."""
EASY = (5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)
"""Round numbers: a film's speed is one of these times a power of ten."""


@dataclass(frozen=True)
class Marks:
    """The times at which frames of a run are due: frame k is the first state at or after the time start + k / rate."""

    start: float
    """[s] when the run began"""
    rate: float
    """[1/s] frames per simulated second"""

    def passed(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Return, for each of the times (n,) [s], the number of the last mark at or before that time, (n,)."""
        return np.floor((np.asarray(times) - self.start) * self.rate + SAME).astype(np.int64)

    def at(self, numbers: NDArray[Any]) -> NDArray[np.float64]:
        """Return the times (n,) [s] of the marks with the given numbers (n,)."""
        return self.start + np.asarray(numbers) / self.rate

    def due(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """Return the times (frames,) [s] when frames recorded at ``times`` (frames,) were due. The last state of a run
        may be at no mark; it keeps its own time, as do states that are farther apart than marks."""
        numbers = self.passed(times)
        one_by_one = np.diff(numbers, prepend=numbers[:1] - 1) == 1
        return np.where(one_by_one, self.at(numbers), times)

    def chosen(self, times: NDArray[Any], stride: int) -> Marks | None:
        """Return the marks of every ``stride``-th frame of those recorded at ``times`` (frames,) [s]. None if the
        frames, except the last, are not evenly spaced on the marks."""
        numbers = self.passed(times)
        apart = np.diff(numbers)
        every = 1 if stride == 1 else int(apart[0]) if len(apart) else 0
        if not len(numbers) or every < 1 or (stride != 1 and ((apart[:-1] != every).any() or apart[-1] > every)):
            return None
        return Marks(float(self.at(numbers[0])), self.rate / every)


def common_rate(each: Iterable[Marks | None]) -> float | None:
    """Return the frame rate [1/s] that all runs have in common; None if rates differ or a run has no rate."""
    rates = {None if marks is None else marks.rate for marks in each}
    return rates.pop() if len(rates) == 1 else None


def frame_writer(
    path: str | Path,
    times: NDArray[Any],
    first: Mapping[str, NDArray[Any]],
    constants: Mapping[str, NDArray[Any]],
    steps: int,
    diagnostics: Mapping[str, NDArray[Any]],
    origin: Origin | None,
    quantities: Iterable[str] = (),
    marks: Marks | None = None,
    expected: int | None = None,
    kept: int = 1,
) -> vtkhdf.TrajectoryWriter:
    """Open a trajectory file with room for frames at ``times`` (frames,) [s]. A frame has the fields of ``first`` and
    the named ``quantities``; each of the ``steps`` steps has the ``diagnostics``. ``marks``: due times, for frames
    chosen by time. The disk must have room for all frames, or for ``expected`` frames. An existing file is replaced
    only once its first ``kept`` frames are written to the new file."""
    particles, dimension = first["positions"].shape[-2:]
    single = first["positions"].dtype == np.float32
    vectors = [name for name in quantities if len(QUANTITIES[name].shape(particles, dimension)) == 2]
    numbers = [name for name in quantities if name not in vectors]
    return vtkhdf.TrajectoryWriter(
        path,
        times=times,
        particles=particles,
        dimension=dimension,
        precision="float32" if single else "float64",
        steps=steps,
        scalars=[*fraction_names(first["mass_fractions"].shape[-1] if "mass_fractions" in first else 0), *numbers],
        vectors=vectors,
        others=_others(first),
        constants=constants,
        diagnostics={name: column.dtype for name, column in diagnostics.items()},
        origin="" if origin is None else origin.to_json(),
        marks=() if marks is None else (marks.start, marks.rate),
        expected=expected,
        kept=kept,
    )


def append_frame(
    writer: vtkhdf.TrajectoryWriter,
    frame: Mapping[str, NDArray[Any]],
    step: int,
    quantities: Mapping[str, NDArray[Any]] | None = None,
    time: float | None = None,
) -> None:
    """Write the fields and quantities of a frame after ``step`` steps to a file of `frame_writer`, and its ``time`` [s]
    if it was not known before."""
    fractions = frame["mass_fractions"].T if "mass_fractions" in frame else ()
    scalars = {**dict(zip(fraction_names(len(fractions)), fractions, strict=True)), **(quantities or {})}
    writer.append(frame["positions"], frame["velocities"], step=step, time=time, others=_others(frame), **scalars)


def _others(frame: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: frame[name] for name in frame if name not in ("positions", "velocities", "mass_fractions")}


def fraction_names(phases: int) -> list[str]:
    """Return the names of the scalar fields with the mass fractions of several phases; no names for one phase."""
    return [f"{FRACTION}{k}" for k in range(phases)]


@dataclass(frozen=True)
class Pace:
    """The frames that a film shows, and the time of each in the film."""

    frames: tuple[int, ...]
    """Numbers of the frames shown."""
    times: tuple[float, ...]
    """[s] times in the film of these frames"""
    speed: float | None
    """[-] simulated seconds per second of film; 1 is real time; None if times are unknown"""
    recorded: int
    """Number of recorded frames."""
    enough: float = 0.0
    """[1/s] frames per simulated second that give the film `USUAL` frames per second; 0 if times are unknown"""
    is_asked: bool = False
    """True if the user chose the speed."""
    of_search: bool = False
    """True for frames of a search instead of a run; the table [picture] gives their number."""

    @classmethod
    def of(
        cls,
        times: Sequence[float] | NDArray,
        count: int | None = None,
        speed: float | None = None,
        rate: float | None = None,
    ) -> Pace:
        """Choose the pace for a run with frames at ``times`` [s]. ``count``: number of frames of the film, evenly
        chosen; `USUAL` per second of film if left out. ``speed``: if left out, a film of ``count`` frames shows `USUAL`
        per second. Other films are in real time, or slower or faster if they would be shorter than `SHORTEST` or longer
        than `LONGEST`. ``rate`` [1/s]: frames recorded per simulated second; without ``count`` the film shows every
        frame, or every second frame, and so on, without interpolation."""
        span = float(times[-1] - times[0])
        full, is_asked = speed or _easy_speed(span), speed is not None
        if speed is None:
            speed = _speed(span, min(count or len(times), len(times)), full if count is None else 0.0)
        most = min(count or round(USUAL * span / speed) + 1, len(times))
        enough = USUAL / full
        chosen = np.unique(np.rint(np.linspace(0, len(times) - 1, most)).astype(int)).tolist()
        if rate is not None and count is None:
            chosen = list(range(0, _whole(times, rate), max(round(rate * speed / USUAL), 1)))
        shown = tuple((times[k] - times[0]) / speed for k in chosen)
        return cls(tuple(chosen), shown, speed, len(times), enough, is_asked)

    @classmethod
    def unknown(cls, count: int) -> Pace:
        """Return the pace of ``count`` frames whose times are not known."""
        rate = float(np.clip(count / SHORTEST, SLOWEST, USUAL))
        return cls(tuple(range(count)), tuple(k / rate for k in range(count)), None, count)

    @property
    def frames_per_second(self) -> float:
        """Return the mean number of frames per second of the film."""
        return (len(self.frames) - 1) / self.times[-1] if self.times[-1] > 0.0 else USUAL

    @property
    def in_words(self) -> str:
        """Return a text with the film's speed relative to real time."""
        if self.speed is None:
            return "step by step"
        return "in real time" if self.speed == 1.0 else f"at {self.speed:g} x"

    @property
    def seconds(self) -> float:
        """Return the length of the film [s]."""
        return self.times[-1] + 1.0 / self.frames_per_second

    @property
    def _more(self) -> str:
        """Return the command line option that records enough frames."""
        if self.of_search and self.speed is not None:
            return f"picture.film_frames={self.enough * self._span + 1.0:.0f}"
        return f"--fps {self.enough:.4g}" if self.enough < 1e3 else f"--fps {self.enough:.0f}"

    def __str__(self) -> str:
        left_out = self.recorded - len(self.frames)
        kept = f"{counted(len(self.frames), 'frame')}, {self.seconds:.1f} s, {self.in_words}"
        if left_out:
            kept += f"; {left_out} of the {self.recorded} that were recorded are left out"
        if self.speed is not None and 1 < len(self.frames) == self.recorded and self._lacks:
            kept += f", with {self.frames_per_second:.2g} frames a second, as no more were recorded: {self._more} "
            kept += f"records {USUAL:g} for each second of a film of {self.enough * self._span / USUAL:.2g} s"
        return kept if self.is_asked or self.speed in (None, 1.0) else f"{kept}; picture.film_speed=1 is real time"

    @property
    def _span(self) -> float:
        """Return the simulated time of the run [s]."""
        return self.times[-1] * (self.speed or 0.0)

    @property
    def _lacks(self) -> bool:
        """Return True if single frames are visible in the film, or if it is much shorter than with enough frames."""
        return self.frames_per_second < SMOOTH or (self.speed or 0.0) > SHORT * USUAL / self.enough


@dataclass(frozen=True)
class Film:
    """A film file, with its pace and notes."""

    path: Path
    pace: Pace
    """The film's frames and their times."""
    notes: str = ""
    """A sentence for viewers of the film, or an empty text."""

    @property
    def in_words(self) -> str:
        """Return the film's pace and notes as text."""
        return f"{self.pace}; {self.notes}" if self.notes else str(self.pace)

    def __str__(self) -> str:
        return f"{self.path.name}: {self.in_words}"

    def __repr__(self) -> str:
        return f"Film({self.path}, {self.pace})"

    def _repr_html_(self) -> str:
        """Show the repr and a video player in a notebook."""
        page: str = on_top("film_page")(self)
        return page


def pace_of(times: Sequence[float] | NDArray, picture: Picture, rate: float | None = None) -> Pace:
    """Return the pace that the table [picture] sets for a run with frames at ``times`` [s]; ``rate`` as in `Pace.of`.
    Warn if the table sets more frames than were recorded."""
    asked = picture.film_frames or None
    if asked is not None and len(times) < asked:
        found = f"the film has {counted(len(times), 'frame')} of the {asked} that picture.film_frames asks for"
        advice = "a smaller --record-every or more steps give more"
        warn(f"{found}, as the run has no more; {advice}.")
    return Pace.of(times, asked, picture.film_speed, rate)


def _whole(times: Sequence[float] | NDArray, rate: float) -> int:
    """Return the number of frames, not counting a last frame that is recorded before it is due."""
    is_early = len(times) > 2 and (times[-1] - times[-2]) * rate < 1.0 - EARLY
    return len(times) - 1 if is_early else len(times)


def _speed(span: float, count: int, easy: float) -> float:
    """Return the speed of a film with at most ``count`` frames of a run that lasts ``span`` [s]: ``easy`` if that many
    frames suffice, else the speed with `USUAL` frames per second."""
    if span <= 0.0:
        return 1.0
    room = max((count - 1) / USUAL, min(FEW, count / SLOWEST))
    return easy if span <= 1.01 * room * easy else float(f"{span / room:.2g}")


def _easy_speed(span: float) -> float:
    """Return the speed of a film with enough frames, for a run that lasts ``span`` [s]."""
    wanted = span / min(max(span, SHORTEST), LONGEST)
    if wanted <= 0.0:
        return 1.0
    power = 10.0 ** floor(log10(wanted) + 1e-9)
    speeds = [round(easy * power, 12) for easy in (10.0, *EASY)]
    if wanted > 1.0:
        return min(speed for speed in speeds if speed >= wanted * (1.0 - 1e-9))
    return max(speed for speed in speeds if speed <= wanted * (1.0 + 1e-9))


@dataclass(frozen=True, eq=False)
class SolidMotion:
    """The motion of one solid, in every frame."""

    positions: NDArray[Any]
    """(frames, d) positions of the solid's middle [m]"""
    rotations: NDArray[Any]
    """(frames, 3) rotation vectors, in 2-D (frames,) angles, of the rotation about the solid's middle [rad]"""
    velocities: NDArray[Any] | None = None
    """(frames, d) velocities of the middle of a free body [m/s]; None for a solid with a prescribed path."""
    angular_velocities: NDArray[Any] | None = None
    """(frames, 3), in 2-D (frames,), angular velocities of a free body [rad/s]; None for a solid with a prescribed
    path."""
    scale: float = 1.0
    """Scale of a solid with a prescribed path, relative to its size in the scene."""

    def __getitem__(self, frames: slice | NDArray[np.intp]) -> Self:
        """Return the motion in some of the frames."""
        velocities, spins = (None if a is None else a[frames] for a in (self.velocities, self.angular_velocities))
        places, turns = self.positions[frames], self.rotations[frames]
        return replace(self, positions=places, rotations=turns, velocities=velocities, angular_velocities=spins)

    def carried(self, shifts: NDArray[Any]) -> Self:
        """Return a free body's motion, extrapolated in each frame by ``shifts`` (frames,) [s] with constant
        velocities."""
        assert self.velocities is not None and self.angular_velocities is not None
        places, turns = self.positions + shifts[:, None] * self.velocities, (shifts * self.angular_velocities.T).T
        rotations = self.rotations + turns if turns.ndim == 1 else _product(turns, self.rotations)
        return replace(self, positions=places, rotations=rotations)

    def between(self, known: NDArray[Any], times: NDArray[Any], table: SolidTable) -> Self:
        """Return the motion at ``times`` (k,) [s] of a solid with a given path and frames at times ``known`` (frames,)
        [s]: its path in ``table``, plus the interpolated deviation of the recorded poses from that path."""
        shift, turn = courses(table)
        kept = self.positions - shift.at(known)
        places = np.stack([np.interp(times, known, x) for x in kept.T], axis=1) + shift.at(times)
        if self.rotations.ndim == 1:
            turns = np.interp(times, known, self.rotations - turn.at(known)) + turn.at(times)
        else:
            from scipy.spatial.transform import Rotation, Slerp

            begun = Rotation.from_rotvec(_product(-turn.at(known), self.rotations))
            turns = _product(turn.at(times), Slerp(known, begun)(times).as_rotvec())
        return replace(self, positions=places, rotations=turns)


class SolidMotions(dict[str, SolidMotion]):
    """The motions of the moving solids of a run, by name."""

    def __missing__(self, name: object) -> SolidMotion:
        """Raise `InputError` for a solid that did not move."""
        known = f"moved {', '.join(self)}" if self else "moved none"
        raise InputError(f"solids has no {shown(name)}, as the run {known}.")

    def in_frames(self, frames: slice) -> SolidMotions:
        """Return the motions in the given frames."""
        return SolidMotions({name: motion[frames] for name, motion in self.items()})

    def at(self, scene: Scene, known: NDArray[Any], recorded: NDArray[np.intp], times: NDArray[Any]) -> SolidMotions:
        """Return the motions at ``times`` (k,) [s] in a run with frames at times ``known`` (frames,) [s]. Entry k is
        close to the frame with number ``recorded`` (k,)."""
        shifts, tables = times - known[recorded], {table.name: table for table in told(scene.solid)}
        if not shifts.any():
            return SolidMotions({name: motion[recorded] for name, motion in self.items()})
        return SolidMotions(
            {
                name: motion.between(known, times, tables[name]) if name in tables else motion[recorded].carried(shifts)
                for name, motion in self.items()
                if name in tables or motion.velocities is not None
            }
        )


def solid_motions(scene: Scene, fields: Mapping[str, NDArray[Any]]) -> SolidMotions:
    """Return the motions of the solids of a scene, by their names, from recorded fields (frames, 1, ...) of states."""
    names = (table.name for table in moving(scene.solid) if position_name(table.name) in fields)
    return SolidMotions({name: _motion(name, fields, scene.dimension) for name in names})


def motions_in(fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotions:
    """Return the motions of all solids that recorded fields (frames, 1, ...) of states have, by their names."""
    return SolidMotions({name: _motion(name, fields, dimension) for name in solids_in(fields)})


def _motion(name: str, fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotion:
    position, begun = (fields[of(name)][:, 0].astype(np.float64) for of in (position_name, rotation_name))
    if f"{name}.{AXES[0]}" in fields:  # of a body that is free
        axes = np.stack([fields[f"{name}.{axis}"][:, 0].astype(np.float64) for axis in AXES], axis=-1)
        moving: dict[str, Any] = {"velocities": fields[velocity_name(name)][:, 0]}
        moving["angular_velocities"] = fields[angular_velocity_name(name)][:, 0]
        return SolidMotion(position, _turned(axes + np.eye(dimension, 3), begun, dimension), **moving)
    turns = fields[turn_name(name)][:, 0].astype(np.float64)
    rotations = turns + begun if dimension == 2 else _product(turns, begun)
    return SolidMotion(position, rotations, scale=float([*fields[scale_name(name)][:, 0], 1.0][0]))


def _turned(axes: NDArray[Any], begun: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return the rotation ``begun`` followed by the matrices ``axes`` (frames, d, 3), whose columns are in world
    coordinates. In 2-D the results are angles, each the nearest to the previous one."""
    if dimension == 2:
        return np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])) + begun
    from scipy.spatial.transform import Rotation

    return _product(Rotation.from_matrix(axes).as_rotvec(), begun)


def _product(turns: NDArray[Any], begun: NDArray[Any]) -> NDArray[Any]:
    """Return the rotation vectors (frames, 3) of the rotation ``begun`` followed by the rotations ``turns``."""
    from scipy.spatial.transform import Rotation

    return np.asarray((Rotation.from_rotvec(turns) * Rotation.from_rotvec(begun)).as_rotvec())


def sized(scene: Scene, motions: Mapping[str, SolidMotion]) -> Scene:
    """Return the scene with its moving solids scaled as in a run."""
    tables = (table.stretched(motions[table.name].scale) if table.name in motions else table for table in scene.solid)
    return scene.model_copy(update={"solid": tuple(tables)})


def posed(scene: Scene, motions: Mapping[str, SolidMotion], frame: int) -> Scene:
    """Return the scene with its solids at their poses in a frame, for drawing."""
    tables = []
    for table in sized(scene, motions).solid:
        if motion := motions.get(table.name):
            table = table.moved(motion.positions[frame], tuple(np.atleast_1d(motion.rotations[frame]).tolist()))
        tables.append(table)
    return scene.model_copy(update={"solid": tuple(tables)})
