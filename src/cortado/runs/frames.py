"""Frames of a run and of a film, their times, and the poses of solids."""

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
"""Tolerance of the time of a frame, in frame intervals."""
FRACTION = "mass_fraction_"
SLOWEST, USUAL = 6.0, 25.0
"""Smallest and usual number of frames per second of a film."""
Fields = Mapping[str, NDArray[Any]]
Times = Sequence[float] | NDArray


@dataclass(frozen=True)
class Marks:
    """Due times of the frames of a run. Frame k is the first state at or after the time start + k / rate."""

    start: float
    """Time of frame 0 [s]."""
    rate: float
    """Number of frames per second [1/s]."""

    def passed(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Return for each of ``times`` (n,) [s] the number of the last due frame."""
        return np.floor((np.asarray(times) - self.start) * self.rate + SAME).astype(np.int64)

    def at(self, numbers: NDArray[Any]) -> NDArray[np.float64]:
        return self.start + np.asarray(numbers) / self.rate

    def due(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """Return due times (frames,) [s] of frames at ``times`` (frames,) [s]. A frame after a gap keeps its time."""
        numbers = self.passed(times)
        one_by_one = np.diff(numbers, prepend=numbers[:1] - 1) == 1
        return np.where(one_by_one, self.at(numbers), times)

    def chosen(self, times: NDArray[Any], stride: int) -> Marks | None:
        """Return None if the chosen frames are not evenly spaced."""
        numbers = self.passed(times)
        apart = np.diff(numbers)
        every = 1 if stride == 1 else int(apart[0]) if len(apart) else 0
        if not len(numbers) or every < 1 or (stride != 1 and ((apart[:-1] != every).any() or apart[-1] > every)):
            return None
        return Marks(float(self.at(numbers[0])), self.rate / every)


def common_rate(each: Iterable[Marks | None]) -> float | None:
    """Return the frame rate [1/s] of the runs, or None if the rates differ."""
    rates = {None if marks is None else marks.rate for marks in each}
    return rates.pop() if len(rates) == 1 else None


def frame_writer(
    path: str | Path, first: Fields, diagnostics: Fields, origin: Origin | None, marks: Marks | None, **layout: Any
) -> vtkhdf.TrajectoryWriter:
    """Open a trajectory file for frames like ``first``. ``layout`` has further arguments of `TrajectoryWriter`."""
    quantities = layout.pop("quantities")
    particles, dimension = first["positions"].shape[-2:]
    single = first["positions"].dtype == np.float32
    vectors = [name for name in quantities if len(QUANTITIES[name].shape(particles, dimension)) == 2]
    numbers = [name for name in quantities if name not in vectors]
    return vtkhdf.TrajectoryWriter(
        path,
        particles=particles,
        dimension=dimension,
        precision="float32" if single else "float64",
        scalars=[*fraction_names(first["mass_fractions"].shape[-1] if "mass_fractions" in first else 0), *numbers],
        vectors=vectors,
        others=_others(first),
        diagnostics={name: column.dtype for name, column in diagnostics.items()},
        origin="" if origin is None else origin.to_json(),
        marks=() if marks is None else (marks.start, marks.rate),
        **layout,
    )


def append_frame(
    writer: vtkhdf.TrajectoryWriter, frame: Fields, step: int, quantities: Fields, time: float | None = None
) -> None:
    """Write a frame. Without ``time`` [s], the frame has the time that `frame_writer` was given."""
    fractions = frame["mass_fractions"].T if "mass_fractions" in frame else ()
    scalars = {**dict(zip(fraction_names(len(fractions)), fractions, strict=True)), **quantities}
    writer.append(frame["positions"], frame["velocities"], step=step, time=time, others=_others(frame), **scalars)


def _others(frame: Fields) -> dict[str, NDArray[Any]]:
    return {name: frame[name] for name in frame if name not in ("positions", "velocities", "mass_fractions")}


def fraction_names(phases: int) -> list[str]:
    return [f"{FRACTION}{k}" for k in range(phases)]


@dataclass(frozen=True)
class Pace:
    frames: tuple[int, ...]
    times: tuple[float, ...]
    speed: float
    """Simulated seconds per second of the film [-]."""
    recorded: int
    enough: float
    """Frames per simulated second that give `USUAL` frames per second of the film [1/s]."""
    is_asked: bool
    of_search: bool = False

    @classmethod
    def of(cls, times: Times, count: int | None = None, speed: float | None = None, rate: float | None = None) -> Pace:
        """Choose at most ``count`` frames. The default ``speed`` is real time, unless the film would be too short or
        too long. With the recorded frame ``rate`` [1/s] the film shows every k-th frame."""
        span = float(times[-1] - times[0])
        full, is_asked = speed or _easy_speed(span), speed is not None
        if speed is None and span <= 0.0:
            speed = 1.0
        elif speed is None:
            shown, easy = min(count or len(times), len(times)), full if count is None else 0.0
            room = max((shown - 1) / USUAL, min(1.0, shown / SLOWEST))
            speed = easy if span <= 1.01 * room * easy else float(f"{span / room:.2g}")
        most = min(count or round(USUAL * span / speed) + 1, len(times))
        chosen = np.unique(np.rint(np.linspace(0, len(times) - 1, most)).astype(int)).tolist()
        if rate is not None and count is None:
            is_early = len(times) > 2 and (times[-1] - times[-2]) * rate < 1.0 - 1e-6  # the last one
            chosen = list(range(0, len(times) - int(is_early), max(round(rate * speed / USUAL), 1)))
        in_film = tuple((times[k] - times[0]) / speed for k in chosen)
        return cls(tuple(chosen), in_film, speed, len(times), USUAL / full, is_asked)

    @property
    def frames_per_second(self) -> float:
        return (len(self.frames) - 1) / self.times[-1] if self.times[-1] > 0.0 else USUAL

    @property
    def in_words(self) -> str:
        return "in real time" if self.speed == 1.0 else f"at {self.speed:g} x"

    @property
    def seconds(self) -> float:
        return self.times[-1] + 1.0 / self.frames_per_second

    def __str__(self) -> str:
        left_out = self.recorded - len(self.frames)
        kept = f"{counted(len(self.frames), 'frame')}, {self.seconds:.1f} s, {self.in_words}"
        if left_out:
            kept += f"; {left_out} of the {self.recorded} that were recorded are left out"
        lacks = self.frames_per_second < 12.0 or self.speed > 1.5 * USUAL / self.enough
        if 1 < len(self.frames) == self.recorded and lacks:
            wanted = self.enough * (self.times[-1] * self.speed)
            more = f"--fps {self.enough:.4g}" if self.enough < 1e3 else f"--fps {self.enough:.0f}"
            more = f"picture.film_frames={wanted + 1.0:.0f}" if self.of_search else more
            kept += f", with {self.frames_per_second:.2g} frames a second, as no more were recorded: {more} "
            kept += f"records {USUAL:g} for each second of a film of {wanted / USUAL:.2g} s"
        return kept if self.is_asked or self.speed == 1.0 else f"{kept}; picture.film_speed=1 is real time"


@dataclass(frozen=True)
class Film:
    path: Path
    pace: Pace
    notes: str = ""

    @property
    def in_words(self) -> str:
        return f"{self.pace}; {self.notes}" if self.notes else str(self.pace)

    def __str__(self) -> str:
        return f"{self.path.name}: {self.in_words}"

    def __repr__(self) -> str:
        return f"Film({self.path}, {self.pace})"

    def _repr_html_(self) -> str:
        return on_top("film_page")(self)


def pace_of(times: Times, picture: Picture, rate: float | None = None) -> Pace:
    asked = picture.film_frames or None
    if asked is not None and len(times) < asked:
        found = f"the film has {counted(len(times), 'frame')} instead of the {asked} of picture.film_frames"
        warn(f"{found}, as the run has no more frames: take a smaller --record-every or more steps.")
    return Pace.of(times, asked, picture.film_speed, rate)


def _easy_speed(span: float) -> float:
    wanted = span / min(max(span, 4.0), 10.0)  # s, the shortest and the longest film
    if wanted <= 0.0:
        return 1.0
    power = 10.0 ** floor(log10(wanted) + 1e-9)
    speeds = [round(easy * power, 12) for easy in (10.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)]
    if wanted > 1.0:
        return min(speed for speed in speeds if speed >= wanted * (1.0 - 1e-9))
    return max(speed for speed in speeds if speed <= wanted * (1.0 + 1e-9))


@dataclass(frozen=True, eq=False)
class SolidMotion:
    positions: NDArray[Any]
    """Positions of the solid's middle (frames, d) [m]."""
    rotations: NDArray[Any]
    """Rotation vectors (frames, 3) [rad], or in 2-D angles (frames,)."""
    velocities: NDArray[Any] | None = None
    """Velocities of the middle of a free body (frames, d) [m/s], or None for a prescribed motion."""
    angular_velocities: NDArray[Any] | None = None
    """Angular velocities of a free body (frames, 3) [rad/s], in 2-D (frames,), or None for a prescribed motion."""
    scale: float = 1.0
    """Size of the solid relative to its size in the scene."""

    @classmethod
    def of(cls, name: str, fields: Mapping[str, NDArray[Any]], dimension: int) -> Self:
        position, begun = (fields[of(name)][:, 0].astype(np.float64) for of in (position_name, rotation_name))
        if f"{name}.{AXES[0]}" in fields:  # of a body that is free
            axes = np.stack([fields[f"{name}.{axis}"][:, 0].astype(np.float64) for axis in AXES], axis=-1)
            axes += np.eye(dimension, 3)
            if dimension == 2:
                rotations = np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])) + begun
            else:
                from scipy.spatial.transform import Rotation

                rotations = _product(Rotation.from_matrix(axes).as_rotvec(), begun)
            velocities, spins = (fields[of(name)][:, 0] for of in (velocity_name, angular_velocity_name))
            return cls(position, rotations, velocities, spins)
        turns = fields[turn_name(name)][:, 0].astype(np.float64)
        rotations = turns + begun if dimension == 2 else _product(turns, begun)
        return cls(position, rotations, scale=float([*fields[scale_name(name)][:, 0], 1.0][0]))

    def __getitem__(self, frames: slice | NDArray[np.intp]) -> Self:
        velocities, spins = (None if a is None else a[frames] for a in (self.velocities, self.angular_velocities))
        places, turns = self.positions[frames], self.rotations[frames]
        return replace(self, positions=places, rotations=turns, velocities=velocities, angular_velocities=spins)

    def carried(self, shifts: NDArray[Any]) -> Self:
        """Extrapolate the motion by ``shifts`` (frames,) [s] with constant velocities of the free body."""
        assert self.velocities is not None and self.angular_velocities is not None
        places, turns = self.positions + shifts[:, None] * self.velocities, (shifts * self.angular_velocities.T).T
        rotations = self.rotations + turns if turns.ndim == 1 else _product(turns, self.rotations)
        return replace(self, positions=places, rotations=rotations)

    def between(self, known: NDArray[Any], times: NDArray[Any], table: SolidTable) -> Self:
        """Interpolate the motion between frames at ``known`` (frames,) [s], for ``times`` (k,) [s]."""
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
    """An unknown name raises `InputError`."""

    @classmethod
    def of(cls, fields: Mapping[str, NDArray[Any]], dimension: int) -> SolidMotions:
        """The recorded fields have the shape (frames, 1, ...)."""
        return cls({name: SolidMotion.of(name, fields, dimension) for name in solids_in(fields)})

    def __missing__(self, name: object) -> SolidMotion:
        known = f"has the moving solids {', '.join(self)}" if self else "has no moving solids"
        raise InputError(f"solids has no {shown(name)}, as the run {known}.")

    def at(self, scene: Scene, known: NDArray[Any], recorded: NDArray[np.intp], times: NDArray[Any]) -> SolidMotions:
        """``recorded`` (k,) are the numbers of the frames nearest to ``times`` (k,) [s]."""
        shifts, tables = times - known[recorded], {table.name: table for table in told(scene.solid)}
        if not shifts.any():
            return SolidMotions({name: motion[recorded] for name, motion in self.items()})
        moved = {name: own[recorded].carried(shifts) for name, own in self.items() if own.velocities is not None}
        by_path = {name: self[name].between(known, times, tables[name]) for name in self if name in tables}
        found = moved | by_path
        return SolidMotions({name: found[name] for name in self if name in found})


def _product(turns: NDArray[Any], begun: NDArray[Any]) -> NDArray[Any]:
    from scipy.spatial.transform import Rotation

    return np.asarray((Rotation.from_rotvec(turns) * Rotation.from_rotvec(begun)).as_rotvec())


def sized(scene: Scene, motions: Mapping[str, SolidMotion]) -> Scene:
    tables = (table.stretched(motions[table.name].scale) if table.name in motions else table for table in scene.solid)
    return scene.model_copy(update={"solid": tuple(tables)})


def posed(scene: Scene, motions: Mapping[str, SolidMotion], frame: int) -> Scene:
    tables = []
    for table in sized(scene, motions).solid:
        if motion := motions.get(table.name):
            table = table.moved(motion.positions[frame], tuple(np.atleast_1d(motion.rotations[frame]).tolist()))
        tables.append(table)
    return scene.model_copy(update={"solid": tuple(tables)})
