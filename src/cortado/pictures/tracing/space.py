"""Draw pictures of fluid in 3-D with a ray tracer.

Particles near walls and solids get mirror images behind the wall, so that the fluid is drawn without a gap.
"""

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from cortado.device.cells import cell_kernels
from cortado.device.launching import BandLauncher
from cortado.device.modules import compile_ahead
from cortado.device.precision import FLOAT32
from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.tracing import trace
from cortado.pictures.tracing.backdrop import EDGE, GLASS_BOX, GLASS_CYLINDER, NO_GLASS, Environment
from cortado.pictures.tracing.liquid_surface import Level, Mesh, liquid_level, liquid_surface, spheres
from cortado.pictures.tracing.near_particles import (
    MODULE,
    Ints,
    Look,
    Particles,
    Vec3s,
    last_of,
    list_marked,
    marked,
    mixed,
)
from cortado.pictures.tracing.solid_surfaces import DeviceSurface, FloorShadow, SolidSurfaces, cast
from cortado.pictures.tracing.steady import steadied, still_of
from cortado.scene.appearance import View
from cortado.scene.scene import Scene

SKIN = 0.7
"""Approximate distance from a particle to the drawn surface [spacings]."""
DEPTHS = (1.0, 0.7, 0.4, 0.1)
"""Depths of a mirror image, relative to the particle's distance from the surface, in order of preference. An image must
be hidden inside the solid."""
ON_SURFACE = 0.05
"""Tolerance [spacings] for points on the surface of a solid."""
SAME_SIDE = 0.8
"""Cosine of the angle between two normals of a solid, above which both normals belong to the same side."""


def mirrored(points: Points, solids: Sequence[ShownSolid], near: float, spacing: float) -> tuple[Points, np.ndarray]:
    """Return mirror images (m, d) [m] of points (n, d) [m] behind solids, and the index of each original point (m,).
    Sides of solids within ``near`` [m] of a point, and corners between such sides, mirror the point. A thin solid has
    images closer to its surface, or none."""
    dimension = points.shape[1]
    images, of = [np.zeros((0, dimension))], [np.zeros(0, dtype=int)]
    for shown in solids:
        distances = shown.solid.distance(points)
        touching = np.flatnonzero((distances > 0.0) & (distances < near))
        ways = _ways(points[touching], shown, near, spacing)
        for count in range(1, dimension + 1):
            for chosen in combinations(ways, count):
                there = np.all([way.any(axis=1) for way in chosen], axis=0)
                images.append((points[touching] + np.sum(chosen, axis=0))[there])
                of.append(touching[there])
    return np.concatenate(images), np.concatenate(of)


def _ways(points: Points, shown: ShownSolid, touching: float, spacing: float) -> list[Points]:
    solid, normals, ways = shown.solid, list[Points](), list[Points]()
    for probe in touching * np.concatenate([np.zeros((1, len(shown.turn))), shown.turn.T, -shown.turn.T]):
        feet, away = solid.nearest(points + probe), solid.outward(points + probe)
        heights = ((points - feet) * away).sum(axis=1)[:, None]
        below = points - heights * away
        is_new = ((heights > 0.0) & (heights < touching))[:, 0] & (np.abs(solid.distance(below)) < ON_SURFACE * spacing)
        for other in normals:
            is_new &= (away * other).sum(axis=1) < SAME_SIDE
        way = np.zeros_like(points)
        for part in DEPTHS[::-1]:
            hidden = is_new & (solid.distance(below - (part * heights + SKIN * spacing) * away) < 0.0)
            way = np.where(hidden[:, None], -(1.0 + part) * heights * away, way)
        normals.append(np.where(is_new[:, None], away, 0.0))
        ways.append(way)
    return ways


TOUCHING, TOUCHING_SOLID, TOUCHING_ROUND = wp.constant(wp.float32(0.8)), 1.1, wp.constant(wp.float32(1.5))
"""Greatest distances [spacings] of touching particles from a flat wall, a solid, and a round wall."""


@wp.kernel(module=MODULE, enable_backward=False)
def turn(first: wp.int32, frame: wp.mat33, places: Vec3s):
    i = first + wp.tid()
    places[i] = frame * places[i]


def particles_of(
    stage: Stage, positions: np.ndarray, colours: np.ndarray, launch: BandLauncher, fractions: Points | None = None
) -> Particles:
    """Convert ``positions`` (n, 3) [m] in scene axes to particles in picture axes."""
    media = stage.media.mean(axis=0) if fractions is None else mixed(fractions, stage.media)
    places = stage.container.domain(3).wrapped(positions)
    found = Particles.on(launch.device, np.subtract(places, stage.origin), colours, media)
    launch(turn, len(found), frame=wp.mat33(*stage.frame.ravel()), places=found.places)
    return found


@wp.func
def images_along(s: Environment, q: wp.vec3, axis: wp.int32, spacing: wp.float32):
    """Return a bit mask of mirror images along an axis: 1 for the lower wall, and 2 for the upper wall."""
    found = wp.int32(0)
    if s.glass == wp.static(GLASS_BOX) or axis == 1:
        if wp.abs(q[axis] - s.room_lower[axis]) < TOUCHING * spacing:
            found = found | 1
        if wp.abs(q[axis] - s.room_upper[axis]) < TOUCHING * spacing:
            found = found | 2
    elif axis == 0:
        off = q - 0.5 * (s.glass_lower + s.glass_upper)
        radius = 0.5 * (s.glass_upper[0] - s.glass_lower[0])
        if wp.abs(radius - wp.sqrt(off[0] * off[0] + off[2] * off[2])) < TOUCHING_ROUND * spacing:
            found = 3
    return found


@wp.func
def image_along(s: Environment, q: wp.vec3, axis: wp.int32, which: wp.int32, spacing: wp.float32):
    """Return the vector from a particle at ``q`` to its mirror image number ``which`` along an axis."""
    way = wp.vec3(0.0)
    if which == 0:
        return way
    if s.glass == wp.static(GLASS_BOX) or axis == 1:
        way[axis] = 2.0 * (wp.where(which == 1, s.room_lower[axis], s.room_upper[axis]) - q[axis])
        return way
    off = q - 0.5 * (s.glass_lower + s.glass_upper)
    return float(which) * spacing * wp.normalize(wp.vec3(off[0], 0.0, off[2]))


@wp.func
def has_image(which: wp.int32, images: wp.int32):
    return which == 0 or (images >> (which - 1)) & 1 == 1


@wp.kernel(module=MODULE, enable_backward=False)
def count_images(first: wp.int32, s: Environment, spacing: wp.float32, places: Vec3s, counts: Ints):
    i = first + wp.tid()
    q = s.glass_frame * places[i]
    count = wp.int32(1)
    for axis in range(3):
        images = images_along(s, q, axis, spacing)
        count = count * (1 + (images & 1) + (images >> 1))
    counts[i] = count


@wp.kernel(module=MODULE, enable_backward=False)
def list_images(
    first: wp.int32,
    s: Environment,
    spacing: wp.float32,
    places: Vec3s,
    looks: wp.array(dtype=Look),
    counts: Ints,
    image_places: Vec3s,
    image_looks: wp.array(dtype=Look),
):
    i = first + wp.tid()
    n = wp.int32(0)
    if i > 0:
        n = counts[i - 1]
    q = s.glass_frame * places[i]
    along = wp.vec3i(images_along(s, q, 0, spacing), images_along(s, q, 1, spacing), images_along(s, q, 2, spacing))
    for which in range(27):
        a = which % 3
        b = (which / 3) % 3
        c = which / 9
        if has_image(a, along[0]) and has_image(b, along[1]) and has_image(c, along[2]):
            way = image_along(s, q, 0, a, spacing) + image_along(s, q, 1, b, spacing)
            way += image_along(s, q, 2, c, spacing)
            image_places[n] = wp.transpose(s.glass_frame) * (q + way)
            image_looks[n] = looks[i]
            n += 1


def wetting(stage: Stage, s: Any, particles: Particles, launch: BandLauncher) -> Particles:
    """Return the particles and their mirror images behind solids and walls."""
    if stage.solids:
        placed = particles.places.numpy().astype(np.float64)
        images, of = mirrored(placed, stage.solids, TOUCHING_SOLID * stage.spacing, stage.spacing)
        looks = np.concatenate([particles.looks.numpy(), particles.looks.numpy()[of]])
        both = np.concatenate([particles.places.numpy(), images])
        particles = Particles.on(launch.device, both, looks[:, :3], looks[:, 3:])
    if not stage.cuts:
        return particles
    own, given = {"s": s, "spacing": stage.spacing}, {"places": particles.places, "looks": particles.looks}
    counts = wp.empty(len(particles), dtype=wp.int32, device=particles.places.device)
    launch(count_images, len(particles), **own, places=particles.places, counts=counts)
    wp.utils.array_scan(counts, counts)
    total = last_of(counts)
    found = Particles(*(wp.empty(total, dtype=one, device=counts.device) for one in (wp.vec3, Look)))
    filled = {"image_places": found.places, "image_looks": found.looks}
    launch(list_images, len(particles), **own, **given, counts=counts, **filled)
    return found


def environment_of(stage: Stage) -> Any:
    """Return the `Environment` of a stage, without solids and without shadows."""
    picture, light, s = stage.picture, stage.picture.sun_and_sky, Environment()
    horizon = np.asarray(light.background)
    s.size, s.nearest, s.segments = stage.size, 1e-4 * stage.size, trace.effort_of(stage.picture).segments
    s.sun, s.fill = wp.vec3(*stage.sun), wp.vec3(*stage.fill)
    s.horizon, s.zenith = wp.vec3(*horizon), wp.vec3(*(horizon * light.zenith))
    s.lamp, s.strip, s.sunlight = wp.vec3(*light.lamp), wp.vec3(*light.strip), wp.vec3(*light.sunlight)
    s.has_floor, s.floor_height = int(picture.floor), float(stage.lower[1])
    s.floor_colour = wp.vec3(*(0.93 * horizon))
    s.floor_centre = wp.vec3(*(0.5 * (stage.lower + stage.upper)))
    length = stage.size / 6.0  # of a square on the floor, 1, 2 or 5 at the front
    power = 10.0 ** np.floor(np.log10(length))
    s.grid = float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))
    s.glass = NO_GLASS
    if stage.container.extent() is not None:
        lower, upper = stage.glass_ends
        s.glass = GLASS_BOX if stage.container.shape == "box" else GLASS_CYLINDER
        s.glass_frame = wp.mat33(*stage.glass_frame.ravel())
        s.glass_lower, s.glass_upper = wp.vec3(*lower), wp.vec3(*upper)
        lower, upper = (np.clip(end, -1e8, 1e8) for end in stage.room)
        s.room_lower, s.room_upper = wp.vec3(*lower), wp.vec3(*upper)
        s.has_room = int(stage.cuts and picture.surface == "liquid")
        finish = stage.container.finish
        s.edge_colour = wp.vec3(*(EDGE if finish is None else finish.colour))
        if finish is not None and not finish.transparency:
            s.has_walls, s.wall_colour, s.wall_reflectivity = 1, wp.vec3(*finish.colour), finish.reflectivity
        s.panes = wp.mat33(*(stage.panes * (1 - s.has_walls)).ravel(), 0.0, 0.0, 0.0)
    return s


class State(NamedTuple):
    positions: Points
    """Positions of particles (n, d) [m], in scene axes."""
    colours: Points
    """Colours of particles (n, 3), in linear RGB."""
    pose: Scene | None = None
    """Scene with the poses of the solids, or None if solids do not move."""
    view: View | None = None
    """View of a moving camera, or None for a camera at rest."""
    fractions: Points | None = None
    """Mass fractions (n, phases), or None for a single phase."""


class SpacePainter:
    def __init__(self, stage: Stage, device: Any = "cpu"):
        self.stage, self.device = stage, wp.get_device(device)
        self._launch = BandLauncher(self.device)
        self._solids = SolidSurfaces(stage, self.device)
        self._trace, self._illuminates = (
            trace.trace_kernel(*self._solids.kinds),
            trace.illuminate_kernel(*self._solids.kinds),
        )
        shading = self._trace, self._illuminates
        self._kernels = *shading, trace.find_contrast, list_marked, turn, cast, cell_kernels(FLOAT32).count
        """Kernels of a picture. `compile_ahead` compiles the modules of these kernels in parallel."""
        self._effort, is_liquid = trace.effort_of(stage.picture), stage.picture.surface == "liquid"
        self._lamps = self._rays_to_light(*(self._effort.lights if is_liquid else trace.SPHERE_LIGHTS))
        self._lamps_of_solids = self._rays_to_light(*trace.SOLID_LIGHTS)
        self._pixels = wp.array(
            trace.in_tiles(stage.picture.width, stage.picture.height), dtype=wp.int32, device=device
        )
        offsets = trace.MIDDLE, trace.ROTATED_GRID[: self._effort.again]
        self._offsets = [wp.array(one, dtype=wp.vec2, device=device) for one in offsets]

    def image(self, *state: Any) -> Points:
        with WARP:
            compile_ahead(self, self.device)
            return self._rays(*self.scenery(State(*state)))

    def still(self, state: State) -> Any:
        """Prepare a frame for averages. Return None if the picture has no fluid surface."""
        with WARP:
            compile_ahead(self, self.device)
            stage, s, particles, shadow = self._placed(state)
            if stage.picture.surface != "liquid" or not len(particles):
                return None
            shadow.of_fluid(particles)
            images = wetting(stage, s, particles, self._launch)
            level, near = liquid_level(images, stage.spacing, self._launch, self._effort.cube)
            return still_of(level, near, shadow.light, self._launch)

    def steady_image(self, state: State, own: Any, before: Sequence[Any], after: Sequence[Any]) -> Points:
        with WARP:
            return self._rays(*self.scenery(state, steadied(own, before, after, self.stage.spacing, self._launch)))

    def scenery(self, state: State, steady: Any = None) -> tuple[Stage, Any, DeviceSurface, FloorShadow]:
        """Return stage, environment, surface and shadow. A frame ``steady`` replaces the state's surface and shadow."""
        stage, s, particles, shadow = self._placed(state)
        if steady is None:
            shadow.of_fluid(particles)
        else:
            shadow.light = steady.light
        level = None if steady is None else (steady.b, steady.blocks)
        return stage, s, self._surface(stage, s, particles, level), shadow

    def _placed(self, state: State) -> tuple[Stage, Any, Particles, FloorShadow]:
        stage = self.stage.at(state.pose, state.view)
        s, shadow = environment_of(stage), FloorShadow(stage, self._launch)
        s.shadow_corner, s.shadow_cell = wp.vec3(*shadow.corner), shadow.cell
        return stage, s, particles_of(stage, state.positions, state.colours, self._launch, state.fractions), shadow

    def _surface(self, stage: Stage, s: Any, particles: Particles, level: Level | None) -> DeviceSurface:
        if not len(particles):  # meshes need a triangle: one too small and too far below the floor to be seen
            places = stage.lower - 1e3 * stage.size + 1e-6 * stage.size * np.eye(3)
            return DeviceSurface.on(self.device, Mesh(places, np.arange(3), np.eye(3), np.eye(3)))
        if stage.picture.surface == "liquid":
            images = wetting(stage, s, particles, self._launch)
            found = liquid_surface(images, stage.spacing, self._launch, self._effort.cube, level)
            softened = partial(found.softened, launch=self._launch)
            surface = DeviceSurface.of(found.points, found.triangles, found.normals, found.colours, softened)
            surface.lit.media = found.media
            return surface
        balls = spheres(particles.places.numpy(), particles.looks.numpy()[:, :3], stage.spacing)
        surface = DeviceSurface.on(self.device, balls)
        surface.lit.media.fill_(wp.vec2(*stage.media[0]))
        return surface

    def _rays(self, stage: Stage, s: Any, seen: DeviceSurface, shadow: FloorShadow) -> Points:
        picture = stage.picture
        seen.lit.reach = 2.0 * self.stage.spacing
        seen.lit.is_flat = int(not picture.shaded)
        self._solids.cast(shadow, stage.solids)
        s.solids, solids = self._solids.on_device(stage.solids)
        given = {"s": s, "surface": seen.lit}
        self._illuminate(seen, self._lamps, given)
        for one in solids:
            self._illuminate(one, self._lamps_of_solids, given)
        image = wp.empty(picture.width * picture.height, dtype=wp.vec3, device=self.device)
        given |= {"eye": _eye(stage), "shadow": shadow.light, "image": image}
        once, again = self._offsets
        self._launch(self._trace, len(self._pixels), **given, pixels=self._pixels, offsets=once)
        rough = wp.empty(len(image), dtype=wp.int32, device=self.device)
        how = {"columns": picture.width, "contrast": self._effort.contrast}
        self._launch(trace.find_contrast, len(image), image=image, **how, found=rough)
        pixels, _ = marked(rough, self._launch)
        self._launch(self._trace, len(pixels), **given, pixels=pixels, offsets=again)
        found: Points = image.numpy().reshape(picture.height, picture.width, 3)
        return found

    def _illuminate(self, surface: DeviceSurface, lamps: tuple[wp.array, wp.array], given: dict[str, Any]) -> None:
        own = {"points": surface.mesh.points, "normals": surface.lit.normals, "light": surface.lit.light}
        own |= {"directions": lamps[0], "sun_directions": lamps[1]}
        how = {"reach": 0.2 * self.stage.size, "clearness": 0.85 * self.stage.transparency}
        self._launch(self._illuminates, len(surface.mesh.points), **given, **own, **how)
        if surface.softened is not None:
            wp.copy(surface.lit.light, surface.softened(surface.lit.light))

    def _rays_to_light(self, around: int, lamp: int) -> tuple[wp.array, wp.array]:
        in_lamp = self.stage.sun + (0.16 if lamp > 1 else 0.0) * _directions(lamp)
        in_lamp /= np.linalg.norm(in_lamp, axis=1)[:, None]
        found = [wp.array(one, dtype=wp.vec3, device=self.device) for one in (_directions(around), in_lamp)]
        return found[0], found[1]


def _directions(count: int) -> Points:
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    away = np.sqrt(1.0 - height**2)
    return np.stack([away * np.cos(turn), height, away * np.sin(turn)], axis=1)


def _eye(stage: Stage) -> Any:
    picture, eye = stage.picture, trace.Eye()
    forward = stage.look_at - stage.eye
    forward = forward / np.linalg.norm(forward)
    right, up = screen_axes(forward)
    half = np.tan(0.5 * np.radians(picture.field_of_view))
    eye.position, eye.forward = wp.vec3(*stage.eye), wp.vec3(*forward)
    eye.right, eye.up = wp.vec3(*(half * right)), wp.vec3(*(half * picture.height / picture.width * up))
    eye.columns, eye.rows = picture.width, picture.height
    return eye
