"""The numbers that a fit searches: one vector of those that are free, positive ones by their logarithm."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, require_table
from cortado.errors import InputError

MOST_NUMBERS = 100
"""That a fit searches: each costs a run along its tangent."""


@dataclass(frozen=True)
class Coordinates:
    """Numbers of parameters by name, in their order, and which of them are searched."""

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    at_start: np.ndarray
    """(all,) [unit of the parameter]"""
    logarithmic: np.ndarray
    """(all,) whether a number is searched by its logarithm."""
    lower: np.ndarray
    """(all,)"""
    upper: np.ndarray
    """(all,)"""

    @classmethod
    def of(
        cls,
        start: Mapping[str, Any],
        positive: Iterable[str],
        bounds: Mapping[str, tuple[Any, Any]] | None,
        unseen: Mapping[str, np.ndarray] | None = None,
    ) -> "Coordinates":
        """``positive`` parameters are searched by their logarithm where all of their numbers are above 0; numbers that
        are ``unseen`` are not searched. Raises `InputError` for what does not fit."""
        require_table("start", start, "{'viscosity': 0.5}")
        values = {name: as_numbers(f"start of {name}", value) for name, value in start.items()}
        given = {} if bounds is None else bounds
        require_table("bounds", given, "{'viscosity': (0.1, 10.0)}")
        for name in given:
            if name not in values:
                raise InputError(f"bounds has {name}, but must be made of parameters that start has.")
        by_logarithm = {name for name in positive if name in values and (values[name] > 0.0).all()}
        ends = {name: _ends(name, values[name], given.get(name, (None, None))) for name in values}
        for name, mask in ({} if unseen is None else unseen).items():
            lower, upper = ends[name]
            ends[name] = np.where(mask, values[name], lower), np.where(mask, values[name], upper)

        def flat(rows: Iterable[np.ndarray]) -> np.ndarray:
            return np.concatenate([np.ravel(row) for row in rows])

        lower, upper = (flat(ends[name][k] for name in values) for k in range(2))
        logarithmic = flat(np.full(np.shape(v), name in by_logarithm) for name, v in values.items())
        lower = np.where(logarithmic, np.maximum(lower, 0.0), lower)
        found = cls(
            tuple(values), tuple(v.shape for v in values.values()), flat(values.values()), logarithmic, lower, upper
        )
        if not 0 < found.free.sum() <= MOST_NUMBERS:
            raise InputError(f"start has {found.free.sum()} free numbers, but must have 1 to {MOST_NUMBERS}.")
        return found

    @property
    def free(self) -> np.ndarray:
        """(all,) whether a number is searched: its bounds are not the same."""
        return self.lower < self.upper

    @property
    def labels(self) -> list[str]:
        """Of the free numbers: the name of the parameter, with its index where it has several numbers."""
        every = [
            name if not shape else f"{name}[{', '.join(map(str, index))}]"
            for name, shape in zip(self.names, self.shapes, strict=True)
            for index in np.ndindex(*shape)
        ]
        return [label for label, is_free in zip(every, self.free, strict=True) if is_free]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the vector that is searched."""
        with np.errstate(divide="ignore"):
            logs = [np.where(self.logarithmic, np.log(np.maximum(e, 0.0)), e) for e in (self.lower, self.upper)]
        return logs[0][self.free], logs[1][self.free]

    @property
    def start(self) -> np.ndarray:
        """The vector that is searched, at the start."""
        return self.vector(self.at_start)

    def vector(self, numbers: np.ndarray) -> np.ndarray:
        """(free,) of all numbers."""
        chosen, is_log = numbers[self.free], self.logarithmic[self.free]
        return np.where(is_log, np.log(np.where(is_log, chosen, 1.0)), chosen)

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """(free,) numbers in the units of the parameters."""
        is_log = self.logarithmic[self.free]
        with np.errstate(over="ignore"):  # an interval may have no upper end
            return np.where(is_log, np.exp(np.where(is_log, u, 0.0)), u)

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """(free,) the derivative of each number with respect to its coordinate."""
        return np.where(self.logarithmic[self.free], self.numbers(u), 1.0)

    def values(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters by name."""
        whole = self.at_start.copy()
        whole[self.free] = self.numbers(u)
        return self.named(whole)

    def named(self, whole: np.ndarray) -> dict[str, np.ndarray]:
        """(all,) numbers as arrays by name."""
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)])
        return {n: whole[ends[k] : ends[k + 1]].reshape(self.shapes[k]) for k, n in enumerate(self.names)}

    def directions(self, u: np.ndarray) -> list[dict[str, np.ndarray]]:
        """The direction of the parameters along each coordinate, only with the parameter that it moves."""
        found, slopes = [], self.slopes(u)
        for k, place in enumerate(np.flatnonzero(self.free)):
            whole = np.zeros(len(self.at_start))
            whole[place] = slopes[k]
            found.append({name: value for name, value in self.named(whole).items() if value.any()})
        return found

    def spread(self, free: np.ndarray, otherwise: float) -> dict[str, np.ndarray]:
        """(free,) numbers as arrays by name, in which fixed numbers are ``otherwise``."""
        whole = np.full(len(self.at_start), otherwise)
        whole[self.free] = free
        return self.named(whole)


def _ends(name: str, value: np.ndarray, pair: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound, each of the parameter's shape."""
    if len(pair) != 2:
        raise InputError(f"bounds of {name} must be a pair, the lower and the upper one.")
    try:
        lower, upper = (
            np.broadcast_to(way * np.inf if end is None else as_numbers(f"a bound of {name}", end), value.shape)
            for way, end in zip((-1.0, 1.0), pair, strict=True)
        )
    except ValueError:
        raise InputError(f"bounds of {name} must be numbers, or have its shape, {value.shape}.") from None
    if not ((lower <= value) & (value <= upper)).all():
        raise InputError(f"start of {name} is {value.tolist()}, but must be within its bounds.")
    return lower, upper
