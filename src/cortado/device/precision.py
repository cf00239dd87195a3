"""The two floating-point precisions: scalar, vector and NumPy types that belong together; roots and reciprocals; and
types of parameters by their names.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import by_name
from cortado.errors import InputError, shown


@dataclass(frozen=True)
class Precision:
    """One floating-point format, in the three spellings that the code needs."""

    name: str
    real: Any
    """Warp scalar type."""
    vector: Any
    """Warp vector type of three components (z is 0 in two dimensions)."""
    pair: Any
    """Warp vector type of two components."""
    numpy: type
    """NumPy scalar type."""
    tiny: float
    """Positive number far below round-off of 1, with a finite reciprocal."""
    furthest: float
    """Distance from the origin, in spacings, where positions are rounded to about 0.001 spacings (float32) or less."""
    greatest: float
    """Greatest size of a parameter, as products of several must stay finite."""

    @property
    def bytes(self) -> int:
        """Number of bytes of a number."""
        return np.dtype(self.numpy).itemsize

    @property
    def six(self) -> Any:
        """Warp vector type of six components, for a symmetric matrix."""
        return _vector_type(self.real, 6)

    def fractions(self, phases: int) -> Any:
        """Return the Warp vector type of one number for each phase."""
        return _vector_type(self.real, phases)


@cache
def _vector_type(real: Any, length: int) -> Any:
    return wp.types.vector(length=length, dtype=real)


FLOAT32 = Precision("float32", wp.float32, wp.vec3f, wp.vec2f, np.float32, 1e-30, 1e4, 1e12)
FLOAT64 = Precision("float64", wp.float64, wp.vec3d, wp.vec2d, np.float64, 1e-200, 1e9, 1e50)


def precision_named(name: str) -> Precision:
    """Return the precision called ``"float32"`` or ``"float64"``; raises `InputError` for any other name."""
    for precision in (FLOAT32, FLOAT64):
        if isinstance(name, str) and precision.name == name:
            return precision
    raise InputError(f'precision is {shown(name)}, but must be "float32" or "float64".')


class TypesByName:
    """The types of names that many functions of Warp share, so that each is told once, and not at every parameter.

        typed = TypesByName(real, {vector: "x v", neighbourhood: "s"})

        @fluid_sum(discretisation)
        @typed
        def spread(x_ij, x_dot_ij, v_ij, m_i, m_j, s) -> vector: ...

    A parameter without a type has that of the longest of these names with which its words begin, as those of x_dot_ij
    begin with x. One that begins with none of them has the usual type, which is that of numbers as a rule."""

    def __init__(self, usual: Any, *names: Mapping[Any, str]):
        """Take the usual type, and tables of words that are names of each other type, of which later ones count."""
        self._usual = usual
        self._types = {name: kind for own in names for kind, words in own.items() for name in words.split()}

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Give types to the parameters of a function."""
        return self._give(function, lambda kind: kind)

    def arrays(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Give types to the parameters of a kernel: those without a type are arrays of entries, or Warp's structs, and
        those that a kernel writes come last."""
        return self._give(function, lambda kind: wp.array(dtype=kind) if isinstance(kind, type) else kind)

    def _give(self, function: Callable[..., Any], whole: Callable[[Any], Any]) -> Callable[..., Any]:
        given = function.__annotations__
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        types = {name: given[name] if name in given else whole(self._of(name)) for name in names}
        function.__annotations__ = types | given
        return function

    def _of(self, name: str) -> Any:
        while name and name not in self._types:
            name = name.rpartition("_")[0]
        return self._types.get(name, self._usual)


@cache
def arithmetic(precision: Precision, taped: bool) -> SimpleNamespace:
    """Make the Warp functions ``root``, ``inverse_root`` and ``reciprocal`` of a positive number that is neither
    subnormal nor infinite; ``taped`` ones have derivatives, and round as IEEE 754 asks."""
    return _of_the_gpu() if precision == FLOAT32 and not taped else _plain(precision)


def _plain(precision: Precision) -> SimpleNamespace:
    real = precision.real

    @wp.func
    def root(x: real) -> real:
        return wp.sqrt(x)

    @wp.func
    def inverse_root(x: real) -> real:
        return real(1.0) / wp.sqrt(x)

    @wp.func
    def reciprocal(x: real) -> real:
        return real(1.0) / x

    return by_name(root, inverse_root, reciprocal)


def _of_the_gpu() -> SimpleNamespace:
    """Return approximate float32 roots and reciprocal of CUDA; on the CPU they are the plain ones."""

    def native(cuda: str, cpu: str) -> str:
        return f"\n#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"

    approximate = 'float y; asm("{}.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); return {};'

    @wp.func_native(native(approximate.format("rsqrt", "x * y"), "return sqrtf(x);"))
    def root(x: wp.float32) -> wp.float32: ...

    @wp.func_native(native(approximate.format("rsqrt", "y"), "return 1.0f / sqrtf(x);"))
    def inverse_root(x: wp.float32) -> wp.float32: ...

    @wp.func_native(native(approximate.format("rcp", "y"), "return 1.0f / x;"))
    def reciprocal(x: wp.float32) -> wp.float32: ...

    return by_name(root, inverse_root, reciprocal)
