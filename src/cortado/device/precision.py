"""The two floating-point precisions: scalar, vector and NumPy types that belong together; roots and reciprocals; and
types of parameters by their names.

Lanes are several GPU threads that share a particle: each processes some of its neighbours, and their sums are added.
With one thread per particle, few particles leave a large GPU mostly idle. A kernel for lanes is launched with LANES
threads per particle, and finds its particle as `wp.tid() // LANES`. A lane processes `UNROLL` neighbours, then the
group LANES groups further down the list. A butterfly of shuffles adds the lanes' sums, with the same bits in every
lane; the first lane writes the result. On a CPU, and for Warp's tape, there is one lane.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import whole_number
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
    """The types of parameter names that many Warp functions share, so that each type is given only once.

        typed = TypesByName(real, {vector: "x v", neighbourhood: "s"})

        @fluid_sum(discretisation)
        @typed
        def spread(x_ij, x_dot_ij, v_ij, m_i, m_j, s) -> vector: ...

    A parameter without a type has that of the longest of these names with which its words begin, as those of x_dot_ij
    begin with x. One that begins with none of them has the usual type, which is that of numbers as a rule."""

    def __init__(self, usual: Any, *names: Mapping[Any, str]):
        """Set the usual type, and tables with the names of each other type; later tables have priority."""
        self._usual = usual
        self._types = {name: kind for own in names for kind, words in own.items() for name in words.split()}

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Add types to the parameters of a function."""
        return self._give(function, lambda kind: kind)

    def arrays(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Add types to the parameters of a kernel. Those without a type become arrays of entries, or Warp's structs;
        arrays that a kernel writes must come last."""
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
    """Build the Warp functions ``root``, ``inverse_root`` and ``reciprocal`` of a positive number that is neither
    subnormal nor infinite. ``taped`` ones have derivatives, and round as IEEE 754 demands."""
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
    """Return CUDA's approximate float32 roots and reciprocal; on a CPU they are the usual functions."""

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


BY_SIZE = ((2_000, 16), (16_000, 8), (48_000, 4))
"""Pairs (greatest number of particles, lanes of a particle) on a GPU; above the last, one lane. Measured on an H200."""
_OF_MODULES: dict[str, int] = {}
"""Value of LANES in the kernels of each Warp module, by its name."""


def set_lanes(module: Any, lanes: int) -> None:
    """Register the value of LANES in the kernels of a Warp module."""
    _OF_MODULES[module.name] = lanes


@cache
def lanes_of(kernel: wp.Kernel) -> int:
    """Return the number of a kernel's threads for each particle: one, unless it divides them by LANES."""
    return _OF_MODULES.get(kernel.module.name, 1) if "wp.tid() // LANES" in kernel.adj.source else 1


@cache
def check_lanes(kernel: wp.Kernel) -> None:
    """Raise `TypeError` for a kernel that calls a sum shared by lanes without being made for lanes: on a GPU each
    thread would get part of the sum of a wrong particle."""
    source = kernel.adj.source
    if "wp.tid() // LANES" in source and "lane()" in source:
        return
    for function in _called(kernel.func):
        if getattr(function, "shares_lanes", False):
            raise TypeError(
                f"kernel {kernel.key} calls the sum {function.key}, which lanes share, but is not made for lanes: let "
                "it begin with i = s.first + wp.tid() // LANES, and write nothing but where lane() is 0."
            )


def _called(function: Any) -> Iterator[Any]:
    """Yield the Warp functions that a Python function names, and, recursively, those that they name."""
    known = inspect.getclosurevars(function)
    for value in (*known.nonlocals.values(), *known.globals.values()):
        if isinstance(value, wp.Function) and value.func:
            yield value
            yield from _called(value.func)


COUNTS = (1, 2, 4, 8, 16)
"""Numbers of lanes that a particle can have."""


def checked_lanes(lanes: Any) -> int | None:
    """Return the user's argument ``lanes``, or None; raises `InputError` for an impossible number of lanes."""
    if lanes is not None and whole_number("lanes", lanes, 1) not in COUNTS:
        wanted = ", ".join(map(str, COUNTS))
        raise InputError(f"lanes is {shown(lanes)}, but must be one of {wanted}, or be left out.")
    return None if lanes is None else int(lanes)


def lanes_for(particles: int, device: Any, wanted: int | None = None) -> int:
    """Return the lanes of a particle on a device: on a GPU the number ``wanted``, if given, otherwise a number that
    suits the particles of one scene."""
    if device.is_cpu:
        return 1
    return wanted or next((lanes for most, lanes in BY_SIZE if particles <= most), 1)


@cache
def lane_functions(precision: Precision, lanes: int) -> SimpleNamespace:
    """Build the Warp functions of kernels for a number of lanes, a power of 2 up to 32.

    ``lane`` returns the number of a thread's lane, ``add_up`` and ``add_up_vectors`` return sums over the lanes.
    ``vote`` returns a number whose bit k is set if lane k votes yes; ``ones`` counts the bits of a vote, and ``before``
    the bits of earlier lanes."""
    return _of_one(precision) if lanes == 1 else _of_several(precision, lanes)


@cache
def sum_over_lanes(kind: Any, precision: Precision, lanes: int) -> Any:
    """Return a Warp function that sums a number, or a vector of any length, of type ``kind`` over the lanes."""
    functions = lane_functions(precision, lanes)
    if kind is precision.real:
        return functions.add_up
    if kind is precision.vector:
        return functions.add_up_vectors
    add_up, length = functions.add_up, len(kind())

    @wp.func
    def same(x: kind) -> kind:
        return x

    @wp.func
    def add_up_components(x: kind) -> kind:
        result = kind()
        for k in range(wp.static(length)):
            result[k] = add_up(x[k])
        return result

    return same if lanes == 1 else add_up_components


def _of_one(precision: Precision) -> SimpleNamespace:
    real, vector = precision.real, precision.vector

    @wp.func
    def lane() -> int:
        return 0

    @wp.func
    def add_up(x: real) -> real:
        return x

    @wp.func
    def add_up_vectors(x: vector) -> vector:
        return x

    @wp.func
    def vote(yes: bool) -> int:
        return wp.where(yes, 1, 0)

    @wp.func
    def ones(votes: int) -> int:
        return votes

    @wp.func
    def before(votes: int) -> int:
        return 0

    return by_name(lane, add_up, add_up_vectors, vote, ones, before)


def _of_several(precision: Precision, lanes: int) -> SimpleNamespace:
    """Return CUDA functions of lanes: threads of a particle are neighbours in one warp, and wait for each other."""
    real, vector = precision.real, precision.vector
    first, group = f"(threadIdx.x % 32u / {lanes}u * {lanes}u)", f"{(1 << lanes) - 1}u"

    @wp.func_native(f"return threadIdx.x % {lanes}u;")
    def lane() -> int: ...

    rounds = " ".join(f"x += __shfl_xor_sync(mask, x, {lanes >> k});" for k in range(1, lanes.bit_length()))

    @wp.func_native(f"unsigned mask = {group} << {first}; {rounds} return x;")
    def add_up(x: real) -> real: ...

    @wp.func
    def add_up_vectors(x: vector) -> vector:
        return vector(add_up(x[0]), add_up(x[1]), add_up(x[2]))

    @wp.func_native(f"return __ballot_sync({group} << {first}, yes) >> {first} & {group};")
    def vote(yes: bool) -> int: ...

    @wp.func_native("return __popc(votes);")
    def ones(votes: int) -> int: ...

    @wp.func_native(f"return __popc(votes & ((1u << threadIdx.x % {lanes}u) - 1u));")
    def before(votes: int) -> int: ...

    return by_name(lane, add_up, add_up_vectors, vote, ones, before)
