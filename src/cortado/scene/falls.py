"""How far fluid may fall: through a scene, and onto each of its solids."""

from math import inf

import numpy as np

from cortado.discretise.shapes import Points
from cortado.scene.model import SceneTables
from cortado.scene.motions import free, greatest_speed, moving, position_name, rotation_name, scale_name, told
from cortado.scene.parameters.values import Arrays
from cortado.scene.room import solids_of
from cortado.scene.solids import SolidTable


def greatest_fall(scene: SceneTables, gravity: Points) -> float:
    """What gravity (k, d) [m/s2] gives at most to fluid that falls through the whole room, per mass [J/kg]."""
    lower, upper = _extent(scene)
    return float((np.abs(gravity) @ (upper - lower)).max())


def fall_to(scene: SceneTables, solid: SolidTable, gravity: Points, values: Arrays) -> float:
    """What gravity (k, d) [m/s2] gives at most to fluid that falls to the foot of a solid from where fluid, or a free
    body, is highest at the start or comes out, per mass [J/kg], with ``values`` of parameters that replace the scene's.
    That of the `greatest_fall` where something else raises fluid or takes the solid down: where gravity changes or goes
    around a period, the solid is free, solids go along paths, convey, or begin elsewhere. What values say of each step
    of a path is not looked at."""
    whole = greatest_fall(scene, gravity)
    around = scene.container.periods(scene.dimension)[1] > 0.0
    stirred = greatest_speed(told(scene.solid), values) > 0.0 or any(one.surface_velocity for one in scene.solid)
    elsewhere = {name(one.name) for one in moving(scene.solid) for name in (position_name, rotation_name, scale_name)}
    if len(gravity) > 1 or (gravity[0] * around).any() or stirred or solid.motion == "free" or elsewhere & {*values}:
        return whole
    lower, upper = _extent(scene)
    foot = np.clip(solid.solid().extent(), lower, upper)
    highest = min((np.minimum(*(gravity[0] * np.array(ends))).sum() for ends in _begins(scene, values)), default=-inf)
    return float(np.clip(np.maximum(*(gravity[0] * foot)).sum() - highest, 0.0, whole))


def _begins(scene: SceneTables, values: Arrays) -> list[tuple[Points, Points]]:
    """The boxes around each body of fluid, each free body and the outlet: lower and upper, each (d,) [m]."""
    spacing = scene.discretisation.spacing
    places = values.get("initial_positions")
    extents = [fluid.extent(spacing) for fluid in scene.fluid]
    if places is not None and len(places):
        extents = [(places.min(axis=0), places.max(axis=0))]
    boxes = [(lower - 0.5 * spacing, upper + 0.5 * spacing) for lower, upper in extents]
    boxes += [solid.extent() for solid in solids_of(tuple(free(scene.solid)))]
    if scene.emitter is not None:
        opening = scene.emitter.opening(spacing)
        boxes.append((opening.min(axis=0), opening.max(axis=0)))
    return boxes


def _extent(scene: SceneTables) -> tuple[Points, Points]:
    """The box through which fluid may fall: lower and upper, each (d,) [m]."""
    lower, upper = _room(scene)
    if scene.emitter is None:
        return lower, upper
    return np.minimum(lower, scene.emitter.outlet), np.maximum(upper, scene.emitter.outlet)


def _room(scene: SceneTables) -> tuple[Points, Points]:
    """The box around the container, or around the fluids and the solids, which fluid falls along, if there is none, or
    around the outlet if there is only the emitter: lower and upper, each (d,) [m]."""
    ends = scene.container.extent()
    if ends is not None:
        return ends
    half = 0.5 * scene.discretisation.spacing
    fluids = np.array([fluid.extent(scene.discretisation.spacing) for fluid in scene.fluid])
    boxes = [(lower - half, upper + half) for lower, upper in fluids]
    boxes += [solid.extent() for solid in solids_of(scene.solid)]
    if scene.emitter is not None and not boxes:
        boxes = [(np.array(scene.emitter.outlet), np.array(scene.emitter.outlet))]
    lower, upper = np.swapaxes(boxes, 0, 1)
    return lower.min(axis=0), upper.max(axis=0)
