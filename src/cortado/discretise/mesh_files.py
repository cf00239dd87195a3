"""Read solids from triangle files with trimesh, and check their unit of length and wall thickness."""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cortado.calls import point_in_words
from cortado.discretise.mesh import Mesh
from cortado.discretise.mesh_checks import FoundMesh, found_mesh
from cortado.discretise.shapes import Numbers, Points, bisected
from cortado.errors import InputError, Words, shown, warn
from cortado.files.disk import cached_by_file, reason

SUFFIXES = (".stl", ".obj", ".ply", ".gltf", ".glb")
MOST_BYTES = 2**30
LEAST_THICKNESS = 0.5
"""Least allowed wall thickness [spacings]. Water leaks through walls of 0.2 spacings."""
SHARE = 0.01
ALONG = 0.9
"""Least cosine between the normals of opposite surfaces of a sheet, with one normal reversed."""
TOO_LARGE = 100.0
"""Relative size above which a mesh seems to be in a wrong unit. The reference size is the container or 100 spacings."""
PROBES, STEPS, HALVINGS = 20_000, 16, 12
"""Numbers of surface points, of steps for each point, and of bisections of the last step, in measuring thickness."""
BEYOND = 1e-3
"""Distance behind a wall at which the normal of its back is computed, relative to the length of a step."""


def read_mesh(
    path: str,
    scale: float,
    spacing: float,
    support: float | None = None,
    container: tuple[Points, Points] | None = None,
) -> Mesh:
    """Read and check the solid in a file. ``scale`` is a factor for the lengths in the file, such as 0.001 for
    millimetres. ``support`` [m] is None if the file describes a region of fluid, which may have any thickness.
    ``container`` has the lower and the upper corner (3,) [m] of the box around the container."""
    found, what = mesh_in_file(path), repr(path)
    mesh = found.mesh.moved(scale, np.zeros(3))
    length = float(np.ptp(mesh.extent(), axis=0).max())
    room = None if container is None else float(np.ptp(container, axis=0).max())
    if length > TOO_LARGE * (100.0 * spacing if room is None else room):
        times = f"{length / spacing:,.0f} spacings" if room is None else f"{length / room:,.0f} times the container"
        raise InputError(
            f"{what} is {length:g} m long, {times}; it looks like millimetres: give it scale = {0.001 * scale:g}, and "
            f"it will be {0.001 * length:g} m long."
        )
    if length < spacing:
        raise InputError(
            f"{what} is only {length:g} m long, less than a spacing, {spacing:g} m; it may have another unit of "
            f"length, so give it a larger scale than {scale:g}, or make the spacing smaller."
        )
    of_thickness = _thickness_notes(mesh, scale * found.origin, what, spacing, support) if support is not None else ()
    for note in (*found.notes, *of_thickness):
        warn(note)
    return mesh


@cached_by_file(8, MOST_BYTES)
def mesh_in_file(path: str) -> FoundMesh:
    vertices, triangles, rounding = read_triangles(path)
    return found_mesh(vertices, triangles, repr(path), rounding)


def triangles_in_file(path: str) -> tuple[Points, Numbers]:
    """The surface in the file may be open. Vertices (m, 3) are in the file's unit."""
    vertices, triangles, _ = read_triangles(path)
    if not np.isfinite(vertices).all():
        raise InputError(f"{path!r} has a vertex that is not finite: export the mesh once more.")
    return vertices, triangles


def read_triangles(path: str) -> tuple[Points, Numbers, float]:
    """Return vertices (m, 3) in the file's unit, triangles (k, 3), and the rounding step of float32, or 0."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"{path!r} does not end in one of {', '.join(SUFFIXES)}: export the mesh as one of these.")
    if not (size := Path(path).stat().st_size):
        raise InputError(f"{path!r} is empty: export the mesh once more.")
    (scene, head), suffix = _scene(path), Path(path).suffix.lower()
    is_single = suffix in (".gltf", ".glb")  # whether coordinates are float32
    if suffix == ".ply":
        is_single = not re.search(rb"property (double|float64) x", head)
    elif suffix == ".stl":
        is_single = len(head) >= 84 and size == 84 + 50 * int.from_bytes(head[80:84], "little")
    rounding = 0.0
    vertices, triangles, count, others = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0, False
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        body = scene.geometry[name]
        corners = np.asarray(getattr(body, "faces", np.zeros((0, 3))), dtype=np.int64)
        others |= not len(corners)
        if np.linalg.det(transform[:3, :3]) < 0.0:
            corners = corners[:, ::-1]  # what is mirrored is turned over
        if len(corners):
            vertices.append(np.asarray(body.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3])
            triangles.append(corners + count)
            count += len(vertices[-1])
            if is_single and np.isfinite(body.vertices).all():
                step = float(np.spacing(np.float32(np.abs(body.vertices).max())))
                rounding = max(rounding, step * float(np.linalg.norm(transform[:3, :3], axis=0).max()))
    if len(triangles) == 1:
        what = "points or lines, but no triangles" if others else "no triangles that can be read; it may be damaged"
        raise InputError(f"{path!r} holds {what}: export the mesh as triangles.")
    return np.concatenate(vertices), np.concatenate(triangles), rounding


def _scene(path: str) -> tuple[Any, bytes]:
    """Read a file with trimesh. Return trimesh's scene, and the first bytes of the file."""
    import trimesh

    try:
        with open(path, "rb") as file, warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            kind, beside = Path(path).suffix.lower()[1:], trimesh.resolvers.FilePathResolver(path)
            head, _ = file.read(4096), file.seek(0)
            return trimesh.load_scene(file, file_type=kind, resolver=beside, process=False), head
    except Exception as problem:  # of many types, where a file is damaged
        why = shown(Words(f"{type(problem).__name__}: {reason(problem)}"))
        raise InputError(f"{path!r} is no mesh that can be read ({why}); it may be damaged.") from None


@dataclass(frozen=True)
class Thickness:
    points: Points
    """Points on the surface (n, 3) [m]."""
    lengths: Points
    """Length of the straight line from each point through the solid (n,) [m], or infinity without an end."""
    is_sheet: np.ndarray
    """Mask (n,) of the points with a nearly parallel opposite surface."""

    def share(self, which: np.ndarray) -> float:
        return float(np.count_nonzero(which) / max(len(which), 1))

    def place(self, which: np.ndarray) -> str:
        return f"{point_in_words(self.points[which][np.argmin(self.lengths[which])])} m"

    @property
    def thinnest(self) -> float:
        """Return the thickness of sheets [m], or infinity. The thinnest fraction `SHARE` of the surface is ignored."""
        return float(np.quantile(np.where(self.is_sheet, self.lengths, np.inf), SHARE, method="higher"))


def thickness_of(mesh: Mesh, reach: float) -> Thickness:
    points, outward = mesh.own_feet(float(np.sqrt(mesh.areas().sum() / PROBES)))
    depths = reach * (np.arange(STEPS) + 1.0) / STEPS
    inside = np.array([mesh.holds(points - depth * outward) for depth in depths])
    through = ~inside.all(axis=0)
    high, probes, down = depths[np.argmin(inside, axis=0)[through]], points[through], -outward[through]
    _, high = bisected(lambda at: mesh.holds(probes + at[:, None] * down), high - reach / STEPS, high, HALVINGS)
    lengths, is_sheet = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    lengths[through] = high
    beyond = probes + (high + BEYOND * reach)[:, None] * down
    is_sheet[through] = (mesh.outward(beyond) * down).sum(axis=1) > ALONG
    return Thickness(points, lengths, is_sheet)


def _thickness_notes(mesh: Mesh, origin: Points, what: str, spacing: float, support: float) -> Iterator[str]:
    found, least = thickness_of(mesh, support), LEAST_THICKNESS * spacing
    found = replace(found, points=origin + found.points)
    sheet, sharp = (found.lengths < least) & found.is_sheet, (found.lengths < least) & ~found.is_sheet
    if found.share(sheet) > SHARE:
        raise InputError(
            f"{what} is thinner than half a spacing, {least:g} m, at {found.share(sheet):.0%} of its surface, for "
            f"example at {found.place(sheet)}, so that fluid would pass: make it thicker, or the spacing smaller."
        )
    if found.share(sharp) > SHARE:
        yield (
            f"{what} has edges so sharp that it is thinner than half a spacing, {least:g} m, at "
            f"{found.share(sharp):.0%} of its surface, for example at {found.place(sharp)}: fluid may pass there."
        )
    thin = (found.lengths < support) & found.is_sheet
    if found.share(thin) > SHARE:
        yield (
            f"{what} is thinner than the support, {support:g} m, at {found.share(thin):.0%} of its surface, down to "
            f"{found.lengths[thin].min():.3g} m at {found.place(thin)}: fluid on one side feels that on the other."
        )
