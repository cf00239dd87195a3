"""Makers of forces and solvers: what `Simulation` takes as ``forces`` and ``solver``, and the makers of those that a
scene names by their kinds, with the parameters that these bring.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from cortado.code_words import code_words
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.motions import motion_parameters, moving
from cortado.scene.parameter_values import REGISTRY, Known, checked_value
from cortado.scene.parameters import Parameter, Source
from cortado.scene.scene import Scene
from cortado.scene.solids import SolidTable
from cortado.scene.solvers import OWN, PackageSolver, SolverTable
from cortado.solvers.solver import Solver
from cortado.sph.free_energy import FreeEnergy
from cortado.sph.own_force import Rheology
from cortado.sph.parts import Force, Setting
from cortado.sph.viscosity_law import LAWS


class ForceMaker(Protocol):
    """A maker of a force for each solver of a simulation, which says which parameters the force has.

    It is pickled with the simulation. A ``fingerprint``, a text, tells it from others, so that a search is not resumed
    with another force; without one its type and its attributes do. A method ``check(values, simulation)`` raises an
    `InputError` for values of parameters, by name, with which there can be no run.
    """

    parameters: Sequence[Parameter]
    """Of the force, with names that no others have: ``drag.k`` is found by kernels as ``drag_k``. `known.TIME` is among
    them where kernels read ``time``."""

    def force(self, setting: Setting) -> Force | None:
        """Make the force in one precision and on one device; None where nothing acts."""


def checked_makers(forces: Any) -> tuple[ForceMaker, ...]:
    """Return what a user gives as ``forces`` if these are makers of forces; else raise `InputError`."""
    if not isinstance(forces, (list, tuple)):
        wanted = "a list of forces, such as [cortado.forces.Body(function, k=2.0)]"
        raise InputError(f"forces is {shown(forces)}, but must be {wanted}.")
    for k, maker in enumerate(forces):
        if isinstance(maker, type) or not callable(getattr(maker, "force", None)):
            wanted = "but each must be an object with a method force(setting), such as cortado.forces.Body(f, k=2.0)"
            raise InputError(f"forces has {shown(maker)} at place {k}, {wanted}.")
        checked_parameters("force", maker, getattr(maker, "parameters", None))
    return tuple(forces)


def checked_parameters(what: str, maker: Any, parameters: Any) -> Sequence[Parameter]:
    """Return the parameters of a maker of ``what``; raise `InputError` where they are no list of parameters."""
    if not isinstance(parameters, (list, tuple)) or not all(isinstance(p, Parameter) for p in parameters):
        wanted = "a list of cortado.scene.parameters.Parameter, which may be empty"
        raise InputError(f"the {what} {shown(maker)} has parameters {shown(parameters)}, but must have {wanted}.")
    return parameters


def known_of(forces: Sequence[ForceMaker], solver: Any = None, solids: Sequence[SolidTable] = ()) -> Known:
    """Return the parameters of a simulation with these forces, this solver's maker and these solids; raise `InputError`
    where two have one name, or replace the same force."""
    taken: dict[str, ForceMaker] = {}
    for maker in forces:
        if (place := getattr(maker, "replaces", None)) is not None and taken.setdefault(place, maker) is not maker:
            what = place.rpartition(".")[2].replace("_", " ")
            found = f"{shown(taken[place])} and {shown(maker)} both take the place of the scene's force of {what}"
            raise InputError(f"{found}, but only one can: leave out the other, in forces or as the phase's rheology.")
    own = [(parameter, "a solver") for parameter in getattr(solver, "parameters", ())]
    own += [(parameter, "a force") for maker in forces for parameter in maker.parameters]
    return Known([*own, *((parameter, "a solid") for parameter in motion_parameters(solids))])


def check_own(known: Known, source: Source) -> None:
    """Raise `InputError` where values that forces and a solver give their parameters have a shape that does not suit
    the scene."""
    for parameter in known.own:
        shapes = parameter.shapes(0, len(source.scene.phase), source.positions.shape)
        checked_value(parameter.name, parameter.value(source), shapes, known=known)


def fingerprint(makers: Sequence[Any], source: Source) -> str:
    """Return a hash of the forces or solvers of these makers, with their parameters' values; empty without any."""
    words = []
    for maker in makers:
        parameters = getattr(maker, "parameters", ())
        values = [(p.name, np.asarray(p.value(source), dtype=np.float64).tolist()) for p in parameters]
        words.append(f"{getattr(maker, 'fingerprint', None) or code_words(maker)} {values}")
    return sha256("\n".join(words).encode()).hexdigest()[:16] if words else ""


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


def checked_solver(solver: Any) -> SolverMaker:
    """Return what a user gives as ``solver`` if it is a maker of solvers; else raise `InputError`."""
    if isinstance(solver, type) or not callable(getattr(solver, "build", None)):
        wanted = "an object with a method build(setting), which returns a solver: see docs/own_parts.md"
        raise InputError(f"solver is {shown(solver)}, but must be {wanted}.")
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
