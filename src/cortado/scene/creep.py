"""How fast a fluid creeps that does not yield, as its yield stress is made smooth: said where a scene has one."""

import numpy as np

from cortado.scene.model import SceneTables
from cortado.scene.rheology import Yielding
from cortado.scene.stability import fluid_lengths


def creep_sentence(scene: SceneTables) -> str | None:
    """None for a scene without a yield stress, or without fluid at the start.

    A film of depth H whose stress at the wall is a part r <= 1 of the yield stress has at its surface the speed
    (H / m) (1 + (1 - r) ln(1 - r) / r), where the shear rate at each height is -ln(1 - stress / yield stress) / m: at
    most H / m, with the ``regularisation`` m.
    """
    phase, law = scene.phase[0], scene.phase[0].rheology
    if not isinstance(law, Yielding) or law.yield_stress == 0.0 or not scene.fluid:
        return None
    lengths, pull = fluid_lengths(scene), np.abs(scene.forces.gravity)
    depth = lengths[pull.argmax()] if pull.any() else lengths.max()
    growth = law.numbers(phase.viscosity)["regularisation"]
    return (
        f"where {phase.name} does not yield, below {law.yield_stress:g} Pa, it creeps, at up to "
        f"{depth / growth:.2g} m/s: its depth, {depth:g} m, over rheology.regularisation, "
        f"{growth:g} s; a longer one makes it slower."
    )
