"""Refuses what Warp takes in a user's function for something else than Python does."""

import ast
import builtins
from collections.abc import Mapping
from typing import Any

import warp as wp

from cortado.errors import InputError
from cortado.sph.function_text import counts_of

BUILTINS = ("abs", "float", "int", "max", "min", "pow", "range", "round")
"""Functions of Python that a function may call."""
MATH = (
    *("acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "degrees", "exp", "floor", "isfinite", "isinf", "isnan"),
    *("log", "log10", "log2", "pow", "radians", "sin", "sinh", "sqrt", "tan", "tanh", "trunc"),
)
"""Those of its module math."""


def check_calls(what: str, function: ast.FunctionDef, own: set[str], scope: Mapping[str, Any]) -> None:
    """Raises `InputError` for a call of something else than functions and types of Warp, as Warp would take one of its
    own of the same name."""
    for node in ast.walk(function):
        if not isinstance(node, ast.Call):
            continue
        name, root = ast.unparse(node.func), _root(node.func)
        if root is None or root in own:
            continue
        called = _found(node.func, scope)
        if root not in scope and root in BUILTINS:
            if name == "round" and len(node.args) + len(node.keywords) != 1:
                raise InputError(f"{what} rounds to digits, but must have round of one number alone.")
        elif not _is_of_warp(called):
            raise InputError(
                f"{what} cannot be compiled: it calls {name}, which is no function of Warp; it must call functions of "
                f"Warp alone, of its own under @wp.func, {', '.join(BUILTINS)}, or those of math that Warp has."
            )


def check_truths(what: str, function: ast.FunctionDef) -> None:
    """Raises `InputError` for ``and`` and ``or`` whose value is one of their numbers, as it is a truth in Warp."""
    tests: set[ast.AST] = set()
    for node in ast.walk(function):
        if isinstance(node, (ast.If, ast.IfExp, ast.While, ast.Assert)):
            tests.add(node.test)
        elif isinstance(node, ast.BoolOp) and node in tests:
            tests.update(node.values)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            tests.add(node.operand)
    truths = {name for name, values in _assigned(function).items() if all(_is_truth(v, set()) for v in values)}
    for node in ast.walk(function):
        if isinstance(node, ast.BoolOp) and node not in tests and not _is_truth(node, truths):
            found = f"{what} has {ast.unparse(node)!r}, which is one of its numbers in Python and a truth in Warp"
            raise InputError(f"{found}, but must have comparisons there, or x if x != 0.0 else y.")


def check_helper(what: str, function: ast.FunctionDef) -> None:
    """Raises `InputError` for what a function under ``@wp.func``, whose numbers have types of their own, has in another
    meaning than Python's."""
    check_truths(what, function)
    wholes = set(counts_of(function))
    for node in ast.walk(function):
        of = getattr(node, "op", None)
        if isinstance(of, (ast.Mod, ast.FloorDiv)) or (isinstance(of, ast.Div) and _is_of_wholes(node, wholes)):
            wanted = "wp.mod, wp.floor, wp.rint and numbers with a point"
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("round", "builtins.round"):
            wanted = "wp.rint, or wp.round, which rounds halves away from 0"
        else:
            continue
        found = f"{what} calls a function of Warp with {ast.unparse(node)!r}, which is another number in Python"
        raise InputError(f"{found}, but must say what is meant, by {wanted}.")


def _is_of_wholes(node: ast.AST, wholes: set[str]) -> bool:
    return isinstance(node, ast.BinOp) and all(_is_whole(part, wholes) for part in (node.left, node.right))


def _is_whole(node: ast.expr, wholes: set[str]) -> bool:
    if isinstance(node, ast.Constant):
        return type(node.value) is int
    if isinstance(node, ast.BinOp):
        return _is_of_wholes(node, wholes)
    if isinstance(node, ast.UnaryOp):
        return _is_whole(node.operand, wholes)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("int", "wp.int32", "wp.int64")
    return isinstance(node, ast.Name) and node.id in wholes


def _assigned(function: ast.FunctionDef) -> dict[str, list[ast.expr]]:
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        for target in node.targets if isinstance(node, ast.Assign) else ():
            found.setdefault(ast.unparse(target), []).append(node.value)
    return found


def _is_truth(node: ast.expr, truths: set[str]) -> bool:
    if isinstance(node, ast.BoolOp):
        return all(_is_truth(value, truths) for value in node.values)
    is_not = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
    is_named = isinstance(node, ast.Name) and node.id in truths
    return is_not or is_named or isinstance(node, ast.Compare) or getattr(node, "value", None) in (True, False)


def _root(node: ast.expr) -> str | None:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def _found(node: ast.expr, scope: Mapping[str, Any]) -> Any:
    if isinstance(node, ast.Attribute):
        owner = _found(node.value, scope)
        return getattr(owner, node.attr, wp._src.context.builtin_functions.get(node.attr) if owner is wp else None)
    return scope.get(node.id, getattr(builtins, node.id, None)) if isinstance(node, ast.Name) else None


def _is_of_warp(called: Any) -> bool:
    if isinstance(called, wp.Function) or called is float:
        return True
    name = getattr(called, "__module__", None) or ""
    return name.partition(".")[0] == "warp" or (name == "math" and called.__name__ in MATH)
