"""Which solver a scene names in ``solver.kind``."""

from importlib import import_module

from cortado.scene.model import Solver
from cortado.solvers.makers import SolverMaker

MODULES = {"pcisph": "cortado.solvers.pcisph.build"}
"""By the kind of Cortado's own, the module whose ``maker`` takes the table and makes what builds them."""


def solver_named(table: Solver) -> SolverMaker:
    """What builds the solver of a scene with this table."""
    made: SolverMaker = import_module(MODULES[table.kind]).maker(table)
    return made
