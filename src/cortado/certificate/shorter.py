"""A problem of fewer steps: as far as a copy of its run comes that loses a particle."""

from typing import Any

from cortado.losses import Frames
from cortado.problem import Problem
from cortado.scene.parameters.values import Arrays


def up_to(problem: Problem, steps: int) -> Problem | None:
    """The same problem of so many steps, at the end of which its loss is one, or that of its frames up to there; None
    where nothing is left of it."""
    loss: Any = problem.loss
    if isinstance(loss, Frames):
        kept = {step: one for step, one in loss.losses.items() if step <= steps}
        loss = Frames(kept) if kept else None
    return Problem(problem.simulation, steps, loss, problem.memory_budget) if loss is not None and steps > 0 else None


def first_rows(problem: Problem, values: Arrays, steps: int) -> Arrays:
    """Parameters of a problem as those of its first steps."""
    known = problem.simulation.known
    over_time = {name for name, value in values.items() if name in known.over_time and value.ndim > known[name].rank}
    return {name: value[:steps] if name in over_time else value for name, value in values.items()}
