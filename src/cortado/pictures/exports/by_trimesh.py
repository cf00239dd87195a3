"""Series of PLY, OBJ and glTF files, which trimesh writes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cortado.files.atomic import write_atomically
from cortado.files.srgb import to_srgb
from cortado.pictures.exports.exported import Exported, ExportedFrame, Mesh, Pose

Advance = Callable[[], None]
"""Called after each frame."""


def write_ply(run: Exported, folder: Path, advance: Advance) -> Path:
    """See `_write_series`."""
    return _write_series(run, folder, "ply", advance)


def write_obj(run: Exported, folder: Path, advance: Advance) -> Path:
    """See `_write_series`."""
    return _write_series(run, folder, "obj", advance)


def write_glb(run: Exported, folder: Path, advance: Advance) -> Path:
    """A glTF file for each frame, with all of it by name, y up as glTF wants it, and linear colours; returns the
    folder."""
    import trimesh

    upright = Pose(run.up, np.zeros(3)).matrix
    for number, frame in enumerate(run.frames(run.series)):
        scene = trimesh.Scene()
        if frame.surface is not None:
            scene.add_geometry(_trimesh(frame.surface, _bytes), "surface", "surface", transform=upright)
        for solid in run.solids:
            pose = upright @ frame.poses[solid.name].matrix
            scene.add_geometry(_trimesh(solid.mesh, _bytes), solid.part, solid.part, transform=pose)
        scene.add_geometry(_cloud(frame, _bytes), "particles", "particles", transform=upright)
        write_atomically(folder / numbered("frame", number, "glb"), scene.export(file_type="glb"))
        advance()
    return folder


def _write_series(run: Exported, folder: Path, ending: str, advance: Advance) -> Path:
    """A file for the surface, for the particles and for each solid that moves in each frame, and one for each solid
    at rest; colours are those of sRGB, which programs expect there. Returns the folder."""
    for number, frame in enumerate(run.frames(run.series)):
        found: dict[str, Any] = {numbered("particles", number, ending): _cloud(frame, _srgb)}
        if frame.surface is not None:
            found[numbered("surface", number, ending)] = _trimesh(frame.surface, _srgb)
        for solid in run.solids:
            if solid.moves or not number:
                name = numbered(solid.part, number, ending) if solid.moves else f"{solid.part}.{ending}"
                found[name] = _trimesh(solid.mesh.moved(frame.poses[solid.name]), _srgb)
        for name, one in found.items():
            write_atomically(folder / name, one.export(file_type=ending))
        advance()
    return folder


def numbered(name: str, number: int, ending: str) -> str:
    """The name of the file of a frame."""
    return f"{name}_{number:05d}.{ending}"


def _trimesh(mesh: Mesh, colours: Callable[[Any], Any]) -> Any:
    import trimesh

    return trimesh.Trimesh(
        mesh.points, mesh.triangles, vertex_normals=mesh.normals, vertex_colors=colours(mesh.colours), process=False
    )


def _cloud(frame: ExportedFrame, colours: Callable[[Any], Any]) -> Any:
    import trimesh

    return trimesh.PointCloud(frame.positions, colors=colours(frame.colours))


def _srgb(colours: Any) -> Any:
    """(p, 4) bytes of linear colours (p, 3)."""
    return np.pad(to_srgb(np.clip(colours, 0.0, 1.0)[None])[0], ((0, 0), (0, 1)), constant_values=255)


def _bytes(colours: Any) -> Any:
    """(p, 4) the same, linear."""
    found = np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
    return np.pad(found, ((0, 0), (0, 1)), constant_values=255)
