"""What to say of solids that are told to go too far in a step, or to be too large or too small."""

from collections.abc import Mapping

import numpy as np

from cortado.particles.state import State
from cortado.rollout.travel import Travel, moved_by
from cortado.scene.discrete_scene import WHOLE
from cortado.scene.motions import displacement_name, position_name, scale_name, told
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Changing
from cortado.scene.scene import Scene

FURTHEST = 1.0
"""In spacings: solids that go further in a step pass over fluid, which is in them then."""
SCALES = (0.6, 1.5)
"""Between which wall particles hold fluid as they should: twice as large, a disc lets it in by 0.8 spacings."""


def path_sentence(
    scene: Scene, first: State, values: Arrays, run: Arrays, courses: Mapping[str, Changing]
) -> str | None:
    """One of those below, with the parameters that were given, all that steps take, and what changes by the time; None
    if there is none."""
    leap = leap_sentence(scene, values, courses) if scene.solver.chooses else None
    return stretch_sentence(scene, values) or leap or jump_sentence(scene, first, run, courses)


def leap_sentence(scene: Scene, values: Arrays, courses: Mapping[str, Changing]) -> str | None:
    """Of the first path that goes further than a spacing in the shortest step that is chosen for it; None if there is
    none."""
    spacing = scene.discretisation.spacing
    for what, moved in moved_by(scene, values, courses).items():
        travel = Travel.of(scene, values, [moved])
        sizes = travel.at(travel.times + travel.least) - travel.lengths
        if sizes.max() > FURTHEST * spacing * (1.0 + 1e-6):
            time, size = travel.times[sizes.argmax()], sizes.max()
            return (
                f"{what} goes {size:.3g} m in {travel.least:.2g} s, the shortest step there is, at {time:g} s, which "
                f"is further than a spacing, {spacing:g} m: fluid is left behind in it. Give it more time."
            )
    return None


def jump_sentence(scene: Scene, first: State, run: Arrays, courses: Mapping[str, Changing]) -> str | None:
    """Of the first solid that goes further than a spacing in a step, from where a first state has it, of a batch in its
    first scene, with the parameters of a run; None if there is none. Where steps are still to be chosen, those count
    that are told step by step, and have no course."""
    spacing = scene.discretisation.spacing
    for table in told(scene.solid):
        if scene.solver.chooses and displacement_name(table.name) in courses:
            continue
        position = position_name(table.name)
        begun = first.numpy(scene.dimension, only=[position])[position].reshape(-1, scene.dimension)[:1]
        places = np.concatenate([begun, run[position] + run[displacement_name(table.name)]])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        if len(steps) and steps.max() > FURTHEST * spacing * (1.0 + 1e-6):
            number, size = int(steps.argmax()) + 1, steps.max()
            return (
                f"the solid {table.name!r} goes {size:.3g} m in step {number} of this run, which is further than a "
                f"spacing, {spacing:g} m: fluid is left behind in it. A displacement begins near 0, and a run that "
                f"goes on from a state is given {position} as the first one was."
            )
    return None


def stretch_sentence(scene: Scene, values: Arrays) -> str | None:
    """Of the first solid whose scale, among the parameters of a run, is too far from 1 for its walls, makes it reach
    over fluid that the scene puts beside it, or lets it fill a period no more; None if there is none."""
    spacing, periods = scene.discretisation.spacing, scene.container.periods(scene.dimension)[1]
    for table in told(scene.solid):
        scale = float(values.get(scale_name(table.name), 1.0))
        if scale == 1.0:
            continue
        start = f"the solid {table.name!r} is {scale:.4g} times as large as in the scene"
        least, most = SCALES
        if not least <= scale <= most:
            return f"{start}, but its walls hold for {least:g} to {most:g} times: give it another size there."
        size = float(np.ptp(table.shape_about()[0].extent(), axis=0).max())
        grown = 0.5 * size * (1.0 - scale if table.side == "inside" else scale - 1.0)
        if grown > FURTHEST * spacing and "initial_positions" not in values:
            return f"{start} and reaches {grown:.3g} m, more than a spacing, over what may be fluid there."
        lower, upper = table.solid().extent()
        if ((periods > 0.0) & (upper - lower > periods * (1.0 - WHOLE))).any():
            return f"{start}, so that it does not fill a period of the container, as it does there."
    return None
