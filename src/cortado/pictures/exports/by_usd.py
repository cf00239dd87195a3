"""One USD file of a run, with time samples, which pxr writes: what Blender, Houdini and Omniverse open."""

from pathlib import Path
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points
from cortado.errors import ComputationError, ExtraMissingError
from cortado.files.atomic import sentences, unfinished
from cortado.pictures.exports.by_trimesh import Advance
from cortado.pictures.exports.exported import Exported, ExportedFrame, Mesh, Pose


def write_usd(run: Exported, folder: Path, advance: Advance) -> Path:
    """``run.usdc`` with the mesh ``/run/surface``, the points ``/run/particles``, and for each solid a
    transform ``/run/solid_NAME`` with a mesh; returns its path.

    Frame k is at time code k, and the file says how many time codes a second has: `WholeFrames` says which states
    these are. Lengths are metres, colours linear.
    """
    pxr = _pxr()
    path = folder / "run.usdc"
    temporary = unfinished(path).with_suffix(".usdc")
    with sentences(path):
        try:
            stage = pxr.Usd.Stage.CreateNew(str(temporary))
            writer = _Writer(pxr, stage, run, len(run.whole.times), run.whole.rate)
            for code, frame in enumerate(run.frames(run.whole)):
                writer.add(float(code), frame)
                advance()
            stage.GetRootLayer().Save()
            temporary.replace(path)
        except pxr.Tf.ErrorException as problem:
            raise ComputationError(
                f"{path} cannot be written: USD reports {' '.join(str(problem).split())}; free some space, or choose "
                "another place."
            ) from problem
        finally:
            temporary.unlink(missing_ok=True)
    return path


class _Writer:
    """Adds frames to a stage."""

    def __init__(self, pxr: Any, stage: Any, run: Exported, frames: int, rate: float):
        self._pxr, self._run, geometry = pxr, run, pxr.UsdGeom
        geometry.SetStageMetersPerUnit(stage, 1.0)
        gravity = np.abs(np.asarray(run.scene.forces.gravity))
        geometry.SetStageUpAxis(stage, geometry.Tokens.z if gravity.argmax() == 2 else geometry.Tokens.y)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(frames - 1))
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
        """Write a frame at a time code."""
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
                self._set_pose(solid.name, frame.poses[solid.name], own)

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
        colour = prim.CreateDisplayColorPrimvar(self._pxr.UsdGeom.Tokens.vertex)
        colour.Set(self._floats(colours), code)

    def _set_pose(self, name: str, pose: Pose, code: Any) -> None:
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(pose.turn).as_quat()
        translate, orient = self._poses[name]
        gf = self._pxr.Gf
        translate.Set(gf.Vec3d(*pose.position), code)
        orient.Set(gf.Quatd(float(turn[3]), gf.Vec3d(*turn[:3])), code)

    def _floats(self, values: np.ndarray) -> Any:
        """(n,) or (n, k) as an array of USD, in float32."""
        vt, own = self._pxr.Vt, np.ascontiguousarray(values, dtype=np.float32)
        kind = vt.FloatArray if own.ndim == 1 else {2: vt.Vec2fArray, 3: vt.Vec3fArray}[own.shape[1]]
        return kind.FromNumpy(own)


def _pxr() -> Any:
    try:
        import pxr
        import pxr.Gf
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.Vt
    except ImportError as error:
        raise ExtraMissingError("USD", "usd-core") from error
    return pxr
