"""Parts of packages at work: what goes wrong in one is a sentence that names its package, wherever it is used."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from functools import cache, cached_property, wraps
from inspect import getattr_static, isfunction
from traceback import extract_tb
from typing import Any

from cortado.errors import ComputationError, CortadoError, InputError
from cortado.scene.parameters.parameter import Parameter

GUARDED = "_guarded_by_cortado"
"""The attribute of classes that are guarded."""
MISSING = object()
OTHERS = ("builtins", "cortado", "numpy", "types", "warp")
"""Modules whose objects are no part of a package."""


def _in_words(problem: BaseException, package: str) -> str:
    """What a package raised, and where, without the full stop."""
    try:
        text = " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".: ")
    except Exception:  # words of its own that cannot be made
        text = type(problem).__name__
    frames = extract_tb(problem.__traceback__)
    own = [frame for frame in frames if "cortado" not in frame.filename.replace("\\", "/").split("/")] or frames
    return f"{text} ({package}, {own[-1].filename}, line {own[-1].lineno})"


@contextmanager
def guarded(
    what: str, package: str, error: type[CortadoError] = InputError, expected: tuple[type[BaseException], ...] = ()
) -> Iterator[None]:
    """Has whatever a package raises within end as an ``error`` that begins with ``what``, but for Cortado's own errors,
    for an interruption and for what is ``expected``. One that asks for the end of the process does not get it."""
    kept: tuple[type[BaseException], ...] = (CortadoError, KeyboardInterrupt, *expected)
    try:
        yield
    except kept:
        raise
    except BaseException as problem:
        raise error(f"{what} {_in_words(problem, package)}.") from problem


class PackageMaker:
    """What a package makes of a table, as `Simulation` takes it; what it makes in turn is guarded too."""

    def __init__(self, part: Any, kind: str, package: str):
        """``kind``: the name that the package gives it; ``package``: what sentences call that."""
        self._part, self._kind, self._package = part, kind, package

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        with guarded(f'"{self._kind}" fails where its {name} is read:', self._package):
            found = getattr(self._part, name, MISSING)
        if found is MISSING:
            raise AttributeError(name)
        return self._guarded(found, f'"{self._kind}" fails in {name}:') if callable(found) else found

    @cached_property
    def parameters(self) -> Any:
        """Those of the part, whose functions are guarded."""
        found = self.__getattr__("parameters")
        return [self._judged(one) for one in found] if isinstance(found, (list, tuple)) else found

    def _judged(self, parameter: Any) -> Any:
        if not isinstance(parameter, Parameter):
            return parameter
        given = {one.name: getattr(parameter, one.name) for one in fields(parameter)}
        own = [name for name, value in given.items() if isfunction(value) and not _is_ours(value)]
        what = f'"{self._kind}" fails in its parameter {parameter.name}:'
        changes: dict[str, Any] = {name: self._guarded(given[name], what) for name in own}
        return replace(parameter, **changes) if own else parameter

    def _guarded(self, method: Callable[..., Any], what: str) -> Callable[..., Any]:
        def call(*arguments: Any, **more: Any) -> Any:
            with guarded(what, self._package):
                return _at_work(method(*arguments, **more), self._kind, self._package)

        return call

    def __repr__(self) -> str:
        return f'"{self._kind}" of {self._package}'


def _at_work(made: Any, kind: str, package: str) -> Any:
    """What a part of a package made, such as a solver: the methods and properties of its class are guarded from then
    on, and what they return."""
    cls: Any = type(made)
    if cls.__module__.partition(".")[0] not in OTHERS and not isinstance(made, type):
        with suppress(TypeError):  # of a class that is not Python's
            made.__class__ = _guarded_class(cls, kind, package)
    return made


@cache
def _guarded_class(cls: type, kind: str, package: str) -> type:
    """One of the same name, without the methods that are Cortado's."""
    if GUARDED in cls.__dict__:
        return cls
    own: dict[str, Any] = {"__slots__": (), "__module__": cls.__module__, GUARDED: True}
    for name in dir(cls):
        found, what = getattr_static(cls, name), f'"{kind}" fails in {name} of {cls.__name__}:'
        if isinstance(found, property) and found.fget and not _is_ours(found.fget):
            own[name] = property(_guarded_method(found.fget, what, kind, package), found.fset, found.fdel)
        elif isfunction(found) and name == "__getattr__":
            own[name] = _guarded_method(found, what, kind, package, (AttributeError,))
        elif isfunction(found) and not name.startswith("__") and not _is_ours(found):
            own[name] = _guarded_method(found, what, kind, package)
    return type(cls)(cls.__name__, (cls,), own)


def _guarded_method(
    function: Callable[..., Any], what: str, kind: str, package: str, expected: tuple[type[BaseException], ...] = ()
) -> Callable[..., Any]:
    @wraps(function)
    def call(*arguments: Any, **more: Any) -> Any:
        with guarded(what, package, ComputationError, expected):
            return _at_work(function(*arguments, **more), kind, package)

    return call


def _is_ours(function: Any) -> bool:
    return (getattr(function, "__module__", None) or "").partition(".")[0] in OTHERS
