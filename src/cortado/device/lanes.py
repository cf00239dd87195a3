"""Lanes: several threads of a GPU that share a particle; each takes some of its neighbours, and sums are added up.

One thread a particle leaves a large GPU empty where there are few particles. A kernel that is made for lanes finds its
particle with `wp.tid() // LANES`, and is launched with so many threads for each. A lane takes `UNROLL` neighbours at a
time, and then those LANES times further down the list. What lanes have summed up is added in a butterfly of shuffles,
of which every lane gets the same bits, and the first one writes. On a CPU, and for Warp's tape, there is one lane.
"""

import inspect
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.arrays import whole_number
from cortado.device.modules import by_name
from cortado.device.precision import Precision
from cortado.errors import InputError, shown

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
    """Return the lanes of a particle on a device: ``wanted`` on a GPU, if given, or a number suited to the particles of
    one scene."""
    if device.is_cpu:
        return 1
    return wanted or next((lanes for most, lanes in BY_SIZE if particles <= most), 1)


@cache
def lane_functions(precision: Precision, lanes: int) -> SimpleNamespace:
    """Make the Warp functions of kernels for a number of lanes, a power of 2 up to 32.

    ``lane`` returns the number of a thread's lane, ``add_up`` and ``add_up_vectors`` sums over the lanes. ``vote``
    returns a number whose bit k is set where lane k says yes; ``ones`` counts the bits of a vote, and ``before`` those
    of lanes before one's own."""
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
