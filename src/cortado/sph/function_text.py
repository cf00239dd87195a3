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


class InPrecision(ast.NodeTransformer):
    """Numbers, and types of numbers and vectors, become those of the precision; what numbers and vectors from outside
    are is written out, so that the text says all that the function does. Indices and what counts them stay whole."""

    def __init__(self, scope: Mapping[str, Any], local: set[str]):
        self._scope, self._local, self._whole = scope, local, set[str]()

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return self._number(node, node.value)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._resolved(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self._resolved(node)

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        node.value = self.visit(node.value)
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        return node if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_For(self, node: ast.For) -> ast.AST:
        if isinstance(node.target, ast.Name):
            self._whole.add(node.target.id)
        node.body = [self.visit(line) for line in node.body]
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if isinstance(node.func, ast.Name) and node.func.id in ("int", "type"):
            return node
        return self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        return node if any(map(self._is_whole, (node.left, *node.comparators))) else self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        return node if self._is_whole(node.left) or self._is_whole(node.right) else self.generic_visit(node)

    def _is_whole(self, node: ast.AST) -> bool:
        return isinstance(node, ast.Name) and node.id in self._whole

    def _resolved(self, node: ast.Name | ast.Attribute) -> ast.AST:
        """A name from outside, as a number or a type of the precision if it stands for one."""
        try:
            value = self._value(node)
        except (KeyError, AttributeError):
            return node
        if isinstance(value, type) and value in _TYPES:
            return ast.Name(_TYPES[value], ast.Load())
        return self._number(node, value)

    def _value(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Attribute):
            return getattr(self._value(node.value), node.attr)
        if not isinstance(node, ast.Name) or node.id in self._local:
            raise KeyError
        return float if node.id == "float" else self._scope[node.id]

    @staticmethod
    def _number(node: ast.expr, value: Any) -> ast.AST:
        """A call that makes a number or a vector of the precision, where a value is one."""
        if type(value) in (wp.vec3f, wp.vec3d):
            return ast.Call(ast.Name(VECTOR, ast.Load()), [ast.Constant(float(part)) for part in value], [])
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return node
        return ast.Call(ast.Name(REAL, ast.Load()), [ast.Constant(float(value))], [])


def _is_range(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == "range"
