"""The meaning of a user's function or object as a text, which is another where it computes something else: its code,
and the numbers, functions and objects that it reads."""

import sysconfig
from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from inspect import isclass, isfunction, ismethod, ismodule
from types import CellType, CodeType, FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

KEPT = ("builtins", "jax", "math", "numpy", "scipy", "torch", "warp")
"""Packages that do not change, whose functions and objects count by name alone."""
PYTHON = sysconfig.get_path("stdlib")
"""Folder of Python's standard modules, and sometimes of installed ones."""
SNIPPETS = ("native_snippet", "adj_native_snippet", "replay_snippet")
"""Attributes of Warp functions that hold their C++ texts."""


def code_words(value: Any) -> str:
    """Return a checksum of the `words` of a value."""
    return sha256("\n".join(words(value)).encode()).hexdigest()[:16]


def words(value: Any, names: tuple[str, ...] | None = None, seen: set[Any] | None = None) -> list[str]:
    """Return lines equal in every process, and different where a value computes something else. Objects and a user's
    modules count by attributes with these ``names``, as the reading code has them; by all if left out."""
    value, seen = _parts(value), set() if seen is None else seen
    if isinstance(value, (bool, int, float, complex, str, bytes, range, slice, type(None))):
        return [repr(value)]
    if isinstance(value, (list, tuple)):
        return ["[", *(word for entry in value for word in words(entry, names, seen)), "]"]
    if isinstance(value, (np.ndarray, np.generic)):
        return [f"{value.dtype} {value.shape} {sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"]
    if ismethod(value):
        return [*words(value.__func__, names, seen), *words(value.__self__, names_in(value.__func__), seen)]
    name, package = str(getattr(value, "__qualname__", type(value).__qualname__)), package_of(value)
    if (id(value), names) in seen or isclass(value) or package in KEPT or _is_told_by_name(value):
        return [value.__name__ if ismodule(value) else name]
    seen.add((id(value), names))
    if isfunction(value):
        return [*_of_code(value.__code__), *words([value.__defaults__, read_by(value)], names_in(value), seen)]
    own = getattr(value, "__dict__", {})
    found = own if names is None else {key: getattr(value, key) for key in names if hasattr(value, key)}
    return [name, *words({key: one for key, one in found.items() if not key.startswith("__")}, names, seen)]


def _parts(value: Any) -> Any:
    """Return the parts that tell a value from others: itself, or a list of its contents."""
    if isinstance(value, wp.Function) and value.func:
        forms = [*value.user_overloads.values(), *value.user_templates.values()] or [value]
        more = ("func", "custom_grad_func", "custom_replay_func", *SNIPPETS)
        return [[one.adj.source, *(getattr(one, name) for name in more)] for one in forms]
    if isinstance(value, wp.Kernel):
        return value.func
    if isinstance(value, wp.array):
        return value.numpy()
    if isinstance(value, partial):
        return [value.func, value.args, value.keywords]
    value = vars(value) if isinstance(value, SimpleNamespace) else value
    if isinstance(value, Mapping):
        return [entry for key in sorted(value, key=repr) for entry in (key, value[key])]
    if isinstance(value, (set, frozenset)):
        return sorted(value, key=repr)
    if package_of(value) == "warp" and hasattr(value, "__len__") and not isclass(value):
        return list(value)
    return value if isfunction(value) else getattr(value, "__wrapped__", value)  # of functools.cache


def _is_told_by_name(value: Any) -> bool:
    """Test if a value is a module or a function of Cortado's or Python's own."""
    file = value.__code__.co_filename if isfunction(value) else ""
    is_python = file.startswith(PYTHON) and "site-packages" not in file
    return is_python or (package_of(value) == "cortado" and (ismodule(value) or isfunction(value)))


def _of_code(code: CodeType) -> list[str]:
    consts = [word for one in code.co_consts for word in (_of_code(one) if isinstance(one, CodeType) else words(one))]
    return [code.co_code.hex(), *code.co_names, *code.co_varnames, *consts]


def read_by(function: FunctionType) -> dict[str, Any]:
    """Return the values that a function reads from outside itself, by name."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    found = {name: function.__globals__[name] for name in names_in(function) if name in function.__globals__}
    return dict(sorted({**found, **{name: cell.cell_contents for name, cell in cells if cell != CellType()}}.items()))


def names_in(function: Any) -> tuple[str, ...]:
    """Return all names that a function, or a code, may read from outside or as attributes."""
    code = getattr(function, "__code__", function)
    inner = [name for one in code.co_consts if isinstance(one, CodeType) for name in names_in(one)]
    return tuple(dict.fromkeys([*code.co_names, *inner]))


def package_of(value: Any) -> str:
    """Return the name of the package of a module, a function or a class, or of an object's class."""
    name = (
        value.__name__
        if ismodule(value)
        else (value if isclass(value) or isfunction(value) else type(value)).__module__
    )
    return str(name).partition(".")[0]
