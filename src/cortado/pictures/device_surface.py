"""A surface on the device that traces rays."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.discretise.shapes import Points
from cortado.pictures.lit_surface import LitSurface


@dataclass(frozen=True)
class DeviceSurface:
    """Triangles, which exist as long as this does, with no light on them yet."""

    mesh: wp.Mesh
    lit: Any
    """`LitSurface`"""

    @classmethod
    def of(
        cls, points: Points, triangles: np.ndarray, normals: Points, colours: Points, device: Any
    ) -> "DeviceSurface":
        """Triangles (t, 3) of points (p, 3) [m] with normals (p, 3), outwards, and linear colours (p, 3)."""
        found, places = LitSurface(), wp.array(points, dtype=wp.vec3, device=device)
        found.corners = wp.array(triangles.ravel(), dtype=wp.int32, device=device)
        mesh = wp.Mesh(places, found.corners)
        found.mesh = mesh.id
        found.normals = wp.array(normals, dtype=wp.vec3, device=device)
        found.colours = wp.array(colours, dtype=wp.vec3, device=device)
        found.light = wp.zeros(len(places), dtype=wp.vec3, device=device)
        return cls(mesh, found)
