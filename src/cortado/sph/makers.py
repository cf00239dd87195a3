"""Forces from outside: what `Simulation` takes in ``forces``."""

from collections.abc import Sequence
from hashlib import sha256
from typing import Any, Protocol

import numpy as np

from cortado.code_words import code_words
from cortado.errors import InputError, shown
from cortado.scene.motions import motion_parameters
from cortado.scene.parameter_values import Known, checked_value
from cortado.scene.parameters import Parameter, Source
from cortado.scene.solids import SolidTable
from cortado.sph.parts import Force, Setting


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


WANTED = "a list of forces, such as [cortado.forces.Body(function, k=2.0)]"


def checked_makers(forces: Any) -> tuple[ForceMaker, ...]:
    """Return what a user gives as ``forces`` if these are makers of forces; else raise `InputError`."""
    if not isinstance(forces, (list, tuple)):
        raise InputError(f"forces is {shown(forces)}, but must be {WANTED}.")
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
