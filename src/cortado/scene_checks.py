"""What must hold for a scene as a whole: names, sizes, and where the fluid is. Each check raises `wrong`."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from cortado.errors import InputError, Phrase, shown
from cortado.scene_containers import check_length
from cortado.scene_fluids import Fluid, PointsFluid
from cortado.scene_kinds import wrong
from cortado.shapes import Points

if TYPE_CHECKING:
    from cortado.scene import Scene

MOST_PARTICLES = 2e8
FURTHEST = 1e9
"""In spacings from the origin; further away, neighbours would not have distinct positions in float64."""
NEAREST = 0.5
"""In spacings: particles that start nearer to each other overlap."""


def check_scene(scene: "Scene") -> None:
    """All checks, those that guard others first."""
    spacing = scene.discretisation.spacing
    _check_phases(scene)
    _check_files(scene)
    _check_counts(scene)
    for index, fluid in enumerate(scene.fluid):
        _check_size(index, fluid, spacing)
    check_length(scene.container, spacing, scene.discretisation.support_radius)
    _check_place(scene)
    for index, fluid in enumerate(scene.fluid):
        _check_inside(scene, index, fluid)
        _check_distinct(index, fluid, spacing)
    _check_overlaps(scene)


def _check_phases(scene: "Scene") -> None:
    names = [phase.name for phase in scene.phase]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise wrong(("phase", index, "name"), name, f"different from that of phase[{names.index(name)}]")
    for index, fluid in enumerate(scene.fluid):
        if fluid.phase not in names:
            raise wrong(("fluid", index, "phase"), fluid.phase, f"the name of a phase, of {shown(names)}")
        if fluid.phase != scene.fluid[0].phase:
            wanted = f"{shown(scene.fluid[0].phase)} as for fluid[0], as only one phase in a scene is supported so far"
            raise wrong(("fluid", index, "phase"), fluid.phase, wanted)


def _check_files(scene: "Scene") -> None:
    for index, fluid in enumerate(scene.fluid):
        if isinstance(fluid, PointsFluid):
            try:
                fluid.points()
            except InputError as error:
                sentence = f"cannot be used: {error}"
                raise wrong(("fluid", index, "file"), fluid.file, "a file of positions", sentence) from None


def _check_counts(scene: "Scene") -> None:
    """Before anything is allocated."""
    spacing = scene.discretisation.spacing
    fluid, walls = sum(fluid.count(spacing) for fluid in scene.fluid), scene.container.wall_count(spacing)
    for count, what in ((fluid, "particles of fluid"), (walls, "wall particles")):
        if count > MOST_PARTICLES:
            wanted = f"so large that there are at most {MOST_PARTICLES:.0e} {what}, not about {count:.1e}"
            raise wrong(("discretisation", "spacing"), spacing, wanted)


def _check_place(scene: "Scene") -> None:
    spacing, ends = scene.discretisation.spacing, scene.container.extent()
    if ends is not None and np.abs(ends).max() > FURTHEST * spacing:
        raise wrong(("container",), Phrase(f"{np.abs(ends).max():g} m from the origin"), _nearer(spacing))


def _check_size(index: int, fluid: Fluid, spacing: float) -> None:
    if fluid.count(spacing) == 0.0:
        wanted = f"at least one spacing, {spacing:g} m, wide along every axis"
        raise wrong(("fluid", index), Phrase("too thin to hold a particle"), wanted)
    furthest = np.abs(fluid.extent(spacing)).max()
    if furthest > FURTHEST * spacing:
        raise wrong(("fluid", index), Phrase(f"{furthest:g} m from the origin"), _nearer(spacing))


def _check_inside(scene: "Scene", index: int, fluid: Fluid) -> None:
    """Containers are convex: if the corners of a box around the particles are inside, all are."""
    spacing = scene.discretisation.spacing
    if scene.container.contains(fluid.corners(spacing), 1e-6 * spacing).all():
        return
    witnesses = fluid.witnesses(spacing)
    outside = ~scene.container.contains(witnesses, 1e-6 * spacing)
    if outside.any():
        found = Phrase(f"partly outside, for example at {_place(witnesses[outside][0])}")
        raise wrong(("fluid", index), found, "inside the container")


def _check_distinct(index: int, fluid: Fluid, spacing: float) -> None:
    """The points of a file may overlap each other; those of a lattice cannot."""
    if not isinstance(fluid, PointsFluid) or fluid.count(spacing) < 2:
        return
    points = fluid.points()
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    if len(distinct) < len(points):
        raise wrong(("fluid", index), *_overlap("itself", distinct[np.argmax(counts)], spacing))
    distances = cKDTree(points).query(points, k=[2])[0].ravel()
    if distances.min() < _nearest(spacing):
        raise wrong(("fluid", index), *_overlap("itself", points[np.argmin(distances)], spacing))


def _check_overlaps(scene: "Scene") -> None:
    """Between different fluids, and between a fluid and the periodic images of all."""
    spacing = scene.discretisation.spacing
    lengths = scene.container.periods(scene.dimension)[1]
    lower, upper = np.swapaxes([fluid.extent(spacing) for fluid in scene.fluid], 0, 1)
    shifts = [np.array(s) * lengths for s in product(*[(0, -1, 1) if length else (0,) for length in lengths])]
    for second, shift in product(range(len(scene.fluid)), shifts):
        last = second + 1 if shift.any() else second
        gaps = np.maximum(lower[:last] - upper[second] - shift, lower[second] + shift - upper[:last])
        for first in np.nonzero((gaps < _nearest(spacing)).all(axis=1))[0]:
            place = _meeting(scene.fluid[first], scene.fluid[second], shift, spacing)
            if place is not None:
                raise wrong(("fluid", second), *_overlap(f"fluid[{first}]", place, spacing))


def _meeting(first: Fluid, second: Fluid, shift: Points, spacing: float) -> Points | None:
    """(d,) where a particle of the second fluid, shifted, is too near to one of the first; None if nowhere."""
    lower, upper = first.extent(spacing)
    moved = second.particles(spacing) + shift
    near = moved[((moved > lower - spacing) & (moved < upper + spacing)).all(axis=1)]
    if not len(near):
        return None
    distances = cKDTree(first.particles(spacing)).query(near)[0]
    return near[np.argmin(distances)] if distances.min() < _nearest(spacing) else None


def _overlap(other: str, place: Points, spacing: float) -> tuple[Phrase, str]:
    wanted = f"at least half a spacing, {NEAREST * spacing:g} m, from it everywhere"
    return Phrase(f"overlapping {other} at {_place(place)}"), wanted


def _nearest(spacing: float) -> float:
    return NEAREST * spacing * (1.0 - 1e-6)


def _nearer(spacing: float) -> str:
    return f"within {FURTHEST:g} spacings of {spacing:g} m"


def _place(point: Points) -> str:
    return f"({', '.join(f'{value:g}' for value in point)})"
