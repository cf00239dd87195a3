"""A force that is one Python function, as Warp compiles it: in either precision, with numbers of that precision."""

import ast
import inspect
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from tempfile import TemporaryFile
from types import FunctionType, MappingProxyType
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.device.warp_start import c_stderr_to
from cortado.errors import InputError
from cortado.sph.frozen import Frozen
from cortado.sph.function_source import definition
from cortado.sph.function_text import DerivativeCheck, check_names, check_returns
from cortado.sph.in_precision import REAL, VECTOR, InPrecision
from cortado.sph.meaning_checks import check_calls, check_helper, check_truths
from cortado.sph.python_meaning import meanings


@dataclass(frozen=True)
class Inputs:
    """What functions of a kind are given before their parameters, but for the time, which they may leave out."""

    names: tuple[str, str]
    """What sentences call them."""
    kind: str = "vector"
    """"vector" or "number": what they are, and what the function returns."""


TIME = "t", "time"
"""Names that the time has."""
TYPES = re.compile(r"'[^']*' \(aka '[^']*'\)")
"""How a compiler writes those of vectors and numbers."""
INPUTS = {
    "Body": Inputs(("x", "v")),
    "Pair": Inputs(("x_ij", "v_ij")),
    "Rheology": Inputs(("shear_rate", "viscosity"), "number"),
}
"""By what sentences call a force."""


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
    outside: str
    """What the text does not say: the functions under ``@wp.func`` that it calls, and values, as a text."""
    scope: Mapping[str, Any] = field(compare=False, repr=False)
    """What names in the text stand for."""

    def function(self, precision: Precision, types: tuple[Any, ...], module: Any) -> Any:
        """The Warp function of a precision, with the types of its parameters; it has the name of the user's."""
        real, vector = precision.real, precision.vector
        scope = {**self.scope, **meanings(precision), REAL: real, VECTOR: vector}
        code = compile(self.text, f"<force {self.name}>", "exec")
        exec(code, scope)
        made: Any = scope[self.name]
        own = vector if self.kind == "vector" else real
        known = (own, own, real)[: len(self.inputs)]
        made.__annotations__ = dict(zip((*self.inputs, *self.parameters), (*known, *types), strict=True))
        made.__annotations__["return"] = own
        return wp.Function(func=made, key=self.name, namespace="", module=module, source=self.text)


def formula(
    kind: str, function: FunctionType, source: str, parameters: Mapping[str, Any]
) -> tuple[Formula, dict[str, Any]]:
    """A user's function with its text, called ``kind`` in sentences, and the values of its parameters: those given, and
    its own for what is not. Raises `InputError`."""
    what = f"{kind} function {function.__name__}"
    inputs, values = _arguments(what, function, parameters, INPUTS[kind])
    frozen, written = Frozen(what, function), definition(what, function, source)
    for helper in frozen.helpers:
        tree = helper.adj.tree
        DerivativeCheck(what).visit(tree)
        check_helper(what, tree.body[0])
    DerivativeCheck(what).visit(written)
    local = {node.id for node in ast.walk(written) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    own = {*inputs, *values, *local}
    check_returns(what, written, INPUTS[kind].kind)
    check_names(what, written, own, frozen.scope)
    check_calls(what, written, own, frozen.scope)
    check_truths(what, written)
    rewritten = InPrecision(what, frozen.scope, own).visit(ast.Module([written], []))
    text = ast.unparse(ast.fix_missing_locations(rewritten)) + "\n"
    scope = MappingProxyType(frozen.scope)
    return Formula(written.name, text, inputs, INPUTS[kind].kind, tuple(values), frozen.words, scope), values


def _arguments(
    what: str, function: FunctionType, given: Mapping[str, Any], first: Inputs
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the inputs, and the parameters' values in the order of the function's arguments. The first two inputs
    may have any names; those of ``first``, and t, stand for nothing else. A third one is the time only where its name
    says so, as it may be a parameter whose value was forgotten."""
    signature, known = inspect.signature(function, follow_wrapped=False).parameters, (*first.names, "t")
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


def compiled(what: str, module: Any, device: Any, returned: str = "vector") -> None:
    """Compile a module with a user's function, which returns a vector or a number; raises `InputError` where
    Warp cannot, with the first thing that its compiler says of it."""
    with TemporaryFile() as said:
        try:
            with c_stderr_to(said.fileno()):
                wp.load_module(module, device)
        except Exception as error:  # Warp raises any kind for a text that it does not understand
            said.seek(0)
            found = re.findall("error: (.*)", said.read().decode(errors="replace"))
            text = (
                TYPES.sub(lambda one: "a vector" if "vec" in one[0] else "a number", found[0]) if found else str(error)
            )
            reason = text.replace("\\n", "\n").strip().splitlines()[-1:] or [type(error).__name__]
            wanted = (
                f"it must use numbers, vectors of three components and functions of Warp alone, and return a {returned}"
            )
            raise InputError(f"{what} cannot be compiled: {reason[0].lstrip('; ').rstrip('.')}; {wanted}.") from error
        said.seek(0)
        sys.stderr.write(said.read().decode(errors="replace"))
