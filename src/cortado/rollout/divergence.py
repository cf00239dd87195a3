"""What is said of a scene that has lost a particle."""

from collections.abc import Sequence

import numpy as np

from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.solvers.containment import Lost
from cortado.solvers.narrows import shut_in
from cortado.solvers.solver import Solver

AROUND = 6.0
"""In spacings: how far from where a particle was before a step something may be that it was lost by."""


def diverged(solver: Solver, member: int, lost: Lost, known: Sequence[State], advice: str) -> DivergedError:
    """Of one scene of a batch, given states up to the one after the step in which it lost a particle, at least two, and
    what to try."""
    containment, particles = solver.containment, solver.layout.particles
    spacing, d = containment.walled.spacing, containment.walled.dimension
    own = slice(member * particles, (member + 1) * particles)
    first, was, after = (known[k].positions.numpy()[own, :d] for k in (0, -2, -1))
    if not np.isfinite(was[lost.particle]).all():
        where = "had been lost in steps before these"
        return DivergedError(lost.step + 1, lost.particle, "begin that scene anew", where, lost.others)
    position, places = after[lost.particle], np.concatenate([first, was])
    if not lost.others:
        places = places[np.linalg.norm(places - was[lost.particle], axis=1) < AROUND * spacing]
    if narrow := shut_in(containment, member, places):
        advice = f"{narrow}, or {advice}"
    return DivergedError(
        step=lost.step + 1,
        particle=lost.particle,
        advice=f"{advice}, or float64 for fluid that flies that far" if containment.is_imprecise(position) else advice,
        where=containment.where(position),
        others=lost.others,
    )
