"""Makers of solvers: what `Simulation` takes as ``solver``, and the makers of the solver and the forces that a scene
names by their kinds, with the parameters that these bring."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.motions import moving
from cortado.scene.parameter_values import REGISTRY, Known
from cortado.scene.scene import Scene
from cortado.scene.solvers import OWN, PackageSolver, SolverTable
from cortado.solvers.solver import Solver
from cortado.sph.free_energy import FreeEnergy
from cortado.sph.makers import ForceMaker, checked_makers, checked_parameters, known_of
from cortado.sph.rheology import Rheology
from cortado.sph.viscosity_law import LAWS


@dataclass(frozen=True)
class SolverSetting:
    """The arguments from which a solver is made; `cortado.solvers.build.particle_system` makes particles of them."""

    scene: Scene
    discrete: DiscreteScene
    free_energy: FreeEnergy
    precision: Precision
    device: Any
    batch: int | None
    forces: Sequence[ForceMaker]
    """Makers of the forces that are not named in the scene."""
    known: Known
    """The parameters of the simulation, those of these forces and of the solver among them."""
    called: str
    """The name of the solver in messages."""
    lanes: int | None = None
    """Threads of a GPU that share a particle; None takes a number that suits the scene, see `cortado.device.lanes`."""


class SolverMaker(Protocol):
    """Makes the solver of a simulation that is given it, and of each that is made from it in another precision or size.

    It is pickled with the simulation, and may have, as makers of forces do, ``parameters``, which kernels find by their
    names, and a ``fingerprint``. ``batches = True`` says that its solver runs in batches.
    """

    def build(self, setting: SolverSetting) -> Solver:
        """Make the solver for a setting, in one precision and on one device."""


WANTED = "an object with a method build(setting), which returns a solver: see docs/own_parts.md"


def checked_solver(solver: Any) -> SolverMaker:
    """Return what a user gives as ``solver`` if it is a maker of solvers; else raise `InputError`."""
    if isinstance(solver, type) or not callable(getattr(solver, "build", None)):
        raise InputError(f"solver is {shown(solver)}, but must be {WANTED}.")
    checked_parameters("solver", solver, getattr(solver, "parameters", ()))
    return solver


def called(table: SolverTable, given: SolverMaker | None) -> str:
    """Return the name of a solver in messages, from the scene's table or from the maker that is given in its place."""
    return f'solver.kind "{table.kind}"' if given is None else f"the solver {type(given).__name__}"


NEEDED = ("new_parameters", "new_log", "set_substeps", "reset", "make_room", "step")
"""Methods without which a solver takes no steps."""


def built(maker: SolverMaker, setting: SolverSetting) -> Solver:
    """Let a maker build its solver; raise `InputError` where the solver does not fit the simulation."""
    if setting.batch is not None and not getattr(maker, "batches", False):
        raise InputError(f"batch is {setting.batch}, but must be left out, as {setting.called} has no batches.")
    solver = maker.build(setting)
    if not callable(getattr(solver, "new_state", None)):
        raise InputError(f"build of {setting.called} returned {shown(solver)}, but must return a solver.")
    lacking = [name for name in NEEDED if not callable(getattr(solver, name, None))]
    if lacking:
        found = f"build of {setting.called} returned {shown(solver)}, which has no {lacking[0]}"
        raise InputError(f"{found}, but must have one: see cortado.solvers.solver.Solver.")
    if setting.forces and not hasattr(solver, "forces"):
        raise InputError(f"forces is given, but must be left out, as {setting.called} takes no others.")
    return solver


MODULES = {kind: f"cortado.solvers.{kind}.solver" for kind in OWN}
"""The module of each of Cortado's own kinds of solvers, whose ``maker`` takes the table of a scene."""


def solver_named(table: SolverTable) -> SolverMaker:
    """Return the maker of the solver that the table of a scene names."""
    if isinstance(table, PackageSolver):
        return checked_solver(table.make())
    made: SolverMaker = import_module(MODULES[table.kind]).maker(table)
    return made


def forces_named(scene: Scene) -> tuple[ForceMaker, ...]:
    """Return makers of the forces that a scene names by kind: laws of viscosity and forces of installed packages."""
    laws = [
        Rheology(LAWS[phase.rheology.kind], None, **phase.rheology.numbers(phase.viscosity))
        for phase in scene.phase
        if phase.rheology is not None
    ]
    return checked_makers([*laws, *(table.make() for table in scene.force)])


def known_in(scene: Scene) -> Known:
    """Return the parameters of a scene, with those of parts of packages and of moving solids; raise `InputError` where
    two have one name."""
    own = scene.force or any(phase.rheology for phase in scene.phase) or isinstance(scene.solver, PackageSolver)
    if not (own or moving(scene.solid)):
        return REGISTRY
    return known_of(forces_named(scene), solver_named(scene.solver), scene.solid)
