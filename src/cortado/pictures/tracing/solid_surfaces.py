"""Surfaces on the device that traces rays, and those of the solids of a stage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid, SolidMesh
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.shadow import FloorShadow
from cortado.pictures.tracing.surroundings import LitSurface, Solids

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


FINE, FINE_OWN = 0.03, 0.05
"""How wide faces of round solids are: in sizes of what is shown, and of the solid itself, if that is less."""
LONGEST = 0.04
"""Of the sides of triangles, at whose corners light is found, in sizes of what is shown."""


Placed = tuple[ShownSolid, SolidMesh]


class SolidSurfaces:
    """Those of the solids of a stage, whose triangles are found once; in poses, for each picture."""

    def __init__(self, stage: Stage, device: Any):
        self._stage, self._device = stage, device
        self._own = {one.name: _mesh_of(one, stage.size) for one in stage.solids}

    @property
    def kinds(self) -> tuple[bool, bool]:
        """Whether there are opaque, and transparent ones."""
        clear = [_is_clear(one) for one in self._stage.solids]
        return not all(clear), any(clear)

    def cast(self, shadow: FloorShadow, solids: Sequence[ShownSolid]) -> None:
        """Add their shadows; ``solids``: those of the stage, in poses."""
        for one, mesh in self._placed(solids):
            if not one.is_tank:
                shadow.of_solid(one, mesh)

    def on_device(self, solids: Sequence[ShownSolid]) -> tuple[Any, list[DeviceSurface]]:
        """`Solids`, and their surfaces, which must be kept and lit; ``solids``: those of the stage, in poses."""
        found, surfaces, lit = Solids(), list[DeviceSurface](), [LitSurface(), LitSurface()]
        found.are_cut, placed = int(self._stage.cuts_solids), self._placed(solids)
        opaque, clear = ([pair for pair in placed if _is_clear(pair[0]) == kind] for kind in (False, True))
        if opaque:
            surfaces.append(self._surface(_joined(opaque), opaque))
            lit[0] = surfaces[-1].lit
            found.opaque = lit[0].mesh
            mirrors = [np.full(len(own.triangles), one.finish.reflectivity) for one, own in opaque]
            lit[0].reflectivity = wp.array(np.concatenate(mirrors), dtype=wp.float32, device=self._device)
        if clear:
            mesh = _joined(clear)
            surfaces.append(self._surface(mesh, clear))
            lit[1] = surfaces[-1].lit
            found.clear = lit[1].mesh
            found.has_tank = int(any(one.is_tank for one, _ in clear))
            left = [np.tile(_left(one), (len(own.triangles), 1)) for one, own in clear]
            lit[1].left = wp.array(np.concatenate(left), dtype=wp.vec2, device=self._device)
            lit[1].from_edges = wp.array(mesh.from_edges, dtype=wp.mat33, device=self._device)
        found.surfaces = wp.array(lit, dtype=LitSurface, device=self._device)
        return found, surfaces

    def _placed(self, solids: Sequence[ShownSolid]) -> list[Placed]:
        return [(one, self._own[one.name].moved(one.turn, one.position)) for one in solids]

    def _surface(self, mesh: SolidMesh, solids: Sequence[Placed]) -> DeviceSurface:
        """That of several, whose mesh it is."""
        colours = np.concatenate([np.tile(one.colour, (len(own.points), 1)) for one, own in solids])

        def softened(light: wp.array) -> wp.array:
            return wp.array(mesh.smoothed(light.numpy()), dtype=wp.vec3, device=self._device)

        return DeviceSurface.on(self._device, mesh.points, mesh.triangles, mesh.normals, colours, softened)


def _joined(solids: Sequence[Placed]) -> SolidMesh:
    return SolidMesh.joined([mesh for _, mesh in solids])


def _mesh_of(shown: ShownSolid, size: float) -> SolidMesh:
    """That of a solid about its middle; of a tank its outside is within the cavity."""
    own = float(np.ptp(shown.shape.extent(), axis=0).max())
    faces = shown.shape.shown_faces(min(FINE * size, FINE_OWN * own))
    longest = np.inf if shown.transparency == 1.0 else LONGEST * size  # what is clear has no light of its own
    return SolidMesh.of(faces.reversed() if shown.is_tank else faces, longest)


def _is_clear(shown: ShownSolid) -> bool:
    """Whether fluid is seen through it, or in it."""
    return shown.is_tank or shown.transparency > 0.0


def _left(shown: ShownSolid) -> tuple[float, float]:
    """The part of the light that comes through one surface, seen from within a solid and from outside: one looks into a
    tank whatever its walls are."""
    return (1.0, shown.transparency) if shown.is_tank else (shown.transparency**0.5,) * 2
