"""The solids of a scene as pictures show them: shapes in poses, with colours."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.solid import Hollow, Placed, Solid
from cortado.scene.materials import Finish
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class ShownSolid:
    """A solid in a pose."""

    name: str
    shape: Solid
    """About its middle, not turned; of a tank the cavity."""
    position: Points
    """(d,) where its middle is [m]"""
    turn: Points
    """(d, d) rotation matrix"""
    finish: Finish
    is_tank: bool
    """Whether fluid is inside of it."""

    @property
    def colour(self) -> Points:
        """(3,) linear"""
        return np.array(self.finish.colour)

    @property
    def transparency(self) -> float:
        """From 0 to 1."""
        return self.finish.transparency

    @property
    def body(self) -> Solid:
        """The shape in its place."""
        return Placed(self.shape, self.position, self.turn)

    @property
    def solid(self) -> Solid:
        """Where fluid cannot be."""
        return Hollow(self.body) if self.is_tank else self.body

    def moved(self, position: Points, turn: Points) -> "ShownSolid":
        """In another pose: its middle at a position (d,) [m], turned by a matrix (d, d)."""
        return replace(self, position=position, turn=turn)

    def within(self, frame: Points, origin: Points) -> "ShownSolid":
        """In other axes: those of a frame (d, d), from an origin (d,) [m]."""
        return self.moved(frame @ (self.position - origin), frame @ self.turn)


def shown_solids(scene: Scene) -> tuple[ShownSolid, ...]:
    """Those of a scene, where its tables have them, of those that went on beyond the end of a period the images within
    it; and behind them the images that are a period away and reach into the container."""
    found, domain = [], scene.container.domain(scene.dimension)
    for table in scene.solid:
        shape, middle = table.shape_about()
        position, is_tank = middle if table.position is None else np.array(table.position), table.side == "inside"
        position = domain.wrapped(position)
        found.append(ShownSolid(table.name, shape, position, table.turn(scene.dimension), table.finish, is_tank))
    ends, lengths = scene.container.extent(), scene.container.periods(scene.dimension)[1]
    if ends is None or not lengths.any():
        return tuple(found)
    shifts = list(product(*[(0.0, -length, length) if length else (0.0,) for length in lengths]))[1:]
    images = [one.moved(one.position + np.array(shift), one.turn) for one in found for shift in shifts]
    return (*found, *(one for one in images if _overlap(one.body.extent(), ends)))


def extents_of_solids(scenes: Iterable[Scene]) -> list[tuple[Points, Points]]:
    """Lower and upper ends (d,) [m] of each solid in scenes."""
    return [one.body.extent() for scene in scenes for one in shown_solids(scene)]


def extent_with(ends: tuple[Points, Points], scenes: Iterable[Scene]) -> tuple[Points, Points]:
    """Lower and upper ends (d,) [m] of all that is between such, and of the solids of scenes."""
    return union([ends, *extents_of_solids(scenes)])


def union(boxes: Sequence[tuple[Points, Points]]) -> tuple[Points, Points]:
    """Lower and upper ends (d,) [m] of all that is in boxes, which are pairs of such ends."""
    both = np.array(boxes)
    return both[:, 0].min(axis=0), both[:, 1].max(axis=0)


def _overlap(one: tuple[Points, Points], other: tuple[Points, Points]) -> bool:
    """Whether two boxes do."""
    return bool((one[0] < other[1]).all() and (other[0] < one[1]).all())
