"""Warp arrays by name. Vectors have three components on a device, z is 0 in 2-D."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import warp as wp

from cortado.device.precision import Precision
from cortado.fixed import Staying
from cortado.scene.parameter_values import argument


def padded(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 2) or (n, 3) with three components, in float64."""
    return np.hstack([vectors, np.zeros((len(vectors), 3 - vectors.shape[1]))])


def to_device(values: np.ndarray, precision: Precision, device: Any) -> wp.array:
    """Vectors (n, 2) or (n, 3) as a Warp array of vectors (n,)."""
    return wp.array(padded(values), dtype=precision.vector, device=device)


def components(array: wp.array, shape: tuple[int, ...]) -> wp.array:
    """The memory of numbers, vectors or matrices as an array of numbers of a shape, which keeps it."""
    real = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    view = wp.array(ptr=array.ptr, dtype=real, shape=shape, device=array.device)
    view._ref = array
    return view


class Arrays(Staying):
    """Warp arrays by name."""

    def __init__(self, arrays: Mapping[str, wp.array]):
        self._arrays = dict(arrays)
        self._named: dict[str, dict[str, wp.array]] = {}

    def __getitem__(self, name: str) -> wp.array:
        return self._arrays[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, in their order."""
        return tuple(self._arrays)

    def arrays(self) -> list[wp.array]:
        """The arrays, in their order."""
        return list(self._arrays.values())

    def named(self, suffix: str = "") -> dict[str, wp.array]:
        """The arrays as kernels call their arguments, ``drag_k`` for ``drag.k``: "_dot" behind the name of a tangent,
        "_bar" of an adjoint."""
        if suffix not in self._named:
            self._named[suffix] = {argument(name) + suffix: array for name, array in self._arrays.items()}
        return self._named[suffix]

    def assign(self, other: Self) -> None:
        """Copy another of the same device and sizes, without a host round trip; what both share stays as it is."""
        for own, source in zip(self.arrays(), other.arrays(), strict=True):
            if own is not source:
                wp.copy(own, source)

    def gradients(self) -> Self:
        """The adjoints of the arrays that Warp's tape has written."""
        return type(self)({name: array.grad for name, array in self._arrays.items()})

    def clear(self) -> None:
        """Make everything 0."""
        for array in self.arrays():
            array.zero_()


def zeros(kinds: Mapping[str, tuple[Any, Any]], device: Any, requires_grad: bool = False) -> dict[str, wp.array]:
    """Arrays of zeros by name, each of a size or a shape and a Warp type."""
    options = {"device": device, "requires_grad": requires_grad}
    return {name: wp.zeros(size, dtype=dtype, **options) for name, (size, dtype) in kinds.items()}


class Fields(Arrays):
    """Sorted particles within a step. Also the type of tangents and adjoints.

    ``x`` (n,) positions [m]; ``v`` (n,) velocities [m / s]; ``n`` (n,) number densities [-], 1 on the rest lattice;
    ``m`` (n,) masses over the volume on the rest lattice [kg / m3], so that the density is m n; ``rho_0`` (n,) rest
    densities [kg / m3]; ``mu`` (n,) dynamic viscosities [Pa s].
    """

    @classmethod
    def zeros(cls, particles: int, precision: Precision, device: Any, requires_grad: bool = False) -> Self:
        """Fields of zeros."""
        types = dict.fromkeys("xv", precision.vector) | dict.fromkeys(("n", "m", "rho_0", "mu"), precision.real)
        return cls(zeros({name: (particles, dtype) for name, dtype in types.items()}, device, requires_grad))
