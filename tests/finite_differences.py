"""Derivatives against central differences, which are right only over a range of steps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

PLATEAU = 3
"""Neighbouring steps that must all agree: a chance crossing of zero by the error is none."""


def plateau(errors: Sequence[float], width: int = PLATEAU) -> float:
    """Of errors at neighbouring steps, the greatest of so many in a row, where that is least."""
    assert len(errors) >= width
    return float(min(max(errors[k : k + width]) for k in range(len(errors) - width + 1)))


def central_difference(
    value: Callable[[Mapping[str, Any]], Any], point: Mapping[str, Any], directions: Mapping[str, Any], h: float
) -> Any:
    """(f(p + h d) - f(p - h d)) / 2 h, of a function of parameters by name; a direction that is left out is 0."""
    ahead, behind = (
        value({name: array + sign * h * directions.get(name, 0.0) for name, array in point.items()})
        for sign in (1.0, -1.0)
    )
    return (ahead - behind) / (2.0 * h)


def fourth_order_difference(
    value: Callable[[Mapping[str, Any]], Any], point: Mapping[str, Any], directions: Mapping[str, Any], h: float
) -> Any:
    """The same of fourth order, by Richardson's extrapolation: it bears larger steps, with less round-off."""
    return (
        4.0 * central_difference(value, point, directions, h) - central_difference(value, point, directions, 2.0 * h)
    ) / 3.0


Difference = Callable[[Callable[[Mapping[str, Any]], Any], Mapping[str, Any], Mapping[str, Any], float], Any]


def distance(
    value: Callable[[Mapping[str, Any]], float],
    point: Mapping[str, Any],
    directions: Mapping[str, Any],
    derivative: float,
    steps: Sequence[float],
    enough: float = 0.0,
    difference: Difference = central_difference,
) -> float:
    """Relative distance of a derivative from a plateau of differences; stops where that is small enough."""
    errors: list[float] = []
    for h in steps:
        errors.append(abs(difference(value, point, directions, h) - derivative) / abs(derivative))
        if len(errors) >= PLATEAU and plateau(errors) < enough:
            break
    return plateau(errors)


def decades(first: float, last: float, apart: float = 0.5) -> np.ndarray:
    """Steps 10^-first, ... 10^-last, half a decade apart unless told."""
    return 10.0 ** -np.arange(first, last + 0.1 * apart, apart)
