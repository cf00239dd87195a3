"""The quantities of particles by name, with their units and what they are. Without Warp."""

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown


class Kind(Enum):
    """The numbers that a quantity has for each particle."""

    NUMBER = "a number"
    VECTOR = "a vector"
    TURNING = "in the plane a number, which is positive counter-clockwise, in space a vector"


@dataclass(frozen=True)
class Quantity:
    """A quantity of each particle that follows from a state and the parameters of the step after it."""

    name: str
    unit: str
    meaning: str
    """One sentence."""
    kind: Kind = Kind.NUMBER

    def shape(self, particles: int, dimension: int) -> tuple[int, ...]:
        """Return the shape of its values for a number of particles and dimensions."""
        is_vector = self.kind is Kind.VECTOR or (self.kind is Kind.TURNING and dimension == 3)
        return (particles, dimension) if is_vector else (particles,)


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity("density", "kg/m3", "The sum of smoothing kernels around a particle, walls included, times its mass."),
        Quantity("pressure", "Pa", "What a gauge would read in the step that begins at the state."),
        Quantity("speed", "m/s", "The length of the velocity."),
        Quantity("vorticity", "1/s", "The curl of the velocity, from the fluid around a particle.", Kind.TURNING),
        Quantity("wall_force", "N", "What a particle pushes the walls with; in the plane N/m.", Kind.VECTOR),
    )
}
"""Every quantity by its name."""
NAMES = tuple(QUANTITIES)


def sizes(name: str, values: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return sizes (..., n) of the values of a quantity or, of one frame, of a field: numbers, or lengths of vectors
    (..., n, k)."""
    known = QUANTITIES.get(name)
    is_vector = values.ndim == 2 if known is None else len(known.shape(1, dimension)) == 2
    return np.linalg.norm(values, axis=-1) if is_vector else values


LOAD = ".load"
"""Ending of the names of loads on solids."""


def load_name(solid: str) -> str:
    """Return the name of force [N] and torque [N m] of the fluid on a solid, in the plane [N/m] and [N], one behind the
    other."""
    return f"{solid}{LOAD}"


def is_load(name: object) -> bool:
    """Test whether a name is that of a load; its computation says whether there is such a solid."""
    return isinstance(name, str) and name.endswith(LOAD)


def check_readable(name: object, what: str, fields: tuple[str, ...]) -> str:
    """Return a name of a quantity, of one of the ``fields`` of a state, or of a load on a solid; raise `InputError` for
    any other."""
    return str(name) if is_load(name) else check_quantity(name, what, fields)


def check_quantity(name: object, what: str = "quantity", others: tuple[str, ...] = ()) -> str:
    """Return a name of a quantity, or one of ``others``; raise `InputError` for any other."""
    if not isinstance(name, str) or name not in (*others, *NAMES):
        raise InputError(f"{what} is {shown(name)}, but must be one of {', '.join((*others, *NAMES))}.")
    return name
