"""What a function of a user's computes, as a text: its code, and the numbers, functions and kernels that it names."""

from functools import partial
from hashlib import sha256
from types import CodeType, FunctionType, MethodType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp


def code_words(function: Any) -> str:
    """A checksum that is the same in another process, and another one where the function computes something else. Of a
    callable object only the name of its type counts."""
    return sha256("\n".join(_words(function, set())).encode()).hexdigest()[:16]


def _words(value: Any, seen: set[int]) -> list[str]:
    if isinstance(value, (wp.Kernel, wp.Function)):
        value = value.func or value.key
    if isinstance(value, partial):
        value = [value.func, value.args, value.keywords]
    if isinstance(value, MethodType):
        value = value.__func__
    if isinstance(value, SimpleNamespace):
        value = vars(value)
    if not isinstance(value, FunctionType):
        value = getattr(value, "__wrapped__", value)  # of functools.cache
    if isinstance(value, dict):
        value = [entry for key in sorted(value, key=repr) for entry in (key, value[key])]
    if isinstance(value, (bool, int, float, complex, str, bytes, type(None))):
        return [repr(value)]
    if isinstance(value, (list, tuple)):
        return [word for entry in value for word in _words(entry, seen)]
    if isinstance(value, (np.ndarray, np.generic)):
        return [sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if not isinstance(value, FunctionType):
        return [getattr(value, "__qualname__", type(value).__qualname__)]
    if id(value) in seen:
        return [value.__qualname__]
    seen.add(id(value))
    cells = dict(zip(value.__code__.co_freevars, value.__closure__ or (), strict=True))
    outside = {name: cell.cell_contents for name, cell in cells.items() if name not in value.__code__.co_cellvars}
    outside |= {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
    named = [word for name in sorted(outside) for word in (name, *_words(outside[name], seen))]
    return [*_code(value.__code__), *_words(value.__defaults__, seen), *named]


def _code(code: CodeType) -> list[str]:
    consts = [word for one in code.co_consts for word in (_code(one) if isinstance(one, CodeType) else [repr(one)])]
    return [code.co_code.hex(), *code.co_names, *code.co_varnames, *consts]


def _names(code: CodeType) -> set[str]:
    inner = [_names(one) for one in code.co_consts if isinstance(one, CodeType)]
    return set(code.co_names).union(*inner)
