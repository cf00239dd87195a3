"""Draws the frames of a run whose solids move: each has them in other places."""

from collections.abc import Iterable, Iterator
from typing import Any

from cortado.discretise.shapes import Points
from cortado.pictures.painter import painter
from cortado.pictures.scenery import State
from cortado.runs.solid_motion import posed, solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import Scene

ENOUGH = 100
"""Frames that tell where solids come to."""


class MovingPainter:
    """A `cortado.pictures.painter.Painter` that is told which frame comes next."""

    at_once = 1

    def __init__(self, scene: Scene, trajectory: Trajectory, device: Any):
        self._scene, self._motions = scene, solid_motions(scene, trajectory.others)
        frames = range(0, len(trajectory), max(len(trajectory) // ENOUGH, 1))
        poses = [posed(scene, self._motions, frame) for frame in frames]
        self._painter = painter(scene, trajectory.positions, device, poses)
        self.frame = 0
        """Number of the frame that is drawn next."""

    def image(self, positions: Points, colours: Points) -> Points:
        """A picture of the frame (rows, columns, 3), linear from 0 to 1."""
        return self._painter.posed(posed(self._scene, self._motions, self.frame)).image(positions, colours)

    def images(self, states: Iterable[State]) -> Iterator[Points]:
        """The `image` of each state, as soon as somebody has told its frame."""
        return (self.image(*state) for state in states)
