"""What builds the solver that a scene names in ``solver.kind``."""

from importlib import import_module

from cortado.scene.solvers import PackageSolver, Solver
from cortado.solvers.makers import SolverMaker, checked_solver

MODULES = {"pcisph": "cortado.solvers.pcisph.build"}
"""By the kind of Cortado's own, the module whose ``maker`` takes the table."""


def solver_named(table: Solver) -> SolverMaker:
    """What builds the solver of a scene with this table."""
    if isinstance(table, PackageSolver):
        return checked_solver(table.make())
    made: SolverMaker = import_module(MODULES[table.kind]).maker(table)
    return made
