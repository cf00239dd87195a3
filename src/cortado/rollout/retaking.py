"""Which steps of the projection that were chosen are taken again, shorter: those that press fluid together, or lose a
particle.

Between walls that face one another, nearer than a spacing, a pressure that is right on one side of the middle is wrong
on the other. A particle that a step takes too far goes to and fro there, and then through a wall. The state before a
step alone decides, so that a run that goes on has the steps of one that did not stop.
"""

import numpy as np
from numpy.typing import NDArray

from cortado.solvers.loop import IterationLog
from cortado.solvers.solver import Solver, StepLog

PRESSED = 0.2
"""Of the density: a step of the projection whose repairs find a particle compressed by more is taken again. In dam
breaks, with ink and with a jug that pours, they found 0.15 at most."""
SHORTER = 0.25
"""How long it is then, in parts of what it was."""
TIMES = 2
"""How often a step is taken again at most."""


class Retaken:
    """The steps of one run that were taken again."""

    def __init__(self) -> None:
        self._times: dict[tuple[int, int], int] = {}

    def found(self, solver: Solver, log: StepLog, first: int, last: int) -> list[tuple[int, int]]:
        """Of the steps between two numbers, which were taken, those to be taken again, each with its scene of a batch:
        the first of each scene, as the later ones follow from it."""
        found = compression(log, first, last)
        if found is None:
            return []
        bad, again = found > PRESSED, []
        lost = {member: one.step for member, one in solver.containment.lost().items()}
        for member in range(solver.layout.members):
            end = lost.get(member, last)
            steps = [first + int(n) for n in np.flatnonzero(bad[:, member]) if first + n < end]
            for step in (*steps, end) if first <= end < last else steps:
                times = self._times.get((step, member), 0)
                if times < TIMES:
                    self._times[step, member] = times + 1
                    again.append((step, member))
                    break
        return again


def compression(log: StepLog, first: int, last: int) -> NDArray[np.float64] | None:
    """(last - first, members) the greatest that the repairs of the projection found; None of other solvers."""
    for record in log.records if isinstance(log, IterationLog) else ():
        if record.loop.iterations_name == "repairs":
            return np.asarray(record.errors[first:last].numpy()[..., 1], dtype=np.float64)
    return None
