"""Pictures of 2-D fluid on paper, with smooth edges and a little gloss."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cortado.device.threads import usable_cores
from cortado.discretise.shapes import Points, wrapped
from cortado.pictures.shown_solids import ShownSolid, extents_of_solids, shown_solids, union
from cortado.pictures.stage import fluid_extent, thinned
from cortado.pictures.tracing.space import State, mirrored
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import BoxContainer

LIGHT = (-0.45, 0.70, 0.55)
"""Direction to the lamp: right, up, and towards the viewer."""
BLUR, DROPPED, AROUND = 0.022, 0.020, 0.12
"""Softness, downward offset and greatest distance of shadows, relative to the greater side of the region."""
Layer = tuple[Points, Points]
"""Opacity (rows, columns, 1) and colours (rows, columns, 3) of one layer of a picture."""
SUPPORT = 1.3
"""Distance [spacings] from a particle at which the particle's contribution to the drawn fluid vanishes."""


def glossy(cover: Points, colour: Points, width: float, gleaming: float = 0.55) -> Points:
    """Return shaded colours (rows, columns, 3). ``cover`` (rows, columns) is the covered fraction of each pixel. The
    edge of the shape is ``width`` pixels wide."""
    from scipy.ndimage import gaussian_filter

    height = gaussian_filter(cover, width)
    height = height * height * (3.0 - 2.0 * height)
    down, right = np.gradient(height)
    steep = 1.9 * width
    normal = np.stack([-steep * right, steep * down, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lamp = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    half = lamp + (0.0, 0.0, 1.0)
    half /= np.linalg.norm(half)
    diffuse = 0.62 + 0.38 * np.clip(normal @ lamp, 0.0, 1.0) / lamp[2]
    gleam = np.clip(normal @ half, 0.0, 1.0) ** 60 - half[2] ** 60
    deep = 0.80 + 0.20 * height
    return colour * (np.minimum(diffuse, 1.12) * deep)[..., None] + gleaming * np.clip(gleam, 0.0, 1.0)[..., None]


@dataclass(frozen=True)
class PlaneStage:
    """Everything in a 2-D picture except the fluid: paper, container and solids."""

    picture: Picture
    container: BoxContainer | None
    lower: Points
    """Lower corner (2,) [m] of the container if the scene has one, else of the fluid and the solids."""
    upper: Points
    spacing: float
    solids: tuple[ShownSolid, ...] = ()
    seen: tuple[Points, Points] | None = None
    """Lower and upper corner (2,) [m] of the shown region, by default `lower` and `upper`."""

    @classmethod
    def of(cls, scene: Scene, positions: Points | Sequence[Points], poses: Iterable[Scene] = ()) -> "PlaneStage":
        container = scene.container if isinstance(scene.container, BoxContainer) else None
        spacing, solids = scene.discretisation.spacing, shown_solids(scene)
        if container is not None:
            lower, upper = (np.asarray(end) for end in container.extent())
        else:
            paper = 0.0 if any(one.is_tank for one in solids) else spacing
            solid_ends = extents_of_solids([scene, *poses])
            lower, upper = fluid_extent(thinned(positions), solid_ends)
            lower, upper = union([(lower - paper, upper + paper), *solid_ends])
        return cls(scene.picture or Picture(), container, lower, upper, spacing, solids)

    @property
    def ends(self) -> tuple[Points, Points]:
        return self.lower, self.upper

    @property
    def seen_size(self) -> Points:
        lower, upper = self.seen or self.ends
        return upper - lower

    def framed(self, ends: tuple[Points, Points], picture: Picture) -> "PlaneStage":
        return replace(self, picture=picture, seen=ends)

    @cached_property
    def pixel(self) -> float:
        """Width of a pixel [m]."""
        size = np.array([self.picture.width, self.picture.height])
        return float((self.seen_size / (0.80 * size)).max())  # of which the contents fill 0.8

    @property
    def middle(self) -> Points:
        lower, upper = self.seen or self.ends
        return 0.5 * (lower + upper)

    @cached_property
    def pixels(self) -> tuple[Points, Points]:
        """Coordinates x and y [m] of the centre of each pixel, two arrays (rows, columns)."""
        columns, rows, middle = self.picture.width, self.picture.height, self.middle
        x = middle[0] + (np.arange(columns) - 0.5 * (columns - 1)) * self.pixel
        y = middle[1] - (np.arange(rows) - 0.5 * (rows - 1)) * self.pixel
        return np.meshgrid(x, y)

    def on_screen(self, points: Points) -> Points:
        """Convert points (n, 2) [m] to pixel coordinates (n, 2): column and row in the picture."""
        off = (points - self.middle) / self.pixel
        return np.stack([0.5 * self.picture.width + off[:, 0], 0.5 * self.picture.height - off[:, 1]], axis=1)

    up_axis = 1

    @property
    def gloss_width(self) -> float:  # of the edge, in pixels
        return max(0.55 * self.spacing / self.pixel, 1.5)

    @cached_property
    def behind(self) -> Points:
        """Colours (rows, columns, 3) of paper, shadows and the inside of the container."""
        (x, y), middle, half = self.pixels, self.middle, 0.5 * self.pixel * self.picture.width
        away = ((x - middle[0]) ** 2 + (y - middle[1] - 0.2 * half) ** 2) / half**2
        paper = np.asarray(self.picture.sun_and_sky.background) * (1.12 - 0.20 * away)[..., None]
        blur, drop = BLUR * self._size, DROPPED * self._size

        def edge(distance: Points) -> Points:
            return 0.5 * (1.0 + np.tanh(distance / blur))

        shadows = [0.28 * self._below(shown) for shown, _ in self._tanks]
        if self.container is not None:
            across = edge(x - self.lower[0]) * edge(self.upper[0] - x)
            shadows.append(0.28 * across * edge(y + drop - self.lower[1]) * edge(self.upper[1] - y - drop))
        if shadows:
            outside = paper * (1.0 - np.max(shadows, axis=0) * (1.0 - self._room))[..., None]
            paper = outside + (1.0 - paper) * (0.40 * self._room)[..., None]
        for shown, _ in self._bodies:
            darker = 0.25 * (1.0 - shown.finish.transparency) * self._below(shown) * self._room
            paper = paper * (1.0 - darker)[..., None]
        return paper

    @cached_property
    def before(self) -> list[Layer]:
        layers, (x, y) = list[Layer](), self.pixels
        for shown, distance in self._bodies:
            cover = self._covered(distance)
            gleaming = 0.12 + (0.7 - 0.12) * shown.finish.reflectivity  # 0.12 of dull solids, 0.7 of mirrors
            light = glossy(np.where(self._room > 0.5, cover, 1.0), shown.colour, self.gloss_width, gleaming)
            opacity = ((1.0 - shown.finish.transparency) * cover * self._room)[..., None]
            layers.append((opacity, opacity * light))
        if self.container is not None:
            off = np.stack([x, y]) - (0.5 * (self.lower + self.upper))[:, None, None]
            beyond = np.abs(off) - (0.5 * (self.upper - self.lower))[:, None, None]
            outside = np.hypot(*np.maximum(beyond, 0.0))
            distance = np.where(outside > 0.0, outside, beyond.max(axis=0))  # from the inner side, outwards
            part: Points | float = 1.0
            for axis in (axis for axis in range(2) if self.container.periodic[axis]):
                part = part * (beyond[axis] < 0.0)
            colour = (0.40, 0.50, 0.55) if self.container.finish is None else self.container.finish.colour
            layers.append(self._walls(distance, part, np.array(colour)))
        return layers + [self._walls(distance, 1.0, shown.colour) for shown, distance in self._tanks]

    @cached_property
    def free(self) -> Points:
        """Fraction of each pixel (rows, columns) that is inside the container and outside all solids."""
        free = self._room
        for _, distance in self._bodies:
            free = free * (1.0 - self._covered(distance))
        return free

    @cached_property
    def shown(self) -> Points:
        """Fraction of each pixel (rows, columns) where fluid is drawn. Opaque solids are later drawn over the fluid."""
        return self.free if any(shown.finish.transparency > 0.0 for shown, _ in self._bodies) else self._room

    @cached_property
    def _bodies(self) -> list[tuple[ShownSolid, Points]]:
        return [(one, self._distance(one)) for one in self.solids if not one.is_tank]

    @cached_property
    def _tanks(self) -> list[tuple[ShownSolid, Points]]:
        return [(one, self._distance(one)) for one in self.solids if one.is_tank]

    def _distance(self, shown: ShownSolid, drop: float = 0.0) -> Points:
        """Return signed distances (rows, columns) [m] from a solid, measured ``drop`` [m] above the pixels."""
        (x, y), (lower, upper), margin = self.pixels, shown.body.extent(), AROUND * self._size
        columns = np.flatnonzero((x[0] > lower[0] - margin) & (x[0] < upper[0] + margin))
        rows = np.flatnonzero((y[:, 0] + drop > lower[1] - margin) & (y[:, 0] + drop < upper[1] + margin))
        found, near = np.full(x.shape, np.inf), np.ix_(rows, columns)
        points = np.stack([x[near].ravel(), y[near].ravel() + drop], axis=1)
        found[near] = shown.body.distance(points).reshape(len(rows), len(columns))
        return found

    def _covered(self, distance: Points) -> Points:
        return np.clip(0.5 - distance / self.pixel, 0.0, 1.0)

    @cached_property
    def _room(self) -> Points:
        """Fraction of each pixel (rows, columns) that is inside the container and the tanks."""
        room = np.ones(self.pixels[0].shape)
        if self.container is not None:
            x, y = self.pixels
            off = np.minimum.reduce([x - self.lower[0], self.upper[0] - x, y - self.lower[1], self.upper[1] - y])
            room = np.clip(off / self.pixel + 0.5, 0.0, 1.0)
        for _, distance in self._tanks:
            room = room * self._covered(distance)
        return room

    @property
    def _size(self) -> float:
        return float((self.upper - self.lower).max())

    def _below(self, shown: ShownSolid) -> Points:
        return 0.5 * (1.0 - np.tanh(self._distance(shown, DROPPED * self._size) / (BLUR * self._size)))

    def _walls(self, distance: Points, part: Points | float, colour: Points) -> Layer:
        """``distance`` [m] is the distance of the pixels from the inner side of the walls."""
        wall = 0.01 * self._size
        band = np.clip(distance / self.pixel + 0.5, 0.0, 1.0) * np.clip((wall - distance) / self.pixel + 0.5, 0.0, 1.0)
        shine = 1.0 - 0.35 * np.clip(distance / wall, 0.0, 1.0)
        opacity = 0.85 * (band * part)[..., None]
        return opacity, opacity * colour * shine[..., None]


@dataclass(frozen=True)
class PlanePainter:
    stage: PlaneStage

    def image(self, *state: Any) -> Points:
        positions, colours, pose = State(*state)[:3]
        if pose is not None:
            return PlanePainter(replace(self.stage, solids=shown_solids(pose))).image(positions, colours)
        cover, colour = self._fluid(*(np.asarray(one, dtype=np.float64) for one in (positions, colours)))
        stage = self.stage
        body = np.where(stage.free > 0.5, cover, 1.0)
        fluid = glossy(body, colour, stage.gloss_width) if stage.picture.shaded else colour
        alpha = (cover * stage.shown)[..., None]
        image = stage.behind * (1.0 - alpha) + fluid * alpha
        for opacity, light in stage.before:
            image = image * (1.0 - opacity) + light
        return np.clip(image, 0.0, 1.0)

    def _fluid(self, positions: Points, colours: Points) -> tuple[Points, Points]:
        """Return the opacity (rows, columns) and the colours (rows, columns, 3) of the fluid."""
        from scipy.ndimage import map_coordinates
        from scipy.spatial import cKDTree

        order = np.lexsort(positions.T)  # so that sums do not depend on the order of the particles
        positions, colours = positions[order], colours[order]
        wet, of = self._wetting(positions)
        reach, cell = 2.0 * SUPPORT * self.stage.spacing, self.stage.spacing / 4
        half = 0.5 * self.stage.pixel * np.array([self.stage.picture.width, self.stage.picture.height])
        # the grid would be as large as what is spilt comes far
        near = (np.abs(wet - self.stage.middle) <= half + 2.0 * reach).all(axis=1)
        wet, of = wet[near], of[near]
        if not len(wet):
            empty = np.zeros(self.stage.pixels[0].shape)
            return empty, np.zeros((*empty.shape, 3))
        distances, _ = cKDTree(wet).query(wet, k=24, distance_upper_bound=reach, workers=usable_cores())
        strength = np.minimum(1.0 / _weight(distances, reach).sum(axis=1), 0.8)  # 0.8 for one alone
        corner = wet.min(axis=0) - reach
        counts = np.ceil((wet.max(axis=0) + reach - corner) / cell).astype(int) + 1
        field, tinted = _splat(wet, strength, colours[of], corner, cell, counts, reach)
        x, y = self.stage.pixels
        at = [(x - corner[0]) / cell, (y - corner[1]) / cell]
        level = map_coordinates(field, at, order=3, mode="constant", cval=0.0)
        cover = np.clip(0.5 + (level - 0.5) / np.maximum(np.hypot(*np.gradient(level)), 1e-3), 0.0, 1.0)
        if (colours == colours[0]).all():
            return cover, np.broadcast_to(colours[0], (*cover.shape, 3))
        colour = np.stack([map_coordinates(tinted[k], at, order=1, mode="nearest") for k in range(3)], axis=-1)
        return cover, np.clip(colour, 0.0, 1.0)

    def _wetting(self, positions: Points) -> tuple[Points, np.ndarray]:
        """Return positions (m, 2) [m] of particles and their mirror images, and the particle of each position."""
        stage, of, reach = self.stage, np.arange(len(positions)), 0.9 * self.stage.spacing
        lengths = np.zeros(2) if stage.container is None else stage.container.periods(2)[1]
        positions = stage.lower + wrapped(positions - stage.lower, lengths)
        if stage.solids:
            behind, of_those = mirrored(positions, stage.solids, reach, stage.spacing)
            positions, of = np.concatenate([positions, behind]), np.concatenate([of, of_those])
        for axis in range(2 if stage.container is not None else 0):
            for place, way in ((stage.lower[axis], lengths[axis]), (stage.upper[axis], -lengths[axis])):
                near = np.abs(positions[:, axis] - place) < (2.0 * SUPPORT * stage.spacing if way else reach)
                behind = positions[near].copy()
                behind[:, axis] = behind[:, axis] + way if way else 2.0 * place - behind[:, axis]
                positions, of = np.concatenate([positions, behind]), np.concatenate([of, of[near]])
        return positions, of


def _weight(distances: Points, reach: float) -> Points:
    """Return Wendland's C2 function, which falls from 1 at distance 0 to 0 at the distance ``reach``."""
    q = np.minimum(distances / reach, 1.0)
    return (1.0 - q) ** 4 * (1.0 + 4.0 * q)


def _splat(
    positions: Points, strength: Points, colours: Points, corner: Points, cell: float, counts: np.ndarray, reach: float
) -> tuple[Points, Points]:
    """Return the density of fluid at nodes (nx, ny), and the mean colour of near particles (3, nx, ny)."""
    patch = np.arange(-int(reach / cell) - 1, int(reach / cell) + 2)
    nearest = np.rint((positions - corner) / cell).astype(int)
    size = int(np.prod(counts))
    field, close, tinted = np.zeros(size), np.zeros(size), np.zeros((3, size))
    for i in patch:
        for j in patch:
            node = nearest + (i, j)
            distance = np.linalg.norm(corner + node * cell - positions, axis=1)
            on = (distance < reach) & (node >= 0).all(axis=1) & (node < counts).all(axis=1)
            flat, weight = node[on, 0] * counts[1] + node[on, 1], _weight(distance[on], reach)
            field += np.bincount(flat, weight * strength[on], minlength=size)
            near = weight**4 + 1e-9 * weight
            close += np.bincount(flat, near, minlength=size)
            for k in range(3):
                tinted[k] += np.bincount(flat, near * colours[on, k], minlength=size)
    return field.reshape(counts), (tinted / np.maximum(close, 1e-30)).reshape(3, *counts)
