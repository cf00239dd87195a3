"""What makes the solver and the forces that a scene names by their kinds, and the parameters that these bring."""

from importlib import import_module

from cortado.scene.motions import moving
from cortado.scene.parameters.known import REGISTRY, Known
from cortado.scene.scene import Scene
from cortado.scene.solvers import OWN, PackageSolver, SolverTable
from cortado.solvers.makers import SolverMaker, checked_solver
from cortado.sph.laws import LAWS
from cortado.sph.makers import ForceMaker, checked_makers, known_of
from cortado.sph.rheology import Rheology

MODULES = {kind: f"cortado.solvers.{kind}.build" for kind in OWN}
"""By the kind of Cortado's own, the module whose ``maker`` takes the table."""


def solver_named(table: SolverTable) -> SolverMaker:
    """What builds the solver of a scene with this table."""
    if isinstance(table, PackageSolver):
        return checked_solver(table.make())
    made: SolverMaker = import_module(MODULES[table.kind]).maker(table)
    return made


def forces_named(scene: Scene) -> tuple[ForceMaker, ...]:
    """What makes the forces that a scene names by their kinds: laws of viscosity, and those of installed packages."""
    laws = [
        Rheology(LAWS[phase.rheology.kind], None, **phase.rheology.numbers(phase.viscosity))
        for phase in scene.phase
        if phase.rheology is not None
    ]
    return checked_makers([*laws, *(table.make() for table in scene.force)])


def known_in(scene: Scene) -> Known:
    """The parameters of a scene by itself, those of parts of packages and of solids that move among them; raises
    `InputError` where two of them have one name."""
    own = scene.force or any(phase.rheology for phase in scene.phase) or isinstance(scene.solver, PackageSolver)
    if not (own or moving(scene.solid)):
        return REGISTRY
    return known_of(forces_named(scene), solver_named(scene.solver), scene.solid)
