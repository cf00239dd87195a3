"""Pictures of fluid in 2-D: a body with a smooth edge and a little gloss, in its container, on paper."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cortado.device.cores import usable_cores
from cortado.discretise.pairs import wrapped
from cortado.discretise.shapes import Points
from cortado.pictures.gloss import glossy
from cortado.pictures.mirrored import mirrored
from cortado.pictures.plane_stage import PlaneStage
from cortado.pictures.scenery import State
from cortado.pictures.shown_solids import shown_solids

SUPPORT = 1.3
"""In spacings: how far a particle is felt."""
DROP = 0.8
"""How strongly a particle is felt that is alone: a drop about as large as a spacing."""
GRID = 4
"""Nodes of the field for each spacing, along an axis."""
TOUCHING = 0.9
"""In spacings: fluid that is nearer to a wall touches it."""


@dataclass(frozen=True)
class PlanePainter:
    """Draws states of one scene."""

    stage: PlaneStage

    def image(self, *state: Any) -> Points:
        """A picture (rows, columns, 3), linear from 0 to 1, of a `State`."""
        positions, colours, pose = State(*state)[:3]
        own = self if pose is None else PlanePainter(replace(self.stage, solids=shown_solids(pose)))
        return own._drawn(np.asarray(positions, dtype=np.float64), np.asarray(colours, dtype=np.float64))

    def _drawn(self, positions: Points, colours: Points) -> Points:
        """The picture with the solids where the stage has them."""
        stage, (cover, colour) = self.stage, self._fluid(positions, colours)
        body, width = np.where(stage.free > 0.5, cover, 1.0), stage.gloss_width
        fluid = glossy(body, colour, width) if stage.picture.shaded else colour
        alpha = (cover * stage.shown)[..., None]
        image = stage.behind * (1.0 - alpha) + fluid * alpha
        for opacity, light in stage.before:
            image = image * (1.0 - opacity) + light
        return np.clip(image, 0.0, 1.0)

    def _fluid(self, positions: Points, colours: Points) -> tuple[Points, Points]:
        """(rows, columns) the part of each pixel that fluid covers, and its colour (rows, columns, 3)."""
        from scipy.ndimage import map_coordinates
        from scipy.spatial import cKDTree

        order = np.lexsort(positions.T)  # so that sums do not depend on the order of the particles
        positions, colours = positions[order], colours[order]
        wet, of = self._wetting(positions)
        reach, cell = 2.0 * SUPPORT * self.stage.spacing, self.stage.spacing / GRID
        near = self.stage.is_near(wet, 2.0 * reach)  # the grid would be as large as what is spilt comes far
        wet, of = wet[near], of[near]
        if not len(wet):
            empty = np.zeros(self.stage.pixels[0].shape)
            return empty, np.zeros((*empty.shape, 3))
        wet_tree = cKDTree(wet)
        own = _weight(_distances(wet_tree, wet, reach), reach)
        strength = np.minimum(1.0 / own.sum(axis=1), DROP)
        corner = wet.min(axis=0) - reach
        counts = np.ceil((wet.max(axis=0) + reach - corner) / cell).astype(int) + 1
        field, tinted = _splat(wet, strength, colours[of], corner, cell, counts, reach)
        x, y = self.stage.pixels
        at = [(x - corner[0]) / cell, (y - corner[1]) / cell]
        level = map_coordinates(field, at, order=3, mode="constant", cval=0.0)
        slope = np.hypot(*np.gradient(level))
        cover = np.clip(0.5 + (level - 0.5) / np.maximum(slope, 1e-3), 0.0, 1.0)
        if (colours == colours[0]).all():
            return cover, np.broadcast_to(colours[0], (*cover.shape, 3))
        colour = np.stack([map_coordinates(tinted[k], at, order=1, mode="nearest") for k in range(3)], axis=-1)
        return cover, np.clip(colour, 0.0, 1.0)

    def _wetting(self, positions: Points) -> tuple[Points, np.ndarray]:
        """Positions (n, 2), their mirror images behind walls that they touch and images a period away, and which
        particle each shows."""
        stage, of, reach = self.stage, np.arange(len(positions)), TOUCHING * self.stage.spacing
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
