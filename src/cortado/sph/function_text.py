"""The source code of a user-defined function, and a text that changes whenever the function changes.

The text consists of the source code and of all numbers, functions and objects that the function reads. Code that Warp
cannot differentiate raises an error.
"""

import ast
import builtins
import dis
import inspect
import sysconfig
import textwrap
from bisect import bisect_left
from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from hashlib import sha256
from inspect import isclass, isfunction, ismethod, ismodule
from types import CellType, CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from cortado.device.modules import kernel_module
from cortado.errors import InputError, shown

SENT: WeakKeyDictionary[FunctionType, str] = WeakKeyDictionary()
"""Source codes of functions that came from another process."""
_LEFT_OUT = ("CACHE", "EXTENDED_ARG", "NOP", "PRECALL", "PUSH_NULL", "RESUME")


def plain_function(kind: str, function: Any) -> FunctionType:
    plain = function.func if isinstance(function, wp.Function) else function
    if not isinstance(plain, FunctionType):
        raise InputError(f"{kind} has {shown(function)}, but must have a function defined by def.")
    check_bare(f"{kind} function {plain.__name__}", plain)
    if plain.__code__.co_flags & (inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ASYNC_GENERATOR):
        raise InputError(
            f"{kind} function {plain.__name__} is a coroutine or a generator, but must be a plain function."
        )
    return plain


def check_bare(what: str, function: Any) -> None:
    if hasattr(function, "__wrapped__"):
        found = f"{what} has a decorator, which Warp would ignore"
        raise InputError(f"{found}, but may only have the decorator wp.func.")


def source_of(what: str, function: FunctionType) -> str:
    if function in SENT:
        return SENT[function]
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError) as error:
        raise InputError(f"the source code of {what} is not found, but must be in a file or a notebook.") from error


def definition(what: str, function: FunctionType, source: str) -> ast.FunctionDef:
    """Parse ``source`` without annotations. Raise `InputError` if ``function`` was compiled from different code."""
    try:
        found: ast.AST = ast.parse(source).body[0]
    except (SyntaxError, IndexError):  # a lambda on one of several lines, or lines that have moved
        found = ast.Pass()
    if function.__code__.co_name == "<lambda>":
        raise InputError(f"{what} is a lambda, but must be defined by def.")
    if isinstance(found, ast.FunctionDef):
        found.decorator_list, found.returns = [], None
        found.args.defaults, found.args.kw_defaults = [], [None] * len(found.args.kwonlyargs)
        for argument in found.args.args:
            argument.annotation = None
        if any(isinstance(one, ast.Call) and ast.unparse(one.func) == found.name for one in ast.walk(found)):
            raise InputError(f"{what} calls itself, but Warp has no recursion.")
        if found.name == function.__code__.co_name and _same(_compiled(found, function.__code__), function.__code__):
            return found
    raise InputError(
        f"the source code of {what} in {function.__code__.co_filename} differs from the code that runs, as "
        "the file or the function has changed since the import: import the function again."
    )


def _compiled(found: ast.FunctionDef, of: CodeType) -> CodeType | None:
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
    if not isinstance(one, CodeType) or not isinstance(other, CodeType):
        return type(one) is type(other) and repr(one) == repr(other)
    found, wanted = _instructions(one), _instructions(other)
    if one.co_varnames != other.co_varnames or len(found) != len(wanted):
        return False
    return all(a == b and _same(x, y) for (a, x), (b, y) in zip(found, wanted, strict=True))


def _instructions(code: CodeType) -> list[tuple[str, Any]]:
    steps = [step for step in dis.get_instructions(code) if step.opname not in _LEFT_OUT]
    places, jumps = [step.offset for step in steps], (*dis.hasjrel, *dis.hasjabs)
    names = (step.opname.replace("LOAD_METHOD", "LOAD_ATTR") for step in steps)
    values = (bisect_left(places, step.argval) if step.opcode in jumps else step.argval for step in steps)
    return list(zip(names, values, strict=True))


class Frozen:
    """Copies of all outside values that a function, or a function called by it, reads."""

    def __init__(self, what: str, function: FunctionType):
        self._what, self._made = what, dict[Any, Any]()
        self.helpers: list[Any] = []
        self.scope = self._scope(function)
        self.words = "\n".join(words(self.scope))

    def _scope(self, function: FunctionType) -> dict[str, Any]:
        return {name: self._value(value, names_in(function)) for name, value in read_by(function).items()}

    def _value(self, value: Any, names: tuple[str, ...]) -> Any:
        if isinstance(value, wp.Function) and value.func:
            if id(value) not in self._made:
                self._made[id(value)] = value  # where it calls itself
                forms = [*value.user_overloads.values(), *value.user_templates.values()]
                first, *others = [self._copy(one) for one in forms if one.generic_parent is None]
                for one in others:
                    first.add_overload(one)
                self._made[id(value)] = first
            return self._made[id(value)]
        if package_of(value) in KEPT:
            return value if ismodule(value) or callable(value) else deepcopy(value)
        if callable(value) and not isclass(value):
            return value
        if (key := (id(value), names)) not in self._made:
            made = self._made[key] = ModuleType("frozen")  # whose attributes Warp looks up
            for name in names:
                if hasattr(value, name):
                    setattr(made, name, self._value(getattr(value, name), names))
        return self._made[key]

    def _copy(self, helper: Any) -> Any:
        own = self._function(helper)
        snippets = {name: getattr(helper, name) for name in SNIPPETS}
        known = {"module": kernel_module("helpers"), "source": helper.adj.source, "inline_hint": helper.inline_hint}
        made = wp.Function(func=own, key=helper.key, namespace="", **known, **snippets, scope_locals={})
        for other, decorate in ((helper.custom_grad_func, wp.func_grad), (helper.custom_replay_func, wp.func_replay)):
            if other is not None:
                decorate(made)(self._function(other))
        self.helpers.append(made)
        return made

    def _function(self, helper: Any) -> FunctionType:
        function, what = helper.func, f"the function {helper.func.__name__} that {self._what} calls"
        check_bare(what, function)
        definition(what, function, helper.adj.source)
        code, scope = function.__code__, self._scope(function)
        cells = tuple(CellType(scope[name]) if name in scope else CellType() for name in code.co_freevars)
        made: Any = FunctionType(code, scope, function.__name__, function.__defaults__, cells)
        made.__annotations__, made.__module__ = dict(helper.adj.arg_types), function.__module__
        return made


class DerivativeCheck(ast.NodeVisitor):
    """Refuses code with wrong derivatives in Warp: loops that are not unrolled, and assignments to components."""

    def __init__(self, what: str, most: int = wp.config.max_unroll):
        self._what, self._most = what, most

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        targets = [one.target for one in ast.walk(node) if isinstance(one, ast.For)]
        loops = [target.id for target in targets if isinstance(target, ast.Name)]
        named = [one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
        named += [argument.arg for argument in node.args.args]
        if twice := [name for name in loops if named.count(name) > loops.count(name)]:
            found = f"{self._what} assigns to {twice[0]}, which is also the counter of a loop"
            raise InputError(f"{found}, but must have different names for the two variables.")
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        ends = node.iter.args if isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range" else []
        numbers = [end.value for end in ends if isinstance(end, ast.Constant) and isinstance(end.value, int)]
        if not ends or len(numbers) < len(ends) or len(range(*numbers)) > self._most:
            self._refuse(node)
        self.generic_visit(node)

    def _refuse_part(self, node: ast.Subscript | ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Store):
            found = f"{self._what} changes {ast.unparse(node)} separately, which Warp cannot differentiate"
            raise InputError(f"{found}, but must assign whole vectors, as in wp.vec3(a, b, c).")
        self.generic_visit(node)

    visit_Subscript = visit_Attribute = _refuse_part

    def _refuse(self, node: ast.AST) -> None:
        line = ast.unparse(node).splitlines()[0].rstrip(":")
        raise InputError(
            f"{self._what} has {line!r}, which Warp cannot differentiate, but may loop only over "
            f"range(k), with a number k of at most {self._most}, and must not leave a loop early."
        )

    visit_While = visit_Break = visit_Continue = _refuse


def returns(body: list[ast.stmt]) -> bool:
    last = body[-1]
    if isinstance(last, ast.If):
        return returns(last.body) and bool(last.orelse) and returns(last.orelse)
    return isinstance(last, ast.Return) and last.value is not None


def check_names(what: str, function: ast.FunctionDef, own: set[str], scope: Mapping[str, Any]) -> None:
    for node in ast.walk(function):
        if not isinstance(node, ast.Name) or node.id in own:
            continue
        if node.id not in scope and not hasattr(builtins, node.id):
            raise InputError(f"{what} has the name {node.id}, which is not defined.")
        if isinstance(scope.get(node.id), (list, tuple, dict, str, np.ndarray)):
            found = f"{what} has the name {node.id}, which is a {type(scope[node.id]).__name__} outside the function"
            raise InputError(f"{found}, but must be a number or a vector: make {node.id} a parameter.")


class SizesWritten(ast.NodeTransformer):
    """Replaces ``len(w)`` and ``w.shape[0]`` of an array ``w`` by numbers in the source code of a function."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]):
        self._shapes = shapes

    def visit_Call(self, node: ast.Call) -> ast.AST:
        of = node.args[0] if len(node.args) == 1 and ast.unparse(node.func) == "len" else None
        if isinstance(of, ast.Name) and of.id in self._shapes:
            return ast.copy_location(ast.Constant(self._shapes[of.id][0]), node)
        return self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        name, _, end = ast.unparse(node.value).partition(".")
        axis = node.slice.value if isinstance(node.slice, ast.Constant) else None
        if end == "shape" and name in self._shapes and axis in range(len(self._shapes[name])):
            return ast.copy_location(ast.Constant(self._shapes[name][axis]), node)
        return self.generic_visit(node)


KEPT = ("builtins", "jax", "math", "numpy", "scipy", "torch", "warp")
"""Packages that are assumed not to change."""
PYTHON = sysconfig.get_path("stdlib")
SNIPPETS = ("native_snippet", "adj_native_snippet", "replay_snippet")


def code_words(value: Any) -> str:
    return sha256("\n".join(words(value)).encode()).hexdigest()[:16]


def words(value: Any, names: tuple[str, ...] | None = None, seen: set[Any] | None = None) -> list[str]:
    """Return lines of text that identify what a value computes. The lines for a value are equal in every process. For
    objects and for a user's modules, only the attributes ``names`` are included."""
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
    file = value.__code__.co_filename if isfunction(value) else ""
    is_known = package in KEPT or (file.startswith(PYTHON) and "site-packages" not in file)
    is_known |= package == "cortado" and (ismodule(value) or isfunction(value))
    if (id(value), names) in seen or isclass(value) or is_known:
        return [value.__name__ if ismodule(value) else name]
    seen.add((id(value), names))
    if isfunction(value):
        return [*_of_code(value.__code__), *words([value.__defaults__, read_by(value)], names_in(value), seen)]
    own = getattr(value, "__dict__", {})
    found = own if names is None else {key: getattr(value, key) for key in names if hasattr(value, key)}
    return [name, *words({key: one for key, one in found.items() if not key.startswith("__")}, names, seen)]


def _parts(value: Any) -> Any:
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


def _of_code(code: CodeType) -> list[str]:
    consts = [word for one in code.co_consts for word in (_of_code(one) if isinstance(one, CodeType) else words(one))]
    return [code.co_code.hex(), *code.co_names, *code.co_varnames, *consts]


def read_by(function: FunctionType) -> dict[str, Any]:
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    found = {name: function.__globals__[name] for name in names_in(function) if name in function.__globals__}
    return dict(sorted({**found, **{name: cell.cell_contents for name, cell in cells if cell != CellType()}}.items()))


def names_in(function: Any) -> tuple[str, ...]:
    code = getattr(function, "__code__", function)
    inner = [name for one in code.co_consts if isinstance(one, CodeType) for name in names_in(one)]
    return tuple(dict.fromkeys([*code.co_names, *inner]))


def package_of(value: Any) -> str:
    owner = value if isclass(value) or isfunction(value) else type(value)
    return str(value.__name__ if ismodule(value) else owner.__module__).partition(".")[0]
