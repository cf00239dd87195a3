"""Pictures of fluid in 2-D: a body with a smooth edge and a little gloss, in its container, on paper."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import starmap
from typing import ClassVar

import numpy as np

from cortado.device.cores import usable_cores
from cortado.discretise.shapes import Points
from cortado.pictures.scenery import State
from cortado.scene.containers import BoxContainer
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene

FILLED = 0.80
"""The part of the picture's width or height that the container takes."""
SUPPORT = 1.3
"""In spacings: how far a particle is felt."""
DROP = 0.8
"""How strongly a particle is felt that is alone: a drop about as large as a spacing."""
GRID = 4
"""Nodes of the field for each spacing, along an axis."""
TOUCHING = 0.9
"""In spacings: fluid that is nearer to a wall touches it."""
LIGHT = (-0.45, 0.70, 0.55)
"""Towards the lamp: to the right, up, towards the viewer."""


@dataclass(frozen=True)
class PlanePainter:
    """Draws states of one scene: `image` and `images`."""

    picture: Picture
    container: BoxContainer | None
    lower: Points
    """(2,) of what is shown [m]"""
    upper: Points
    """(2,) [m]"""
    spacing: float
    """[m]"""
    at_once: ClassVar[int] = 1

    @classmethod
    def of(cls, scene: Scene, lower: Points, upper: Points) -> "PlanePainter":
        """That of a scene in 2-D, the fluid of which is between lower and upper (2,) [m]."""
        container = scene.container if isinstance(scene.container, BoxContainer) else None
        if container is not None:
            lower, upper = (np.asarray(end) for end in container.extent())
        else:
            lower, upper = lower - scene.discretisation.spacing, upper + scene.discretisation.spacing
        return cls(scene.picture or Picture(), container, lower, upper, scene.discretisation.spacing)

    @property
    def pixel(self) -> float:
        """The width of a pixel [m]."""
        size = np.array([self.picture.width, self.picture.height])
        return float(((self.upper - self.lower) / (FILLED * size)).max())

    def image(self, positions: Points, colours: Points) -> Points:
        """A picture (rows, columns, 3), linear from 0 to 1: particles at positions (n, 2) [m] with colours (n, 3)."""
        cover, colour = self._fluid(np.asarray(positions, dtype=np.float64), np.asarray(colours, dtype=np.float64))
        if self.container is None:
            fluid, alpha = self._glossy(cover, colour), cover[..., None]
        else:
            fluid, alpha = self._glossy(np.where(self._room > 0.5, cover, 1.0), colour), (cover * self._room)[..., None]
        image = self._behind * (1.0 - alpha) + fluid * alpha
        if self.container is not None:
            opacity, glass = self._glass
            image = image * (1.0 - opacity) + glass
        return np.clip(image, 0.0, 1.0)

    def images(self, states: Iterable[State]) -> Iterator[Points]:
        """The `image` of each state in their order."""
        return starmap(self.image, states)

    @cached_property
    def _pixels(self) -> tuple[Points, Points]:
        """(rows, columns) where the middle of each pixel is [m]: x, and y."""
        columns, rows, middle = self.picture.width, self.picture.height, 0.5 * (self.lower + self.upper)
        x = middle[0] + (np.arange(columns) - 0.5 * (columns - 1)) * self.pixel
        y = middle[1] - (np.arange(rows) - 0.5 * (rows - 1)) * self.pixel
        return np.meshgrid(x, y)

    @cached_property
    def _behind(self) -> Points:
        """(rows, columns, 3) what is behind the fluid: the paper, the container's shadow on it, and its inside."""
        if self.container is None:
            return self._paper()
        room, paper = self._room, self._paper()
        outside = paper * (1.0 - self._shadow() * (1.0 - room))[..., None]
        return outside + (1.0 - paper) * (0.40 * room)[..., None]

    def _paper(self) -> Points:
        """The background, a little brighter in the middle and darker in the corners."""
        x, y = self._pixels
        middle, half = 0.5 * (self.lower + self.upper), 0.5 * self.pixel * self.picture.width
        away = ((x - middle[0]) ** 2 + (y - middle[1] - 0.2 * half) ** 2) / half**2
        return np.asarray(self.picture.background) * (1.12 - 0.20 * away)[..., None]

    @cached_property
    def _room(self) -> Points:
        """(rows, columns) the part of each pixel that is within the container."""
        x, y = self._pixels
        off = np.minimum.reduce([x - self.lower[0], self.upper[0] - x, y - self.lower[1], self.upper[1] - y])
        return np.clip(off / self.pixel + 0.5, 0.0, 1.0)

    @property
    def _wall(self) -> float:
        """How thick the walls are drawn [m]."""
        return 0.010 * float((self.upper - self.lower).max())

    def _shadow(self) -> Points:
        """(rows, columns) how much darker the paper is behind the container."""
        x, y = self._pixels
        size = float((self.upper - self.lower).max())
        blur, drop = 0.022 * size, 0.020 * size

        def edge(distance: Points) -> Points:
            return 0.5 * (1.0 + np.tanh(distance / blur))

        across = edge(x - self.lower[0]) * edge(self.upper[0] - x)
        return 0.28 * across * edge(y + drop - self.lower[1]) * edge(self.upper[1] - y - drop)

    def _fluid(self, positions: Points, colours: Points) -> tuple[Points, Points]:
        """(rows, columns) the part of each pixel that fluid covers, and its colour (rows, columns, 3)."""
        from scipy.ndimage import map_coordinates
        from scipy.spatial import cKDTree

        order = np.lexsort(positions.T)  # so that sums do not depend on the order of the particles
        positions, colours = positions[order], colours[order]
        wet, of = self._wetting(positions)
        reach, cell = 2.0 * SUPPORT * self.spacing, self.spacing / GRID
        wet_tree = cKDTree(wet)
        own = _weight(_distances(wet_tree, wet, reach), reach)
        strength = np.minimum(1.0 / own.sum(axis=1), DROP)
        corner = wet.min(axis=0) - reach
        counts = np.ceil((wet.max(axis=0) + reach - corner) / cell).astype(int) + 1
        field, tinted = _splat(wet, strength, colours[of], corner, cell, counts, reach)
        x, y = self._pixels
        at = [(x - corner[0]) / cell, (y - corner[1]) / cell]
        level = map_coordinates(field, at, order=3, mode="constant", cval=0.0)
        slope = np.hypot(*np.gradient(level))
        cover = np.clip(0.5 + (level - 0.5) / np.maximum(slope, 1e-3), 0.0, 1.0)
        if (colours == colours[0]).all():
            return cover, np.broadcast_to(colours[0], (*cover.shape, 3))
        colour = np.stack([map_coordinates(tinted[k], at, order=1, mode="nearest") for k in range(3)], axis=-1)
        return cover, np.clip(colour, 0.0, 1.0)

    def _wetting(self, positions: Points) -> tuple[Points, np.ndarray]:
        """Positions (n, 2) and their mirror images behind walls that they touch, and which particle each shows."""
        of = np.arange(len(positions))
        if self.container is None:
            return positions, of
        for axis in range(2):
            for place in (self.lower[axis], self.upper[axis]):
                near = np.abs(positions[:, axis] - place) < TOUCHING * self.spacing
                behind = positions[near].copy()
                behind[:, axis] = 2.0 * place - behind[:, axis]
                positions, of = np.concatenate([positions, behind]), np.concatenate([of, of[near]])
        return positions, of

    def _glossy(self, cover: Points, colour: Points) -> Points:
        """The fluid as if it were thicker in the middle than at its edge, under a lamp."""
        from scipy.ndimage import gaussian_filter

        width = max(0.55 * self.spacing / self.pixel, 1.5)
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
        return colour * (np.minimum(diffuse, 1.12) * deep)[..., None] + 0.55 * np.clip(gleam, 0.0, 1.0)[..., None]

    @cached_property
    def _glass(self) -> tuple[Points, Points]:
        """The walls of the container: how much they hide of what is behind them (rows, columns, 1), and what they add
        (rows, columns, 3)."""
        assert self.container is not None
        x, y = self._pixels
        wall, half = self._wall, 0.5 * (self.upper - self.lower)
        off = np.stack([x, y]) - (0.5 * (self.lower + self.upper))[:, None, None]
        beyond = np.abs(off) - half[:, None, None]
        outside = np.hypot(*np.maximum(beyond, 0.0))
        distance = np.where(outside > 0.0, outside, beyond.max(axis=0))  # from the inner side, outwards
        band = np.clip(distance / self.pixel + 0.5, 0.0, 1.0) * np.clip((wall - distance) / self.pixel + 0.5, 0.0, 1.0)
        for axis in range(2):
            if self.container.periodic[axis]:
                band = band * (beyond[axis] < 0.0)
        shine = 1.0 - 0.35 * np.clip(distance / wall, 0.0, 1.0)
        opacity = 0.85 * band[..., None]
        return opacity, opacity * np.array([0.40, 0.50, 0.55]) * shine[..., None]


def _distances(tree: object, points: Points, reach: float) -> Points:
    """(p, k) [m] to the nearest particles; infinite where there are fewer within reach."""
    distances, _ = tree.query(points, k=24, distance_upper_bound=reach, workers=usable_cores())  # type: ignore[attr-defined]
    return distances


def _weight(distances: Points, reach: float) -> Points:
    """Wendland's C2 function, 1 at 0."""
    q = np.minimum(distances / reach, 1.0)
    return (1.0 - q) ** 4 * (1.0 + 4.0 * q)


def _splat(
    positions: Points, strength: Points, colours: Points, corner: Points, cell: float, counts: np.ndarray, reach: float
) -> tuple[Points, Points]:
    """At nodes (nx, ny): the sum of what is felt of all particles, and the mean of their colours (3, nx, ny), of which
    near ones count most."""
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
