"""Derivatives in both modes, and against central differences, which are right only over a range of steps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

PLATEAU = 3
"""Neighbouring steps that must all agree: a chance crossing of zero by the error is none."""


def directional(gradient: Mapping[str, Any], directions: Mapping[str, Any]) -> float:
    """The derivative along directions of parameters, by name, that a gradient says."""
    return float(sum(np.sum(gradient[name] * direction) for name, direction in directions.items()))


def both_modes(problem: Any, point: Mapping[str, Any], directions: Mapping[str, Any], tolerance: float = 1e-10) -> Any:
    """The gradient of a problem at a point, and its derivative along directions in forward mode, of which that in
    reverse mode is off by a relative tolerance at most."""
    gradient, tangent = problem.value_and_gradient(point)[1], problem.tangent(point, directions)
    assert abs(directional(gradient, directions) - tangent) <= tolerance * abs(tangent)
    return gradient, tangent


def plateau(errors: Sequence[float]) -> float:
    """Of errors at neighbouring steps, the greatest of so many in a row, where that is least."""
    assert len(errors) >= PLATEAU
    return float(min(max(errors[k : k + PLATEAU]) for k in range(len(errors) - PLATEAU + 1)))


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
    near, far = (central_difference(value, point, directions, step) for step in (h, 2.0 * h))
    return (4.0 * near - far) / 3.0


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
