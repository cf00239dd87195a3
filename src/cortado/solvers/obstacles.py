"""Where particles may go: the region of their container, and solids as solvers know them, by their wall particles and
as meshes, for those who ask how deep something is."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.precision import Precision
from cortado.discretise.room import Region
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid

FINE = 0.2
"""In spacings: the width of faces by which round solids are looked at."""
HEIGHT = 100.0
"""Height over width of the mesh that stands for a plane shape."""
DEEPEST, THINNEST = 1.0, 0.45
"""In spacings, and of the thickness of a solid: particles that are deeper in it are lost. Sharp edges, behind which
there are few wall particles, let some in by half a spacing."""
FURTHEST = 1e6
"""In spacings from the region of the first particles and walls: particles beyond are lost."""


@dataclass(frozen=True)
class Obstacle:
    """A solid, which particles cannot enter."""

    name: str
    solid: Solid
    is_hollow: bool
    """True where fluid is inside of the shape."""
    thickness: float
    """Thickness of its thinnest part [m], as far as it is known; infinite otherwise."""


@dataclass(frozen=True)
class NamedSolid:
    """A solid of a scene, by the number of its wall particles and its middle at the start."""

    number: int
    """Number of its wall particles (`cortado.scene.motions.wall_numbers`)."""
    middle: NDArray
    """(3,) where its middle is at the start [m]"""


@dataclass(frozen=True)
class Walled:
    """The places where particles may go: the region of the container and the solids in it."""

    region: Region
    """The container, without the sides that nothing closes: along a period, or where no pressure acts."""
    near: Region
    """A box around the first particles and the walls."""
    spacing: float
    """[m]"""
    solids: tuple[Obstacle, ...]
    """Solids at rest, in their places."""
    moving: tuple[Obstacle, ...]
    """Solids that move, each about its middle."""
    periods: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    @property
    def dimension(self) -> int:
        """Return the number of dimensions, 2 or 3."""
        return len(self.near.lower)

    def tolerance(self, one: Obstacle) -> float:
        """Return how deep in a solid a particle may be [m]: a spacing, or 0.45 of a thin solid's thickness."""
        return min(DEEPEST * self.spacing, THINNEST * one.thickness)

    def furthest(self, precision: Precision) -> Region:
        """Return the box that positions must not leave [m]: far away, within the distance from the origin that a
        precision resolves; what is spilled over the rim of an open cup may fall on."""
        spilled, reach = np.isfinite(self.region.rim), FURTHEST * self.spacing
        limit = np.inf if spilled else precision.furthest * self.spacing
        return Region.between(np.maximum(self.near.lower - reach, -limit), np.minimum(self.near.upper + reach, limit))


def middle_of(one: Obstacle) -> Points:
    """Return the middle (d,) of the box around the shape of an obstacle [m]."""
    lower, upper = one.solid.extent()
    return np.asarray(0.5 * (lower + upper))


def obstacle_mesh(one: Obstacle, spacing: float, device: wp.Device) -> wp.Mesh:
    """Make the surface mesh of an obstacle about its middle; a plane shape becomes a prism of great height."""
    faces = one.solid.faces(FINE * spacing)
    faces = faces.reversed() if one.is_hollow else faces
    vertices, corners = faces.vertices - middle_of(one), faces.corners
    if vertices.shape[1] == 2:
        height = HEIGHT * (np.ptp(vertices) + spacing)
        low, high, count = (
            np.insert(vertices, 2, -height, axis=1),
            np.insert(vertices, 2, height, axis=1),
            len(vertices),
        )
        a, b = corners.T
        vertices = np.concatenate([low, high])
        corners = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    return wp.Mesh(
        points=wp.array(vertices, dtype=wp.vec3f, device=device),
        indices=wp.array(corners.ravel(), dtype=wp.int32, device=device),
        support_winding_number=True,
    )
