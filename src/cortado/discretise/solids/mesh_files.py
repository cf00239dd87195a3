"""Files of triangles: STL, OBJ, PLY and glTF, as trimesh reads them; and meshes as solids out of them."""

import re
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.mesh import Mesh
from cortado.discretise.solids.mesh_checks import FoundMesh, found_mesh
from cortado.discretise.solids.mesh_fit import check_fit, check_unit
from cortado.discretise.solids.triangle_tree import Numbers
from cortado.errors import InputError, Words, shown, warn
from cortado.files.input_files import reason, regular_file

SUFFIXES = (".stl", ".obj", ".ply", ".gltf", ".glb")
"""How a file of triangles may end."""
MOST_BYTES = 2**30
"""Of a file."""


def read_mesh(
    path: str,
    scale: float,
    spacing: float,
    support: float | None = None,
    container: tuple[Points, Points] | None = None,
) -> Mesh:
    """A solid out of a file, beside particles a spacing [m] apart that see each other up to a support [m], or a body of
    fluid, which may be as thin as it likes.

    Raises `InputError`, a sentence that names the file and says what is wrong, where, and what to do; warns with
    `CortadoWarning` of what is probably not meant.

    Args:
        path: of the file.
        scale: what its lengths are multiplied with, 0.001 where they are millimetres.
        spacing: [m].
        support: [m]; None of a body of fluid.
        container: lower and upper corner, each (3,) [m], of the box around the container of the fluid, if there is one.
    """
    found = mesh_in_file(path)
    mesh = found.mesh.moved(scale, np.zeros(3))
    notes, what = found.notes, repr(path)
    if support is None:
        check_unit(mesh, what, scale, spacing, container)
    else:
        notes = (*notes, *check_fit(mesh, scale * found.origin, what, scale, spacing, support, container))
    for note in notes:
        warn(note)
    return mesh


def mesh_in_file(path: str) -> FoundMesh:
    """What a file holds, in its own unit of length, checked by itself; raises `InputError`."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"{path!r} does not end in one of {', '.join(SUFFIXES)}: export the mesh as one of these.")
    try:
        stat = regular_file(path, MOST_BYTES)
    except OSError as problem:
        raise InputError(f"{path!r} cannot be opened ({reason(problem)}).") from None
    if not stat.st_size:
        raise InputError(f"{path!r} is empty: export the mesh once more.")
    return _found(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=8)
def _found(path: str, changed: int, size: int) -> FoundMesh:
    """Read once for each version of the file: the time of its last change and its size stand for the version."""
    vertices, triangles, rounding = read_triangles(path)
    return found_mesh(vertices, triangles, repr(path), rounding)


def read_triangles(path: str) -> tuple[Points, Numbers, float]:
    """Of all bodies of a file, where its scene puts them, in its unit of length: the vertices (m, 3), the triangles
    (k, 3) between them, of which there is at least one, and to what the file rounds coordinates, 0 if they are not
    float32; raises `InputError`."""
    rounding, is_single = 0.0, _is_single(path)
    vertices, triangles, count, others = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0, False
    scene = _scene(path)
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


def _is_single(path: str) -> bool:
    """Whether a file has its coordinates as float32: a binary STL, glTF, or a PLY that does not say double."""
    suffix = Path(path).suffix.lower()
    if suffix in (".stl", ".ply"):
        with open(path, "rb") as file:
            head = file.read(4096)
        if suffix == ".ply":
            return not re.search(rb"property (double|float64) x", head)
        return len(head) >= 84 and Path(path).stat().st_size == 84 + 50 * int.from_bytes(head[80:84], "little")
    return suffix in (".gltf", ".glb")


def _scene(path: str) -> Any:
    import trimesh

    try:
        with open(path, "rb") as file, warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            kind, beside = Path(path).suffix.lower()[1:], trimesh.resolvers.FilePathResolver(path)
            return trimesh.load_scene(file, file_type=kind, resolver=beside, process=False)
    except Exception as problem:  # of many types, where a file is damaged
        why = shown(Words(f"{type(problem).__name__}: {reason(problem)}"))
        raise InputError(f"{path!r} is no mesh that can be read ({why}); it may be damaged.") from None
