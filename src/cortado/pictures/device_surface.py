"""A surface on the device that traces rays."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.discretise.shapes import Points
from cortado.pictures.lit_surface import LitSurface

Soften = Callable[[wp.array], wp.array]


@dataclass(frozen=True)
class DeviceSurface:
    """Triangles, which exist as long as this does, with no light on them yet."""

    mesh: wp.Mesh
    lit: Any
    """`LitSurface`"""
    softened: Soften | None = None
    """Takes from the light at points (p,) of vec3 the steps that it has where it comes from few directions."""

    @classmethod
    def of(
        cls, points: wp.array, triangles: wp.array, normals: wp.array, colours: wp.array, softened: Soften | None = None
    ) -> "DeviceSurface":
        """Triangles, (3 t,) numbers of points (p,) of vec3 [m] with normals (p,), outwards, and linear colours (p,)."""
        mesh, found = wp.Mesh(points, triangles), LitSurface()
        found.mesh, found.corners, found.normals, found.colours = mesh.id, triangles, normals, colours
        found.light, found.media = wp.zeros_like(points), wp.zeros(len(points), dtype=wp.vec2, device=points.device)
        return cls(mesh, found, softened)

    @classmethod
    def on(
        cls,
        device: Any,
        points: Points,
        triangles: np.ndarray,
        normals: Points,
        colours: Points,
        softened: Soften | None = None,
    ) -> "DeviceSurface":
        """The same of arrays of NumPy, (t, 3) and (p, 3)."""
        corners = wp.array(triangles.ravel(), dtype=wp.int32, device=device)
        own = [wp.array(one, dtype=wp.vec3, device=device) for one in (points, normals, colours)]
        return cls.of(own[0], corners, own[1], own[2], softened)
