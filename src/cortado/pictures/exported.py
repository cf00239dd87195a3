"""The data of a run for export: the particles, the fluid's surface, and the solids. Surfaces end at container walls and
enclose the volume of their particles."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import floor
from operator import itemgetter

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import BandLauncher
from cortado.device.threads import WARP, usable_cores
from cortado.discretise.shapes import Points, in_space
from cortado.errors import ComputationError
from cortado.pictures.film import Computed, coloured_by, is_out, shown_places, those
from cortado.pictures.painter import Scale, colours_of
from cortado.pictures.shown_solids import Numbers, ShownSolid, SolidMesh, shown_solids
from cortado.pictures.stage import Stage, upright
from cortado.pictures.tracing.liquid_surface import Mesh, liquid_surface, nearest_colours, spheres
from cortado.pictures.tracing.space import environment_of, particles_of, wetting
from cortado.runs.frames import SAME, Marks, SolidMotions, fraction_names, posed, sized
from cortado.runs.particle_sums import square
from cortado.runs.trajectory import Frame, Trajectory
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import CylinderContainer

EVEN = 1e-6
"""Relative tolerance for evenly spaced frames."""
MOST_SHIFT = 1.0
"""Greatest displacement of a surface point in one pass [spacings]."""


@dataclass(frozen=True)
class WholeFrames:
    """Evenly spaced frames of an animation, extrapolated from recorded states."""

    rate: float
    """Frame rate [1/s]."""
    times: NDArray[np.float64]
    """Times of the frames (frames,) [s]."""
    recorded: NDArray[np.intp]
    """Number of the recorded state for each frame (frames,)."""
    shifts: NDArray[np.float64]
    """Time of each frame minus the time of its recorded state (frames,) [s]."""
    left_out: float
    """Time from the last frame to the end of the run [s]."""

    @classmethod
    def of(cls, times: NDArray[np.float64], marks: Marks | None = None) -> "WholeFrames":
        """Choose frames for recorded ``times`` (m,) [s]. Without ``marks``, prefer a round frame rate."""
        if marks is not None:
            whole = marks.at(np.arange(int(marks.passed(times[-1:])[0]) + 1))
            recorded = np.searchsorted(times, whole - SAME / marks.rate)
            shifts = whole - times[recorded]
            shifts[np.abs(shifts) < EVEN / marks.rate] = 0.0
            return cls(marks.rate, whole, recorded, shifts, float(times[-1] - whole[-1]))
        steps = np.diff(times)
        if not len(steps):
            return cls(24.0, times, np.zeros(1, dtype=np.intp), np.zeros(1), 0.0)
        start, step = float(times[0]), float(steps[0])
        if (np.abs(steps[:-1] / step - 1.0) < EVEN).all() and steps[-1] < step * (1.0 + EVEN):
            rate, count = 1.0 / step, len(times) if steps[-1] > step * (1.0 - EVEN) else len(times) - 1
            return cls(rate, times[:count], np.arange(count), np.zeros(count), float(times[-1] - times[count - 1]))
        usual = times[:-1] - start
        mean, numbers = (len(usual) - 1) / float(usual[-1]), np.arange(len(usual))
        rates = (rate for rate in (round(mean, digits) for digits in range(4)) if rate > 0.0)
        own = (rate for rate in rates if (np.abs(usual - numbers / rate) < 0.5 / rate).all())  # one for each state
        rate = next(own, float(f"{mean:.3g}"))
        whole = start + np.arange(floor((times[-1] - start) * rate + EVEN) + 1) / rate
        after = np.clip(np.searchsorted(times, whole), 1, len(times) - 1)  # the nearest one is this or that before
        recorded = np.where(whole - times[after - 1] <= times[after] - whole, after - 1, after)
        return cls(rate, whole, recorded, whole - times[recorded], float(times[-1] - whole[-1]))

    @property
    def in_words(self) -> str:
        found = []
        if self.shifts.any():
            most = 1e3 * float(np.abs(self.shifts).max())
            found.append(f"states are moved along their velocities to whole frames, by at most {most:.3g} ms")
        if self.left_out > EVEN / self.rate:
            found.append(f"the last state, {1e3 * self.left_out:.3g} ms after the last whole frame, is left out")
        return "; ".join(found)


@dataclass(frozen=True)
class Pose:
    turn: Points
    """Rotation matrix (3, 3)."""
    position: Points
    """Position (3,) [m]."""

    def of(self, mesh: Mesh) -> Mesh:
        return replace(mesh, points=mesh.points @ self.turn.T + self.position, normals=mesh.normals @ self.turn.T)

    @property
    def matrix(self) -> Points:
        """Transformation matrix (4, 4) for column vectors."""
        return np.block([[self.turn, self.position[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@dataclass(frozen=True)
class ExportedSolid:
    name: str
    part: str
    """Unique name in files, which begins with "solid_" and has only letters, digits and underscores."""
    mesh: Mesh
    """Mesh of the solid with its middle at the origin, without rotation."""
    moves: bool


@dataclass(frozen=True)
class ExportedFrame:
    time: float
    positions: Points
    """Positions of the particles (n, 3) [m]."""
    velocities: Points
    """Velocities of the particles (n, 3) [m/s]."""
    colours: Points
    """Linear colours of the particles (n, 3)."""
    fields: Mapping[str, np.ndarray]
    """Mass fractions and recorded quantities by name, (n,) or (n, k)."""
    surface: Mesh | None
    """Surface of the fluid, or None in 2-D and for scattered particles."""
    poses: Mapping[str, Pose]


class Exported:
    def __init__(self, trajectory: Trajectory, scene: Scene, simulation: Computed = None):
        self.times, self.scene = trajectory.times, scene
        self._values = coloured_by(scene, trajectory, simulation)
        self._scale = None if self._values is None else Scale.of((scene.picture or Picture()).colour, self._values, "")
        self.solids = list[ExportedSolid]()
        for number, (name, one) in enumerate(_first_of_each(sized(scene, trajectory.solids)).items()):
            part = f"solid_{re.sub(r'[^A-Za-z0-9_]', '_', name)}"
            part = f"{part}_{number}" if part in {solid.part for solid in self.solids} else part
            self.solids.append(_solid(one, part, name in trajectory.solids))
        self._trajectory = trajectory
        self.up = upright(np.asarray(scene.forces.gravity)) if scene.dimension == 3 else np.eye(3)
        """Rotation matrix (3, 3) that turns the upward direction of the scene to the y axis."""
        self.spacing = scene.discretisation.spacing
        self._held = (0.0, 0.0, 1.0, 1.0)
        """Largest volume error so far: relative error, time [s], and volumes [m³] of the surface and of the fluid."""

    @cached_property
    def whole(self) -> WholeFrames:
        return WholeFrames.of(self.times, self._trajectory.marks)

    @property
    def series(self) -> WholeFrames | None:
        """Frames for a series of files, or None if the series contains every recorded state."""
        return None if self._trajectory.marks is None else self.whole

    def frames(self, whole: WholeFrames | None = None) -> Iterator[ExportedFrame]:
        """Yield evenly spaced frames ``whole``, or by default all recorded states."""
        if whole is None:
            return (self._frame(frame, k, self._trajectory.solids, k) for k, frame in enumerate(self._trajectory))
        solids = self._trajectory.solids.at(self.scene, self.times, whole.recorded, whole.times)
        states = enumerate(zip(whole.recorded.tolist(), whole.shifts.tolist(), strict=True))
        return (self._frame(self._trajectory[k].moved(shift), k, solids, frame) for frame, (k, shift) in states)

    @property
    def in_words(self) -> str:
        unlike, time, held, whole = self._held
        if unlike <= 0.05:
            return ""
        return f"at {time:.4g} s the surface encloses {held:.4g} m³, where there are {whole:.4g} m³ of fluid"

    def _frame(self, frame: Frame, recorded: int, solids: SolidMotions, number: int) -> ExportedFrame:
        shown = those(is_out(self.scene, frame.others, len(frame.positions)))
        within = self.scene.domain.wrapped(frame.positions[shown])
        positions, velocities = in_space(np.float64(within)), in_space(np.float64(frame.velocities[shown]))
        colours = colours_of(self.scene, frame.mass_fractions, len(frame.positions))
        if self._scale is not None and self._values is not None:
            colours = self._scale.colours(self._values[recorded])
        fractions = np.zeros((len(frame.positions), 0)) if frame.mass_fractions is None else frame.mass_fractions
        named = dict(zip(fraction_names(fractions.shape[1]), fractions.T, strict=True)) | dict(frame.quantities)
        colours, fields = colours[shown], {name: values[shown] for name, values in named.items()}
        placed = _first_of_each(posed(self.scene, solids, number))
        poses = {name: Pose(square(one.turn), in_space(one.position)) for name, one in placed.items()}
        surface = self._surface(positions, velocities, colours) if self.scene.dimension == 3 else None
        if surface is not None and self._stage.picture.surface != "spheres":
            held, whole = enclosed(surface.points, surface.triangles), self.spacing**3 * len(positions)
            self._held = max(self._held, (abs(held / whole - 1.0), frame.time, held, whole), key=itemgetter(0))
        return ExportedFrame(frame.time, positions, velocities, colours, fields, surface, poses)

    @cached_property
    def _stage(self) -> Stage:
        return Stage.of(self.scene, shown_places(self.scene, self._trajectory))

    def _surface(self, positions: Points, velocities: Points, colours: Points) -> Mesh | None:
        try:
            if self._stage.picture.surface == "spheres":
                found = spheres(positions, colours, self.spacing)
            else:
                found = contained_liquid(self._stage, positions, colours)
        except ComputationError:
            return None
        return replace(found, velocities=nearest_colours(found.points, positions, velocities, self.spacing))


def _first_of_each(scene: Scene) -> dict[str, ShownSolid]:
    return {one.name: one for one in reversed(shown_solids(scene))}


def _solid(shown: ShownSolid, part: str, moves: bool) -> ExportedSolid:
    size = float(np.ptp(shown.shape.extent(), axis=0).max())
    faces = shown.shape.shown_faces(0.05 * size)
    faces = faces.reversed() if shown.is_tank else faces
    if len(shown.turn) == 2:  # an outline, which becomes a ribbon a tenth of its size wide
        start, end = (faces.vertices[edge] for edge in faces.corners.T)
        along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
        outwards = np.stack([along[:, 1], -along[:, 0], np.zeros(len(along))], axis=1)
        height = np.array([-0.05, 0.05]) * size
        ends = np.stack([start, end, end, start], axis=1)
        points = np.concatenate([ends, np.broadcast_to(height[[0, 0, 1, 1], None], (len(ends), 4, 1))], axis=2)
        triangles = 4 * np.arange(len(ends))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
        points, triangles, normals = points.reshape(-1, 3), triangles.reshape(-1, 3), np.repeat(outwards, 4, axis=0)
    else:
        found = SolidMesh.of(faces, np.inf)
        points, triangles, normals = found.points, found.triangles, found.normals
    colours = np.tile(shown.colour, (len(points), 1))
    return ExportedSolid(shown.name, part, Mesh(points, triangles, normals, colours), moves)


def enclosed(points: Points, triangles: np.ndarray) -> float:
    """Return the volume [m³] inside triangles (t, 3) with corners ``points`` (p, 3) [m]."""
    a, b, c = (points[corner] - points[0] for corner in triangles.T)
    return float(_sixth(a, b, c).sum())


def with_volume(
    points: Points, triangles: Numbers, ways: Points, places: Points, spacing: float, kept: Callable[[Points], Points]
) -> Points:
    """Move the points (p, 3) [m] of a surface until the surface encloses the volume n ``spacing``³ of n particles.
    ``ways`` (p, 3) are outward unit vectors, or 0 for fixed points. ``places`` (n, 3) [m] are particle positions. The
    function ``kept`` moves points from beyond a wall to the wall."""
    of_points, of_particles = _bodies(points, triangles, places, spacing)
    count = max(of_points.max(), of_particles.max(initial=-1)) + 1
    wanted = np.bincount(of_particles[of_particles >= 0], minlength=count) * spacing**3
    most, own = MOST_SHIFT * spacing, of_points[triangles[:, 0]]
    for _ in range(2):  # as walls stop some points
        shift = np.zeros(count)
        (a, b, c), (x, y, z) = ([each[corner] for corner in triangles.T] for each in (points - points[0], ways))
        terms = (
            _sixth(a, b, c),
            _sixth(x, b, c) + _sixth(a, y, c) + _sixth(a, b, z),
            _sixth(x, y, c) + _sixth(x, b, z) + _sixth(a, y, z),
            _sixth(x, y, z),
        )
        c0, c1, c2, c3 = (np.bincount(own, term, count) for term in terms)
        for _ in range(20):  # Newton's method for the volume, a polynomial of the shift
            volume = c0 + shift * (c1 + shift * (c2 + shift * c3))
            slope = c1 + shift * (2.0 * c2 + 3.0 * shift * c3)
            step = np.divide(wanted - volume, slope, out=np.zeros(count), where=slope > 0.0)
            shift = np.clip(shift + np.clip(step, -0.2 * spacing, 0.2 * spacing), -most, most)
        points = kept(points + shift[of_points][:, None] * ways)
    return points


def _bodies(points: Points, triangles: np.ndarray, places: Points, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the fluid body, or -1, for each surface point (p,) and for each particle (n,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    def parts(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        links = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
        return np.asarray(connected_components(links, directed=False)[1])

    sheets = parts(len(points), triangles[:, :2].T.ravel(), triangles[:, 1:].T.ravel())
    tree, n = cKDTree(places), len(places)
    near = tree.query(points, workers=usable_cores())[1]
    pairs = tree.query_pairs(1.25 * spacing, output_type="ndarray")
    first, second = np.append(pairs[:, 0], near), np.append(pairs[:, 1], n + sheets)
    found = parts(n + sheets.max() + 1, first, second)
    of_points, of_particles = found[n + sheets], found[:n]
    alone = np.flatnonzero(~np.isin(of_particles, of_points))
    if len(alone):
        distances, nearest = cKDTree(points).query(places[alone], workers=usable_cores())
        of_particles[alone] = np.where(distances < 2.0 * spacing, of_points[nearest], -1)
    return of_points, of_particles


def _sixth(a: Points, b: Points, c: Points) -> np.ndarray:
    return np.einsum("tk,tk->t", a, np.cross(b, c)) / 6.0


def contained_liquid(stage: Stage, positions: Points, colours: Points) -> Mesh:
    """Positions (n, 3) [m] and the mesh are in scene axes. Raises `ComputationError` without a surface."""
    launch, stage = BandLauncher(wp.get_device("cpu")), replace(stage, solids=())
    with WARP:
        own = particles_of(stage, positions, colours, launch)
        fluid = wetting(stage, environment_of(stage), own, launch)
        found = liquid_surface(fluid, stage.spacing, launch)
        places = own.places.numpy().astype(np.float64)
        points, normals = (one.numpy().astype(np.float64) for one in (found.points, found.normals))
        triangles, colours = found.triangles.numpy().reshape(-1, 3), found.colours.numpy()
    kept = _in_room(stage, points)
    beyond = np.linalg.norm(points - kept, axis=1)
    is_free = beyond <= 1e-6 * stage.spacing
    normals[~is_free] = (points - kept)[~is_free] / beyond[~is_free, None]
    ways, in_room = np.where(is_free[:, None], normals, 0.0), partial(_in_room, stage)
    points = with_volume(kept, triangles, ways, places, stage.spacing, in_room)
    return Mesh(points @ stage.frame + stage.origin, triangles, normals @ stage.frame, colours)


def _in_room(stage: Stage, points: Points) -> Points:
    """Move points (p, 3) [m] in picture axes into the container."""
    if not stage.cuts:
        return points
    lower, upper = stage.room
    places = points @ stage.glass_frame.T
    if isinstance(stage.container, CylinderContainer):
        radius = 0.5 * (upper[0] - lower[0])
        off = places[:, ::2] - 0.5 * (lower + upper)[::2]
        places[:, ::2] -= off * np.maximum(1.0 - radius / np.linalg.norm(off, axis=1, keepdims=True), 0.0)
        places[:, 1] = np.clip(places[:, 1], lower[1], upper[1])
    else:
        np.clip(places, lower, upper, out=places)
    return np.matmul(places, stage.glass_frame)
