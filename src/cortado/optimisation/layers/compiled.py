"""Python functions within programs that JAX compiles, by Warp's foreign functions: on the memory of the program and, on
a GPU, in its stream."""

import inspect
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from itertools import count
from typing import Any
from uuid import uuid4
from weakref import finalize

import warp as wp

from cortado.device.threads import WARP
from cortado.errors import CortadoError
from cortado.optimisation.layers.layer import Array, on_host

Kind = tuple[int, str]
"""How many axes an array has, and the name of its type."""


class ForeignFunction:
    """A function of arrays that a compiled program calls, for as long as the program holds this, and some time longer:
    JAX lets go of a program that still runs."""

    def __init__(self, function: Callable[[list[Array]], Sequence[Array]]):
        self._number = next(_NUMBERS)
        _FUNCTIONS[self._number] = function
        finalize(self, _let_go, self._number)

    @WARP
    def __call__(self, *arrays: Any, results: Sequence[Any]) -> list[Any]:
        """The call within a function that JAX traces; ``results`` have the shape and the type of what it returns."""
        given = [array.reshape(array.shape or (1,)) for array in arrays]
        shapes = [result.shape or (1,) for result in results]
        kinds = tuple((array.ndim, str(array.dtype)) for array in given)
        made = tuple((len(shape), str(result.dtype)) for shape, result in zip(shapes, results, strict=True))
        dims = {f"out_{k}": shape for k, shape in enumerate(shapes)}
        found = _callable(kinds, made)(*given, self._number, output_dims=dims)
        return [own.reshape(result.shape) for own, result in zip(found, results, strict=True)]


LONGER = 64
"""So many functions whose programs are gone are kept."""
_NUMBERS = count(1)
_FUNCTIONS: dict[int, Callable[[list[Array]], Sequence[Array]]] = {}
_GONE: deque[int] = deque()


def _let_go(number: int) -> None:
    _GONE.append(number)
    while len(_GONE) > LONGER:
        _FUNCTIONS.pop(_GONE.popleft(), None)


@cache
def _callable(given: tuple[Kind, ...], made: tuple[Kind, ...]) -> Any:
    """What calls a function by its number, with so many arrays of these kinds."""

    def call(*arguments: Any) -> None:
        arrays, number, results = arguments[: len(given)], arguments[len(given)], arguments[len(given) + 1 :]
        with WARP, _in_order(results[0].device):
            try:
                found = _FUNCTIONS[number]([_as_array(array) for array in arrays])
            except CortadoError as error:
                raise error.with_traceback(None) from None
            for result, own in zip(results, found, strict=True):
                if isinstance(own, wp.array) and own.dtype == result.dtype and own.device == result.device:
                    wp.copy(result, own.reshape(result.shape))
                else:
                    result.assign(on_host(own).reshape(result.shape))

    types = {f"in_{k}": _annotation(*kind) for k, kind in enumerate(given)}
    types |= {"number": int} | {f"out_{k}": _annotation(*kind) for k, kind in enumerate(made)}
    call.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in types]
    )
    call.__annotations__ = types
    call.__qualname__ = f"call_{uuid4().hex}"  # a program that was kept on disk does not find it in another process
    found = wp.jax_callable(call, len(made), wp.JaxCallableGraphMode.NONE, vmap_method=None)
    vars(sys.modules[type(found).__module__])["print"] = _print
    return found


def _print(*words: Any, **options: Any) -> None:
    """What Warp's foreign functions print, which is the traceback of each error, but for errors of ours: JAX raises
    them with their sentence, and their traceback says nothing more. Warp has no setting for it."""
    if not isinstance(sys.exc_info()[1], CortadoError):
        print(*words, **options)


def _in_order(device: Any) -> AbstractContextManager[Any]:
    """On a GPU, in a stream of ours, after and before what is in that of the program, which cannot be captured."""
    return nullcontext() if device.is_cpu else wp.ScopedStream(_stream(device.alias), sync_enter=True, sync_exit=True)


@cache
def _stream(device: str) -> Any:
    return wp.Stream(device)


def _annotation(axes: int, dtype: str) -> Any:
    return wp.array(dtype=getattr(wp, dtype), ndim=axes)


def _as_array(array: wp.array) -> Array:
    return array.numpy() if array.device.is_cpu else array
