"""A picture that changes over a run: that of one run, or those of several side by side."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from cortado.discretise.shapes import Points

Ahead = Callable[[Iterator[Points]], Iterator[Points]]
Panel = Callable[[int], Points]
"""From a frame, a number, to a picture (rows, columns, 3), linear from 0 to 1."""


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
        return self.composed([panel(frame) for panel in self.panels])

    def images(self, frames: Sequence[int], ahead: Ahead = iter) -> Iterator[Points]:
        """The `image` of each frame in their order; ``ahead``: from the pictures that they are made of to the same."""
        drawn = ahead(panel(frame) for frame in frames for panel in self.panels)
        return (self.composed(list(islice(drawn, len(self.panels)))) for _ in frames)
