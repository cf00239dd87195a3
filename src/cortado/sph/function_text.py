"""The text of a user's function: what Warp can differentiate, and its numbers in a precision."""

import ast
import builtins
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from cortado.errors import InputError

REAL, VECTOR = "cortado_real", "cortado_vector"
"""What the compiled text calls the types of a number and of a vector."""
_TYPES = {float: REAL, wp.float32: REAL, wp.float64: REAL, wp.vec3f: VECTOR, wp.vec3d: VECTOR}


class DerivativeCheck(ast.NodeVisitor):
    """Refuses what Warp would differentiate wrongly without a word: loops that it does not unroll, and vectors that are
    changed in part."""

    def __init__(self, what: str):
        self._what = what

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        loops = [
            one.target.id for one in ast.walk(node) if isinstance(one, ast.For) and isinstance(one.target, ast.Name)
        ]
        named = [one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
        named += [argument.arg for argument in node.args.args]
        if twice := [name for name in loops if named.count(name) > loops.count(name)]:
            found = f"{self._what} gives {twice[0]}, which a loop counts with, another value too"
            raise InputError(f"{found}, but must have another name for one of them.")
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        ends = node.iter.args if isinstance(node.iter, ast.Call) and _is_range(node.iter.func) else []
        numbers = [end.value for end in ends if isinstance(end, ast.Constant) and isinstance(end.value, int)]
        if not ends or len(numbers) < len(ends) or len(range(*numbers)) > wp.config.max_unroll:
            self._refuse(node)
        self.generic_visit(node)

    def _refuse_part(self, node: ast.Subscript | ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Store):
            part = ast.unparse(node)
            found = f"{self._what} changes {part} alone, which Warp cannot differentiate"
            raise InputError(f"{found}, but must make vectors whole, as in wp.vec3(a, b, c).")
        self.generic_visit(node)

    visit_Subscript = visit_Attribute = _refuse_part

    def _refuse(self, node: ast.AST) -> None:
        line = ast.unparse(node).splitlines()[0].rstrip(":")
        raise InputError(
            f"{self._what} has {line!r}, which Warp cannot differentiate, but must have no loops other than over "
            f"range(k), with a number k of at most {wp.config.max_unroll}, and not leave them before their end."
        )

    visit_While = visit_Break = visit_Continue = _refuse


def check_returns(what: str, function: ast.FunctionDef, kind: str) -> None:
    """Raises `InputError` for a function that may end without returning anything."""
    if not _returns(function.body):
        raise InputError(f"{what} may end without return, but must return a {kind}, whatever its arguments are.")


def _returns(body: list[ast.stmt]) -> bool:
    last = body[-1]
    if isinstance(last, ast.If):
        return _returns(last.body) and bool(last.orelse) and _returns(last.orelse)
    return isinstance(last, ast.Return) and last.value is not None


def check_names(what: str, function: ast.FunctionDef, own: set[str], scope: Mapping[str, Any]) -> None:
    """Raises `InputError` for a name that stands for nothing, or for arrays and lists, of which Warp takes none."""
    for node in ast.walk(function):
        if not isinstance(node, ast.Name) or node.id in own:
            continue
        if node.id not in scope and not hasattr(builtins, node.id):
            raise InputError(f"{what} has the name {node.id}, which stands for nothing, but must name what is there.")
        if isinstance(scope.get(node.id), (list, tuple, dict, str, np.ndarray)):
            found = f"{what} has the name {node.id}, which is a {type(scope[node.id]).__name__} outside of it"
            raise InputError(f"{found}, but must take a number or a vector: make it a parameter of the function.")


def _is_range(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == "range"


def counts_of(function: ast.FunctionDef) -> list[str]:
    """The names that its loops count with."""
    targets = [node.target for node in ast.walk(function) if isinstance(node, ast.For)]
    return [target.id for target in targets if isinstance(target, ast.Name)]
