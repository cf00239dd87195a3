"""When an emitter has given all that it has, and what to say of a run that goes on after that."""

import numpy as np

from cortado.rollout.rollout import Rollout
from cortado.scene.scene import Scene

SAME = 1e-6
"""Relative: what lacks so little is enough."""


def dry_sentence(scene: Scene, rollout: Rollout) -> str | None:
    """Of a run whose emitter gives all that it has before the end; None of others. Where steps are chosen, the end is
    known once they are taken."""
    emitter, spacing, clock = scene.emitter, scene.discretisation.spacing, rollout.clocks[0]
    if emitter is None:
        return None
    flow_rate, size = float(np.max(rollout.parameters["flow_rate"].numpy())), float(rollout.time_steps.max())
    end = clock.after(rollout.taken if scene.solver.chooses else rollout.steps, size).time
    emitted = float(np.max(rollout.initial["emitted"].numpy()))
    speed = max(emitter.speed(spacing) * flow_rate / emitter.flow_rate, 1e-30)
    left = max(emitter.supply(spacing) * spacing - emitted, 0.0) / speed
    if clock.time + left >= end * (1.0 - SAME):
        return None
    advice = f"scene.lasting({end:.4g}) has more in reserve, as has a scene with emitter.duration"
    if emitter.duration is not None or scene.lasting(end) is scene:
        advice = f"a longer emitter.{'length' if emitter.duration is None else 'duration'} gives it more"
    return f"the emitter runs dry at {clock.time + left:.4g} s of a run to {end:.4g} s, as all of it is out: {advice}."
