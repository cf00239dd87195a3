"""Solids as solvers know them: by their wall particles, and as meshes, for those who ask how deep something is."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid

FINE = 0.2
"""In spacings: the width of faces by which round solids are looked at."""
HEIGHT = 100.0
"""Height over width of the mesh that stands for a plane shape."""


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
