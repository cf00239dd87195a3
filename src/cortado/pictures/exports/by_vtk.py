"""Series of VTP files for ParaView, which VTK writes, and one file that tells their times."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cortado.errors import ExtraMissingError
from cortado.files.atomic import write_atomically
from cortado.files.srgb import to_srgb
from cortado.pictures.exports.by_trimesh import Advance, numbered
from cortado.pictures.exports.exported import Exported, ExportedFrame, Mesh, in_space


def write_vtp(run: Exported, folder: Path, advance: Advance) -> Path:
    """The surface, the particles with all their fields and each solid, as a file of its own in each frame, one for a
    solid at rest; returns ``run.pvd``, which has them all at their times."""
    entries = []
    for number, frame in enumerate(run.frames(run.series)):
        parts = {"particles": (numbered("particles", number, "vtp"), _particles(frame))}
        if frame.surface is not None:
            parts["surface"] = numbered("surface", number, "vtp"), _mesh(frame.surface)
        for solid in run.solids:
            name = numbered(solid.part, number, "vtp") if solid.moves else f"{solid.part}.vtp"
            parts[solid.part] = name, _mesh(solid.mesh.moved(frame.poses[solid.name]))
        for part, (name, (name_of, data)) in enumerate((one, parts[one]) for one in parts):
            write_atomically(folder / name_of, _written(data))
            where = f'timestep="{frame.time!r}" part="{part}" name="{name}" file="{name_of}"'
            entries.append(f"    <DataSet {where}/>")
        advance()
    lines = ['<VTKFile type="Collection" version="0.1">', "  <Collection>", *entries, "  </Collection>", "</VTKFile>"]
    write_atomically(folder / "run.pvd", "\n".join([*lines, ""]))
    return folder / "run.pvd"


def _mesh(mesh: Mesh) -> Any:
    """Triangles with normals and colours, and the velocity of a surface [m/s]."""
    fields = {"colour": _srgb(mesh.colours)}
    if mesh.velocities is not None:
        fields["velocity"] = mesh.velocities
    data = _polydata(mesh.points, mesh.triangles, "Polys", fields)
    data.GetPointData().SetNormals(_array("normals", mesh.normals))
    return data


def _particles(frame: ExportedFrame) -> Any:
    """A vertex for each particle, with its velocity [m/s] and all fields."""
    own = {name: in_space(values) if values.ndim == 2 else values for name, values in frame.fields.items()}
    fields = {"velocity": frame.velocities, "colour": _srgb(frame.colours), **own}
    return _polydata(frame.positions, np.arange(len(frame.positions))[:, None], "Verts", fields)


def _polydata(points: np.ndarray, corners: np.ndarray, cells: str, fields: Mapping[str, np.ndarray]) -> Any:
    """Of points (p, 3) [m] and cells of so many corners each (c, k), with fields (p, ...) by name."""
    vtk = _vtk()
    data, places, topology = vtk.vtkPolyData(), vtk.vtkPoints(), vtk.vtkCellArray()
    places.SetData(_array("points", points))
    data.SetPoints(places)
    starts = np.arange(0, corners.size + 1, corners.shape[1], dtype=np.int64)
    flat = np.ascontiguousarray(corners.ravel(), dtype=np.int64)
    topology.SetData(*(vtk.numpy_to_vtkIdTypeArray(one, deep=True) for one in (starts, flat)))
    getattr(data, f"Set{cells}")(topology)
    for name, values in fields.items():
        data.GetPointData().AddArray(_array(name, values))
    return data


def _array(name: str, values: np.ndarray) -> Any:
    """As an array of VTK, in float32 unless it is made of bytes."""
    kept = values if values.dtype == np.uint8 else np.asarray(values, dtype=np.float32)
    found = _vtk().numpy_to_vtk(np.ascontiguousarray(kept), deep=True)
    found.SetName(name)
    return found


def _written(data: Any) -> str:
    """As the text of a file, with the numbers in base64."""
    writer = _vtk().vtkXMLPolyDataWriter()
    writer.SetInputData(data)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString())


def _srgb(colours: np.ndarray) -> np.ndarray:
    """(p, 3) bytes of linear colours (p, 3)."""
    return to_srgb(np.clip(colours, 0.0, 1.0)[None])[0]


@cache
def _vtk() -> Any:
    """What is used of VTK, of which the whole takes seconds to import."""
    try:
        from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkIOXML
        from vtkmodules.util import numpy_support
    except ImportError as error:
        raise ExtraMissingError("VTK", "vtk") from error
    modules = (vtkCommonCore, vtkCommonDataModel, vtkIOXML, numpy_support)
    return SimpleNamespace(**{name: value for one in modules for name, value in vars(one).items()})
