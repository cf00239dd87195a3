"""Where the drains of a scene are, what they do, and where particles rest that they took."""

import numpy as np

from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.drain_tables import BLENDED, PRESCRIBED, BoxDrain, PlaneDrain, open_sphere
from cortado.scene.fluid_particles import drained_places
from cortado.scene.scene import Scene
from cortado.sph.drains import BALL, BOX, PLANE, Drained, Mouth, Pull


def drained_of(scene: Scene, discrete: DiscreteScene, precision: Precision) -> Drained | None:
    """Find where drains are and what they do; None for a scene without drains. Raises `InputError` where
    there is no place for what they take."""
    if not scene.drain:
        return None
    fluid, d, spacing = discrete.fluid, scene.dimension, scene.discretisation.spacing
    mouths, pulls = [], {}
    for drain in scene.drain:
        if isinstance(drain, BoxDrain):
            mouths.append(Mouth(drain.name, BOX, drain.middle(d), drain.ends(d) - drain.middle(d)))
        elif isinstance(drain, PlaneDrain):
            mouths.append(Mouth(drain.name, PLANE, np.array(drain.position), np.array([drain.direction] * 2)))
        else:
            place, inner = np.array(drain.position), drain.inner(spacing)
            mouths.append(Mouth(drain.name, BALL, place, np.zeros((2, d)), inner))
            shell = inner + PRESCRIBED * spacing
            sphere = open_sphere(scene.resting_room, place, shell)
            ends = (shell, shell + BLENDED * spacing)
            pulls[drain.name] = Pull(drain.name, ends, sphere, sphere * (shell / spacing) ** d / d)
    upstream = np.zeros(len(fluid.positions))
    if fluid.emitter is not None:
        upstream[fluid.emitted] = fluid.emitter.upstream
    places = drained_places(scene, len(upstream))
    if (furthest := np.abs(places).max() / spacing) > precision.furthest:
        raise InputError(
            f"The drains would put particles aside as far as {furthest:.3g} spacings of {spacing:g} m from the origin, "
            f"but must stay within {precision.furthest:g} in {precision.name}: take another precision."
        )
    return Drained(mouths, pulls, places, upstream, discrete.periods)
