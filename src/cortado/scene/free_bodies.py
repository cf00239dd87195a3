"""What bodies that are free need of a scene, and where they may begin."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.errors import Words
from cortado.scene.fields import field_error
from cortado.scene.model import SceneTables
from cortado.scene.motions import free
from cortado.scene.sentences import point_in_words

DEEPEST = 0.25
"""In spacings: how deep bodies may begin in walls and in each other."""
FINE, MOST = 0.5, 40
"""In spacings: how far apart the points are by which a body is looked at, of which there are at most so many along an
axis."""


def check_free(scene: SceneTables) -> None:
    """Bodies are moved by the projection alone, and begin outside of walls and of each other."""
    bodies = free(scene.solid)
    if not bodies:
        return
    if scene.solver.kind != "projection":
        wanted = (
            f'"projection", as the solid {bodies[0].name!r} is free, and pressures that are not shared with it move it'
        )
        raise field_error(("solver", "kind"), scene.solver.kind, wanted)
    if not scene.forces.pressure:
        raise field_error(("forces", "pressure"), False, f"true, as the solid {bodies[0].name!r} is free")
    spacing, lengths = scene.discretisation.spacing, scene.container.periods(scene.dimension)[1]
    region = scene.container.region(scene.dimension).opened(lengths)
    for index, table in enumerate(scene.solid):
        if table.motion != "free":
            continue
        points = _within(table.solid(), FINE * spacing)
        depths = [("the container", region.distance(points))]
        for other in scene.solid:
            if other is not table:
                near = _near(points, np.mean(other.solid().extent(), axis=0), lengths)
                depths.append((f"the solid {other.name!r}", -other.solid().distance(near)))
        for name, depth in depths:
            if depth.max() > DEEPEST * spacing:
                place = point_in_words(points[depth.argmax()])
                wanted = f"at most a quarter of a spacing, {DEEPEST * spacing:g} m, in it"
                raise field_error(("solid", index), Words(f"{depth.max():g} m deep in {name} at {place}"), wanted)


def _near(points: Points, middle: Points, lengths: Points) -> Points:
    """The images of points (n, d) that are nearest to a middle (d,), for periods (d,), 0 along axes without one."""
    periods = np.where(lengths > 0.0, lengths, np.inf)
    return points - np.where(lengths > 0.0, lengths * np.round((points - middle) / periods), 0.0)


def _within(solid: Solid, step: float) -> Points:
    """(n, d) the corners of a solid, and points of a lattice in it."""
    sides = [np.linspace(a, b, min(int((b - a) / step) + 2, MOST)) for a, b in zip(*solid.extent(), strict=True)]
    points = np.stack([axis.ravel() for axis in np.meshgrid(*sides, indexing="ij")], axis=-1)
    return np.concatenate([solid.faces(step).vertices, points[solid.distance(points) < 0.0]])
