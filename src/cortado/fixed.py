"""Objects that do not change once they are made, and objects that stay in their process: both refuse in a sentence."""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, ClassVar, NoReturn, TypeVar

from cortado.calls import told
from cortado.errors import InputError

T = TypeVar("T")
_OWN = "_made_with"
"""The attribute with the names of those that the constructor has set."""


def fixed(made: type[T]) -> type[T]:
    """A class whose public attributes stay as its constructor sets them, as what it computes is decided there; others
    are refused too. A class derived from it may have further attributes of its own, and an object methods of its own.

    Raises `InputError` where one is set or deleted, and where the class is called with other arguments than it takes.
    """
    begin: Callable[..., None] = told(made.__init__)

    @wraps(begin)
    def construct(self: Any, *arguments: Any, **named: Any) -> None:
        begin(self, *arguments, **named)
        object.__setattr__(self, _OWN, frozenset(name for name in vars(self) if not name.startswith("_")))

    def is_fixed(self: Any, name: str) -> bool:
        if name.startswith("_") or _OWN not in vars(self):
            return False
        unknown = type(self) is made and not callable(getattr(made, name, None))
        return unknown or name in vars(self)[_OWN]

    def set_attribute(self: Any, name: str, value: Any) -> None:
        if is_fixed(self, name):
            _refuse(made, name, "set")
        object.__setattr__(self, name, value)

    def delete_attribute(self: Any, name: str) -> None:
        if is_fixed(self, name):
            _refuse(made, name, "deleted")
        object.__delattr__(self, name)

    for name, method in {
        "__init__": construct,
        "__setattr__": set_attribute,
        "__delattr__": delete_attribute,
    }.items():
        setattr(made, name, method)
    return made


def _refuse(made: type, name: str, done: str) -> NoReturn:
    kind = made.__name__
    raise InputError(f"{name} cannot be {done}, as a {kind} does not change; make another {kind}.")


class FixedDict(dict[Any, Any]):
    """A copy of a table that cannot be changed; its ``repr`` is that of the table."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FixedDict, (dict(self),)

    def _refuse(self, *arguments: Any, **named: Any) -> NoReturn:
        raise InputError("A setting cannot be changed within an object that was made with it; make another object.")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse


def keep_own(made: object, name: str) -> None:
    """Give a frozen dataclass a copy of a setting that is a table or a list, so that nobody changes it later."""
    value = getattr(made, name)
    if isinstance(value, Mapping):
        object.__setattr__(made, name, FixedDict(value))
    elif isinstance(value, list):
        object.__setattr__(made, name, tuple(value))


class Staying:
    """An object with arrays on a device, which raises `InputError` where it is pickled or copied."""

    instead: ClassVar[str] = "but NumPy arrays of what it holds can"
    """The end of the sentence: what can be pickled in its place."""

    def __reduce__(self) -> NoReturn:
        name = type(self).__name__
        article = "An" if name[0] in "AEIOU" else "A"
        raise InputError(f"{article} {name} can be neither pickled nor copied, {self.instead}.")
