"""Derivatives of sums over neighbours that are written by hand.

They are those that make a step faster than the ones that Warp makes of a term (`cortado.particles.made_derivatives`):
`benchmarks/by_hand.py` measures by how much. They have the same arrays and one more for the tangent of each array, or
for the adjoint of the sum. Each is noted here beside its sum, so that tests compare all of them with the made ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ByHand:
    """The derivative of a sum, as Warp functions."""

    kind: str
    """"tangent", or "adjoint": one that returns the adjoints of the entries of particle i in each array of the sum, in
    their order, then those of what is the same for all neighbours, or what else a kernel needs."""
    of: Any
    function: Any


BY_HAND: list[ByHand] = []
"""Those of all sums that were made."""


def tangent_of(sum_of: Any) -> Callable[[Any], Any]:
    """A decorator of the tangent of a sum over neighbours."""
    return lambda function: _noted("tangent", sum_of, function)


def adjoint_of(sum_of: Any) -> Callable[[Any], Any]:
    """A decorator of the adjoint of a sum over neighbours."""
    return lambda function: _noted("adjoint", sum_of, function)


def _noted(kind: str, sum_of: Any, function: Any) -> Any:
    BY_HAND.append(ByHand(kind, sum_of, function))
    return function
