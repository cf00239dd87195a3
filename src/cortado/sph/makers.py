"""Forces from outside: what `Simulation` takes in ``forces``."""

from collections.abc import Sequence
from hashlib import sha256
from typing import Any, Protocol

import numpy as np

from cortado.errors import InputError, shown
from cortado.parameters.known import Known
from cortado.parameters.registry import Parameter, Source
from cortado.parameters.values import checked_value
from cortado.sph.parts import Force, Setting


class ForceMaker(Protocol):
    """Makes a force for each solver of a simulation that is given it, and says which parameters the force has.

    It is pickled with the simulation. One with a ``fingerprint``, a text, is told from others of its type by it, so
    that a search is not resumed with another force.
    """

    parameters: Sequence[Parameter]
    """Of the force, with names that no others have: ``drag.k`` is found by kernels as ``drag_k``. `known.TIME` is among
    them where kernels read ``time``."""

    def force(self, setting: Setting) -> Force | None:
        """The force in one precision and on one device; None where nothing acts."""


WANTED = "a list of forces, such as [cortado.forces.Body(function, k=2.0)]"


def checked_makers(forces: Any) -> tuple[ForceMaker, ...]:
    """What a user gives as ``forces``; raises `InputError`."""
    if not isinstance(forces, (list, tuple)):
        raise InputError(f"forces is {shown(forces)}, but must be {WANTED}.")
    for k, maker in enumerate(forces):
        if isinstance(maker, type) or not callable(getattr(maker, "force", None)):
            raise InputError(f"forces has {shown(maker)} at place {k}, but must be {WANTED}.")
        parameters = getattr(maker, "parameters", None)
        if not isinstance(parameters, (list, tuple)) or not all(isinstance(p, Parameter) for p in parameters):
            wanted = "a list of cortado.parameters.registry.Parameter, which may be empty"
            raise InputError(f"the force {shown(maker)} has parameters {shown(parameters)}, but must have {wanted}.")
    return tuple(forces)


def known_of(makers: Sequence[ForceMaker]) -> Known:
    """The parameters of a simulation with these forces; raises `InputError` where two have one name."""
    return Known(parameter for maker in makers for parameter in maker.parameters)


def check_own(known: Known, source: Source) -> None:
    """The values that forces give their parameters are numbers of a shape that a scene can have; raises
    `InputError`."""
    for parameter in known.own:
        shapes = parameter.shapes(0, len(source.scene.phase), source.positions.shape)
        checked_value(parameter.name, parameter.value(source), shapes, known=known)


def fingerprint(makers: Sequence[ForceMaker], source: Source) -> str:
    """Which forces these are, with the values that they give their parameters; empty without any."""
    words = []
    for maker in makers:
        values = [(p.name, np.asarray(p.value(source), dtype=np.float64).tolist()) for p in maker.parameters]
        words.append(f"{getattr(maker, 'fingerprint', type(maker).__qualname__)} {values}")
    return sha256("\n".join(words).encode()).hexdigest()[:16] if words else ""
