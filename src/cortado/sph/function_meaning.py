"""Rewrites a user-defined function so that Warp computes the same as Python.

Operators with a different meaning in Warp are replaced by Warp functions with Python's meaning. Code that cannot be
replaced raises an error.
"""

import ast
import builtins
from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.sph.function_text import DerivativeCheck, Frozen, check_names, returns

REMAINDER, QUOTIENT, NEAREST, WHOLE = "cortado_remainder", "cortado_quotient", "cortado_nearest", "cortado_whole"
"""Names of the Warp functions for a % b, a // b, round(a) and int(a)."""


@cache
def meanings(precision: Precision) -> dict[str, Any]:
    """The Warp functions of a % b and a // b are equal to CPython's operators bit for bit."""
    real, module = precision.real, kernel_module(f"python_{precision.name}")
    none, one, half = (wp.constant(real(value)) for value in (0.0, 1.0, 0.5))

    @wp.func(module=module)
    def quotient(a: real, b: real) -> real:
        left = wp.mod(a, b)
        ratio = (a - left) / b
        if left != none and (left < none) != (b < none):
            ratio = ratio - one
        whole = wp.floor(ratio)
        if ratio - whole > half:
            whole = whole + one
        return whole

    @wp.func(module=module)
    def remainder(a: real, b: real) -> real:
        left = wp.mod(a, b)
        if left != none and (left < none) != (b < none):
            left = left + b
        return left

    @wp.func_grad(remainder)
    def adjoint_of_remainder(a: real, b: real, left_bar: real):
        wp.adjoint[a] += left_bar
        wp.adjoint[b] -= quotient(a, b) * left_bar

    return {REMAINDER: remainder, QUOTIENT: quotient, NEAREST: wp.rint, WHOLE: wp.trunc}


REAL, VECTOR = "cortado_real", "cortado_vector"
PLACE, READ, READ_OF = "cortado_place", "cortado_read", ("cortado_e", "cortado_w", "cortado_member", "cortado_row")
"""Names of the Warp functions that read arrays, and names of the first arguments of these functions."""
_TYPES = {float: REAL, wp.float32: REAL, wp.float64: REAL, wp.vec3f: VECTOR, wp.vec3d: VECTOR}
_OPERATORS: Mapping[type[ast.operator], str] = {ast.Mod: REMAINDER, ast.FloorDiv: QUOTIENT}
_CALLS = {"round": NEAREST, "int": WHOLE}
FRACTIONS = "mass_fractions"
Lines = ast.AST | list[ast.stmt]


class InPrecision(ast.NodeTransformer):
    """Rewrites the source code of a function for a precision: outside values become numbers, and loops are unrolled."""

    def __init__(self, what: str, scope: Mapping[str, Any], local: set[str], shapes: Mapping[str, tuple[int, ...]]):
        self._what, self._scope, self._local = what, scope, local
        sizes = [prod(shape) for shape in shapes.values()]
        self._arrays = {name: (sum(sizes[:k]), shape) for k, (name, shape) in enumerate(shapes.items())}
        """Start index and shape of each array parameter in the array of all parameters, by name."""
        self._counts: dict[str, int] = {}
        self._given = set[str]()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self._given = {one.arg for one in node.args.args} - {FRACTIONS}
        node.args.args = [one for one in node.args.args if one.arg not in self._arrays]
        if self._arrays:
            node.args.args += [ast.arg(name) for name in READ_OF]
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return _number(node, node.value)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        if node.id in self._arrays:
            found = f"{self._what} uses the array {node.id} without indices, or assigns to {node.id}"
            wanted = f"read single numbers, as in {node.id}[0], or sizes, as in {node.id}.shape"
            raise InputError(f"{found}, but must {wanted}.")
        return self._resolved(node) if isinstance(node.ctx, ast.Load) else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self.generic_visit(node) if (found := self._resolved(node)) is node else found

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if isinstance(node.value, ast.Name) and node.value.id in self._arrays:
            return self._read(node, parts, *self._arrays[node.value.id])
        node.value = self.visit(node.value)
        numbers = [self._index(part) for part in parts]
        if isinstance(node.value, ast.Name) and node.value.id in self._given and set(numbers) - set(range(-3, 3)):
            raise InputError(f"{self._what} has {ast.unparse(node)}, but the index of a component must be 0, 1 or 2.")
        written: list[ast.expr] = [ast.Constant(number) for number in numbers]
        node.slice = ast.Tuple(written, ast.Load()) if isinstance(node.slice, ast.Tuple) else written[0]
        return node

    def _read(self, node: ast.Subscript, parts: list[ast.expr], first: int, shape: tuple[int, ...]) -> ast.AST:
        if len(parts) != len(shape) or any(isinstance(part, (ast.Slice, ast.Starred)) for part in parts):
            found = f"{self._what} has {ast.unparse(node)}"
            raise InputError(f"{found}, but must have an index for each axis of the shape {shape}.")
        place = _number(node, first)
        for k, (part, size) in enumerate(zip(parts, shape, strict=True)):
            own = ast.BinOp(self._place(node, part, size), ast.Mult(), _number(node, prod(shape[k + 1 :])))
            place = ast.BinOp(place, ast.Add(), own)
        return _call(READ, *(ast.Name(name, ast.Load()) for name in READ_OF), place)

    def _place(self, node: ast.Subscript, part: ast.expr, size: int) -> ast.expr:
        number = self._whole(part)
        if number is None:
            return _call(PLACE, _call(REAL, self.visit(part)), _number(node, size))
        if not -size <= number < size:
            found = f"{self._what} has {ast.unparse(node)} with the index {number}"
            raise InputError(f"{found}, but the index must be from {-size} to {size - 1}.")
        return _number(node, number % size)

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        return node if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_For(self, node: ast.For) -> Lines:
        ends, found = [self._index(end) for end in node.iter.args], list[ast.AST | list[ast.stmt]]()
        for count in range(*ends):
            self._counts[node.target.id] = count
            found += [self.visit(deepcopy(line)) for line in node.body]
        found += [self.visit(deepcopy(line)) for line in node.orelse]
        return [line for one in found for line in (one if isinstance(one, list) else [one])] or [ast.Pass()]

    def visit_AugAssign(self, node: ast.AugAssign) -> Lines:
        before = ast.Name(node.target.id, ast.Load())  # type: ignore[union-attr]
        return self.visit(ast.Assign([node.target], ast.BinOp(before, node.op, node.value)))

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        left, right = self.visit(node.left), self.visit(node.right)
        name = _OPERATORS.get(type(node.op))
        return _call(name, left, right) if name else ast.BinOp(left, node.op, right)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        values, each = [node.left, *node.comparators], list[ast.expr]()
        for a, op, b in zip(values, node.ops, values[1:], strict=False):
            each.append(ast.Compare(self.visit(deepcopy(a)), [op], [self.visit(deepcopy(b))]))
        return each[0] if len(each) == 1 else ast.BoolOp(ast.And(), each)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        name = node.func.id if isinstance(node.func, ast.Name) and node.func.id not in self._scope else None
        given = [self.visit(argument) for argument in node.args]
        if name in _CALLS:
            return _call(_CALLS[name], *given)
        if name == "pow" and len(given) == 2:
            return ast.BinOp(given[0], ast.Pow(), given[1])
        if name in ("min", "max") and len(given) > 2:
            while len(given) > 1:
                given = [_call(name, *given[:2]), *given[2:]]
            return given[0]
        keywords = [ast.keyword(one.arg, self.visit(one.value)) for one in node.keywords]
        return ast.Call(self.visit(node.func), given, keywords)

    def _index(self, node: ast.expr) -> int:
        number = self._whole(node)
        if number is None:
            wanted = "whole numbers or expressions of loop counters"
            raise InputError(f"{self._what} has the index {ast.unparse(node)}, but indices must be {wanted}.")
        return number

    def _whole(self, node: ast.expr) -> int | None:
        known = {one.id: one for one in ast.walk(node) if isinstance(one, ast.Name)}
        values = {name: self._counts.get(name, self._scope.get(name)) for name in known if name not in self._local}
        values |= {name: count for name, count in self._counts.items() if name in known}
        try:
            found = eval(compile(ast.Expression(node), "<index>", "eval"), {"__builtins__": {}}, values)
            if isinstance(found, (int, np.integer)) and not isinstance(found, bool):
                return int(found)
        except Exception:  # whatever an expression of other things raises
            pass
        return None

    def _resolved(self, node: ast.Name | ast.Attribute) -> ast.AST:
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


def _call(name: str, *given: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), [*given], [])


def _number(node: ast.expr, value: Any) -> ast.expr:
    if type(value) in (wp.vec3f, wp.vec3d):
        return _call(VECTOR, *(ast.Constant(float(part)) for part in value))
    if isinstance(value, (bool, np.bool_)):
        return ast.Constant(bool(value))
    if type(value) in wp._src.types.scalar_types:
        value = value.value
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return node
    return _call(REAL, ast.Constant(float(value)))


MOST_TURNS = 256


def text_for_warp(
    what: str, function: ast.FunctionDef, frozen: Frozen, shapes: Mapping[str, tuple[int, ...]], kind: str
) -> str:
    """Return the source code of a user's function for Warp. ``shapes`` are the shapes of arrays by name. Raise
    `InputError` for code that Warp does not support, cannot differentiate, or interprets differently from Python. Also
    raise `InputError` if the user's function may not return a ``kind``."""
    for helper in frozen.helpers:
        tree = helper.adj.tree
        DerivativeCheck(what).visit(tree)
        check_helper(what, tree.body[0])
    DerivativeCheck(what, MOST_TURNS).visit(function)
    local = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    own = local | {argument.arg for argument in function.args.args}
    if not returns(function.body):
        raise InputError(f"{what} may end without return, but must return a {kind} for all arguments.")
    check_names(what, function, own, frozen.scope)
    check_calls(what, function, own, frozen.scope)
    check_truths(what, function)
    rewritten = InPrecision(what, frozen.scope, own, shapes).visit(ast.Module([function], []))
    return ast.unparse(ast.fix_missing_locations(rewritten)) + "\n"


BUILTINS = ("abs", "float", "int", "max", "min", "pow", "range", "round")
MATH = (
    *("acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "degrees", "exp", "floor", "isfinite", "isinf", "isnan"),
    *("log", "log10", "log2", "pow", "radians", "sin", "sinh", "sqrt", "tan", "tanh", "trunc"),
)


def check_calls(what: str, function: ast.FunctionDef, own: set[str], scope: Mapping[str, Any]) -> None:
    for node in ast.walk(function):
        if not isinstance(node, ast.Call):
            continue
        name, root = ast.unparse(node.func), _root(node.func)
        if root is None or root in own:
            continue
        called = _found(node.func, scope)
        if root not in scope and root in BUILTINS:
            if name == "round" and len(node.args) + len(node.keywords) != 1:
                raise InputError(f"{what} must call round with one number only.")
        elif not isinstance(called, wp.Function) and called is not float:
            package = str(getattr(called, "__module__", None) or "").partition(".")[0]
            if package != "warp" and not (package == "math" and called.__name__ in MATH):
                wanted = f"functions under @wp.func, {', '.join(BUILTINS)}, and functions of math that Warp supports"
                found = f"{what} cannot be compiled: the code calls {name}"
                raise InputError(f"{found}, but may only call functions of Warp, {wanted}.")


def check_truths(what: str, function: ast.FunctionDef) -> None:
    """Raise `InputError` for ``and`` and ``or`` used as numbers. Warp returns other values than Python."""
    tests: set[ast.AST] = set()
    for node in ast.walk(function):
        if isinstance(node, (ast.If, ast.IfExp, ast.While, ast.Assert)):
            tests.add(node.test)
        elif isinstance(node, ast.BoolOp) and node in tests:
            tests.update(node.values)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            tests.add(node.operand)
    assigned: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        for target in node.targets if isinstance(node, ast.Assign) else ():
            assigned.setdefault(ast.unparse(target), []).append(node.value)
    truths = {name for name, values in assigned.items() if all(_is_truth(value, set()) for value in values)}
    for node in ast.walk(function):
        if isinstance(node, ast.BoolOp) and node not in tests and not _is_truth(node, truths):
            found = (
                f"{what} has {ast.unparse(node)!r}, which is one of its operands in Python but True or False in Warp"
            )
            raise InputError(f"{found}: compare the operands, or write x if x != 0.0 else y instead of x or y.")


def check_helper(what: str, function: ast.FunctionDef) -> None:
    """Raise `InputError` for code in a ``@wp.func`` function that means something different in Python."""
    check_truths(what, function)
    targets = [node.target for node in ast.walk(function) if isinstance(node, ast.For)]
    wholes = {target.id for target in targets if isinstance(target, ast.Name)}
    for node in ast.walk(function):
        of = getattr(node, "op", None)
        if isinstance(of, (ast.Mod, ast.FloorDiv)) or (isinstance(of, ast.Div) and _is_whole(node, wholes)):
            wanted = "wp.mod, wp.floor, wp.rint and numbers with a point"
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("round", "builtins.round"):
            wanted = "wp.rint, or wp.round, which rounds halves away from 0"
        else:
            continue
        found = f"{what} calls a function of Warp with {ast.unparse(node)!r}, which has another value in Python"
        raise InputError(f"{found}: use {wanted}.")


def _is_whole(node: ast.AST, wholes: set[str]) -> bool:
    if isinstance(node, ast.Constant):
        return type(node.value) is int
    if isinstance(node, ast.BinOp):
        return _is_whole(node.left, wholes) and _is_whole(node.right, wholes)
    if isinstance(node, ast.UnaryOp):
        return _is_whole(node.operand, wholes)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("int", "wp.int32", "wp.int64")
    return isinstance(node, ast.Name) and node.id in wholes


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
