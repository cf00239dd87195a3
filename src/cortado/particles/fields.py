"""The fields that a state consists of, as solvers and their parts declare them. Without Warp."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from cortado.scene.parameters import Axis, Parameter


class Entry(Enum):
    """The kind of entry that a field holds for each particle or scene: a number, a vector or another."""

    NUMBER = "a number"
    VECTOR = "a vector"
    FRACTIONS = "a number for each phase"
    DOUBLE = "a number in float64, whatever the precision of the run: a sum over many steps"


@dataclass(frozen=True)
class StateField:
    """An array that a step reads and writes, as a solver or a part of one declares it. What the next step reads of the
    last one must be such a field: a run goes on, and is restarted, from its state alone."""

    name: str
    unit: str
    """In SI; empty for a plain number."""
    entry: Entry
    axis: Axis = Axis.PARTICLE
    """PARTICLE, in the scene's order, or SCALAR for one entry."""
    first: str | None = None
    """The parameter that gives its first value, of one over time the first row; None for a field that begins at 0."""
    is_constant: bool = False
    """True where no step changes it: the states of a run share the array."""

    def shape(self, particles: int, dimension: int, phases: int) -> tuple[int, ...]:
        """Return the shape of the field's values as NumPy has them."""
        own = {Entry.VECTOR: (dimension,), Entry.FRACTIONS: (phases,)}.get(self.entry, ())
        return (particles if self.axis is Axis.PARTICLE else 1, *own)


def check_fields(fields: Iterable[StateField], known: Mapping[str, Parameter]) -> None:
    """Raise `TypeError` for fields of one name, and for one that begins as an unknown parameter or as one without a
    value for each of its entries."""
    names: set[str] = set()
    for field in fields:
        if field.name in names:
            raise TypeError(f"a state has several fields called {field.name!r}, but each must have a name of its own.")
        names.add(field.name)
        if field.first is None:
            continue
        if field.first not in known:
            raise TypeError(
                f"field {field.name!r} begins as {field.first!r}, but must begin as one of {', '.join(known)}, or at 0."
            )
        particles, dimension, phases = 7, 2, 5  # any that differ
        (shape, *_) = known[field.first].shapes(0, phases, (particles, dimension))
        given = shape if field.axis is Axis.PARTICLE else (1, *shape)
        wanted = field.shape(particles, dimension, phases)
        if given != wanted:
            raise TypeError(
                f"field {field.name!r} begins as {field.first!r}, which is not {field.entry.value} "
                f"{'of each particle' if field.axis is Axis.PARTICLE else 'of the scene'}, but must be."
            )


def first_values(fields: Iterable[StateField], parameters: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the first values of fields by name, where these begin as one of the given parameters."""
    found = {}
    for field in fields:
        if field.first is not None and field.first in parameters:
            value = parameters[field.first]
            if field.axis is not Axis.PARTICLE:  # (1,) or (1, components), over time the first row
                value = (np.atleast_2d(value) if field.entry is Entry.VECTOR else np.atleast_1d(value))[:1]
            found[field.name] = value
    return found


POSITIONS = StateField("positions", "m", Entry.VECTOR, first="initial_positions")
VELOCITIES = StateField("velocities", "m/s", Entry.VECTOR, first="initial_velocities")
