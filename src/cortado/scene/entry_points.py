"""Solvers and forces that installed packages register, by entry points, for scene files to name.

Entry points are read where a scene names a kind that is not Cortado's own, and nowhere else.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from inspect import Parameter, signature
from typing import Annotated, Any, get_origin

from pydantic import TypeAdapter, ValidationError

from cortado.errors import CortadoError, SceneError, Words, shown
from cortado.scene.fields import MISSING, Flag, Text, count, quantity
from cortado.scene.package_parts import PackageMaker, guarded
from cortado.scene.sentences import wanted

MOST = 1_000_000_000
TYPES = {float: Annotated[float, quantity()], int: Annotated[int, count(-MOST, MOST)], bool: Flag, str: Text}
"""Of keys whose argument is annotated with a plain type, what is checked."""


def registered(group: str, kind: str, own: Collection[str], advice: str) -> EntryPoint:
    """The entry point of a group, such as "cortado.forces", with a name that is none of Cortado's ``own``; raises a
    `SceneError` about ``kind``."""
    if kind in own:
        raise SceneError(None, "kind", kind, f"another name, as {kind} is a force of Cortado's own, in [forces]")
    found = entry_points(group=group)
    for entry in found:
        if entry.name in own:
            sentence = f'cannot be read: {_package(entry)} registers "{entry.name}" under {group}, which is a name of '
            raise SceneError(None, "kind", kind, sentence=f"{sentence}Cortado's own, and must take another.")
    same = list({(entry.value, _package(entry)): entry for entry in found if entry.name == kind}.values())
    if not same:
        names = ", ".join(sorted({f'"{entry.name}"' for entry in found})) or "which there is none"
        offered = f'{advice}a name that an installed package registers under "{group}", of {names}'
        raise SceneError(None, "kind", kind, offered.replace(', of "', ': "'))
    if len(same) > 1:
        packages = " and ".join(_package(entry) for entry in same)
        raise SceneError(None, "kind", kind, f"a name that one package has: {packages} register it under {group}")
    return same[0]


def _package(entry: EntryPoint) -> str:
    """As sentences call it."""
    return f"the package {entry.dist.name}" if entry.dist is not None else f"the package of {entry.value}"


def loaded(entry: EntryPoint) -> Callable[..., Any]:
    """The class or function that an entry point names; raises a `SceneError` about ``kind``."""
    where = f"is {shown(entry.name)}, for which {_package(entry)} registers {entry.value}"
    with _told("kind", entry, f"{where}, but that cannot be imported:"):
        found = entry.load()
    if not callable(found):
        sentence = f"{where}, but that is {shown(found)}, and must be a class or a function."
        raise SceneError(None, "kind", entry.name, sentence=sentence)
    return found


@contextmanager
def _told(field: str, entry: EntryPoint, what: str) -> Iterator[None]:
    """Has whatever a package raises end as a `SceneError` about a field, other errors of Cortado's own included."""
    try:
        with guarded(what, _package(entry)):
            yield
    except SceneError:
        raise
    except CortadoError as problem:
        found = str(problem)
        sentence = found if found.startswith(what) else f"{what} {found}"
        raise SceneError(None, field, entry.name, sentence=sentence) from problem


def checked_keys(factory: Callable[..., Any], keys: Mapping[str, Any], reserved: Collection[str]) -> dict[str, Any]:
    """The keys of a table as the arguments of a factory, each checked by its annotation; raises a `SceneError` about
    the first that does not fit."""
    arguments = _arguments(factory)
    if arguments is None:
        return dict(keys)
    for name in reserved:
        if name in arguments:
            sentence = f"has an argument {name}, which is a key of every such table, and must be called otherwise."
            raise SceneError(None, "kind", name, sentence=f"{getattr(factory, '__name__', 'the factory')} {sentence}")
    known = [name for name, one in arguments.items() if one.kind is not Parameter.VAR_KEYWORD]
    for name in keys:
        if name not in known and len(known) == len(arguments):
            its = f"its keys are {', '.join([*reserved, *known])}"
            raise SceneError(None, name, Words("unknown"), "", f"is not a key of {{table}}; {its}.")
    for name in known:
        if name not in keys and arguments[name].default is Parameter.empty:
            raise SceneError(None, name, MISSING, _adapter(arguments[name])[1])
    return {name: _checked(name, value, arguments.get(name)) for name, value in keys.items()}


def _arguments(factory: Callable[..., Any]) -> dict[str, Parameter] | None:
    """Those that have names, and ``**others`` if it takes them; None where Python cannot tell."""
    for evaluated in (True, False):
        try:
            found = signature(factory, eval_str=evaluated).parameters
            break
        except Exception:  # annotations may be any text
            continue
    else:
        return None
    unnamed = (Parameter.POSITIONAL_ONLY, Parameter.VAR_POSITIONAL)
    return {name: one for name, one in found.items() if one.kind not in unnamed}


def _adapter(argument: Parameter) -> tuple[TypeAdapter | None, str]:
    """What checks a value, and what it must be, in words; of other annotations than plain types and fields of scenes
    whoever is given the value judges it."""
    annotation: Any = TYPES.get(argument.annotation) if isinstance(argument.annotation, type) else argument.annotation
    if annotation is None or get_origin(annotation) is not Annotated:
        return None, "given"
    try:
        adapter: TypeAdapter = TypeAdapter(annotation)
        return adapter, wanted(adapter.json_schema(), argument.name)
    except Exception:  # an annotation that is for others
        return None, "given"


def _checked(name: str, value: Any, argument: Parameter | None) -> Any:
    adapter, words = _adapter(argument) if argument is not None else (None, "")
    if adapter is None:
        return value
    try:
        return adapter.validate_python(value)
    except ValidationError:
        raise SceneError(None, name, value, words) from None


def made(entry: EntryPoint, factory: Callable[..., Any], keys: Mapping[str, Any], method: str) -> Any:
    """What a factory makes of the keys of a table, which must have a method of that name; raises a `SceneError`."""
    called = f'of the kind "{entry.name}"'
    with _told("", entry, f"{called} cannot be made:"):
        found = factory(**keys)
        fits = not isinstance(found, type) and callable(getattr(found, method, None))
    if not fits:
        sentence = f"{called} is made by {entry.value}, but that returned {shown(found)}, and must return an object"
        raise SceneError(None, "", entry.name, sentence=f"{sentence} with a method {method}(setting).")
    return PackageMaker(found, entry.name, _package(entry))
