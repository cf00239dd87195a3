"""A user's text as Warp compiles it: with numbers of a precision, and with what Python means by its operators."""

import ast
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
import warp as wp

from cortado.errors import InputError
from cortado.sph.python_meaning import NEAREST, QUOTIENT, REMAINDER, WHOLE

REAL, VECTOR = "cortado_real", "cortado_vector"
"""What the compiled text calls the types of a number and of a vector."""
_TYPES = {float: REAL, wp.float32: REAL, wp.float64: REAL, wp.vec3f: VECTOR, wp.vec3d: VECTOR}
_OPERATORS: Mapping[type[ast.operator], str] = {ast.Mod: REMAINDER, ast.FloorDiv: QUOTIENT}
_CALLS = {"round": NEAREST, "int": WHOLE}
Lines = ast.AST | list[ast.stmt]


class InPrecision(ast.NodeTransformer):
    """Numbers, and types of numbers and vectors, become those of the precision; what numbers and vectors from outside
    are is written out, so that the text says all that the function does. Whole numbers are left as indices alone:
    loops are written out too, and with them what each index is."""

    def __init__(self, what: str, scope: Mapping[str, Any], local: set[str]):
        self._what, self._scope, self._local = what, scope, local
        self._counts: dict[str, int] = {}
        """What loops count with, where the text has come to."""
        self._given = set[str]()
        """Arguments, of which vectors have three components."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self._given = {one.arg for one in node.args.args}
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return _number(node, node.value)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._resolved(node) if isinstance(node.ctx, ast.Load) else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self.generic_visit(node) if (found := self._resolved(node)) is node else found

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        node.value = self.visit(node.value)
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        numbers = [self._index(part) for part in parts]
        if isinstance(node.value, ast.Name) and node.value.id in self._given and set(numbers) - set(range(-3, 3)):
            raise InputError(f"{self._what} has {ast.unparse(node)}, but must have an index of 0, 1 or 2 there.")
        written: list[ast.expr] = [ast.Constant(number) for number in numbers]
        node.slice = ast.Tuple(written, ast.Load()) if isinstance(node.slice, ast.Tuple) else written[0]
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        return node if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_For(self, node: ast.For) -> Lines:
        ends, lines = [self._index(end) for end in node.iter.args], list[ast.stmt]()
        for count in range(*ends):
            self._counts[node.target.id] = count
            lines += self._lines(node.body)
        return lines + self._lines(node.orelse) or [ast.Pass()]

    def _lines(self, lines: list[ast.stmt]) -> list[ast.stmt]:
        found = [self.visit(deepcopy(line)) for line in lines]
        return [line for one in found for line in (one if isinstance(one, list) else [one])]

    def visit_AugAssign(self, node: ast.AugAssign) -> Lines:
        before = ast.Name(node.target.id, ast.Load())  # type: ignore[union-attr]
        return self.visit(ast.Assign([node.target], ast.BinOp(before, node.op, node.value)))

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        left, right = self.visit(node.left), self.visit(node.right)
        if (name := _OPERATORS.get(type(node.op))) is not None:
            return ast.Call(ast.Name(name, ast.Load()), [left, right], [])
        return ast.BinOp(left, node.op, right)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        values = [node.left, *node.comparators]
        pairs = zip(values, node.ops, values[1:], strict=False)
        each: list[ast.expr] = [
            ast.Compare(self.visit(deepcopy(a)), [op], [self.visit(deepcopy(b))]) for a, op, b in pairs
        ]
        return each[0] if len(each) == 1 else ast.BoolOp(ast.And(), each)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        name = node.func.id if isinstance(node.func, ast.Name) and node.func.id not in self._scope else None
        given = [self.visit(argument) for argument in node.args]
        if name in _CALLS:
            return ast.Call(ast.Name(_CALLS[name], ast.Load()), given, [])
        if name == "pow" and len(given) == 2:
            return ast.BinOp(given[0], ast.Pow(), given[1])
        if name in ("min", "max") and len(given) > 2:
            while len(given) > 1:
                given = [ast.Call(ast.Name(name, ast.Load()), given[:2], []), *given[2:]]
            return given[0]
        keywords = [ast.keyword(one.arg, self.visit(one.value)) for one in node.keywords]
        return ast.Call(self.visit(node.func), given, keywords)

    def _index(self, node: ast.expr) -> int:
        """What a whole number is, as Python computes it; raises `InputError`."""
        known = {one.id: one for one in ast.walk(node) if isinstance(one, ast.Name)}
        values = {name: self._counts.get(name, self._scope.get(name)) for name in known if name not in self._local}
        values |= {name: count for name, count in self._counts.items() if name in known}
        try:
            found = eval(compile(ast.Expression(node), "<index>", "eval"), {"__builtins__": {}}, values)
            if isinstance(found, (int, np.integer)) and not isinstance(found, bool):
                return int(found)
        except Exception:  # whatever an expression of other things raises
            pass
        found = f"{self._what} has the index {ast.unparse(node)}"
        raise InputError(f"{found}, but must have whole numbers there, or what follows from the counts of its loops.")

    def _resolved(self, node: ast.Name | ast.Attribute) -> ast.AST:
        """A name from outside, as a number or a type of the precision if it stands for one."""
        try:
            value = self._value(node)
        except (KeyError, AttributeError):
            return node
        if isinstance(value, type) and value in _TYPES:
            return ast.Name(_TYPES[value], ast.Load())
        return _number(node, value)

    def _value(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Attribute):
            return getattr(self._value(node.value), node.attr)
        if not isinstance(node, ast.Name) or (node.id in self._local and node.id not in self._counts):
            raise KeyError
        return float if node.id == "float" else self._counts.get(node.id, self._scope.get(node.id))


def _number(node: ast.expr, value: Any) -> ast.AST:
    """A call that makes a number or a vector of the precision, where a value is one; truth values as they are."""
    if type(value) in (wp.vec3f, wp.vec3d):
        return ast.Call(ast.Name(VECTOR, ast.Load()), [ast.Constant(float(part)) for part in value], [])
    if isinstance(value, (bool, np.bool_)):
        return ast.Constant(bool(value))
    if type(value) in wp._src.types.scalar_types:
        value = value.value
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return node
    return ast.Call(ast.Name(REAL, ast.Load()), [ast.Constant(float(value))], [])
