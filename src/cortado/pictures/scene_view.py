"""The particles of runs of a scene in motion, as a piece of a page, in the scene's colours and its container."""

from collections.abc import Iterable, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from cortado.discretise.shapes import Points, corners
from cortado.pictures.painter import colours_of
from cortado.pictures.particle_view import Cloud, particle_view, thinned
from cortado.pictures.solid_lines import solid_outline
from cortado.pictures.stage import upright
from cortado.scene.containers import CylinderContainer
from cortado.scene.fluids import INDEX_OF_AXIS
from cortado.scene.scene import Scene

ROUND = 48
"""Sides of the polygon that stands for a circle."""


class MovingState(Protocol):
    """A state of a run; n particles in d dimensions."""

    @property
    def positions(self) -> Points:
        """(n, d) [m]"""

    @property
    def velocities(self) -> Points:
        """(n, d) [m/s]"""

    @property
    def mass_fractions(self) -> Points | None:
        """(n, phases) [-]; None with one phase"""


def scene_view(scene: Scene, runs: Mapping[str, Iterable[MovingState]], times: ArrayLike) -> str:
    """HTML that shows runs of a scene side by side, each by its name with a state for each of the times (frames,) [s];
    see `particle_view`. Solids that move are not shown."""
    turn = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(2)
    states, times = {name: list(of_run) for name, of_run in runs.items()}, np.asarray(times)
    particles = len(next(iter(states.values()))[0].positions)
    numbers = len(states) * (2 * scene.dimension + 1 + 3 * (len(scene.phase) > 1))
    chosen, stride = thinned(len(times), particles, numbers)
    clouds = [_cloud(scene, name, [of_run[k] for k in chosen], turn, stride) for name, of_run in states.items()]
    still = tuple(table for table in scene.solid if table.motion == "fixed")
    lines = outline(scene.model_copy(update={"solid": still})) @ turn.T
    return particle_view(clouds, times[chosen], scene.discretisation.spacing, lines=lines, stride=stride)


def outline(scene: Scene) -> Points:
    """(k, 2, d) ends of the lines that draw the container and the solids of a scene [m]; none without both."""
    return np.concatenate([container_outline(scene), solid_outline(scene)])


def container_outline(scene: Scene) -> Points:
    """(k, 2, d) ends of the lines that draw the container of a scene [m]; none without a container."""
    container, ends = scene.container, scene.container.extent()
    if ends is None:
        return np.zeros((0, 2, scene.dimension))
    if isinstance(container, CylinderContainer):
        return _cup(container)
    places = corners(*ends)
    pairs = [(a, b) for a in range(len(places)) for b in range(a) if np.count_nonzero(places[a] != places[b]) == 1]
    return places[np.array(pairs)]


def _cup(container: CylinderContainer) -> Points:
    """Two circles, and four lines between them."""
    angles = np.linspace(0.0, 2.0 * np.pi, ROUND, endpoint=False)
    axis = INDEX_OF_AXIS[container.axis]
    circle = np.insert(container.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1), axis, 0.0, axis=1)
    low = circle + np.asarray(container.base)
    high = low + container.height * np.eye(3)[axis]
    rims = [np.stack([rim, np.roll(rim, -1, axis=0)], axis=1) for rim in (low, high)]
    sides = np.stack([low, high], axis=1)[:: ROUND // 4]
    return np.concatenate([*rims, sides])


def _cloud(scene: Scene, name: str, states: list[MovingState], turn: Points, stride: int) -> Cloud:
    """Of every so many particles one."""
    domain = scene.container.domain(scene.dimension)
    positions = domain.wrapped(np.stack([state.positions[::stride] for state in states])) @ turn.T
    speeds = np.stack([np.linalg.norm(state.velocities[::stride], axis=1) for state in states])
    particles = positions.shape[1]
    if len(scene.phase) == 1:
        return Cloud(name, positions, speeds, colours_of(scene, None, particles))
    fractions = [None if state.mass_fractions is None else state.mass_fractions[::stride] for state in states]
    colours = [colours_of(scene, one, particles) for one in fractions]
    return Cloud(name, positions, speeds, np.stack(colours))
