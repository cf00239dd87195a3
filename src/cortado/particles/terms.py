"""The term of a pair of particles: a function whose parameters say by their names what they are.

x_ij               the separation x_i - x_j, of the nearest image
c_i, c_j, v_ij     an array's entry of the particle, that of its neighbour, and v_i - v_j
i, j               their numbers; j is -1 for a particle of a wall
foot               of a particle of a wall, from it to the surface of the container; in terms of walls alone
turn_dot           of a particle of a wall, the tangent of how its solid is turned; in tangents of terms of walls alone
s                  the neighbourhood
any other          what is the same for all neighbours of a particle
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

NUMBERS = ("i", "j")
INDICES = ("i", "j", "ij")
OF_WALLS = {"foot": "_foot", "turn_dot": "_turn_dot"}
"""Names of a wall particle's data in terms of walls, with their texts."""


@dataclass(frozen=True)
class Term:
    """The function of a pair of particles, taken apart into its parameters and its results."""

    function: Callable[..., Any]
    parameters: Mapping[str, Any]
    """Types of its parameters by name."""
    results: tuple[Any, ...]
    """Types of its results."""

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "Term":
        """Read the term of a function that has an annotation at each parameter, and ``tuple[...]`` if it returns
        several things. Raises `TypeError` for one without them, or for names that begin with an underscore."""
        types, names = inspect.get_annotations(function), (*inspect.signature(function).parameters, "return")
        for name in names:
            if name not in types or isinstance(types[name], str):
                found = "a text" if name in types else "no type"
                raise TypeError(f"term {function.__name__} has {found} at {name!r}, but must have a type at each.")
            if name.startswith("_"):
                raise TypeError(f"term {function.__name__} has {name!r}, but names must not begin with an underscore.")
        result = types.pop("return")
        return cls(function, types, get_args(result) or (result,))

    @property
    def name(self) -> str:
        return self.function.__name__

    @property
    def arrays(self) -> dict[str, Any]:
        """Return the types of the entries of arrays, by the arrays' names."""
        return {array: self.parameters[name] for name in self.parameters if (array := array_of(name))}

    @property
    def of_neighbours(self) -> dict[str, Any]:
        """Return the types of the entries of arrays that are read for a neighbour, by name."""
        read = {array_of(name) for name in self.parameters if name.endswith(("_j", "_ij"))}
        return {array: kind for array, kind in self.arrays.items() if array in read}

    @property
    def others(self) -> dict[str, Any]:
        """Return the types, by name, of arguments that are equal for all neighbours."""
        known = (*NUMBERS, *OF_WALLS, "s")
        return {name: kind for name, kind in self.parameters.items() if not array_of(name) and name not in known}

    def seen_from_i(self, of_j: Mapping[str, str], j: str = "_j") -> str:
        """Return the text of its arguments, given the texts of a neighbour's entries and of its number."""
        return self._arguments("_x_ij", own_entry, of_j.__getitem__, {"i": "i", "j": j, **OF_WALLS})

    def seen_from_j(self, of_j: Mapping[str, str]) -> str:
        """Return the text of its arguments with the particles exchanged."""
        return self._arguments("-_x_ij", of_j.__getitem__, own_entry, {"i": "_j", "j": "i"})

    def _arguments(
        self, separation: str, own: Callable[[str], str], other: Callable[[str], str], numbers: Mapping[str, str]
    ) -> str:
        def argument(name: str) -> str:
            array = array_of(name)
            if name == "x_ij":
                return separation
            if not array:
                return numbers.get(name, name)
            if name.endswith("_ij"):
                return f"{own(array)} - {other(array)}"
            return own(array) if name.endswith("_i") else other(array)

        return ", ".join(map(argument, self.parameters))


def array_of(parameter: str) -> str:
    """Return the name of the array that a parameter is an entry of; an empty text for others."""
    array, _, index = parameter.rpartition("_")
    return array if index in INDICES else ""


def own_entry(array: str) -> str:
    """Return the text of a particle's own entry of an array."""
    return f"_{array}_i"
