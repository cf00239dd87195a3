"""Call Python functions of arrays from compiled JAX programs, through the foreign function interface of XLA.

XLA calls one function of this module with the addresses of buffers. Arrays of one data type are concatenated in one
buffer, because the cost of a call grows with the number of buffers. Warp defines the C structs of the interface.
"""

import ctypes
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from itertools import count, pairwise
from math import prod
from typing import Any
from uuid import uuid4
from weakref import finalize

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from warp._src.jax import xla_ffi

from cortado.device.threads import WARP
from cortado.errors import CortadoError
from cortado.optimisation.layers.layer import Array, fill, kept_or_made
from cortado.rollout.device_states import flat_of

Sizes = tuple[int, ...]
Function = Callable[[list[Array]], Sequence[Array]]
TARGET = f"cortado_{uuid4().hex}"
"""Name of the function in XLA. Each process uses a new name, because JAX may store compiled programs on disk."""
KEPT = 8


class ForeignFunction:
    """A Python function of arrays for compiled programs. The arguments of the function are views of XLA's buffers."""

    def __init__(self, function: Function):
        self._function, self._number = function, next(_NUMBERS)
        finalize(self, _let_go, self._number)

    def __call__(self, *arrays: Any, results: Sequence[Any]) -> list[Any]:
        """Call the function with traced ``arrays``. The call returns arrays with the shapes and data types of
        ``results``. The function returns arrays of the same sizes."""
        given, made = Packing([(a.shape, a.dtype) for a in arrays]), Packing([(r.shape, r.dtype) for r in results])
        _CALLS[self._number] = self._function, given, made
        packed = [jnp.concatenate([arrays[k].reshape(-1) for k in group]) for group in given.groups.values()]
        kinds = [jax.ShapeDtypeStruct((ends[-1],), dtype) for dtype, ends in made.ends.items()]
        return made.cut(jax.ffi.ffi_call(TARGET, kinds)(*packed, number=np.int64(self._number)))


class Packing:
    """A layout of arrays with known shapes. All arrays of one data type are concatenated in one flat array."""

    def __init__(self, kinds: Sequence[tuple[Sizes, Any]]):
        self._shapes = [shape for shape, _ in kinds]
        self.groups: dict[str, list[int]] = {}
        """Indices of the arrays of each data type."""
        for k, (_, dtype) in enumerate(kinds):
            self.groups.setdefault(str(dtype), []).append(k)
        sizes = {dtype: [prod(self._shapes[k]) for k in group] for dtype, group in self.groups.items()}
        self.ends = {dtype: np.cumsum([0, *own]).tolist() for dtype, own in sizes.items()}
        self._kept: dict[tuple[int, ...], tuple[list[Any], list[Any]]] = {}

    def at(self, addresses: tuple[int, ...], device: Any) -> tuple[list[Any], list[Any]]:
        """Return flat arrays at the addresses of buffers, and the views that `cut` makes. The arrays are NumPy arrays
        if ``device`` is None, and Warp arrays otherwise. Results are cached, because programs use the same few buffers
        again."""
        return kept_or_made(self._kept, addresses, lambda _: self._made(addresses, device), KEPT)

    def _made(self, addresses: tuple[int, ...], device: Any) -> tuple[list[Any], list[Any]]:
        each = zip(addresses, self.ends.items(), strict=True)
        whole = [_array_at(address, ends[-1], dtype, device) for address, (dtype, ends) in each]
        return whole, self.cut(whole)

    def cut(self, whole: Sequence[Any]) -> list[Any]:
        """Return views of flat arrays in the shapes of the packed arrays."""
        found: list[Any] = [None] * len(self._shapes)
        for flat, (dtype, group) in zip(whole, self.groups.items(), strict=True):
            for k, (first, end) in zip(group, pairwise(self.ends[dtype]), strict=True):
                shape = self._shapes[k]
                found[k] = flat[first:end].reshape((shape or (1,)) if isinstance(flat, wp.array) else shape)
        return found

    def fill(self, whole: Sequence[Any], views: Sequence[Any], found: Sequence[Array]) -> None:
        """Copy the arrays ``found`` to flat arrays ``whole``, whose parts are ``views``. Arrays that are adjacent in
        GPU memory are copied together."""
        for result, group in zip(whole, self.groups.values(), strict=True):
            rest = group
            if isinstance(result, wp.array):
                there = [k for k in group if isinstance(found[k], wp.array) and found[k].device == result.device]
                flat = flat_of([found[k] for k in there]) if there == group[: len(there)] else None
                if flat is not None and flat.dtype == result.dtype:
                    wp.copy(result, flat, count=flat.size)
                    rest = group[len(there) :]
            for k in rest:
                fill(views[k], found[k])


_NUMBERS = count(1)
_CALLS: dict[int, tuple[Function, Packing, Packing]] = {}
_GONE: deque[int] = deque()


def _let_go(number: int) -> None:
    _GONE.append(number)
    while len(_GONE) > 64:
        _CALLS.pop(_GONE.popleft(), None)


def _array_at(address: int, size: int, dtype: str, device: Any) -> Any:
    if device is not None:
        return wp.array(ptr=address, dtype=getattr(wp, dtype), shape=(size,), device=device)
    kind = np.dtype(dtype)
    memory: Any = (ctypes.c_char * (size * kind.itemsize)).from_address(address) if size else b""
    return np.frombuffer(memory, dtype=kind)


def _call(frame: Any, device: Any) -> None:
    number = xla_ffi.XLA_FFI_Scalar.from_address(frame.attrs.attrs[0]).value
    function, given, made = _CALLS[ctypes.c_int64.from_address(number).value]
    _, arrays = given.at(_addresses(frame.args.args, frame.args.size), device)
    whole, views = made.at(_addresses(frame.rets.rets, frame.rets.size), device)
    made.fill(whole, views, function(arrays))


def _addresses(buffers: Any, size: int) -> tuple[int, ...]:
    return tuple(xla_ffi.XLA_FFI_Buffer.from_address(buffers[k]).data for k in range(size))


def _call_on_cpu(frame: Any) -> None:
    with WARP:
        _call(frame, None)


def _call_on_gpu(frame: Any) -> None:
    """Call a function in a separate stream, which is synchronised with the program's stream before and after
    the call."""
    with WARP:
        wp.init()
        ordinal = xla_ffi.get_device_ordinal_from_callframe(frame)
        own = _own_stream(ordinal)
        theirs = _stream_at(ordinal, xla_ffi.get_stream_from_callframe(frame))
        own.wait_stream(theirs)
        with wp.ScopedStream(own, sync_enter=False):
            _call(frame, own.device)
        theirs.wait_stream(own)


@cache
def _own_stream(ordinal: int) -> Any:
    """Return the stream of a GPU that all calls share, so that calls run in order."""
    return wp.Stream(wp.get_cuda_device(ordinal))


@cache
def _stream_at(ordinal: int, address: int) -> Any:
    return wp.Stream(wp.get_cuda_device(ordinal), cuda_stream=address)


def _handler(call: Callable[[Any], None]) -> Any:

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(xla_ffi.XLA_FFI_CallFrame))
    def handle(pointer: Any) -> Any:
        frame = pointer.contents
        try:
            asked = frame.extension_start
            if asked and asked.contents.type == xla_ffi.XLA_FFI_Extension_Type.Metadata:
                extension = ctypes.cast(asked, ctypes.POINTER(xla_ffi.XLA_FFI_Metadata_Extension))
                version = extension.contents.metadata.contents.api_version
                version.major_version, version.minor_version = 0, 1
            else:
                call(frame)
        except Exception as error:
            if not isinstance(error, CortadoError):
                traceback.print_exc()
            said = f"FFI callback error: {type(error).__name__}: {error}"
            return xla_ffi.create_ffi_error(frame.api, xla_ffi.XLA_FFI_Error_Code.UNKNOWN, said)
        return None

    return handle


_HANDLERS = {"cpu": _handler(_call_on_cpu), "CUDA": _handler(_call_on_gpu)}
for _platform, _handle in _HANDLERS.items():
    _address = ctypes.cast(_handle, ctypes.c_void_p).value
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(_address), platform=_platform)
