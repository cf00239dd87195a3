"""How fast a film goes through the times of a run, and which of its frames it shows."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10

import numpy as np
from numpy.typing import NDArray

from cortado.errors import CortadoWarning
from cortado.scene.picture import Picture
from cortado.words import counted

SHORTEST = 4.0
"""[s] that a film lasts at least, if it has frames enough."""
SLOWEST, USUAL, QUICKEST = 6.0, 25.0, 60.0
"""Frames that a film shows in a second: fewer are seen one by one, of more the eye sees no more."""
SMOOTH = 12.0
"""Frames in a second below which a film says how more are recorded."""
EASY = (5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)
"""Speeds that are easy to think of, and these times powers of ten."""


@dataclass(frozen=True)
class Pace:
    """Which frames a film shows, and when."""

    frames: tuple[int, ...]
    """Numbers of those that it shows."""
    times: tuple[float, ...]
    """[s] in the film, of each of them"""
    speed: float | None
    """[-] seconds of the run in a second of the film; 1 is real time; None where times are not known"""
    recorded: int
    """How many frames there are."""
    enough: float = 0.0
    """[1/s] frames in a second of the run with which the film would show `USUAL` ones; 0 where times are not known"""
    of_search: bool = False
    """Whether the frames are those of a search, which [picture] says the number of, and not those of a run."""

    @classmethod
    def of(cls, times: Sequence[float] | NDArray, count: int | None = None, speed: float | None = None) -> "Pace":
        """That of a run with frames at ``times`` [s]. ``count``: how many frames the film has, evenly chosen; all if
        left out. ``speed``: if left out that of real time, or as much slower as the film needs to last `SHORTEST`, and
        to show no more frames in a second than are seen."""
        count, span = min(count or len(times), len(times)), float(times[-1] - times[0])
        enough = USUAL / (speed or _easy_speed(span, round(USUAL * max(SHORTEST, span)) + 1))
        if speed is None:
            speed = _easy_speed(span, count)
        elif span > 0.0:
            count = min(count, floor(QUICKEST * span / speed) + 1)
        chosen = np.unique(np.rint(np.linspace(0, len(times) - 1, count)).astype(int)).tolist()
        shown = tuple((times[k] - times[0]) / speed for k in chosen)
        return cls(tuple(chosen), shown, speed, len(times), enough)

    @classmethod
    def unknown(cls, count: int) -> "Pace":
        """That of so many frames whose times are not known."""
        rate = float(np.clip(count / SHORTEST, SLOWEST, USUAL))
        return cls(tuple(range(count)), tuple(k / rate for k in range(count)), None, count)

    @property
    def frames_per_second(self) -> float:
        """In the mean."""
        return (len(self.frames) - 1) / self.times[-1] if self.times[-1] > 0.0 else QUICKEST

    @property
    def in_words(self) -> str:
        """How fast time goes in the film."""
        if self.speed is None:
            return "step by step"
        return "in real time" if self.speed == 1.0 else f"at {self.speed:g} x"

    @property
    def seconds(self) -> float:
        """How long the film is [s]."""
        return self.times[-1] + 1.0 / self.frames_per_second

    @property
    def _more(self) -> str:
        """What records enough frames."""
        if self.of_search and self.speed is not None:
            return f"picture.film_frames={self.enough * self.speed * self.times[-1] + 1.0:.0f}"
        return f"--fps {self.enough:.4g}" if self.enough < 1e3 else f"--fps {self.enough:.0f}"

    def __str__(self) -> str:
        left_out = self.recorded - len(self.frames)
        kept = f"{counted(len(self.frames), 'frame')}, {self.seconds:.1f} s, {self.in_words}"
        if left_out:
            kept += f"; {left_out} of the {self.recorded} that were recorded are left out"
        if self.speed is not None and 1 < len(self.frames) == self.recorded and self.frames_per_second < SMOOTH:
            kept += f", with {self.frames_per_second:.2g} frames a second, as no more were recorded: "
            kept += f"{self._more} records {USUAL:g} for each second of the film"
        return kept


def pace_of(times: Sequence[float] | NDArray, picture: Picture) -> Pace:
    """That of a run with frames at ``times`` [s] as a picture table asks for; warns where it asks for more frames than
    there are."""
    asked = picture.film_frames or None
    if asked is not None and len(times) < asked:
        found = f"the film has {counted(len(times), 'frame')} of the {asked} that picture.film_frames asks for"
        advice = "a smaller --record-every or more steps give more"
        warnings.warn(f"{found}, as the run has no more; {advice}.", CortadoWarning, stacklevel=3)
    return Pace.of(times, asked, picture.film_speed)


def _easy_speed(span: float, count: int) -> float:
    """Of a film with so many frames of a run that lasts ``span`` [s]."""
    if span <= 0.0:
        return 1.0
    lasts = max(min(SHORTEST, count / SLOWEST), (count - 1) / QUICKEST)
    most = min(span / lasts, max(1.0, SLOWEST * span / count))
    power = 10.0 ** floor(log10(most) + 1e-9)
    return next((round(easy * power, 12) for easy in EASY if easy * power <= most * (1.0 + 1e-9)), power)
