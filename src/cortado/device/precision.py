"""The two floating-point precisions, Warp functions in either precision, and Warp types for parameters by their names.

Lanes are GPU threads that share a particle. Each lane processes different neighbours, and every lane gets the sums over
all lanes with the same bits. The first lane of a particle writes the result. Lanes speed up simulations with few
particles.

A kernel for lanes is launched with LANES threads per particle. The index of a thread's particle is `wp.tid() // LANES`.
On a CPU and for Warp's tape there is a single lane.
"""

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
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
    name: str
    real: Any
    vector: Any
    """Warp vector type of three components. In 2-D, z is 0."""
    pair: Any
    numpy: type
    tiny: float
    """Very small positive number with a finite reciprocal."""
    furthest: float
    """Greatest distance of positions from the origin [spacings]. Positions are then rounded by about 0.001 spacings at
    most."""
    greatest: float
    """Greatest size of a parameter, which keeps products of several parameters finite."""

    @property
    def bytes(self) -> int:
        return np.dtype(self.numpy).itemsize

    @property
    def six(self) -> Any:
        """Warp vector type of six components for symmetric matrices."""
        return wp.types.vector(length=6, dtype=self.real)

    @property
    def matrix(self) -> Any:
        return wp.types.matrix(shape=(3, 3), dtype=self.real)

    def vector_of(self, values: Iterable[float]) -> Any:
        return self.vector(*(*values, 0.0)[:3])

    def fractions(self, phases: int) -> Any:
        return wp.types.vector(length=phases, dtype=self.real)


FLOAT32 = Precision("float32", wp.float32, wp.vec3f, wp.vec2f, np.float32, 1e-30, 1e4, 1e12)
FLOAT64 = Precision("float64", wp.float64, wp.vec3d, wp.vec2d, np.float64, 1e-200, 1e9, 1e50)


def precision_named(name: str) -> Precision:
    for precision in (FLOAT32, FLOAT64):
        if isinstance(name, str) and precision.name == name:
            return precision
    raise InputError(f'precision is {shown(name)}, but must be "float32" or "float64".')


def struct_of(name: str, precision: Precision, **fields: Any) -> Any:
    return wp.struct(type(f"{name}_{precision.name}", (), {"__annotations__": fields, "__module__": __name__}))


class TypesByName:
    """A decorator that gives Warp types to the parameters of functions by their names.

        typed = TypesByName(real, {vector: "x v", neighbourhood: "s"})

        @fluid_sum(discretisation, typed)
        def spread(x_ij, x_dot_ij, v_ij, m_i, m_j, s) -> vector: ...

    A parameter without annotation gets its type from the listed names. A listed name fits every parameter whose name
    begins with the listed name, as x fits x_dot_ij. The longest fitting name counts. Without a listed name the
    parameter gets the usual type.
    """

    def __init__(self, usual: Any, *names: Mapping[Any, str]):
        """``names`` map types to the names of parameters. Later mappings in ``names`` have priority."""
        self._usual = usual
        self._types = {name: kind for own in names for kind, words in own.items() for name in words.split()}

    def __call__(self, function: Any, whole: Callable[[Any], Any] = lambda kind: kind) -> Callable[..., Any]:
        given = function.__annotations__
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        types = {name: given[name] if name in given else whole(self._of(name)) for name in names}
        function.__annotations__ = types | given
        return function

    def arrays(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Add array types or Warp structs to the parameters of a kernel. Output arrays must come last."""
        return self(function, lambda kind: wp.array(dtype=kind) if isinstance(kind, type) else kind)

    def kernel(self, module: Any, **options: Any) -> Callable[..., Any]:
        return lambda function: wp.kernel(self.arrays(function), module=module, **options)

    def _of(self, name: str) -> Any:
        while name and name not in self._types:
            name = name.rpartition("_")[0]
        return self._types.get(name, self._usual)


@cache
def arithmetic(precision: Precision, taped: bool) -> SimpleNamespace:
    """The arguments are positive normal numbers. ``taped`` functions have derivatives and exact IEEE 754 rounding."""
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
"""Each pair has the greatest number of particles, and the number of GPU lanes up to this number of particles."""
_OF_MODULES: dict[str, int] = {}


def set_lanes(module: Any, lanes: int) -> None:
    _OF_MODULES[module.name] = lanes


@cache
def lanes_of(kernel: wp.Kernel) -> int:
    return _OF_MODULES.get(kernel.module.name, 1) if "wp.tid() // LANES" in kernel.adj.source else 1


@cache
def check_sum(kernel: wp.Kernel) -> None:
    """Raise `TypeError` for a kernel over neighbours that ignores its range of particles or its lanes."""
    source = kernel.adj.source
    if f"{kernel.adj.args[0].label}.first" not in source:
        raise TypeError(
            f"kernel {kernel.key} takes the neighbourhood s, but ignores the first particle of a range, so that every "
            "range would write to the first particles: begin the kernel with i = s.first + wp.tid()."
        )
    if "wp.tid() // LANES" in source and "lane()" in source:
        return
    for function in _called(kernel.func):
        if getattr(function, "shares_lanes", False):
            raise TypeError(
                f"kernel {kernel.key} calls the sum {function.key}, which lanes share, but ignores the lanes: begin "
                "the kernel with i = s.first + wp.tid() // LANES, and write results only where lane() is 0."
            )


def _called(function: Any) -> Iterator[Any]:
    known = inspect.getclosurevars(function)
    for value in (*known.nonlocals.values(), *known.globals.values()):
        if isinstance(value, wp.Function) and value.func:
            yield value
            yield from _called(value.func)


COUNTS = (1, 2, 4, 8, 16)


def checked_lanes(lanes: Any) -> int | None:
    if lanes is not None and whole_number("lanes", lanes, 1) not in COUNTS:
        raise InputError(f"lanes is {shown(lanes)}, but must be one of {', '.join(map(str, COUNTS))}, or be left out.")
    return None if lanes is None else int(lanes)


def lanes_for(particles: int, device: Any, wanted: int | None = None) -> int:
    if device.is_cpu:
        return 1
    return wanted or next((lanes for most, lanes in BY_SIZE if particles <= most), 1)


@cache
def lane_functions(precision: Precision, lanes: int) -> SimpleNamespace:
    """``lanes`` is a power of 2 up to 32. ``vote`` returns an integer whose bit k is set if lane k votes yes. ``ones``
    counts the set bits, and ``before`` counts the set bits of lower lanes."""
    return _of_one(precision) if lanes == 1 else _of_several(precision, lanes)


@cache
def sum_over_lanes(kind: Any, precision: Precision, lanes: int) -> Any:
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
