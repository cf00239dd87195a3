"""One run as a film shows it: each frame with those around it."""

from collections.abc import Callable
from typing import Any

from cortado.discretise.shapes import Points
from cortado.pictures.page import Around
from cortado.pictures.plane import PlanePainter
from cortado.pictures.scenery import State
from cortado.pictures.space import SpacePainter


class FilmedRun:
    """A `Panel`: pictures of the states of one run, of which fluid at rest does not flicker in 3-D."""

    def __init__(self, artist: PlanePainter | SpacePainter, state: Callable[[int], State]):
        """``state``: that of a frame, by its number."""
        self._artist, self._state, self._stills = artist, state, dict[int, Any]()

    def __call__(self, frame: int, around: Around) -> Points:
        """The picture of a frame."""
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
