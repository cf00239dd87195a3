"""The checks of where a search starts, of its bounds, and of how long it may be."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, is_whole
from cortado.errors import InputError, shown
from cortado.optimisation.replay_log import ParameterLayout, Vector

MOST_ITERATIONS = 10_000_000
"""Updates of a search, in tasks too; more are taken for a mistake."""


def checked_start(start: Mapping[str, Any]) -> dict[str, Vector]:
    """The start as float64 arrays, or InputError if there is a parameter that cannot be optimised."""
    if not isinstance(start, Mapping):
        raise InputError(f"The start is {shown(start)}, but must name its parameters, as {{'gravity': value}} does.")
    if not start:
        raise InputError("The start names no parameter to optimise; give one or more, as {'gravity': value}.")
    return {name: _checked_value(f"The start of '{name}'", value) for name, value in start.items()}


def _checked_value(what: str, value: Any) -> Vector:
    """A value as a float64 array, or InputError if it is not made of finite numbers."""
    array = as_numbers(what, value).copy()
    if array.size == 0:
        raise InputError(f"{what} has shape {array.shape}, but must have at least one number.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} has components that are not finite; start from finite numbers.")
    return array


def checked_bounds(bounds: Mapping[str, tuple[Any, Any]], layout: ParameterLayout) -> tuple[Vector, Vector]:
    """Lower and upper bounds as vectors (size,), or InputError if they do not fit the parameters."""
    if not isinstance(bounds, Mapping):
        raise InputError(f"bounds is {shown(bounds)}, but must be by name, as {{'gravity': (lower, upper)}}.")
    unknown = sorted(set(bounds) - set(layout.names), key=str)
    if unknown:
        raise InputError(
            f"Bounds are given for {', '.join(map(repr, unknown))}, which the start does not name; the "
            f"optimised parameters are {', '.join(map(repr, layout.names))}."
        )
    shapes = dict(zip(layout.names, layout.shapes, strict=True))
    sides = {name: _checked_pair(name, bounds.get(name, (None, None)), shapes[name]) for name in shapes}
    lower = layout.ravel({name: pair[0] for name, pair in sides.items()})
    upper = layout.ravel({name: pair[1] for name, pair in sides.items()})
    return lower, upper


def _checked_pair(name: str, pair: tuple[Any, Any], shape: tuple[int, ...]) -> tuple[Vector, Vector]:
    """The lower and upper bound of one parameter, each of its shape, infinite where there is none."""
    try:
        lower, upper = pair
        low = as_numbers(f"The lower bound of '{name}'", -np.inf if lower is None else lower)
        high = as_numbers(f"The upper bound of '{name}'", np.inf if upper is None else upper)
        low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
    except (TypeError, ValueError):
        raise InputError(
            f"The bounds of '{name}' must be (lower, upper), each None, a number or an array of shape "
            f"{shape}, not {pair!r}."
        ) from None
    if not (low <= high).all():
        raise InputError(f"The lower bound of '{name}' must not exceed the upper one; neither may be NaN.")
    return low, high


def require_within(vector: Vector, lower: Vector, upper: Vector, layout: ParameterLayout) -> None:
    """Raise InputError if the start is outside of the bounds."""
    outside = layout.unravel(((vector < lower) | (vector > upper)).astype(np.float64))
    for name, marks in outside.items():
        if marks.any():
            raise InputError(
                f"The start of '{name}' is outside of its bounds in {int(marks.sum())} of {marks.size} "
                "components; start within the bounds, or widen them."
            )


def require_count(iterations: int) -> None:
    """Raise InputError unless the number of iterations is a positive integer, and one that a search can make."""
    if not is_whole(iterations) or not 1 <= iterations <= MOST_ITERATIONS:
        wanted = f"an integer of at least 1 and at most {MOST_ITERATIONS:,}"
        raise InputError(f"The number of iterations must be {wanted}, not {shown(iterations)}.")
