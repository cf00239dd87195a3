"""The text of a user's function, which is what Warp compiles: it must be what the function was made from."""

import ast
import dis
import inspect
import textwrap
from bisect import bisect_left
from types import CodeType, FunctionType
from typing import Any
from weakref import WeakKeyDictionary

import warp as wp

from cortado.errors import InputError, shown

_SENT: WeakKeyDictionary[FunctionType, str] = WeakKeyDictionary()
"""Texts of functions that came from other processes."""
_LEFT_OUT = ("CACHE", "EXTENDED_ARG", "NOP", "PRECALL", "PUSH_NULL", "RESUME")
"""Instructions that say nothing of what a code does."""


def plain_function(kind: str, function: Any) -> FunctionType:
    """What a user gives as the function of a force, which may be one of Warp; raises `InputError`."""
    plain = function.func if isinstance(function, wp.Function) else function
    if not isinstance(plain, FunctionType):
        raise InputError(f"{kind} has {shown(function)}, but must have a function, made by def.")
    check_bare(f"{kind} function {plain.__name__}", plain)
    if plain.__code__.co_flags & (inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR):
        raise InputError(f"{kind} function {plain.__name__} waits or yields, but must be made by def, and return.")
    return plain


def check_bare(what: str, function: Any) -> None:
    """Raises `InputError` for a function that a decorator has put around another one."""
    if hasattr(function, "__wrapped__"):
        found = f"{what} is one that a decorator has put around another, which Warp would compile without it"
        raise InputError(f"{found}, but must have no decorator other than wp.func.")


def source_of(what: str, function: FunctionType) -> str:
    """The text of a function; raises `InputError`."""
    if function in _SENT:
        return _SENT[function]
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError) as error:
        found = f"the text of {what} is not to be found"
        raise InputError(f"{found}, but must stand in a file or a notebook.") from error


def keep_source(function: FunctionType, source: str) -> None:
    """Keep the text that a function came with from another process, where it may stand in no file."""
    _SENT[function] = source


def definition(what: str, function: FunctionType, source: str) -> ast.FunctionDef:
    """What the text of a function defines, without annotations, defaults and decorators. Raises `InputError` where that
    is another function, as where its file has changed since it was imported."""
    try:
        found: ast.AST = ast.parse(source).body[0]
    except (SyntaxError, IndexError):  # a lambda on one of several lines, or lines that have moved
        found = ast.Pass()
    if function.__code__.co_name == "<lambda>":
        raise InputError(f"{what} is no definition, but must be made by def.")
    if isinstance(found, ast.FunctionDef):
        found.decorator_list, found.returns = [], None
        found.args.defaults, found.args.kw_defaults = [], [None] * len(found.args.kwonlyargs)
        for argument in found.args.args:
            argument.annotation = None
        if any(isinstance(one, ast.Call) and ast.unparse(one.func) == found.name for one in ast.walk(found)):
            raise InputError(f"{what} calls itself, which Warp cannot, but must have its result without that.")
        if found.name == function.__code__.co_name and _same(_compiled(found, function.__code__), function.__code__):
            return found
    raise InputError(
        f"the text of {what} in {function.__code__.co_filename} is not what runs where Python calls it, as the file or "
        "the function has changed since it was imported, but must be the same: import it again."
    )


def _compiled(found: ast.FunctionDef, of: CodeType) -> CodeType | None:
    """The code of a definition within one that has the names from around it; None where Python has none."""
    doc = found.body[0]
    if isinstance(doc, ast.Expr) and isinstance(doc.value, ast.Constant) and isinstance(doc.value.value, str):
        doc.value.value = of.co_consts[0] if of.co_consts else None  # its indentation is no matter
    around = ast.parse(f"def around({', '.join(of.co_freevars)}): pass")
    around.body[0].body = [found]
    try:
        made = compile(ast.fix_missing_locations(around), of.co_filename, "exec", dont_inherit=True)
    except (SyntaxError, ValueError, TypeError):
        return None
    outer = next(one for one in made.co_consts if isinstance(one, CodeType))
    return next(one for one in outer.co_consts if isinstance(one, CodeType))


def _same(one: Any, other: Any) -> bool:
    """Whether two codes or constants are the same."""
    if not isinstance(one, CodeType) or not isinstance(other, CodeType):
        return type(one) is type(other) and repr(one) == repr(other)
    found, wanted = _instructions(one), _instructions(other)
    return one.co_varnames == other.co_varnames and len(found) == len(wanted) and all(map(_alike, found, wanted))


def _alike(one: tuple[str, Any], other: tuple[str, Any]) -> bool:
    return one[0] == other[0] and _same(one[1], other[1])


def _instructions(code: CodeType) -> list[tuple[str, Any]]:
    """What a code does, step by step, without what depends on which names are those of imported modules."""
    steps = [step for step in dis.get_instructions(code) if step.opname not in _LEFT_OUT]
    places = [step.offset for step in steps]
    found = []
    for step in steps:
        jumps = step.opcode in dis.hasjrel or step.opcode in dis.hasjabs
        name = step.opname.replace("LOAD_METHOD", "LOAD_ATTR")
        found.append((name, bisect_left(places, step.argval) if jumps else step.argval))
    return found
