"""What users call says in a sentence which arguments a call lacks, or has that are none."""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Any, TypeVar

from cortado.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])


def told(function: F) -> F:
    """A function, or the ``__init__`` of a class, that raises an `InputError` for a call that does not fit it, where
    Python has a `TypeError`."""
    takes = signature(function)
    needed = [n for n, p in takes.parameters.items() if p.default is Parameter.empty and p.kind.name[:3] != "VAR"]

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        try:
            takes.bind(*arguments, **named)
        except TypeError as problem:
            makes = function.__name__ == "__init__"
            name = type(arguments[0]).__name__ if makes else function.__qualname__
            given = [*list(takes.parameters)[: len(arguments)], *named]
            lacking = [one for one in needed if one not in given]
            found = f"is given no {lacking[0]}" if lacking else f"is called in a wrong way ({problem})"
            written = [("**" if p.kind is Parameter.VAR_KEYWORD else "") + n for n, p in takes.parameters.items()]
            wanted = ", ".join(one for one in written if one != "self")
            raise InputError(f"{name} {found}, but must be called as {name}({wanted}).") from None
        return function(*arguments, **named)

    return call  # type: ignore[return-value]
