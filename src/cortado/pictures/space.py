"""Pictures of fluid in 3-D, by a ray tracer on the device of the run."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.pictures.device_surface import DeviceSurface
from cortado.pictures.lighting import illuminate_kernel
from cortado.pictures.scenery import Scenery, State, processes_for, sceneries, scenery
from cortado.pictures.solid_mesh import SolidMesh
from cortado.pictures.solid_surfaces import SolidSurfaces
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.surface import Surface
from cortado.pictures.surroundings import GLASS_BOX, GLASS_CYLINDER, NO_GLASS, Environment
from cortado.pictures.trace import Eye, find_contrast, trace_kernel

ROTATED_GRID = ((-0.375, -0.125), (-0.125, 0.375), (0.125, -0.375), (0.375, 0.125))
"""Where in a pixel four more rays go, in pixels from its middle."""
CONTRAST = 0.03
"""Between neighbouring pixels, in linear light: above, four more rays go through both."""
LIGHT_RAYS = {"liquid": (20, 4), "spheres": (10, 1)}
"""Rays that find how much light falls on a point of the surface: from all around, and from the lamp."""


SOLID_RAYS = 40, 6
"""The same for solids, which have fewer points and even sides."""


class SpacePainter:
    """Draws states of one scene of so many particles: `image` and `images`."""

    def __init__(self, stage: Stage, particles: int, device: Any = "cpu"):
        self.stage, self.device, self.at_once = stage, wp.get_device(device), processes_for(particles)
        self._launch = BandLauncher(self.device)
        self._solids = SolidSurfaces(stage, self.device) if stage.solids else None
        kinds = self._solids.kinds if self._solids is not None else (False, False)
        self._trace, self._illuminates = trace_kernel(*kinds), illuminate_kernel(*kinds)
        self._lamps = self._rays_to_light(*LIGHT_RAYS[stage.picture.surface])
        self._lamps_of_solids = self._rays_to_light(*SOLID_RAYS)

    def image(self, *state: Any) -> Points:
        """A picture (rows, columns, 3), linear from 0 to 1, of a `State`."""
        return self._traced(scenery(self.stage, State(*state)))

    def images(self, states: Iterable[State]) -> Iterator[Points]:
        """The `image` of each state in their order; surfaces of large fluids are computed in several processes."""
        return map(self._traced, sceneries(self.stage, states, self.at_once))

    def _traced(self, fluid: Scenery) -> Points:
        s, (light, corner, cell) = _surroundings(fluid.stage), fluid.shadow
        s.shadow_corner, s.shadow_cell = wp.vec3(*corner), cell
        if self._solids is not None:
            light = np.minimum(light, self._solids.shadow(fluid.stage.solids))
        shadow = wp.array(light, dtype=wp.vec3, device=self.device)
        with WARP:
            return self._rays(fluid.stage, fluid.surface, s, shadow)

    def _rays(self, stage: Stage, surface: Surface, s: Any, shadow: wp.array) -> Points:
        picture, device, eye = stage.picture, self.device, _eye(stage)
        seen = DeviceSurface.of(surface.points, surface.triangles, surface.normals, surface.colours, device)
        seen.lit.scattering, seen.lit.reach = self._scattering, 2.0 * self.stage.spacing
        seen.lit.is_flat = int(not picture.shaded)
        given, solids = {"s": s, "surface": seen.lit}, list[tuple[DeviceSurface, SolidMesh]]()
        if self._solids is not None:
            s.solids, solids = self._solids.on_device(stage.solids)
        self._illuminate(seen, self._lamps, given)
        for one, mesh in solids:
            self._illuminate(one, self._lamps_of_solids, given)
            one.lit.light.assign(mesh.smoothed(one.lit.light.numpy()))

        def rays(pixels: np.ndarray, offset: tuple[float, float]) -> wp.array:
            found = wp.zeros(len(pixels), dtype=wp.vec3, device=device)
            asked = wp.array(pixels, dtype=wp.int32, device=device)
            where = wp.vec2(*offset)
            self._launch(
                self._trace, len(pixels), **given, eye=eye, shadow=shadow, pixels=asked, offset=where, image=found
            )
            return found

        count = picture.width * picture.height
        once, mask = rays(np.arange(count), (0.0, 0.0)), wp.zeros(count, dtype=bool, device=device)
        self._launch(find_contrast, count, columns=picture.width, image=once, contrast=CONTRAST, found=mask)
        image, rough = once.numpy(), np.flatnonzero(mask.numpy())
        if len(rough):
            image[rough] = np.mean([rays(rough, offset).numpy() for offset in ROTATED_GRID], axis=0)
        return image.reshape(picture.height, picture.width, 3)

    def _illuminate(self, surface: DeviceSurface, lamps: tuple[wp.array, wp.array], given: dict[str, Any]) -> None:
        """Find the light on a surface, by rays in the directions of lamps."""
        around, in_lamp = lamps
        own = {"points": surface.mesh.points, "normals": surface.lit.normals, "light": surface.lit.light}
        how = {"reach": 0.2 * self.stage.size, "clearness": self.stage.clearness}
        count = len(surface.mesh.points)
        self._launch(self._illuminates, count, **given, **own, **how, directions=around, sun_directions=in_lamp)

    def _rays_to_light(self, around: int, lamp: int) -> tuple[wp.array, wp.array]:
        """Directions to all around, and to so many points of the lamp."""
        in_lamp = self.stage.sun + (0.16 if lamp > 1 else 0.0) * _directions(lamp)
        in_lamp /= np.linalg.norm(in_lamp, axis=1)[:, None]
        found = [wp.array(one, dtype=wp.vec3, device=self.device) for one in (_directions(around), in_lamp)]
        return found[0], found[1]

    @property
    def _scattering(self) -> float:
        return self.stage.scattering if self.stage.picture.surface == "liquid" else 1e3 / self.stage.spacing


def _directions(count: int) -> Points:
    """(count, 3) unit vectors, evenly all around: the spiral of Fibonacci."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    away = np.sqrt(1.0 - height**2)
    return np.stack([away * np.cos(turn), height, away * np.sin(turn)], axis=1)


def _surroundings(stage: Stage) -> Any:
    picture, light, s = stage.picture, stage.picture.sun_and_sky, Environment()
    horizon = np.asarray(light.background)
    s.size, s.nearest = stage.size, 1e-4 * stage.size
    s.sun, s.fill = wp.vec3(*stage.sun), wp.vec3(*stage.fill)
    s.horizon, s.zenith = wp.vec3(*horizon), wp.vec3(*(horizon * light.zenith))
    s.lamp, s.strip, s.sunlight = wp.vec3(*light.lamp), wp.vec3(*light.strip), wp.vec3(*light.sunlight)
    s.has_floor, s.floor_height = int(picture.floor), float(stage.lower[1])
    s.floor_colour = wp.vec3(*(0.93 * horizon))
    s.floor_centre = wp.vec3(*(0.5 * (stage.lower + stage.upper)))
    s.grid = _round_length(stage.size / 6.0)
    s.glass = NO_GLASS
    if stage.container.extent() is not None:
        lower, upper = stage.glass_ends
        s.glass = GLASS_BOX if stage.container.shape == "box" else GLASS_CYLINDER
        s.glass_frame = wp.mat33(*stage.glass_frame.ravel())
        s.glass_lower, s.glass_upper = wp.vec3(*lower), wp.vec3(*upper)
        lower, upper = (np.clip(end, -1e8, 1e8) for end in stage.room)
        s.room_lower, s.room_upper = wp.vec3(*lower), wp.vec3(*upper)
        s.has_room = int(stage.cuts and picture.surface == "liquid")
        s.panes = wp.mat33(*stage.panes.ravel(), 0.0, 0.0, 0.0)
    return s


def _round_length(length: float) -> float:
    """The next of 1, 2 and 5 times a power of ten below a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))


def _eye(stage: Stage) -> Any:
    picture, eye = stage.picture, Eye()
    forward = stage.look_at - stage.eye
    forward = forward / np.linalg.norm(forward)
    right, up = screen_axes(forward)
    half = np.tan(0.5 * np.radians(picture.field_of_view))
    eye.position, eye.forward = wp.vec3(*stage.eye), wp.vec3(*forward)
    eye.right, eye.up = wp.vec3(*(half * right)), wp.vec3(*(half * picture.height / picture.width * up))
    eye.columns, eye.rows = picture.width, picture.height
    return eye
