"""What is said of a scene that has lost a particle."""

import numpy as np

from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.solvers.containment import Lost
from cortado.solvers.solver import Solver


def diverged(solver: Solver, member: int, lost: Lost, before: State, state: State, advice: str) -> DivergedError:
    """Of one scene of a batch, given the state before the chunk of steps and the one after the step in which it lost a
    particle, and what to try."""
    containment, particle = solver.containment, member * solver.layout.particles + lost.particle
    if not np.isfinite(before.positions.numpy()[particle]).all():
        where = "had been lost in steps before these"
        return DivergedError(lost.step + 1, lost.particle, "begin that scene anew", where, lost.others)
    position = state.positions.numpy()[particle][: containment.walled.dimension]
    imprecise = ", or float64 for fluid that flies that far" if containment.is_imprecise(position) else ""
    return DivergedError(
        step=lost.step + 1,
        particle=lost.particle,
        advice=f"{advice}{imprecise}",
        where=containment.where(position),
        others=lost.others,
    )
