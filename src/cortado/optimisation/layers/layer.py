"""What a layer is: a function of named arrays, with its derivatives in both modes."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.errors import CortadoWarning, DivergedError, InputError
from cortado.words import counted

STATE, PARAMETER = "state ", "parameter "
"""What the names of fields of a state, and of parameters, begin with among those of a layer's arrays: so they do not
meet, and sentences begin with them."""
POSITIONS = (STATE + "positions", "positions")
"""What a layer that looks at particles calls where they are."""
KEPT = 2
"""Sizes of batches of a layer that are kept for the next call."""
Array = Any
"""A Warp array of numbers, or one of NumPy's. Where a shape is (), it may be (1,)."""
Named = Mapping[str, Array]
Shapes = Mapping[str, tuple[int, ...]]


class Layer(ABC):
    """A function of named arrays of one precision, with its derivatives.

    Arrays are read in their memory, on the host or on the layer's device, and none that is given is written to.
    """

    real: type
    """The NumPy type of the numbers of all arrays."""
    device: Any
    """Where they are; parameters, and other small ones, are read on the host wherever they are."""
    on_device: frozenset[str] = frozenset()
    """The names of those that must be there."""
    kept_bytes: int = 0
    """About what a residual holds."""

    def __init__(self) -> None:
        self._batched: dict[int, Layer] = {}

    @abstractmethod
    def check(self, given: Shapes) -> None:
        """Raises `InputError`, in a sentence, for arrays of other names or shapes than it takes."""

    @abstractmethod
    def outputs(self) -> dict[str, tuple[int, ...]]:
        """The names and the shapes of what it returns."""

    @abstractmethod
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        """What it returns, and, to ``keep``, a residual for `pull` and `push`, else None."""

    @abstractmethod
    def pull(self, residual: Any, bars: Named) -> Named:
        """Reverse mode: from the adjoints of what it returned, 0 where they are left out, to those of all arrays that
        were given."""

    @abstractmethod
    def push(self, residual: Any, dots: Named) -> Named:
        """Forward mode: from tangents of arrays that were given, 0 where they are left out, to those of what it
        returned."""

    @abstractmethod
    def check_mapped(self) -> None:
        """Raises `InputError`, in a sentence, where there is no `many`."""

    @abstractmethod
    def many(self, size: int) -> "Layer":
        """The same function of so many arrays of each kind at once, one behind the other along a first axis."""

    def batched(self, size: int) -> "Layer":
        """The same, of which the last ones are kept."""
        self.check_mapped()
        found = self._batched.pop(size, None) or self.many(size)
        self._batched[size] = found  # the last one
        while len(self._batched) > KEPT:
            self._batched.pop(next(iter(self._batched)))
        return found


@dataclass(frozen=True)
class Lost:
    """An evaluation of several that has no numbers."""

    given: Shapes
    """Of what it was given."""
    why: str

    def along(self, of: Named, shapes: Shapes) -> Named:
        """Derivatives in these shapes: 0 where only zeros are given of those that they are linear in, else NaN."""
        number = np.nan if any(on_host(array).any() for array in of.values()) else 0.0
        return {name: np.full(shape, number) for name, shape in shapes.items()}


class OneByOne(Layer):
    """Several evaluations of a layer that takes them only one after the other."""

    def __init__(self, layer: Layer, size: int):
        super().__init__()
        self._layer, self._size = layer, size
        self.real, self.device, self.on_device = layer.real, layer.device, layer.on_device
        self.kept_bytes = size * layer.kept_bytes

    def check(self, given: Shapes) -> None:
        self._layer.check({name: shape[1:] for name, shape in given.items()})

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return {name: (self._size, *shape) for name, shape in self._layer.outputs().items()}

    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        found = [self._evaluated(own, keep) for own in self._each(given)]
        lost = {number: one for number, (_, one) in enumerate(found) if isinstance(one, Lost)}
        if lost:
            first, one = next(iter(lost.items()))
            said = f"{len(lost)} of {counted(self._size, 'evaluation')} were lost. First evaluation {first}: {one.why}"
            warnings.warn(said, CortadoWarning, stacklevel=2)
        return stacked([one for one, _ in found]), [residual for _, residual in found] if keep else None

    def _evaluated(self, given: Named, keep: bool) -> tuple[Named, Any]:
        """Of one of them, which goes without numbers where its particles have none, or one of them is lost."""
        shapes = {name: np.shape(array) for name, array in given.items()}
        positions = next((array for name, array in given.items() if name in POSITIONS), np.zeros(1))
        lost = Lost(shapes, "its particles had been lost in steps before it.")
        if not np.isnan(on_host(positions)).all():
            try:
                return self._layer.evaluate(given, keep)
            except DivergedError as error:
                lost = Lost(shapes, str(error))
        return {name: np.full(shape, np.nan, self.real) for name, shape in self._layer.outputs().items()}, lost

    def pull(self, residual: Any, bars: Named) -> Named:
        layer, each = self._layer, zip(residual, self._each(bars), strict=True)
        found = (own.along(one, own.given) if isinstance(own, Lost) else layer.pull(own, one) for own, one in each)
        return stacked(found)

    def push(self, residual: Any, dots: Named) -> Named:
        layer, each = self._layer, zip(residual, self._each(dots), strict=True)
        made = layer.outputs()
        found = (own.along(one, made) if isinstance(own, Lost) else layer.push(own, one) for own, one in each)
        return stacked(found)

    def _each(self, given: Named) -> list[dict[str, Array]]:
        return [rows(given, number) for number in range(self._size)]

    def check_mapped(self) -> None:
        raise unbatched(f"{counted(self._size, 'evaluation')} at once")

    def many(self, size: int) -> "Layer":
        raise NotImplementedError


def unbatched(what: str) -> InputError:
    """That something cannot be mapped over a further axis."""
    return InputError(f"{what} cannot be mapped over a further axis: map over one axis, of what has none.")


def on_host(array: Array) -> np.ndarray:
    """As a NumPy array."""
    return array.numpy() if isinstance(array, wp.array) else np.asarray(array)


def part(given: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Of named arrays those of a kind, without its name."""
    return {name.removeprefix(kind): array for name, array in given.items() if name.startswith(kind)}


def named(kind: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """The other way round."""
    return {kind + name: array for name, array in found.items()}


def rows(given: Named, chosen: int | np.ndarray) -> dict[str, Array]:
    """One entry of the first axis of each array, or several in another order."""
    return {name: _rows(array, chosen) for name, array in given.items()}


def stacked(found: Iterable[Named]) -> dict[str, Array]:
    """Arrays of the same names with a first axis for each of the tables, on the device of the first ones."""
    tables = list(found)
    return {name: _stack([table[name] for table in tables]) for name in tables[0]}


def _rows(array: Array, chosen: int | np.ndarray) -> Array:
    if not isinstance(array, wp.array):
        return np.asarray(array[chosen])
    if isinstance(chosen, np.ndarray):
        return _stack([_rows(array, int(one)) for one in chosen])
    return array[chosen] if array.ndim > 1 else array[chosen : chosen + 1]


def _stack(arrays: list[Array]) -> Array:
    first = arrays[0]
    if not isinstance(first, wp.array):
        return np.stack(arrays)
    shape = (len(arrays), *first.shape) if first.ndim > 1 or len(first) > 1 else (len(arrays),)
    whole = wp.empty(shape, dtype=first.dtype, device=first.device)
    for own, array in enumerate(arrays):
        wp.copy(_rows(whole, own), array)
    return whole
