"""The term of a pair of particles: a function whose parameters say by their names what they are.

x_ij               the separation x_i - x_j, of the nearest image
c_i, c_j, v_ij     an array's entry of the particle, that of its neighbour, and v_i - v_j
i, j               their numbers; j is -1 for a particle of a wall
s                  the neighbourhood
any other          what is the same for all neighbours of a particle
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args


@dataclass(frozen=True)
class Term:
    """A function of a pair, taken apart."""

    function: Callable[..., Any]
    parameters: Mapping[str, Any]
    """Their types by name."""
    results: tuple[Any, ...]
    """Types of what it returns."""

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "Term":
        """Of a function that has an annotation at each parameter, and ``tuple[...]`` if it returns several things."""
        types = inspect.get_annotations(function)
        result = types.pop("return")
        return cls(function, types, get_args(result) or (result,))

    @property
    def name(self) -> str:
        return self.function.__name__

    @property
    def arrays(self) -> dict[str, Any]:
        """Types of the entries of arrays, by the arrays' names."""
        return {array: self.parameters[name] for name in self.parameters if (array := array_of(name))}

    @property
    def others(self) -> dict[str, Any]:
        """Types of what is the same for all neighbours, by name."""
        return {name: kind for name, kind in self.parameters.items() if not array_of(name) and name not in "ijs"}

    def reads(self, array: str, *indices: str) -> bool:
        """Whether it takes an array's entry with one of these indices."""
        return any(f"{array}_{index}" in self.parameters for index in indices)

    @property
    def of_neighbours(self) -> dict[str, Any]:
        """The arrays of which it takes a neighbour's entry."""
        return {array: kind for array, kind in self.arrays.items() if self.reads(array, "j", "ij")}

    def seen_from_i(self, of_j: Mapping[str, str]) -> str:
        """The text of its arguments, given those of a neighbour's entries."""
        return self._arguments("x_ij", lambda array: f"{array}_i", of_j.__getitem__, ("i", "j"))

    def seen_from_j(self, of_j: Mapping[str, str]) -> str:
        """The same with the particles exchanged."""
        return self._arguments("-x_ij", of_j.__getitem__, lambda array: f"{array}_i", ("j", "i"))

    def _arguments(
        self, separation: str, own: Callable[[str], str], other: Callable[[str], str], numbers: tuple[str, str]
    ) -> str:
        def argument(name: str) -> str:
            array = array_of(name)
            if name == "x_ij":
                return separation
            if name in "ij":
                return numbers["ij".index(name)]
            if not array:
                return name
            if name.endswith("_ij"):
                return f"{own(array)} - {other(array)}"
            return own(array) if name.endswith("_i") else other(array)

        return ", ".join(map(argument, self.parameters))


def array_of(parameter: str) -> str:
    """The array that a parameter is of; nothing for others."""
    array, _, index = parameter.rpartition("_")
    return array if index in ("i", "j", "ij") else ""
