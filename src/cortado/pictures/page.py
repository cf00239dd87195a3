"""A picture that changes over a run: states of one run, or of several side by side."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from cortado.discretise.shapes import Points
from cortado.pictures.painter import Painter
from cortado.pictures.scenery import State

Ahead = Callable[[Iterator[Points]], Iterator[Points]]


def alone(images: list[Points]) -> Points:
    """The one picture that there is."""
    (image,) = images
    return image


@dataclass(frozen=True)
class Page:
    """What is seen at each frame, a number: one picture, made of those of one state or of several."""

    painter: Painter
    states: Sequence[Callable[[int], State]]
    """From a frame to what the painter draws, for each picture that is part of the page."""
    composed: Callable[[list[Points]], Points] = alone
    """From the pictures of the states, (rows, columns, 3) each, to the page."""
    fingerprint: str = ""
    """A checksum of all that its pictures are made of; nothing where that is not known."""

    def image(self, frame: int) -> Points:
        """(rows, columns, 3), linear from 0 to 1."""
        return self.composed([self.painter.image(*state(frame)) for state in self.states])

    def images(
        self, frames: Sequence[int], ahead: Callable[[Iterator[Points]], Iterator[Points]] = iter
    ) -> Iterator[Points]:
        """The `image` of each frame in their order; ``ahead``: from the pictures that they are made of to the same."""
        drawn = ahead(self.painter.images(state(frame) for frame in frames for state in self.states))
        return (self.composed(list(islice(drawn, len(self.states)))) for _ in frames)
