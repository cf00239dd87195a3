"""What an optimiser is given and returns, and the checks of settings that optimisers share."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from cortado.errors import InputError, shown
from cortado.optimisation.replay_log import ParameterLayout, Vector
from cortado.scene.fields import as_number
from cortado.words import quoted

PerParameter = float | Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Search:
    """The problem that an optimiser is given, as a function of one vector."""

    evaluate: Callable[[Vector], tuple[float, Vector]]
    """Vector (size,) -> loss, gradient (size,); raises an error where there is no run, which ends the search."""
    attempt: Callable[[Vector], tuple[float, Vector] | None]
    """The same, but None where there is no run, as it diverges or a parameter is out of its range; it is counted, and
    the search goes on."""
    losses: Callable[[Sequence[Vector]], list[float]]
    """Vectors (size,) -> the loss of each, infinite where there can be no run, as it diverges or parameters
    are out of range; cheaper than so many evaluations."""
    layout: ParameterLayout
    """Which components of the vectors belong to which parameter."""
    start: Vector
    """(size,), within the bounds."""
    lower: Vector
    """(size,), -inf where there is no bound."""
    upper: Vector
    """(size,), +inf where there is no bound."""
    iterations: int
    """Greatest number of updates."""
    updated: Callable[[], None] = lambda: None
    """Called after each update, by which those who follow the search count them."""

    def project(self, vector: Vector) -> Vector:
        """The nearest vector within the bounds."""
        return np.clip(vector, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an optimiser returns."""

    last: Vector
    """(size,), the last iterate, which has been evaluated."""
    converged: bool
    """Whether the optimiser's own test was met."""
    message: str
    """A sentence."""


@runtime_checkable
class Optimiser(Protocol):
    """An algorithm that lowers the loss."""

    def check(self, layout: ParameterLayout) -> None:
        """Raise InputError if the settings do not fit these parameters."""

    def minimise(self, search: Search) -> Outcome:
        """Lower the loss by at most `search.iterations` updates."""


def _values(values: PerParameter) -> Iterator[object]:
    """The numbers of a setting that may be given per parameter."""
    return iter(values.values() if isinstance(values, Mapping) else [values])


def require_positive(name: str, values: PerParameter) -> None:
    """Raise InputError unless every number is positive and finite."""
    for value in _values(values):
        number = as_number(value)
        if number is None or number <= 0.0:
            raise InputError(f"{name} must be a positive, finite number, not {shown(value)}.")


def require_fraction(name: str, value: float) -> None:
    """Raise InputError unless a number is in [0, 1)."""
    number = as_number(value)
    if number is None or not 0.0 <= number < 1.0:
        raise InputError(f"{name} must be a number in [0, 1), not {shown(value)}.")


def require_names(name: str, values: PerParameter, layout: ParameterLayout) -> None:
    """Raise InputError if a setting is given per parameter for others than these parameters."""
    if isinstance(values, Mapping) and set(values) != set(layout.names):
        raise InputError(
            f"{name} is given for {quoted(values)}, but the optimised parameters are "
            f"{quoted(layout.names)}; give it for each of these, or one number for all."
        )
