"""Frames of a run: when they are due, as a VTKHDF file takes them one by one, and which of them a film shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, log10
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import warn
from cortado.files import vtkhdf
from cortado.lazy import on_top
from cortado.scene.appearance import Picture
from cortado.scene.quantity_names import QUANTITIES
from cortado.scene.restart import Origin
from cortado.words import counted

SAME = 1e-9
"""Part of the time between frames: a state that comes earlier than a frame is due by less is that frame, as times are
rounded."""


FRACTION = "mass_fraction_"
SHORTEST, LONGEST = 4.0, 10.0
"""[s] that a film lasts at least and at most, if it has frames enough and nobody asks for another number of them."""
FEW = 1.0
"""Length [s] of a film of a few frames, with at least `SLOWEST` of them in a second."""
SLOWEST, USUAL = 6.0, 25.0
"""Frames that a film shows in a second: fewer are seen one by one."""
SMOOTH = 12.0
"""Frames in a second below which a film says how more are recorded."""
SHORT = 1.5
"""Factor by which a film goes faster for want of frames before it says so."""
EARLY = 1e-6
"""Part of the time between two frames: the last is early if it comes by more before it is due."""
EASY = (5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)
"""Speeds that are easy to think of, and these times powers of ten."""


@dataclass(frozen=True)
class Marks:
    """The times at which frames of a run are due: frame k at start + k / rate, the first state at that time or after
    it."""

    start: float
    """[s] when the run began"""
    rate: float
    """[1/s] frames in a second that is simulated"""

    def passed(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """Return the number (n,) of the last mark at or before each of the times (n,) [s]."""
        return np.floor((np.asarray(times) - self.start) * self.rate + SAME).astype(np.int64)

    def at(self, numbers: NDArray[Any]) -> NDArray[np.float64]:
        """Return the times (n,) [s] of marks of these numbers (n,)."""
        return self.start + np.asarray(numbers) / self.rate

    def due(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """Return the times (frames,) [s] when frames recorded at ``times`` (frames,) were due. The last state of a run,
        which may be at no mark, and states that are farther apart than marks have their own times."""
        numbers = self.passed(times)
        one_by_one = np.diff(numbers, prepend=numbers[:1] - 1) == 1
        return np.where(one_by_one, self.at(numbers), times)

    def chosen(self, times: NDArray[Any], stride: int) -> Marks | None:
        """Return the marks of every ``stride`` frames of those recorded at ``times`` (frames,) [s]; None where they are
        not evenly spaced among the marks, but for the last."""
        numbers = self.passed(times)
        apart = np.diff(numbers)
        every = 1 if stride == 1 else int(apart[0]) if len(apart) else 0
        if not len(numbers) or every < 1 or (stride != 1 and ((apart[:-1] != every).any() or apart[-1] > every)):
            return None
        return Marks(float(self.at(numbers[0])), self.rate / every)


def common_rate(each: Iterable[Marks | None]) -> float | None:
    """Return the number of frames in a second [1/s] that all of several runs record; None where some have none, or
    another one."""
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
    """Open a trajectory file with room for frames at ``times`` (frames,) [s]. A frame has the fields that ``first``
    has, and ``quantities`` of these names; a step, of which there are ``steps``, has the numbers of ``diagnostics``.
    ``marks``: when frames are due, where times choose them. The disk must have room for all frames, or for ``expected``
    ones. A file of that name is replaced once all of its first ``kept`` frames are written to the new one."""
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
    """Write the fields and the quantities of a frame, after ``step`` steps, to a file of `frame_writer`; its ``time``
    [s] where that was not known."""
    fractions = frame["mass_fractions"].T if "mass_fractions" in frame else ()
    scalars = {**dict(zip(fraction_names(len(fractions)), fractions, strict=True)), **(quantities or {})}
    writer.append(frame["positions"], frame["velocities"], step=step, time=time, others=_others(frame), **scalars)


def _others(frame: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: frame[name] for name in frame if name not in ("positions", "velocities", "mass_fractions")}


def fraction_names(phases: int) -> list[str]:
    """Return names of the scalar fields that hold the mass fractions of several phases; none for one phase."""
    return [f"{FRACTION}{k}" for k in range(phases)]


@dataclass(frozen=True)
class Pace:
    """The frames that a film shows, and when."""

    frames: tuple[int, ...]
    """Numbers of the frames that it shows."""
    times: tuple[float, ...]
    """[s] in the film, of each of them"""
    speed: float | None
    """[-] seconds of the run in a second of the film; 1 is real time; None where times are not known"""
    recorded: int
    """Number of recorded frames."""
    enough: float = 0.0
    """[1/s] frames in a second of the run with which the film would show `USUAL` ones; 0 where times are not known"""
    is_asked: bool = False
    """True where somebody chose the speed."""
    of_search: bool = False
    """True for frames of a search, whose number [picture] gives, and not of a run."""

    @classmethod
    def of(
        cls,
        times: Sequence[float] | NDArray,
        count: int | None = None,
        speed: float | None = None,
        rate: float | None = None,
    ) -> Pace:
        """Choose the pace for a run with frames at ``times`` [s]. ``count``: how many frames the film has, evenly
        chosen; if left out `USUAL` in each of its seconds. ``speed``: if left out, a film of ``count`` frames shows
        `USUAL` in a second, and any other is in real time, or slower or faster where it would be shorter than
        `SHORTEST` or longer than `LONGEST`. ``rate`` [1/s]: of frames that were recorded so many in a second; without
        ``count`` the film has every one of them, or every second, and so on, and no state between two."""
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
        """Return the mean number of frames in a second of the film."""
        return (len(self.frames) - 1) / self.times[-1] if self.times[-1] > 0.0 else USUAL

    @property
    def in_words(self) -> str:
        """Say how fast time goes in the film."""
        if self.speed is None:
            return "step by step"
        return "in real time" if self.speed == 1.0 else f"at {self.speed:g} x"

    @property
    def seconds(self) -> float:
        """Return the length of the film [s]."""
        return self.times[-1] + 1.0 / self.frames_per_second

    @property
    def _more(self) -> str:
        """Return the option that records enough frames."""
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
        """Return how long the run lasts [s]."""
        return self.times[-1] * (self.speed or 0.0)

    @property
    def _lacks(self) -> bool:
        """Return True if the film is seen frame by frame, or is much shorter than one of a run with frames enough."""
        return self.frames_per_second < SMOOTH or (self.speed or 0.0) > SHORT * USUAL / self.enough


@dataclass(frozen=True)
class Film:
    """A film that is written, with its pace and notes."""

    path: Path
    pace: Pace
    """Its frames, and how fast it shows them."""
    notes: str = ""
    """A sentence for those who see it; empty if there is nothing to say."""

    @property
    def in_words(self) -> str:
        """Return the pace and the notes of the film, in words."""
        return f"{self.pace}; {self.notes}" if self.notes else str(self.pace)

    def __str__(self) -> str:
        return f"{self.path.name}: {self.in_words}"

    def __repr__(self) -> str:
        return f"Film({self.path}, {self.pace})"

    def _repr_html_(self) -> str:
        """Show the repr, and a player with the film in it, in a notebook."""
        page: str = on_top("film_page")(self)
        return page


def pace_of(times: Sequence[float] | NDArray, picture: Picture, rate: float | None = None) -> Pace:
    """Return the pace of a run with frames at ``times`` [s] as a picture table asks for, ``rate`` as for `Pace.of`;
    warn where it asks for more frames than there are."""
    asked = picture.film_frames or None
    if asked is not None and len(times) < asked:
        found = f"the film has {counted(len(times), 'frame')} of the {asked} that picture.film_frames asks for"
        advice = "a smaller --record-every or more steps give more"
        warn(f"{found}, as the run has no more; {advice}.")
    return Pace.of(times, asked, picture.film_speed, rate)


def _whole(times: Sequence[float] | NDArray, rate: float) -> int:
    """Return how many frames there are without a last one that comes before it is due."""
    is_early = len(times) > 2 and (times[-1] - times[-2]) * rate < 1.0 - EARLY
    return len(times) - 1 if is_early else len(times)


def _speed(span: float, count: int, easy: float) -> float:
    """Return the speed of a film with at most ``count`` frames of a run that lasts ``span`` [s]. It is ``easy`` if that
    many are enough, or else the speed at which they are `USUAL` in a second."""
    if span <= 0.0:
        return 1.0
    room = max((count - 1) / USUAL, min(FEW, count / SLOWEST))
    return easy if span <= 1.01 * room * easy else float(f"{span / room:.2g}")


def _easy_speed(span: float) -> float:
    """Return the speed of a film that has frames enough, of a run that lasts ``span`` [s]."""
    wanted = span / min(max(span, SHORTEST), LONGEST)
    if wanted <= 0.0:
        return 1.0
    power = 10.0 ** floor(log10(wanted) + 1e-9)
    speeds = [round(easy * power, 12) for easy in (10.0, *EASY)]
    if wanted > 1.0:
        return min(speed for speed in speeds if speed >= wanted * (1.0 - 1e-9))
    return max(speed for speed in speeds if speed <= wanted * (1.0 + 1e-9))
