"""Whether a solver counts the steps that it takes."""

from cortado.errors import InputError
from cortado.solvers.solver import Solver


def require_counted(solver: Solver, step: int) -> None:
    """A solver that has taken its steps up to this one has counted each: otherwise it would take the first row of a
    parameter over time in all of them, and notice no lost particle. Raises `InputError`."""
    if (solver.step_number.numpy() != step).any():
        name = type(solver).__name__
        raise InputError(f"solver {name} has not counted its steps, but must: its step is to end with self.end_step.")
