"""Give public functions clear error messages for wrong arguments, and make objects immutable."""

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from functools import cache, wraps
from inspect import BoundArguments, Parameter, isclass, signature
from numbers import Integral, Real
from types import FunctionType, NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from cortado.errors import CortadoError, InputError, shown

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
_WORDS: dict[Any, str] = {
    NoneType: "None",
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    os.PathLike: "a path",
    Callable: "a function",
    Mapping: "a table",
    Iterable: "a list",
}


def face(module: dict[str, Any]) -> Callable[[], list[str]]:
    """Apply `public` to every name in a module's ``__all__``. Return the module's function ``__dir__``."""
    names: list[str] = module["__all__"]
    module.update({name: public(module[name]) for name in names})
    return lambda: names


def public(value: T) -> T:
    """Make a function, or the public methods of a class, raise `InputError` for wrong arguments."""
    if not str(getattr(value, "__module__", "")).startswith("cortado"):
        return value
    made: Any = value
    if isinstance(value, FunctionType):
        home, name = sys.modules[made.__module__], made.__name__
        if getattr(home, name, None) is made:
            setattr(home, name, told(made))
        made = told(made)
    for owner in made.__mro__ if isclass(made) and not getattr(made, "_is_protocol", False) else ():
        if owner.__module__.startswith("cortado"):
            for name, method in list(vars(owner).items()):
                if name != "__init__" and name.startswith("_"):
                    continue
                if isinstance(method, FunctionType):
                    setattr(owner, name, told(method))
                elif isinstance(method, (classmethod, staticmethod)):
                    setattr(owner, name, type(method)(told(method.__func__)))
    return made


@cache
def told(function: F) -> F:
    """Wrap a function so that a call with wrong arguments raises `InputError` with a clear message."""
    if hasattr(function, "is_told"):
        return function
    takes = signature(function)
    needed = [n for n, p in takes.parameters.items() if p.default is Parameter.empty and p.kind.name[:3] != "VAR"]

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except CortadoError:
            raise
        except Exception as problem:
            try:
                bound = takes.bind(*arguments, **named)
            except TypeError as misuse:
                makes = function.__name__ == "__init__"
                name = type(arguments[0]).__name__ if makes else function.__qualname__
                given = [*list(takes.parameters)[: len(arguments)], *named]
                lacking = [one for one in needed if one not in given]
                found = f"is given no {lacking[0]}" if lacking else f"is called in a wrong way ({misuse})"
                written = [("**" if p.kind is Parameter.VAR_KEYWORD else "") + n for n, p in takes.parameters.items()]
                wanted = ", ".join(one for one in written if one != "self")
                raise InputError(f"{name} {found}, but must be called as {name}({wanted}).") from None
            if sentence := _misfit(function, bound):
                raise InputError(sentence) from problem
            raise

    call.is_told = True  # type: ignore[attr-defined]
    return call  # type: ignore[return-value]


def _misfit(function: Any, bound: BoundArguments) -> str | None:
    try:
        hints = get_type_hints(function)
    except NameError:  # of types that are imported for the check of types alone
        return None
    for name, value in bound.arguments.items():
        if name in hints and bound.signature.parameters[name].kind.name[:3] != "VAR" and not _fits(value, hints[name]):
            return f"{name} is {shown(value)}, but must be {_words(hints[name])}."
    return None


def _fits(value: Any, hint: Any) -> bool:
    """Test whether a value matches a type hint, without consuming an iterator."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if kind is Annotated:
        return _fits(value, inner[0])
    if kind is Literal:
        return value in inner
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if kind is Any or not isclass(kind):  # or a type that a variable stands for
        return True
    if getattr(kind, "_is_protocol", False) and kind.__module__.startswith("cortado"):
        protocols = [one for one in kind.__mro__ if getattr(one, "_is_protocol", False)]
        members = [name for one in protocols for name in (*vars(one), *one.__annotations__) if not name.startswith("_")]
        return not isclass(value) and all(hasattr(value, name) for name in members)
    if not isinstance(value, kind) or (isinstance(value, str) and issubclass(kind, Iterable)):
        return kind is str and isinstance(value, str)
    if kind is Callable and inner and isinstance(inner[0], list):
        return _takes(value, len(inner[0]))
    if kind is tuple and isinstance(value, tuple) and inner and inner[-1] is not ...:
        return len(value) == len(inner) and all(_fits(*pair) for pair in zip(value, inner, strict=True))
    if inner and isinstance(value, Mapping):
        return all(_fits(one, inner[-1]) for one in value.values())
    return not (inner and isinstance(value, (list, tuple))) or all(_fits(one, inner[0]) for one in value)


def _takes(function: Any, number: int) -> bool:
    try:
        signature(function).bind(*[None] * number)
    except TypeError:
        return False
    except ValueError:  # of functions that Python knows nothing of
        pass
    return True


def _words(hint: Any) -> str:
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(_words, inner)))
    if kind is Literal:
        return " or ".join(map(repr, inner))
    if kind is Annotated:
        return _words(inner[0])
    if kind is Callable and inner and isinstance(inner[0], list):
        return f"a function of {len(inner[0])} arguments"
    if kind.__name__ == "ndarray":
        return "an array"
    found = next((words for one, words in _WORDS.items() if isclass(kind) and issubclass(kind, one)), None)
    return found or f"an object of the type {kind.__name__}"


_OWN = "_made_with"


def fixed(made: type[T]) -> type[T]:
    """Make setting or deleting public attributes of a class raise `InputError`. Derived classes may add attributes."""
    begin: Callable[..., None] = told(made.__init__)

    @wraps(begin)
    def construct(self: Any, *arguments: Any, **named: Any) -> None:
        begin(self, *arguments, **named)
        object.__setattr__(self, _OWN, frozenset(name for name in vars(self) if not name.startswith("_")))

    def refuse_if_fixed(self: Any, name: str, done: str) -> None:
        if not name.startswith("_") and _OWN in vars(self):
            unknown = type(self) is made and not callable(getattr(made, name, None))
            if unknown or name in vars(self)[_OWN]:
                kind = made.__name__
                raise InputError(f"{name} cannot be {done}, as a {kind} does not change; make another {kind}.")

    def set_attribute(self: Any, name: str, value: Any) -> None:
        refuse_if_fixed(self, name, "set")
        object.__setattr__(self, name, value)

    def delete_attribute(self: Any, name: str) -> None:
        refuse_if_fixed(self, name, "deleted")
        object.__delattr__(self, name)

    changed: Any = made
    changed.__init__, changed.__setattr__, changed.__delattr__ = construct, set_attribute, delete_attribute
    return made


class FixedDict(dict[Any, Any]):
    def __reduce__(self) -> tuple[Any, ...]:
        return FixedDict, (dict(self),)

    def _refuse(self, *arguments: Any, **named: Any) -> NoReturn:
        raise InputError("Settings of an object cannot be changed; make a new object with the new settings.")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse


def keep_own(made: object, name: str) -> None:
    value = getattr(made, name)
    if isinstance(value, Mapping):
        object.__setattr__(made, name, FixedDict(value))
    elif isinstance(value, list):
        object.__setattr__(made, name, tuple(value))


class Staying:
    """A base class for objects with arrays on a device. Pickling or copying a derived object raises `InputError`."""

    instead: ClassVar[str] = "but NumPy arrays of its contents can"
    """End of the error message, which names the objects that can be pickled instead."""

    def __reduce__(self) -> NoReturn:
        name = type(self).__name__
        article = "An" if name[0] in "AEIOU" else "A"
        raise InputError(f"{article} {name} can be neither pickled nor copied, {self.instead}.")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 phase`` or ``2 phases``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def quoted(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in names) or "none"


def point_in_words(point: Iterable[float]) -> str:
    return f"({', '.join(f'{value:g}' for value in point)})"


def sized(arrays: Mapping[str, Any]) -> str:
    """Return names with the shapes of their arrays, such as ``gravity (3,), viscosity``."""
    shapes = {name: getattr(value, "shape", ()) for name, value in arrays.items()}
    return ", ".join(f"{name} {shape}" if shape else name for name, shape in shapes.items())


class ShortRepr:
    """A base class whose ``repr`` shows shapes of arrays. Derived dataclasses must have ``repr=False``."""

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        shown = (f"{name}={_brief(value)}" for name, value in values.items())
        return f"{type(self).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name}: {_brief(entry)}' for name, entry in value.items())}}}"
    shape = getattr(value, "shape", ())
    return f"array {shape}" if shape else repr(value)
