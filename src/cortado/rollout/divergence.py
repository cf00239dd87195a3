"""The error of a run that has lost a particle: where it was lost, and what may help."""

from collections.abc import Sequence

import numpy as np

from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.solvers.containment import Lost, shut_in
from cortado.solvers.solver import Solver

AROUND = 6.0
"""Distance, in spacings, around a lost particle's last position within which causes are sought."""


def diverged(solver: Solver, member: int, lost: Lost, known: Sequence[State], advice: str) -> DivergedError:
    """Return the error for a scene of a batch that lost a particle, given at least two states up to the failed step,
    and advice."""
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
