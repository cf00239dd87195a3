"""Numbers with more digits than a float64: sums of two."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from cortado.arrays import as_numbers


@dataclass(frozen=True, eq=False)
class Digits:
    """An array of numbers high + low, about 32 digits. NumPy's functions take it for ``high``."""

    high: NDArray[np.float64]
    """The nearest float64."""
    low: NDArray[np.float64]
    """What is left, of the same shape."""

    @classmethod
    def of(cls, values: Any) -> "Digits":
        """Numbers as they are, if they have digits already, else with nothing left over."""
        if isinstance(values, Digits):
            return values
        high = as_numbers("An array of numbers", values)
        return cls(high, np.zeros_like(high))

    @property
    def shape(self) -> tuple[int, ...]:
        return self.high.shape

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.high, dtype=dtype) if copy or dtype not in (None, np.float64) else self.high

    def __len__(self) -> int:
        return len(self.high)

    def __getitem__(self, key: Any) -> "Digits":
        return Digits(np.asarray(self.high[key]), np.asarray(self.low[key]))

    def __sub__(self, other: "ArrayLike | Digits") -> NDArray[np.float64]:
        """The difference in float64: right in its leading digits where the numbers agree in theirs."""
        other = Digits.of(other)
        return (self.high - other.high) + (self.low - other.low)

    def reshape(self, shape: tuple[int, ...]) -> "Digits":
        """The same numbers in another shape."""
        return Digits(self.high.reshape(shape), self.low.reshape(shape))
