"""Solvers and forces of installed packages, which register them by entry points, for scene files.

Cortado reads entry points only if a scene names a kind that Cortado does not have.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from functools import cache, cached_property, wraps
from importlib.metadata import EntryPoint, entry_points
from inspect import Parameter as Argument
from inspect import getattr_static, isfunction, signature
from traceback import extract_tb
from typing import Annotated, Any, ClassVar, Self, get_origin

from pydantic import ConfigDict, GetJsonSchemaHandler, TypeAdapter, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from cortado.errors import ComputationError, CortadoError, InputError, SceneError, Words, shown
from cortado.scene.parameters import PARAMETERS, Parameter
from cortado.scene.schema_words import wanted
from cortado.scene.tables import MISSING, FieldPath, Flag, Table, Text, count, field_error, quantity, without_numpy

GUARDED = "_guarded_by_cortado"
ABSENT = object()
OTHERS = ("builtins", "cortado", "numpy", "types", "warp")
"""Top-level modules that are not user packages."""


def _in_words(problem: BaseException, package: str) -> str:
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
    """Convert an exception in a package to an ``error`` whose message begins with ``what``.

    Errors of Cortado, keyboard interrupts and ``expected`` exceptions pass unchanged. A package's attempt to end the
    process is converted too.
    """
    kept: tuple[type[BaseException], ...] = (CortadoError, KeyboardInterrupt, *expected)
    try:
        yield
    except kept:
        raise
    except BaseException as problem:
        raise error(f"{what} {_in_words(problem, package)}.") from problem


class PackageMaker:
    """A solver or force of an installed package. Error messages contain the package's name."""

    def __init__(self, part: Any, kind: str, package: str):
        self._part, self._kind, self._package = part, kind, package

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        with guarded(f'"{self._kind}" fails where its {name} is read:', self._package):
            found = getattr(self._part, name, ABSENT)
        if found is ABSENT:
            raise AttributeError(name)
        return self._guarded(found, f'"{self._kind}" fails in {name}:') if callable(found) else found

    @cached_property
    def parameters(self) -> Any:
        found = self.__getattr__("parameters")
        return [self._judged(one) for one in found] if isinstance(found, (list, tuple)) else found

    def _judged(self, parameter: Any) -> Any:
        if not isinstance(parameter, Parameter):
            return parameter
        what = f'"{self._kind}" fails in its parameter {parameter.name}:'
        given = {one.name: getattr(parameter, one.name) for one in fields(parameter)}
        own = {name: value for name, value in given.items() if isfunction(value) and not _is_ours(value)}
        changes: dict[str, Any] = {name: self._guarded(value, what) for name, value in own.items()}
        return replace(parameter, **changes) if own else parameter

    def _guarded(self, method: Callable[..., Any], what: str) -> Callable[..., Any]:
        def call(*arguments: Any, **more: Any) -> Any:
            with guarded(what, self._package):
                return _at_work(method(*arguments, **more), self._kind, self._package)

        return call

    def __repr__(self) -> str:
        return f'"{self._kind}" of {self._package}'


def _at_work(made: Any, kind: str, package: str) -> Any:
    cls: Any = type(made)
    if cls.__module__.partition(".")[0] not in OTHERS and not isinstance(made, type):
        with suppress(TypeError):  # of a class that is not Python's
            made.__class__ = _guarded_class(cls, kind, package)
    return made


@cache
def _guarded_class(cls: type, kind: str, package: str) -> type:
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


MOST = 1_000_000_000
TYPES = {float: Annotated[float, quantity()], int: Annotated[int, count(-MOST, MOST)], bool: Flag, str: Text}
"""Pydantic type that checks a key, by type of the argument of a factory."""


def registered(group: str, kind: str, own: Collection[str], advice: str) -> EntryPoint:
    """Return the entry point ``kind`` in a group such as "cortado.forces". The names in ``own`` belong to Cortado."""
    if kind in own:
        raise SceneError(None, "kind", kind, f"another name, as {kind} is a force of Cortado's own, in [forces]")
    found = entry_points(group=group)
    for entry in found:
        if entry.name in own:
            sentence = (
                f'cannot be read: {_package_of(entry)} registers "{entry.name}" under {group}, which is a name of'
            )
            raise SceneError(None, "kind", kind, sentence=f"{sentence} Cortado's own; the package must choose another.")
    same = list({(entry.value, _package_of(entry)): entry for entry in found if entry.name == kind}.values())
    if not same:
        names = ", ".join(sorted({f'"{entry.name}"' for entry in found})) or "which there is none"
        offered = f'{advice}a name that an installed package registers under "{group}", of {names}'
        raise SceneError(None, "kind", kind, offered.replace(', of "', ': "'))
    if len(same) > 1:
        packages = " and ".join(_package_of(entry) for entry in same)
        raise SceneError(None, "kind", kind, f"a name that one package has: {packages} register it under {group}")
    return same[0]


def _package_of(entry: EntryPoint) -> str:
    return f"the package {entry.dist.name}" if entry.dist is not None else f"the package of {entry.value}"


def loaded(entry: EntryPoint) -> Callable[..., Any]:
    where = f"is {shown(entry.name)}, for which {_package_of(entry)} registers {entry.value}"
    with _told("kind", entry, f"{where}, but that cannot be imported:"):
        found = entry.load()
    if not callable(found):
        sentence = f"{where}, but that is {shown(found)}, and must be a class or a function."
        raise SceneError(None, "kind", entry.name, sentence=sentence)
    return found


@contextmanager
def _told(field: str, entry: EntryPoint, what: str) -> Iterator[None]:
    try:
        with guarded(what, _package_of(entry)):
            yield
    except SceneError:
        raise
    except CortadoError as problem:
        found = str(problem)
        sentence = found if found.startswith(what) else f"{what} {found}"
        raise SceneError(None, field, entry.name, sentence=sentence) from problem


def checked_keys(factory: Callable[..., Any], keys: Mapping[str, Any], reserved: Collection[str]) -> dict[str, Any]:
    arguments = _arguments(factory)
    if arguments is None:
        return dict(keys)
    for name in reserved:
        if name in arguments:
            sentence = f"has an argument {name}, which is a key of every such table, and must be called otherwise."
            raise SceneError(None, "kind", name, sentence=f"{getattr(factory, '__name__', 'the factory')} {sentence}")
    known = [name for name, one in arguments.items() if one.kind is not Argument.VAR_KEYWORD]
    for name in keys:
        if name not in known and len(known) == len(arguments):
            its = f"its keys are {', '.join([*reserved, *known])}"
            raise SceneError(None, name, Words("unknown"), "", f"is not a key of {{table}}; {its}.")
    adapters, checked = {name: _adapter(arguments[name]) for name in known}, dict(keys)
    for name in known:
        if name not in keys and arguments[name].default is Argument.empty:
            raise SceneError(None, name, MISSING, adapters[name][1])
    for name in keys:
        adapter, words = adapters.get(name, (None, ""))
        try:
            checked[name] = keys[name] if adapter is None else adapter.validate_python(keys[name])
        except ValidationError:
            raise SceneError(None, name, keys[name], words) from None
    return checked


def _arguments(factory: Callable[..., Any]) -> dict[str, Argument] | None:
    for evaluated in (True, False):
        try:
            found = signature(factory, eval_str=evaluated).parameters
            break
        except Exception:  # annotations may be any text
            continue
    else:
        return None
    unnamed = (Argument.POSITIONAL_ONLY, Argument.VAR_POSITIONAL)
    return {name: one for name, one in found.items() if one.kind not in unnamed}


def _adapter(argument: Argument) -> tuple[TypeAdapter | None, str]:
    annotation: Any = TYPES.get(argument.annotation) if isinstance(argument.annotation, type) else argument.annotation
    if annotation is None or get_origin(annotation) is not Annotated:
        return None, "given"
    try:
        adapter: TypeAdapter = TypeAdapter(annotation)
        return adapter, wanted(adapter.json_schema(), argument.name)
    except Exception:  # an annotation that is for others
        return None, "given"


def made(entry: EntryPoint, factory: Callable[..., Any], keys: Mapping[str, Any], method: str) -> Any:
    """Make a solver or force from the keys of a table. The object must have a method named ``method``."""
    called = f'of the kind "{entry.name}"'
    with _told("", entry, f"{called} cannot be made:"):
        found = factory(**keys)
        fits = not isinstance(found, type) and callable(getattr(found, method, None))
    if not fits:
        sentence = f"{called} is made by {entry.value}, but that returned {shown(found)}, and must return an object"
        raise SceneError(None, "", entry.name, sentence=f"{sentence} with a method {method}(setting).")
    return PackageMaker(found, entry.name, _package_of(entry))


class PackageTable(Table):
    """A table for a solver or force of an installed package. All keys except `kind` are arguments of the package's
    factory."""

    model_config = ConfigDict(extra="allow")
    group: ClassVar[str]
    method: ClassVar[str]
    own: ClassVar[Collection[str]] = ()
    advice: ClassVar[str] = ""
    kind: Text
    """Name under which the package registers the solver or force."""

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("kind"), str) or not data["kind"].strip():
            return data
        given = {str(name): without_numpy(value) for name, value in data.items()}
        common = {name: value for name, value in given.items() if name in cls.model_fields}
        others = {name: value for name, value in given.items() if name not in cls.model_fields}
        try:
            entry = registered(cls.group, data["kind"], cls.own, cls.advice)
            factory = loaded(entry)
            checked = checked_keys(factory, others, tuple(cls.model_fields))
            made(entry, factory, checked, cls.method)
            return {**common, **checked}
        except SceneError as error:
            sentence = None if error.wanted and error.sentence.startswith("is ") else error.sentence
            path = () if not error.field else (error.field,)
            raise field_error(path, error.found, error.wanted, sentence) from error

    def make(self) -> Any:
        entry = registered(self.group, self.kind, self.own, self.advice)
        return made(entry, loaded(entry), self.model_extra or {}, self.method)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        return self


class Inline:
    """Marks a table with an inlined JSON schema."""

    def __get_pydantic_json_schema__(self, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"allOf": [handler.resolve_ref_schema(handler(core_schema))]}


class PackageForce(PackageTable):
    """A force from an installed package."""

    group = "cortado.forces"
    method = "force"
    own = ("gravity", "viscosity", "pressure", *(p.name for p in PARAMETERS if p.is_optional))


AnyForces = tuple[Annotated[PackageForce, Inline()], ...]
