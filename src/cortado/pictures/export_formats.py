"""Export trajectories to files for other programs, in several formats, and to an xarray dataset."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points, in_space
from cortado.errors import ComputationError, ExtraMissingError, InputError, shown
from cortado.files.disk import as_path, sentences, unfinished, write_atomically
from cortado.files.image_encoding import srgb_bytes
from cortado.files.terminal import announce, track
from cortado.pictures.exported import Exported, ExportedFrame, Pose
from cortado.pictures.film import Computed
from cortado.pictures.tracing.liquid_surface import Mesh
from cortado.runs.frames import FRACTION, SolidMotion
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameters import QUANTITIES
from cortado.scene.scene import Scene, as_scene
from cortado.version import __version__

Advance = Callable[[], None]


def write_glb(run: Exported, folder: Path, advance: Advance) -> Path:
    """Write the y axis as the upward axis, and linear colours, as glTF requires."""
    import trimesh

    upright = Pose(run.up, np.zeros(3)).matrix
    for number, frame in enumerate(run.frames(run.series)):
        parts: dict[str, Any] = {} if frame.surface is None else {"surface": (frame.surface, upright)}
        parts |= {one.part: (one.mesh, upright @ frame.poses[one.name].matrix) for one in run.solids}
        parts["particles"] = frame, upright
        scene = trimesh.Scene()
        for name, (what, pose) in parts.items():
            scene.add_geometry(_trimesh(what, _linear), name, name, transform=pose)
        write_atomically(folder / _numbered("frame", number, "glb"), scene.export(file_type="glb"))
        advance()
    return folder


def _write_series(run: Exported, folder: Path, advance: Advance, ending: str, text: Callable[[Any], Any]) -> list[str]:
    """Return the XML entries of a ParaView collection."""
    entries = []
    for number, frame in enumerate(run.frames(run.series)):
        files: dict[str, Any] = {"particles": (_numbered("particles", number, ending), frame)}
        if frame.surface is not None:
            files["surface"] = _numbered("surface", number, ending), frame.surface
        for solid in run.solids:
            name = _numbered(solid.part, number, ending) if solid.moves else f"{solid.part}.{ending}"
            files[solid.part] = name, frame.poses[solid.name].of(solid.mesh)
        for part, (of, (name, what)) in enumerate(files.items()):
            if not (folder / name).exists():
                write_atomically(folder / name, text(what))
            entries.append(f'    <DataSet timestep="{frame.time!r}" part="{part}" name="{of}" file="{name}"/>')
        advance()
    return entries


def _write_meshes(run: Exported, folder: Path, advance: Advance, ending: str) -> Path:
    _write_series(run, folder, advance, ending, lambda what: _trimesh(what, srgb_bytes).export(file_type=ending))
    return folder


def write_vtp(run: Exported, folder: Path, advance: Advance) -> Path:
    """Return the path of ``run.pvd``, the ParaView collection of the written files."""
    entries = _write_series(run, folder, advance, "vtp", _vtp)
    lines = ['<VTKFile type="Collection" version="0.1">', "  <Collection>", *entries, "  </Collection>", "</VTKFile>"]
    write_atomically(folder / "run.pvd", "\n".join([*lines, ""]))
    return folder / "run.pvd"


def _numbered(name: str, number: int, ending: str) -> str:
    return f"{name}_{number:05d}.{ending}"


def _trimesh(what: Mesh | ExportedFrame, colours: Callable[[Any], Any]) -> Any:
    import trimesh

    own = np.pad(colours(what.colours), ((0, 0), (0, 1)), constant_values=255)
    if isinstance(what, ExportedFrame):
        return trimesh.PointCloud(what.positions, colors=own)
    return trimesh.Trimesh(what.points, what.triangles, vertex_normals=what.normals, vertex_colors=own, process=False)


def _linear(colours: Any) -> Any:
    return np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)


def write_usd(run: Exported, folder: Path, advance: Advance) -> Path:
    """Write the prims ``/run/surface``, ``/run/particles`` and ``/run/solid_NAME``. Frame k has the time code k.
    Lengths are in metres, and colours are linear."""
    pxr = _pxr()
    path = folder / "run.usdc"
    temporary = unfinished(path).with_suffix(".usdc")
    with sentences(path):
        try:
            stage = pxr.Usd.Stage.CreateNew(str(temporary))
            writer = _Writer(pxr, stage, run)
            for code, frame in enumerate(run.frames(run.whole)):
                writer.add(float(code), frame)
                advance()
            stage.GetRootLayer().Save()
            temporary.replace(path)
        except pxr.Tf.ErrorException as problem:
            found, advice = " ".join(str(problem).split()), "free some space, or choose another place"
            raise ComputationError(f"{path} cannot be written: USD reports {found}; {advice}.") from problem
        finally:
            temporary.unlink(missing_ok=True)
    return path


class _Writer:
    def __init__(self, pxr: Any, stage: Any, run: Exported):
        self._pxr, self._run, geometry = pxr, run, pxr.UsdGeom
        geometry.SetStageMetersPerUnit(stage, 1.0)
        gravity = np.abs(np.asarray(run.scene.forces.gravity))
        geometry.SetStageUpAxis(stage, geometry.Tokens.z if gravity.argmax() == 2 else geometry.Tokens.y)
        stage.SetTimeCodesPerSecond(run.whole.rate)
        stage.SetFramesPerSecond(run.whole.rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(len(run.whole.times) - 1))
        stage.SetDefaultPrim(geometry.Xform.Define(stage, "/run").GetPrim())
        self._particles = geometry.Points.Define(stage, "/run/particles")
        self._particles.CreateWidthsAttr(self._floats(np.array([run.spacing])))
        self._particles.SetWidthsInterpolation(geometry.Tokens.constant)
        self._surface = geometry.Mesh.Define(stage, "/run/surface") if run.scene.dimension == 3 else None
        if self._surface is not None:
            self._begin_mesh(self._surface)
        self._poses: dict[str, tuple[Any, Any]] = {}
        for solid in run.solids:
            form = geometry.Xform.Define(stage, f"/run/{solid.part}")
            self._poses[solid.name] = form.AddTranslateOp(), form.AddOrientOp(geometry.XformOp.PrecisionDouble)
            mesh = geometry.Mesh.Define(stage, f"/run/{solid.part}/mesh")
            self._begin_mesh(mesh)
            self._set_mesh(mesh, solid.mesh, pxr.Usd.TimeCode.Default())

    def add(self, code: float, frame: ExportedFrame) -> None:
        from scipy.spatial.transform import Rotation

        if self._surface is not None:
            empty = np.zeros((0, 3))
            surface = frame.surface or Mesh(empty, empty, empty, empty, empty)
            self._set_mesh(self._surface, surface, code)
        self._set_points(self._particles, frame.positions, frame.velocities, frame.colours, code)
        for name, values in frame.fields.items():
            self._field(name, values).Set(self._floats(values), code)
        for solid in self._run.solids:
            if solid.moves or code == 0.0:
                own = code if solid.moves else self._pxr.Usd.TimeCode.Default()
                pose, (translate, orient), gf = frame.poses[solid.name], self._poses[solid.name], self._pxr.Gf
                turn = Rotation.from_matrix(pose.turn).as_quat()
                translate.Set(gf.Vec3d(*pose.position), own)
                orient.Set(gf.Quatd(float(turn[3]), gf.Vec3d(*turn[:3])), own)

    def _field(self, name: str, values: np.ndarray) -> Any:
        kinds, geometry = self._pxr.Sdf.ValueTypeNames, self._pxr.UsdGeom
        kind = kinds.FloatArray if values.ndim == 1 else {2: kinds.Float2Array, 3: kinds.Float3Array}[values.shape[1]]
        return geometry.PrimvarsAPI(self._particles).CreatePrimvar(name, kind, geometry.Tokens.vertex)

    def _begin_mesh(self, mesh: Any) -> None:
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.SetNormalsInterpolation(self._pxr.UsdGeom.Tokens.vertex)

    def _set_mesh(self, prim: Any, mesh: Mesh, code: Any) -> None:
        ints = self._pxr.Vt.IntArray.FromNumpy
        self._set_points(prim, mesh.points, mesh.velocities, mesh.colours, code)
        prim.GetFaceVertexCountsAttr().Set(ints(np.full(len(mesh.triangles), 3, dtype=np.int32)), code)
        prim.GetFaceVertexIndicesAttr().Set(ints(mesh.triangles.astype(np.int32).ravel()), code)
        prim.GetNormalsAttr().Set(self._floats(mesh.normals), code)

    def _set_points(self, prim: Any, points: Points, velocities: Points | None, colours: Points, code: Any) -> None:
        given = self._floats(points)
        prim.GetPointsAttr().Set(given, code)
        if len(points):
            prim.GetExtentAttr().Set(self._pxr.UsdGeom.PointBased.ComputeExtent(given), code)
        if velocities is not None:
            prim.GetVelocitiesAttr().Set(self._floats(velocities), code)
        prim.CreateDisplayColorPrimvar(self._pxr.UsdGeom.Tokens.vertex).Set(self._floats(colours), code)

    def _floats(self, values: np.ndarray) -> Any:
        vt, own = self._pxr.Vt, np.ascontiguousarray(values, dtype=np.float32)
        kind = vt.FloatArray if own.ndim == 1 else {2: vt.Vec2fArray, 3: vt.Vec3fArray}[own.shape[1]]
        return kind.FromNumpy(own)


def _pxr() -> Any:
    try:
        found = import_module("pxr")
        for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "Vt"):
            import_module(f"pxr.{name}")
    except ImportError as error:
        raise ExtraMissingError("USD", "usd-core") from error
    return found


def _vtp(what: ExportedFrame | Mesh) -> str:
    colours = {"colour": srgb_bytes(what.colours)}
    velocities = {} if what.velocities is None else {"velocity": what.velocities}
    if isinstance(what, ExportedFrame):
        own = {name: in_space(values) if values.ndim == 2 else values for name, values in what.fields.items()}
        data = _polydata(what.positions, np.arange(len(what.positions))[:, None], "Verts", velocities | colours | own)
    else:
        data = _polydata(what.points, what.triangles, "Polys", colours | velocities)
        data.GetPointData().SetNormals(_array("normals", what.normals))
    writer = _vtk().vtkXMLPolyDataWriter()
    writer.SetInputData(data)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString())


def _polydata(points: np.ndarray, corners: np.ndarray, cells: str, fields: Mapping[str, np.ndarray]) -> Any:
    """The positions ``points`` (p, 3) are in metres, and ``corners`` (c, k) are point numbers of cells."""
    vtk = _vtk()
    data, places, topology = vtk.vtkPolyData(), vtk.vtkPoints(), vtk.vtkCellArray()
    places.SetData(_array("points", points))
    data.SetPoints(places)
    starts, flat = np.arange(0, corners.size + 1, corners.shape[1]), np.ascontiguousarray(corners.ravel())
    topology.SetData(*(vtk.numpy_to_vtkIdTypeArray(one.astype(np.int64), deep=True) for one in (starts, flat)))
    getattr(data, f"Set{cells}")(topology)
    for name, values in fields.items():
        data.GetPointData().AddArray(_array(name, values))
    return data


def _array(name: str, values: np.ndarray) -> Any:
    kept = values if values.dtype == np.uint8 else np.asarray(values, dtype=np.float32)
    found = _vtk().numpy_to_vtk(np.ascontiguousarray(kept), deep=True)
    found.SetName(name)
    return found


@cache
def _vtk() -> Any:
    try:
        from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkIOXML
        from vtkmodules.util import numpy_support
    except ImportError as error:
        raise ExtraMissingError("VTK", "vtk") from error
    modules = (vtkCommonCore, vtkCommonDataModel, vtkIOXML, numpy_support)
    return SimpleNamespace(**{name: value for one in modules for name, value in vars(one).items()})


FORMATS: dict[str, Callable[[Exported, Path, Advance], Path]] = {
    "ply": partial(_write_meshes, ending="ply"),
    "obj": partial(_write_meshes, ending="obj"),
    "glb": write_glb,
    "usd": write_usd,
    "vtp": write_vtp,
}


def export(
    trajectory: Trajectory, folder: str | Path, to: str, scene: Scene | str | Path, simulation: Computed = None
) -> Path:
    """Return the path that another program opens. See `Trajectory.export`."""
    if to not in FORMATS:
        raise InputError(f"to is {shown(to)}, but must be one of {', '.join(FORMATS)}.")
    if not len(trajectory):
        raise InputError("The trajectory has no frames, but an export needs at least one.")
    of, into = as_scene(scene), Path(as_path("folder", folder))
    phases = 1 if trajectory.mass_fractions is None else trajectory.mass_fractions.shape[-1]
    if of.dimension != trajectory.dimension or len(of.phase) != phases:
        wanted = f"that of the trajectory, with {trajectory.dimension} and {phases}"
        raise InputError(f"scene has {of.dimension} dimensions and {len(of.phase)} phases, but must be {wanted}.")
    run = Exported(trajectory, of, simulation)
    with sentences(into):
        into.mkdir(parents=True, exist_ok=True)
        if any(into.iterdir()):
            raise InputError(f"{into} is not empty; choose a new or an empty folder.")
    whole = run.whole if to == "usd" else run.series
    with track(len(trajectory if whole is None else whole.times), "export") as advance:
        path = FORMATS[to](run, into, advance)
    for said in ("" if whole is None else whole.in_words, run.in_words):
        if said:
            announce(f"{path.name}: {said}.")
    return path


def labelled(trajectory: Trajectory) -> Any:
    try:
        import xarray
    except ImportError as error:
        raise ExtraMissingError("xarray", "xarray") from error
    axes, of_particles = list("xyz"[: trajectory.dimension]), ("time", "particle")
    variables: dict[str, Any] = {
        "position": ((*of_particles, "space"), trajectory.positions, {"units": "m"}),
        "velocity": ((*of_particles, "space"), trajectory.velocities, {"units": "m/s"}),
    }
    if trajectory.mass_fractions is not None:
        variables[FRACTION.rstrip("_")] = ((*of_particles, "phase"), trajectory.mass_fractions, {"units": "1"})
    if "reference_density" in trajectory.constants:
        variables["reference_density"] = (("particle",), trajectory.constants["reference_density"], {"units": "kg/m3"})
    for name, values in trajectory.quantities.items():
        behind = {2: (), 3: ("space",)}[values.ndim]
        variables[name] = ((*of_particles, *behind), values, {"units": QUANTITIES[name].unit})
    coordinates: dict[str, Any] = {
        "time": ("time", trajectory.times, {"units": "s"}),
        "step": ("time", trajectory.steps, {"units": "1"}),
        "space": ("space", axes),
    }
    if trajectory.solids:
        coordinates |= {"solid": ("solid", list(trajectory.solids))}
        coordinates |= {"rotation_axis": ("rotation_axis", axes)} if trajectory.dimension == 3 else {}
        variables |= _of_solids([*trajectory.solids.values()], ("rotation_axis",) if trajectory.dimension == 3 else ())
    attributes: dict[str, Any] = {"source": f"Cortado {__version__}"}
    if trajectory.origin is not None:
        attributes["spacing"] = trajectory.origin.spacing
        attributes["spacing_units"] = "m"
    return xarray.Dataset(variables, coordinates, attributes)


def _of_solids(solids: list[SolidMotion], turned: tuple[str, ...]) -> dict[str, Any]:
    def over_time(name: str, like: str, axes: tuple[str, ...], unit: str) -> tuple[Any, ...]:
        pairs = [(getattr(one, name), getattr(one, like)) for one in solids]
        rows = [np.full_like(other, np.nan) if own is None else own for own, other in pairs]
        return ("time", "solid", *axes), np.stack(rows, axis=1), {"units": unit}

    return {
        "solid_position": over_time("positions", "positions", ("space",), "m"),
        "solid_scale": (("solid",), [one.scale for one in solids], {"units": "1"}),
        "solid_rotation": over_time("rotations", "rotations", turned, "rad"),
        "solid_velocity": over_time("velocities", "positions", ("space",), "m/s"),
        "solid_angular_velocity": over_time("angular_velocities", "rotations", turned, "rad/s"),
    }
