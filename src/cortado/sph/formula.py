"""A user's Python function, compiled by Warp in either precision, with derivatives. Kernels pass its parameters as one
vector theta, in which time, numbers and vectors are concatenated."""

import ast
import inspect
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import prod
from tempfile import TemporaryFile
from types import FunctionType, MappingProxyType
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import c_stderr_to
from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.sph.function_meaning import FRACTIONS, PLACE, READ, READ_OF, REAL, VECTOR, meanings, text_for_warp
from cortado.sph.function_text import Frozen, SizesWritten, definition
from cortado.sph.own_arrays import MOST_NUMBERS, reading, table_type, theta_of


@dataclass(frozen=True)
class Inputs:
    names: tuple[str, str]
    kind: str = "vector"
    fields: tuple[str, ...] = ()
    arrays: bool = False


TIME = "t", "time"
MOST_AXES = 3
TYPES = re.compile(r"'[^']*' \(aka '[^']*'\)")
INPUTS = {
    "Body": Inputs(("x", "v"), fields=("density", FRACTIONS, "shear_rate", "velocity_gradient"), arrays=True),
    "Pair": Inputs(("x_ij", "v_ij")),
    "Rheology": Inputs(("shear_rate", "viscosity"), "number"),
}


@dataclass(frozen=True)
class Formula:
    """A user's function in the form that kernels call. Formulas with the same texts and outside numbers are equal."""

    name: str
    text: str
    """Source text of the function, with the precision's types and outside numbers written out."""
    inputs: tuple[str, ...]
    """Names of the first arguments: two vectors or numbers, and optionally time."""
    fields: tuple[str, ...]
    kind: str
    parameters: tuple[str, ...]
    arrays: tuple[str, ...]
    outside: str
    """A text of all values and Warp functions that `text` refers to."""
    scope: Mapping[str, Any] = field(compare=False, repr=False)
    phases: int = 0

    def of_phases(self, what: str, phases: int) -> "Formula":
        """Return the formula for a number of phases; raise `InputError` if it takes mass fractions of others."""
        if FRACTIONS not in self.fields:
            return self
        if phases == 1:
            raise InputError(f"{what} takes {FRACTIONS}, but only scenes of several phases have them.")
        for node in ast.walk(ast.parse(self.text)):
            is_read = isinstance(node, ast.Subscript) and ast.unparse(node.value) == FRACTIONS
            if is_read and ast.literal_eval(node.slice) not in range(-phases, phases):
                wanted = f"an index from {-phases} to {phases - 1} there, as there are {phases} phases"
                raise InputError(f"{what} has {ast.unparse(node)}, but must have {wanted}.")
        return replace(self, phases=phases)

    def function(self, precision: Precision, types: tuple[Any, ...], module: Any) -> Any:
        real, vector = precision.real, precision.vector
        scope = {**self.scope, **meanings(precision), REAL: real, VECTOR: vector}
        if self.arrays:
            functions = reading(precision, module.options["enable_backward"])
            scope |= {PLACE: functions.place, READ: functions.read}
        code = compile(self.text, f"<force {self.name}>", "exec")
        exec(code, scope)
        made: Any = scope[self.name]
        own = vector if self.kind == "vector" else real
        made.__annotations__ = dict(zip(self.inputs, (own, own, real), strict=False)) | self.takes(precision)
        made.__annotations__ |= dict(zip(self.parameters, types, strict=True)) | self.reads(precision) | {"return": own}
        return wp.Function(func=made, key=self.name, namespace="", module=module, source=self.text)

    def fractions(self, precision: Precision) -> Any:
        return precision.fractions(max(self.phases, 1))

    def takes(self, precision: Precision) -> dict[str, Any]:
        kinds = {"velocity_gradient": precision.matrix, FRACTIONS: self.fractions(precision)}
        return {name: kinds.get(name, precision.real) for name in self.fields}

    def reads(self, precision: Precision) -> dict[str, Any]:
        return dict(zip(READ_OF, (precision.real, table_type(precision), int, int), strict=True)) if self.arrays else {}


def formula(
    kind: str, function: FunctionType, source: str, parameters: Mapping[str, Any]
) -> tuple[Formula, dict[str, Any]]:
    """Read a user's function, called ``kind`` in messages. Return it with the values of its parameters, given or
    default. Raise `InputError` if the function is invalid."""
    what = f"{kind} function {function.__name__}"
    taken, values = _arguments(what, function, parameters, INPUTS[kind])
    inputs = tuple(name for name in taken if name not in INPUTS[kind].fields)
    fields = taken[len(inputs) :]
    shapes = _shapes(what, function, values, INPUTS[kind])
    frozen, written = Frozen(what, function), SizesWritten(shapes).visit(definition(what, function, source))
    text = text_for_warp(what, written, frozen, shapes, INPUTS[kind].kind)
    scope = MappingProxyType(frozen.scope)
    numbers = tuple(name for name in values if name not in shapes)
    names = (inputs, fields, INPUTS[kind].kind, numbers, tuple(shapes))
    return Formula(written.name, text, *names, frozen.words, scope), values


def _shapes(what: str, function: FunctionType, values: Mapping[str, Any], inputs: Inputs) -> dict[str, tuple[int, ...]]:
    found = {}
    for name, value in values.items():
        annotation = function.__annotations__.get(name)
        told = annotation is wp.array or isinstance(annotation, wp.array) or "array" in str(annotation)
        shape = np.shape(value) if hasattr(value, "__len__") else ()
        if not (told or len(shape) > 1 or (shape and shape[0] not in (2, 3))):
            continue
        if not inputs.arrays:
            raise InputError(f"{what} has the array {name}, but must have numbers and vectors: only Body has arrays.")
        if not (1 <= len(shape) <= MOST_AXES and 0 < prod(shape) <= MOST_NUMBERS):
            wanted = f"one to {MOST_AXES} axes, and 1 to {MOST_NUMBERS} numbers"
            raise InputError(f"{what} has the array {name} of shape {shape}, but must have one with {wanted}.")
        entries = getattr(annotation, "dtype", Any)
        if entries not in (Any, float, wp.float32, wp.float64) or getattr(annotation, "ndim", len(shape)) != len(shape):
            found_one = f"{what} has the array {name} of shape {shape}, with an annotation that does not fit"
            raise InputError(f"{found_one}, but must be annotated as floats with {len(shape)} axes.")
        found[name] = shape
    if sum(map(prod, found.values())) > MOST_NUMBERS:
        raise InputError(f"{what} has arrays of more than {MOST_NUMBERS} numbers together, but must have fewer.")
    return found


def _arguments(
    what: str, function: FunctionType, given: Mapping[str, Any], first: Inputs
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return names of the inputs and fields, and the parameters' values in the order of the arguments. The first two
    inputs may have any names. A third input must have a name of time, because it may be a parameter without value."""
    signature, known = inspect.signature(function, follow_wrapped=False).parameters, (*first.names, "t")
    for argument in signature.values():
        if argument.kind is not argument.POSITIONAL_OR_KEYWORD:
            raise InputError(f"{what} has the argument {argument}, but must have positional arguments alone.")
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
            raise InputError(f"{what} is given a value of {name}, but the run gives it.")
    taken = tuple(name for name in signature if name not in values)
    inputs = tuple(name for name in taken if name not in first.fields or name in taken[:2])
    if lacking := [name for k, name in enumerate(inputs[2:]) if k > 0 or name not in TIME]:
        found = f"{what} is given no value of {', '.join(lacking)}"
        raise InputError(f"{found}, but must have one of each parameter, as in {lacking[0]}=1.0.")
    if len(inputs) not in (2, 3) or tuple(signature)[: len(taken)] != taken or taken[: len(inputs)] != inputs:
        of_particles = f", {', '.join(first.fields)} or none of them" if first.fields else ""
        wanted = (
            f"two {first.kind}s first, then time or nothing{of_particles}, and then parameters that all have values"
        )
        raise InputError(f"{what} has {', '.join(taken) or 'nothing'} without a value, but must have {wanted}.")
    return taken, values


def compiled(what: str, module: Any, device: Any, returned: str = "vector") -> None:
    """Compile a module with a user's function; raise `InputError` with the first message of Warp's compiler."""
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


def applied(text: Formula, precision: Precision, ranks: tuple[int, ...], dimension: int, module: Any) -> Any:
    """Make the Warp function that calls a user's function, with two vectors or numbers, theta, and the arguments of
    `Formula.takes` and `Formula.reads`. In 2-D z of the result is 0."""
    timed, of_numbers = len(text.inputs) == 3, text.kind == "number"
    types = tuple(precision.vector if rank else precision.real for rank in ranks[timed:])
    terms, first = [], 0
    for rank in ranks:
        at = ", ".join(f"theta[{first + k}]" for k in range(3 if rank else 1))
        terms.append(f"vector({at})" if rank else at)
        first += 3 if rank else 1
    more, places = text.takes(precision) | text.reads(precision), [*terms[:timed], *text.fields, *terms[timed:]]
    called = f"own({', '.join(['x', 'v', *places, *text.reads(precision)])})"
    result = called if dimension == 3 or of_numbers else f"wp.cw_mul(vector(one, one, zero), {called})"
    source = f"def applied(x, v, theta{''.join(f', {name}' for name in more)}):\n    return {result}\n"
    own_type = precision.real if of_numbers else precision.vector
    one, zero = (wp.constant(precision.real(value)) for value in (1.0, 0.0))
    own = text.function(precision, types, module)
    scope = {"vector": precision.vector, "one": one, "zero": zero, "wp": wp, "own": own}
    exec(source, scope)
    made: Any = scope["applied"]
    made.__annotations__ = {"x": own_type, "v": own_type, "theta": theta_of(precision, ranks), **more}
    return wp.Function(func=made, key="applied", namespace="", module=module, source=source)
