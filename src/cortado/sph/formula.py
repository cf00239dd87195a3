"""A force that is one Python function, as Warp compiles it: in either precision, with numbers of that precision."""

import ast
import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import FunctionType, MappingProxyType, ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.sph.function_text import REAL, VECTOR, DerivativeCheck, InPrecision, check_names, check_returns


@dataclass(frozen=True)
class Inputs:
    """What functions of a kind are given before their parameters, but for the time, which they may leave out."""

    names: tuple[str, str]
    """What sentences call them."""
    kind: str = "vector"
    """"vector" or "number": what they are, and what the function returns."""


TIME = "t", "time"
"""Names that the time has."""
INPUTS = {
    "Body": Inputs(("x", "v")),
    "Pair": Inputs(("x_ij", "v_ij")),
    "Rheology": Inputs(("shear_rate", "viscosity"), "number"),
}
"""By what sentences call a force."""
_SENT: WeakKeyDictionary[FunctionType, str] = WeakKeyDictionary()
"""Texts of functions that came from other processes."""


@dataclass(frozen=True)
class Formula:
    """The function of a force. Two are equal where their texts are, numbers from outside of them included."""

    name: str
    text: str
    """Its definition, with types of the precision and with numbers from outside written out."""
    inputs: tuple[str, ...]
    """Its arguments before the parameters: two vectors or numbers, and time if there is a third."""
    kind: str
    """"vector" or "number": what the first two are, and what it returns."""
    parameters: tuple[str, ...]
    """Its other arguments."""
    outside: tuple[str, ...]
    """What the text does not say: the functions of Warp that it calls, and values."""
    scope: Mapping[str, Any] = field(compare=False, repr=False)
    """What names in the text stand for."""

    def function(self, precision: Precision, types: tuple[Any, ...], module: Any) -> Any:
        """The Warp function of a precision, with the types of its parameters; it has the name of the user's."""
        real, vector = precision.real, precision.vector
        scope = {**self.scope, REAL: real, VECTOR: vector}
        code = compile(self.text, f"<force {self.name}>", "exec")
        exec(code, scope)
        made: Any = scope[self.name]
        own = vector if self.kind == "vector" else real
        known = (own, own, real)[: len(self.inputs)]
        made.__annotations__ = dict(zip((*self.inputs, *self.parameters), (*known, *types), strict=True))
        made.__annotations__["return"] = own
        return wp.Function(func=made, key=self.name, namespace="", module=module, source=self.text)


def plain_function(kind: str, function: Any) -> FunctionType:
    """What a user gives as the function of a force, which may be one of Warp; raises `InputError`."""
    plain = function.func if isinstance(function, wp.Function) else function
    if not isinstance(plain, FunctionType):
        raise InputError(f"{kind} has {shown(function)}, but must have a function, made by def.")
    return plain


def source_of(kind: str, function: FunctionType) -> str:
    """The text of a function; raises `InputError`."""
    if function in _SENT:
        return _SENT[function]
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError) as error:
        found = f"the text of {kind} function {function.__name__} is not to be found"
        raise InputError(f"{found}, but must stand in a file or a notebook.") from error


def keep_source(function: FunctionType, source: str) -> None:
    """Keep the text that a function came with from another process, where it may stand in no file."""
    _SENT[function] = source


def formula(
    kind: str, function: FunctionType, source: str, parameters: Mapping[str, Any]
) -> tuple[Formula, dict[str, Any]]:
    """A user's function with its text, called ``kind`` in sentences, and the values of its parameters: those given, and
    its own for what is not. Raises `InputError`."""
    name, what = function.__name__, f"{kind} function {function.__name__}"
    inputs, values = _arguments(what, function, parameters, INPUTS[kind])
    definition, scope = _definition(what, source), _scope(function)
    tree = ast.Module([definition], [])
    helpers = _called(scope)
    for one in (tree, *(helper.adj.tree for helper in helpers)):
        DerivativeCheck(what).visit(one)
    scopes = scope, *(_scope(helper.func) for helper in helpers)
    outside = (*(helper.adj.source for helper in helpers), *map(_values, scopes))
    local = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    own = {*inputs, *values, *local}
    check_returns(what, definition, INPUTS[kind].kind)
    check_names(what, definition, own, scope)
    rewritten = InPrecision(scope, own).visit(tree)
    text = ast.unparse(ast.fix_missing_locations(rewritten)) + "\n"
    return Formula(name, text, inputs, INPUTS[kind].kind, tuple(values), outside, MappingProxyType(scope)), values


def _arguments(
    what: str, function: FunctionType, given: Mapping[str, Any], first: Inputs
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the inputs, and the parameters' values in the order of the function's arguments. The first two inputs
    may have any names; those of ``first``, and t, stand for nothing else. A third one is the time only where its name
    says so, as it may be a parameter whose value was forgotten."""
    signature, known = inspect.signature(function).parameters, (*first.names, "t")
    for argument in signature.values():
        if argument.kind is not argument.POSITIONAL_OR_KEYWORD:
            raise InputError(f"{what} has the argument {argument}, but must have arguments by position alone.")
    if any(name in known and known.index(name) != place for place, name in enumerate(signature)):
        found = f"{what} has the arguments {', '.join(signature)}"
        raise InputError(f"{found}, but must have {', '.join(known[:2])} first, and then {known[2]} if it takes time.")
    for name in given:
        if name not in signature:
            found = f"({', '.join(signature)})"
            raise InputError(f"{what} is given a value of {name}, but must have {name} among its arguments {found}.")
    values = {n: given.get(n, a.default) for n, a in signature.items() if n in given or a.default is not a.empty}
    for name in known:
        if name in values:
            raise InputError(f"{what} is given a value of {name}, but must be given none, as the run has its own.")
    inputs = tuple(name for name in signature if name not in values)
    if lacking := [name for k, name in enumerate(inputs[2:]) if k > 0 or name not in TIME]:
        found = f"{what} is given no value of {', '.join(lacking)}"
        raise InputError(f"{found}, but must have one of each parameter, as in {lacking[0]}=1.0.")
    if len(inputs) not in (2, 3) or tuple(signature)[: len(inputs)] != inputs:
        wanted = f"two {first.kind}s first, then time or nothing, and then parameters that all have values"
        raise InputError(f"{what} has {', '.join(inputs) or 'nothing'} without a value, but must have {wanted}.")
    return inputs, values


def _definition(what: str, source: str) -> ast.FunctionDef:
    """The definition alone, without annotations, defaults and decorators."""
    try:
        found: ast.AST = ast.parse(source).body[0]
    except SyntaxError:  # a lambda on one of several lines
        found = ast.Pass()
    if not isinstance(found, ast.FunctionDef):
        raise InputError(f"{what} is no definition, but must be made by def.")
    found.decorator_list, found.returns, found.args.defaults = [], None, []
    for argument in found.args.args:
        argument.annotation = None
    return found


def _scope(function: FunctionType) -> dict[str, Any]:
    """What the names of a function stand for that are not its own."""
    outside = inspect.getclosurevars(function)
    return {**outside.globals, **outside.nonlocals}


def _called(scope: Mapping[str, Any], found: tuple[Any, ...] = ()) -> tuple[Any, ...]:
    """The functions of Warp's users that are named in a scope, and those that they call."""
    for _, helper in sorted(scope.items()):
        if isinstance(helper, wp.Function) and helper.func and helper not in found:
            found = _called(_scope(helper.func), (*found, helper))
    return found


def _values(scope: Mapping[str, Any]) -> str:
    """What is named in a scope and is no function, module or type, in words."""
    kept = {n: v for n, v in sorted(scope.items()) if not callable(v) and not isinstance(v, (ModuleType, wp.Function))}
    return str({name: np.asarray(value).tolist() for name, value in kept.items()})


def compiled(what: str, module: Any, device: Any, returned: str = "vector") -> None:
    """Compile a module with a user's function, which returns a vector or a number; raises `InputError` where
    Warp cannot."""
    try:
        wp.load_module(module, device)
    except Exception as error:  # Warp raises any kind for a text that it does not understand
        reason = str(error).replace("\\n", "\n").strip().splitlines()[-1:] or [type(error).__name__]
        wanted = (
            f"it must use numbers, vectors of three components and functions of Warp alone, and return a {returned}"
        )
        raise InputError(f"{what} cannot be compiled: {reason[0].lstrip('; ').rstrip('.')}; {wanted}.") from error
