"""Everything in a 3-D picture except the fluid: up direction, floor, container, lamps and camera."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cortado.discretise.room import WITHOUT_PERIODS, Domain
from cortado.discretise.shapes import Points, corners
from cortado.pictures.shown_solids import ShownSolid, extents_of_solids, shown_solids, union
from cortado.scene.appearance import LIQUIDS, Picture, View
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import INDEX_OF_AXIS, BoxContainer, Container, CylinderContainer

DROPS = 0.002
ENOUGH = 1_000_000
"""Number of particle positions that suffices to find the extent of the fluid."""
Box = tuple[Points, Points]
"""Two points (d,) [m], such as the lower and the upper corner of a box."""
TINT = 2.6
"""Ratio of absorption to scattering for fluids without a material."""
SPAN = 0.1
"""Thickness of fluid in the definition of transparency, as a fraction of `Stage.size`."""


def thinned(positions: Points | Sequence[Points], domain: Domain = WITHOUT_PERIODS) -> list[Points]:
    """Return a sample of positions (m, d) [m] for each state, inside the periodic box."""
    states = [positions] if isinstance(positions, np.ndarray) and positions.ndim == 2 else list(positions)
    stride = max(sum(map(len, states)) // ENOUGH, 1)
    return [domain.wrapped(state[k % min(stride, len(state) or 1) :: stride]) for k, state in enumerate(states)]


def fluid_extent(states: Sequence[Points], around: Sequence[tuple[Points, Points]]) -> tuple[Points, Points]:
    """Return the lower and the upper corner (d,) [m] of the region with the fluid, without distant drops."""
    first, *later = states
    found = [_ends(first, DROPS)]
    lower, upper = union([*found, *around])
    near = 0.25 * float(np.max(upper - lower))
    for state in later:
        low, high = _ends(state, 0.1)  # the bulk
        beyond = 0.15 * (high - low)
        found.append((np.maximum(low - beyond, state.min(axis=0)), np.minimum(high + beyond, state.max(axis=0))))
        close = state[((state > lower - near) & (state < upper + near)).all(axis=1)]
        found += [_ends(close, DROPS)] if len(close) else []
    return union(found)


def _ends(positions: Points, share: float) -> tuple[Points, Points]:
    """Return the quantiles ``share`` and 1 - ``share`` of positions along each axis (d,) [m]."""
    lower, upper = np.quantile(positions, (share, 1.0 - share), axis=0)
    return lower, upper


def media_of(scene: Scene, size: float) -> tuple[Points, float]:
    """Return scattering and absorption of each phase (phases, 2) [1/m], and the transparency: the mean fraction of
    light that passes through fluid of the thickness `SPAN` times ``size`` [m]."""
    picture, spacing = scene.picture or Picture(), scene.discretisation.spacing
    by_phase, transparency = picture.colour == "phase", picture.transparency
    own = by_phase and transparency is None and picture.surface == "liquid"
    liquids = [LIQUIDS[phase.material] if own and phase.material else None for phase in scene.phase]
    if transparency is None:
        transparency = 0.0 if len(scene.phase) > 1 or not by_phase else 0.9
    plain = 3.0 / spacing  # events of scattering within a spacing
    if picture.surface == "spheres":
        plain = 1e3 / spacing
    elif transparency > 0.0:
        plain = min(-np.log(transparency) / (SPAN * size), plain)
    media = [(one.scattering, one.absorption) if one else (plain, TINT * plain) for one in liquids]
    through, way = [transparency] * len(liquids), SPAN * size
    for k, one in enumerate(liquids):
        if one:
            left = np.mean(np.array(scene.phase[k].colour) ** (way * one.absorption))
            through[k] = float(np.exp(-way * one.scattering) * left)
    return np.array(media), float(np.mean(through))


@dataclass(frozen=True)
class Stage:
    """Everything in a 3-D picture except the fluid. The y axis of a picture points up."""

    frame: Points
    """Rotation matrix (3, 3) from scene axes to picture axes."""
    origin: Points
    """Position of the origin of picture axes (3,) [m], in scene axes."""
    lower: Points
    """Lower corner (3,) [m] of a box around the fluid and the container, in picture axes."""
    upper: Points
    seen: tuple[Points, Points]
    """Lower and upper corner (3,) [m] of the region that the camera shows, in picture axes."""
    elevation: float
    """Elevation of the camera [degrees]."""
    eye: Points
    """Position of the camera (3,) [m]."""
    look_at: Points
    """Point at which the camera looks (3,) [m]."""
    azimuth: float
    """Initial azimuth of the camera [degrees]."""
    picture: Picture
    container: Any
    spacing: float
    transparency: float
    """Fraction of light that passes through a layer of fluid, from `media_of`."""
    media: Points
    """Scattering and absorption coefficients of each phase (phases, 2) [1/m], from `media_of`."""
    cuts: bool
    """True if fluid is shown only inside the container."""
    solids: tuple[ShownSolid, ...]
    """Solids of the scene, in picture axes."""

    @classmethod
    def of(cls, scene: Scene, positions: Points | Sequence[Points], poses: Iterable[Scene] = ()) -> "Stage":
        states, picture = thinned(positions, scene.container.domain(3)), scene.picture or Picture()
        ends = scene.container.extent()
        around = extents_of_solids([scene, *poses]) if ends is None else [ends]
        lower, upper = fluid_extent(states, around)
        frame = upright(np.asarray(scene.forces.gravity))
        if ends is None:
            air = 0.5 * scene.discretisation.spacing + 0.1 * (1.0 - np.abs(frame[1])) * (upper - lower)
            air = 0.0 * air if any(table.side == "inside" for table in scene.solid) else air
            lower, upper = union([(lower - air, upper + air), *around])
        else:
            lower, upper = np.minimum(lower, ends[0]), np.maximum(upper, ends[1])
        origin = 0.5 * (lower + upper)
        low, high = _box((corners(lower, upper) - origin) @ frame.T)
        from_above = len(scene.phase) > 1 and (scene.render is None or scene.render.view == "top")
        into_cup = from_above and isinstance(scene.container, CylinderContainer)
        into_cup |= any(table.shape == "cup" and not table.transparency for table in scene.solid)
        elevation = 40.0 if into_cup else 16.0  # degrees
        media, transparency = media_of(scene, float((high - low).max()))
        spacing = scene.discretisation.spacing
        cuts = ends is not None and not spilled(scene.container, np.concatenate(states), spacing)
        home = (low, high), elevation, np.zeros(3), np.zeros(3), 0.0
        own = cls(frame, origin, low, high, *home, picture, scene.container, spacing, transparency, media, cuts, ())
        return own.framed((lower, upper), picture).at(scene, None)

    def framed(self, ends: tuple[Points, Points], picture: Picture) -> "Stage":
        """Return the stage with a camera that shows the box ``ends`` (3,) [m], given in scene axes."""
        lower, upper = _box((corners(*ends) - self.origin) @ self.frame.T)
        eye, look_at = fitted(lower, upper, self.elevation, picture)
        if picture.look_at is not None:
            wanted = self.frame @ (picture.look_at - self.origin)
            eye, look_at = eye + wanted - look_at, wanted
        if picture.camera is not None:
            eye = self.frame @ (picture.camera - self.origin)
        back = eye - look_at
        azimuth = float(np.degrees(np.arctan2(back[0], back[2])))
        return replace(self, seen=(lower, upper), eye=eye, look_at=look_at, azimuth=azimuth, picture=picture)

    @property
    def ends(self) -> tuple[Points, Points]:
        return _box(corners(self.lower, self.upper) @ self.frame + self.origin)

    @property
    def seen_size(self) -> Points:
        """Width and height (2,) [m] of the shown region, seen from the camera."""
        return np.ptp(corners(*self.seen) @ np.stack(screen_axes(self.look_at - self.eye), axis=1), axis=0)

    @property
    def home(self) -> View:
        return View(*(self.frame.T @ place + self.origin for place in (self.eye, self.look_at)))

    @property
    def home_around(self) -> View:
        """First view of a circling camera. By default the camera sees the whole region from every side."""
        if self.picture.camera is not None:
            return self.home
        back, middle = self.eye - self.look_at, 0.5 * (self.seen[0] + self.seen[1])
        elevation = float(np.degrees(np.arcsin(back[1] / np.linalg.norm(back))))
        sides = (fitted(*self.seen, elevation, self.picture, turn) for turn in np.arange(0.0, 180.0, 15.0))
        off = 1.08 * max(float(np.linalg.norm(eye - look_at)) for eye, look_at in sides)
        eye = middle + off * back / np.linalg.norm(back)
        return View(*(self.frame.T @ place + self.origin for place in (eye, middle)))

    def at(self, pose: Scene | None, view: View | None) -> "Stage":
        """Return the stage with the solids of the scene ``pose`` and the camera ``view``. None changes nothing."""
        found = self
        if pose is not None:
            found = replace(found, solids=tuple(one.within(self.frame, self.origin) for one in shown_solids(pose)))
        if view is not None:
            eye, look_at = (self.frame @ (place - self.origin) for place in (view.eye, view.look_at))
            found = replace(found, eye=eye, look_at=look_at)
        return found

    @property
    def cuts_solids(self) -> bool:
        """True if solids are shown only inside the container."""
        return bool(getattr(self.container, "lid", self.container.extent() is not None))

    @property
    def size(self) -> float:
        """Greatest side of the box around the fluid and the container [m]."""
        return float((self.upper - self.lower).max())

    def placed(self, positions: Points) -> Points:
        """Convert positions (n, 3) [m] from scene axes to picture axes."""
        return (positions - self.origin) @ self.frame.T

    def on_screen(self, points: Points) -> Points:
        """Convert points (n, 3) [m] in scene axes to pixel coordinates (n, 2), column and row."""
        forward = self.look_at - self.eye
        forward = forward / np.linalg.norm(forward)
        off = self.placed(points) - self.eye
        scale = 0.5 * self.picture.width / np.tan(0.5 * np.radians(self.picture.field_of_view))
        right, up = (off @ axis / (off @ forward) * scale for axis in screen_axes(forward))
        return np.stack([0.5 * self.picture.width + right, 0.5 * self.picture.height - up], axis=1)

    @property
    def up_axis(self) -> int:
        return int(np.abs(self.frame[1]).argmax())

    @property
    def glass_frame(self) -> Points:
        """Rotation matrix (3, 3) from picture axes to container axes. Container axis 1 is the axis of a cylinder."""
        if not isinstance(self.container, CylinderContainer):
            return np.eye(3)
        return np.roll(np.eye(3), 1 - INDEX_OF_AXIS[self.container.axis], axis=0) @ self.frame.T

    @property
    def glass_ends(self) -> tuple[Points, Points]:
        """Lower and upper corner of the container (3,) [m], in container axes."""
        return _box(self.placed(corners(*self.container.extent())) @ self.glass_frame.T)

    @property
    def room(self) -> tuple[Points, Points]:
        """Corners (3,) [m] of the region in which fluid is shown, in container axes. The region is infinite along
        periodic axes, and also upwards, as emitters may be above the container."""
        lower, upper = (end.copy() for end in self.glass_ends)
        up = self.glass_frame @ (0.0, 1.0, 0.0)
        axis = int(np.abs(up).argmax())
        if isinstance(self.container, BoxContainer) or axis == 1:
            (upper if up[axis] > 0.0 else lower)[axis] = np.copysign(np.inf, up[axis])
        if isinstance(self.container, BoxContainer):
            periodic = np.abs(self.frame) @ np.asarray(self.container.periodic, dtype=float) > 0.5
            lower[periodic], upper[periodic] = -np.inf, np.inf
        return lower, upper

    @property
    def panes(self) -> Points:
        """Mask (2, 3) of the container's panes of glass. Rows are lower and upper sides, and columns are axes."""
        found = np.ones((2, 3))
        if isinstance(self.container, BoxContainer):
            found *= 1.0 - np.abs(self.frame) @ np.asarray(self.container.periodic, dtype=float)
        found[:, 1] = 0.0  # nor is one on the floor
        return found

    @property
    def sun(self) -> Points:
        """Unit vector (3,) towards the main lamp."""
        light = self.picture.sun_and_sky
        return _towards(self.azimuth + light.azimuth, light.elevation)

    @property
    def fill(self) -> Points:
        """Unit vector (3,) towards the second lamp."""
        return _towards(self.azimuth + 70.0, 28.0)


def _box(points: Points) -> tuple[Points, Points]:
    return points.min(axis=0), points.max(axis=0)


def spilled(container: Container, positions: Points, spacing: float) -> bool:
    """Test whether fluid at positions (n, 3) [m] has flowed over the rim of a cup."""
    if not isinstance(container, CylinderContainer) or container.lid:
        return False
    off = np.delete(positions - np.asarray(container.base), INDEX_OF_AXIS[container.axis], axis=1)
    return bool((np.linalg.norm(off, axis=1) > container.radius + 0.5 * spacing).any())


def upright(gravity: Points) -> Points:
    """Return the rotation matrix (3, 3) from scene axes to picture axes. The picture axes point right, up (against
    ``gravity`` (3,), or along y) and towards the viewer."""
    axis = int(np.abs(gravity).argmax()) if gravity.any() else 1
    up, towards = np.zeros(3), np.zeros(3)
    up[axis] = -1.0 if gravity[axis] > 0.0 else 1.0
    towards[(axis + 1) % 3] = 1.0
    return np.stack([np.cross(up, towards), up, towards])


def _towards(azimuth: float, elevation: float) -> Points:
    a, e = np.radians([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def fitted(lower: Points, upper: Points, elevation: float, picture: Picture, azimuth: float = 24.0) -> Box:
    """Return a camera position (3,) [m] and a look-at point (3,) [m] for which the box fills the picture."""
    back, box = _towards(azimuth, elevation), corners(lower, upper)
    half = np.tan(0.5 * np.radians(picture.field_of_view)) / 1.10
    halves = half, half * picture.height / picture.width
    right, up = screen_axes(-back)
    look_at, distance = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower)) / halves[1]
    for _ in range(20):
        depth = distance - (box - look_at) @ back
        places = [(box - look_at) @ axis / depth for axis in (right, up)]
        spans = [0.5 * (p.max() - p.min()) / h for p, h in zip(places, halves, strict=True)]
        for axis, p in zip((right, up), places, strict=True):
            look_at = look_at + 0.5 * (p.max() + p.min()) * distance * axis
        distance *= max(spans)
    return look_at + distance * back, look_at


def screen_axes(forward: Points) -> tuple[Points, Points]:
    """Return unit vectors (3,) to the right and upwards on the screen."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 * np.linalg.norm(forward) else np.array([0, 0, -1.0])
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    return right, up / np.linalg.norm(up)
