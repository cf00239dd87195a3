"""Pictures of fluid in 3-D, by a ray tracer on the device of the run."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.cells import cell_kernels
from cortado.device.compiling import compile_ahead
from cortado.device.precision import FLOAT32
from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.pictures.device_surface import DeviceSurface
from cortado.pictures.lighting import illuminate_kernel
from cortado.pictures.marked import list_marked, marked
from cortado.pictures.scenery import Scenery, State, scenery, still
from cortado.pictures.shadow import cast
from cortado.pictures.solid_surfaces import SolidSurfaces
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.steady import steadied
from cortado.pictures.trace import Eye, find_contrast, trace_kernel
from cortado.pictures.wetting import turn

ROTATED_GRID = ((-0.375, -0.125), (-0.125, 0.375), (0.125, -0.375), (0.375, 0.125))
"""Where in a pixel four more rays go, in pixels from its middle."""
MIDDLE = ((0.0, 0.0),)
CONTRAST = 0.03
"""Between neighbouring pixels, in linear light: above, four more rays go through both."""
TILE = 8, 4
"""Pixels that rays are sent through together."""
LIGHT_RAYS = {"liquid": (20, 4), "spheres": (10, 1)}
"""Rays that find how much light falls on a point of the surface: from all around, and from the lamp."""


SOLID_RAYS = 40, 6
"""The same for solids, which have fewer points and even sides."""


class SpacePainter:
    """Draws states of one scene of so many particles."""

    def __init__(self, stage: Stage, device: Any = "cpu"):
        self.stage, self.device = stage, wp.get_device(device)
        self._launch = BandLauncher(self.device)
        self._solids = SolidSurfaces(stage, self.device) if stage.solids else None
        kinds = self._solids.kinds if self._solids is not None else (False, False)
        self._trace, self._illuminates = trace_kernel(*kinds), illuminate_kernel(*kinds)
        self._kernels = (
            self._trace,
            self._illuminates,
            find_contrast,
            list_marked,
            turn,
            cast,
            cell_kernels(FLOAT32).count,
        )
        """One of each module that a picture needs: they are compiled side by side before the first."""
        self._lamps = self._rays_to_light(*LIGHT_RAYS[stage.picture.surface])
        self._lamps_of_solids = self._rays_to_light(*SOLID_RAYS)
        self._pixels = wp.array(_in_tiles(stage.picture.width, stage.picture.height), dtype=wp.int32, device=device)
        self._offsets = [wp.array(one, dtype=wp.vec2, device=device) for one in (MIDDLE, ROTATED_GRID)]

    def image(self, *state: Any) -> Points:
        """A picture (rows, columns, 3), linear from 0 to 1, of a `State`."""
        with WARP:
            compile_ahead(self, self.device)
            return self._rays(scenery(self.stage, State(*state), self._launch))

    def still(self, state: State) -> Any:
        """What other frames of a film need of a `State`; None where nothing is steadied. See `still`."""
        with WARP:
            compile_ahead(self, self.device)
            return still(self.stage, state, self._launch)

    def steady_image(self, state: State, own: Any, before: Sequence[Any], after: Sequence[Any]) -> Points:
        """The picture of a state as one frame of a film, in which fluid at rest is drawn at rest; see `steadied`."""
        with WARP:
            steady = steadied(own, before, after, self.stage.spacing, self._launch)
            return self._rays(scenery(self.stage, state, self._launch, steady))

    def _rays(self, fluid: Scenery) -> Points:
        stage, seen, s, solids = fluid.stage, fluid.surface, fluid.environment, list[DeviceSurface]()
        picture = stage.picture
        seen.lit.reach = 2.0 * self.stage.spacing
        seen.lit.is_flat = int(not picture.shaded)
        if self._solids is not None:
            self._solids.cast(fluid.shadow, stage.solids)
            s.solids, solids = self._solids.on_device(stage.solids)
        given = {"s": s, "surface": seen.lit}
        self._illuminate(seen, self._lamps, given)
        for one in solids:
            self._illuminate(one, self._lamps_of_solids, given)
        image = wp.empty(picture.width * picture.height, dtype=wp.vec3, device=self.device)
        given |= {"eye": _eye(stage), "shadow": fluid.shadow.light, "image": image}
        once, again = self._offsets
        self._launch(self._trace, len(image), **given, pixels=self._pixels, offsets=once)
        rough = wp.empty(len(image), dtype=wp.int32, device=self.device)
        self._launch(find_contrast, len(image), columns=picture.width, image=image, contrast=CONTRAST, found=rough)
        pixels, _ = marked(rough, self._launch)
        self._launch(self._trace, len(pixels), **given, pixels=pixels, offsets=again)
        found: Points = image.numpy().reshape(picture.height, picture.width, 3)
        return found

    def _illuminate(self, surface: DeviceSurface, lamps: tuple[wp.array, wp.array], given: dict[str, Any]) -> None:
        """Find the light on a surface, by rays in the directions of lamps."""
        around, in_lamp = lamps
        own = {"points": surface.mesh.points, "normals": surface.lit.normals, "light": surface.lit.light}
        how = {"reach": 0.2 * self.stage.size, "clearness": self.stage.clearness}
        count = len(surface.mesh.points)
        self._launch(self._illuminates, count, **given, **own, **how, directions=around, sun_directions=in_lamp)
        if surface.softened is not None:
            wp.copy(surface.lit.light, surface.softened(surface.lit.light))

    def _rays_to_light(self, around: int, lamp: int) -> tuple[wp.array, wp.array]:
        """Directions to all around, and to so many points of the lamp."""
        in_lamp = self.stage.sun + (0.16 if lamp > 1 else 0.0) * _directions(lamp)
        in_lamp /= np.linalg.norm(in_lamp, axis=1)[:, None]
        found = [wp.array(one, dtype=wp.vec3, device=self.device) for one in (_directions(around), in_lamp)]
        return found[0], found[1]


def _in_tiles(columns: int, rows: int) -> np.ndarray:
    """(pixels,) the numbers of all pixels, those of small tiles together, whose rays go nearly the same way."""
    wide, high = TILE
    row, column = np.divmod(np.arange(columns * rows), columns)
    tile = (row // high) * -(-columns // wide) + column // wide
    return np.argsort(tile, kind="stable").astype(np.int32)


def _directions(count: int) -> Points:
    """(count, 3) unit vectors, evenly all around: the spiral of Fibonacci."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    away = np.sqrt(1.0 - height**2)
    return np.stack([away * np.cos(turn), height, away * np.sin(turn)], axis=1)


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
