"""Emitters and drains as the parts of a step know them, and where particles rest that they hold."""

import numpy as np

from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.drain_tables import BLENDED, PRESCRIBED, BoxDrain, PlaneDrain, open_sphere
from cortado.scene.scene import Scene
from cortado.sph.drains import BALL, BOX, PLANE, Drained, Mouth, Pull
from cortado.sph.emitter import Nozzle


def nozzles_of(scene: Scene, discrete: DiscreteScene) -> list[Nozzle]:
    """Return the emitters of a scene with their particles."""
    spacing, names = scene.discretisation.spacing, [None, *(drain.name for drain in scene.drain)]
    return [
        Nozzle(
            name=emitter.name,
            first=first,
            sample=sample,
            direction=np.array(emitter.direction),
            area=emitter.area(spacing),
            places=discrete.fluid.places,
            feeding=np.array([name in emitter.fed_by for name in names]),
        )
        for emitter, (_, first, sample) in zip(scene.emitter, discrete.fluid.emitters, strict=True)
    ]


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
            pulls[drain.name] = Pull(ends, sphere, sphere * (shell / spacing) ** d / d)
    if (furthest := np.abs(fluid.places).max() / spacing) > precision.furthest:
        raise InputError(
            f"The drains would put particles aside as far as {furthest:.3g} spacings of {spacing:g} m from the origin, "
            f"but must stay within {precision.furthest:g} in {precision.name}: take another precision."
        )
    return Drained(mouths, pulls, fluid.places, nozzles_of(scene, discrete), discrete.periods)
