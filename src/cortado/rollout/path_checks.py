"""What to say of solids that are told to go too far in a step."""

import numpy as np

from cortado.particles.state import State
from cortado.scene.motions import displacement_name, position_name, told
from cortado.scene.parameters.values import Arrays
from cortado.scene.scene import Scene

FURTHEST = 1.0
"""In spacings: solids that go further in a step pass over fluid, which is in them then."""


def jump_sentence(scene: Scene, first: State, run: Arrays) -> str | None:
    """Of the first solid that goes further than a spacing in a step, from where a first state has it, of a batch in its
    first scene, with the parameters of a run; None if there is none, or where steps are still to be chosen."""
    if scene.solver.chooses:
        return None
    spacing = scene.discretisation.spacing
    for table in told(scene.solid):
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
