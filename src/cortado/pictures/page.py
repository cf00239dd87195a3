"""A picture that changes over a run: that of one run, or those of several side by side."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from cortado.discretise.shapes import Points
from cortado.pictures.steady import WINDOW

Ahead = Callable[[Iterator[Points]], Iterator[Points]]
Around = tuple[tuple[int, ...], tuple[int, ...]]
"""Numbers of the frames that a film shows before and after one, nearest first."""
ALONE: Around = (), ()
Panel = Callable[[int, Around], Points]
"""From a frame, a number, and those around it to a picture (rows, columns, 3), linear from 0 to 1."""


def alone(images: list[Points]) -> Points:
    """The one picture that there is."""
    (image,) = images
    return image


@dataclass(frozen=True)
class Page:
    """What is seen at each frame: the picture of one panel, or those of several put together."""

    panels: Sequence[Panel]
    composed: Callable[[list[Points]], Points] = alone
    """From the pictures of the panels to the page."""
    fingerprint: str = ""
    """A checksum of all that its pictures are made of; nothing where that is not known."""
    notes: str = ""
    """What somebody who sees it should know, in a sentence; nothing if there is nothing to say."""

    def image(self, frame: int) -> Points:
        """(rows, columns, 3), linear from 0 to 1."""
        return self.composed([panel(frame, ALONE) for panel in self.panels])

    def images(
        self, frames: Sequence[int], ahead: Ahead = iter, begin: int = 0, window: int = WINDOW
    ) -> Iterator[Points]:
        """Those of a film of so many frames in their order, from one of them on, each given so many before and after
        it; ``ahead``: from the pictures that they are made of to the same."""
        shown = range(begin, len(frames))
        drawn = ahead(panel(frames[n], _around(frames, n, window)) for n in shown for panel in self.panels)
        return (self.composed(list(islice(drawn, len(self.panels)))) for _ in shown)


def _around(frames: Sequence[int], n: int, window: int) -> Around:
    return tuple(frames[max(n - window, 0) : n][::-1]), tuple(frames[n + 1 : n + 1 + window])
