"""User-defined Python functions in kernels, compiled by Warp in float32 or float64, with derivatives.

Numbers, vectors and times among the parameters of a function are stored in one vector. Array parameters, such as the
weights of a neural network, are stored together in one array (members, numbers). Without atomic operations, each thread
adds adjoints of array parameters to a separate row, and the rows are summed in a fixed order.
"""

import ast
import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from math import prod
from tempfile import TemporaryFile
from types import FunctionType, MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import by_name, c_stderr_to, kernel_module, kind_of
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.device.reduction import sum_of
from cortado.errors import InputError
from cortado.particles.state import Layout, Parameters, components
from cortado.scene.parameters import Axis, Parameter
from cortado.sph.function_meaning import FRACTIONS, PLACE, READ, READ_OF, REAL, VECTOR, meanings, text_for_warp
from cortado.sph.function_text import Frozen, SizesWritten, definition
from cortado.sph.parts import Adjoints, StepContext

WIDTH = (1, 3)
MOST_NUMBERS = 2**24
"""Greatest total size of a force's arrays. float32 represents all indices up to this size exactly."""
ROWS, MOST_PARTIAL = {"cpu": 16, "cuda": 2**15}, 2**24

READ_AS = {"e": "_no", "member": "i // particles", "row": "_row"}


def theta_of(precision: Precision, ranks: Sequence[int]) -> Any:
    """Return the Warp vector type for parameters with the given ranks."""
    return precision.fractions(max(sum(WIDTH[rank] for rank in ranks), 1))


@cache
def table_type(precision: Precision) -> Any:
    """Return the Warp struct of a force's array parameters: values, tangents, and an adjoint for each thread."""
    return struct_of("Table", precision, **dict.fromkeys(("values", "dots", "rows"), wp.array2d(dtype=precision.real)))


def arrays_module(precision: Precision, forward: bool, taped: bool = False) -> Any:
    return kernel_module(f"arrays_{kind_of(forward, taped)}_{precision.name}", forward and taped)


@cache
def reading(precision: Precision, taped: bool) -> SimpleNamespace:
    real, table = precision.real, table_type(precision)
    module = arrays_module(precision, True, taped)
    none, nothing = wp.constant(real(0.0)), wp.constant(real(float("nan")))

    @wp.func(module=module)
    def place(k: real, size: real) -> real:
        """Return a valid index. A negative index counts from the end, and an index out of range gives NaN."""
        found = k
        if k < none:
            found = k + size
        if found < none or found >= size or found != wp.floor(found):
            found = nothing
        return found

    @wp.func(module=module)
    def read(e: real, w: table, member: int, row: int, k: real) -> real:
        found = nothing
        if k >= none:
            found = w.values[member, int(k)]
        return found

    if not taped:

        @wp.func_grad(read)
        def read_adjoint(e: real, w: table, member: int, row: int, k: real, bar: real):
            if k >= none and row >= 0:
                w.rows[int(k), row] = w.rows[int(k), row] + bar
            elif k >= none and w.dots.shape[0] > 0:
                wp.adjoint[e] += bar * w.dots[member, int(k)]

    return by_name(place, read)


@cache
def packing_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
    """``pack`` copies a parameter's values in a step to the array ``table``. ``add`` does the reverse for adjoints."""
    typed = TypesByName(wp.array2d(dtype=precision.real), {wp.int32: "step"})

    @typed.kernel(arrays_module(precision, True, taped))
    def pack(first: int, size: int, step, values, table):
        member, k = wp.tid() // size, wp.tid() % size
        row = wp.min(step[member], values.shape[1] // size - 1)
        table[member, first + k] = values[member, row * size + k]

    @typed.kernel(arrays_module(precision, False), enable_backward=False)
    def add(first: int, size: int, step, table, values):
        member, k = wp.tid() // size, wp.tid() % size
        column = wp.min(step[member], values.shape[1] // size - 1) * size + k
        values[member, column] = values[member, column] + table[member, first + k]

    return by_name(pack, add)


class Numbers:
    """The numbers of several parameters in one array, with a row for each scene of a batch."""

    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._kernels = packing_kernels(layout.precision, taped) if parameters else None
        self._members = layout.members
        sizes = [prod(one.shape) if one.axis is Axis.ARRAY else WIDTH[one.rank] for one in parameters]
        self._places = [(one.name, sum(sizes[:k]), sizes[k]) for k, one in enumerate(parameters)]
        self.size = sum(sizes)

    def launch(self, kernel: str, step: StepContext, values: Parameters, table: wp.array) -> None:
        for name, first, size in self._places:
            count = values[name].size * getattr(values[name].dtype, "_length_", 1)
            numbers = components(values[name], (self._members, count // self._members))
            given = {"first": first, "size": size, "values": numbers, "table": table}
            step.launch(getattr(self._kernels, kernel), threads=self._members * size, **given)


class OwnParameters:
    def __init__(self, parameters: Sequence[Parameter], layout: Layout, taped: bool):
        self._layout, own = layout, [one for one in parameters if one.axis is not Axis.ARRAY]
        self._numbers = Numbers(own, layout, taped)
        self._arrays = Numbers([one for one in parameters if one.axis is Axis.ARRAY], layout, taped)
        self._size, members, self._real = self._arrays.size, layout.members, layout.precision.real
        dtype = theta_of(layout.precision, [one.rank for one in own])
        options: dict[str, Any] = {"dtype": dtype, "device": layout.device}
        self._theta, self._theta_dot = wp.zeros(members, **options, requires_grad=taped), wp.zeros(members, **options)
        self._theta_bar = wp.zeros(layout.all_particles, **options)
        """Array of shape (n,) with the particles' terms in the adjoint of ``theta``."""
        self._sum_theta = layout.sum_of(dtype) if own else None
        most = min(ROWS["cpu" if layout.device.is_cpu else "cuda"], layout.particles)
        self.rows = max(min(most, MOST_PARTIAL // (members * max(self._size, 1))), 1)
        self.threads = members * self.rows if self._size else None
        """Number of threads of the adjoint; None for one thread per particle."""
        self._table = self._new(values=self._zeros(members, self._size, requires_grad=taped))

    def now(self, step: StepContext) -> dict[str, Any]:
        return self._told(step, "_table")

    def along(self, step: StepContext, parameters_dot: Parameters) -> dict[str, Any]:
        if self._size:
            self._arrays.launch("pack", step, parameters_dot, self._along.dots)
        self._numbers.launch("pack", step, parameters_dot, _flat(self._theta_dot))
        return {**self._told(step, "_along"), "theta_dot": self._theta_dot}

    def back(self, step: StepContext) -> dict[str, Any]:
        return {**self._told(step, "_back"), "theta_bar": self._theta_bar, "rows": self.rows}

    def collect(self, step: StepContext, bar: Adjoints) -> None:
        if self._sum_theta is not None:
            self._numbers.launch("add", step, bar.parameters, _flat(self._sum_theta(self._theta_bar)))
        if self._size:
            total = self._sum(self._back.rows.flatten()).reshape((self._size, self._layout.members))
            self._arrays.launch("add", step, bar.parameters, total.transpose((1, 0)))
            self._back.rows.zero_()

    def _told(self, step: StepContext, name: str) -> dict[str, Any]:
        self._numbers.launch("pack", step, step.parameters, _flat(self._theta))
        found = {"theta": self._theta}
        if self._size:
            found["table"] = getattr(self, name)
            self._arrays.launch("pack", step, step.parameters, found["table"].values)
        return found

    @cached_property
    def _along(self) -> Any:
        return self._new(values=self._table.values, dots=self._zeros(self._layout.members, self._size))

    @cached_property
    def _back(self) -> Any:
        return self._new(values=self._table.values, rows=self._zeros(self._size, self._layout.members * self.rows))

    @cached_property
    def _sum(self) -> Any:
        return sum_of(self._real, self.rows, self._layout.device, self._size * self._layout.members)

    def _new(self, **arrays: wp.array) -> Any:
        made = table_type(self._layout.precision)()
        for name in ("values", "dots", "rows"):
            setattr(made, name, arrays[name] if name in arrays else self._zeros(0, 0))
        return made

    def _zeros(self, *shape: int, requires_grad: bool = False) -> wp.array:
        return wp.zeros(shape, dtype=self._real, device=self._layout.device, requires_grad=requires_grad)


def _flat(theta: wp.array) -> wp.array:
    return components(theta, (len(theta), theta.dtype._length_))


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
    """A user-defined function for kernels. Two formulas are equal if they compute the same values."""

    name: str
    text: str
    inputs: tuple[str, ...]
    """Names of the function's first arguments: two vectors or numbers, and optionally the time."""
    fields: tuple[str, ...]
    kind: str
    parameters: tuple[str, ...]
    arrays: tuple[str, ...]
    outside: str
    """Source code of the function, with all values and Warp functions from outside that it uses."""
    scope: Mapping[str, Any] = field(compare=False, repr=False)
    phases: int = 0
    ranks: tuple[int, ...] = ()
    """Number of axes of each parameter: 0 for a number, 1 for a vector."""
    topic: str = ""
    """Part of the names of Warp modules for a law of viscosity; empty for Newtonian fluids."""

    def of_phases(self, what: str, phases: int) -> "Formula":
        """Return the formula for the given number of phases. Raise `InputError` for an unsuitable number."""
        if FRACTIONS not in self.fields:
            return self
        if phases == 1:
            raise InputError(f"{what} takes {FRACTIONS}, but only scenes of several phases have mass fractions.")
        for node in ast.walk(ast.parse(self.text)):
            is_read = isinstance(node, ast.Subscript) and ast.unparse(node.value) == FRACTIONS
            if is_read and ast.literal_eval(node.slice) not in range(-phases, phases):
                wanted = f"an index from {-phases} to {phases - 1}, as the scene has {phases} phases"
                raise InputError(f"{what} has {ast.unparse(node)}, but must have {wanted}.")
        return replace(self, phases=phases)

    def function(self, precision: Precision, types: tuple[Any, ...], module: Any) -> Any:
        real, vector = precision.real, precision.vector
        scope = {**self.scope, **meanings(precision), REAL: real, VECTOR: vector}
        if self.arrays:
            functions = reading(precision, module.options["enable_backward"])
            scope |= {PLACE: functions.place, READ: functions.read}
        exec(compile(self.text, f"<force {self.name}>", "exec"), scope)
        made: Any = scope[self.name]
        own = vector if self.kind == "vector" else real
        made.__annotations__ = dict(zip(self.inputs, (own, own, real), strict=False)) | self.takes(precision)
        made.__annotations__ |= dict(zip(self.parameters, types, strict=True)) | self.reads(precision) | {"return": own}
        return wp.Function(func=made, key=self.name, namespace="", module=module, source=self.text)

    def takes(self, precision: Precision) -> dict[str, Any]:
        kinds = {"velocity_gradient": precision.matrix, FRACTIONS: precision.fractions(max(self.phases, 1))}
        return {name: kinds.get(name, precision.real) for name in self.fields}

    def reads(self, precision: Precision) -> dict[str, Any]:
        return dict(zip(READ_OF, (precision.real, table_type(precision), int, int), strict=True)) if self.arrays else {}


def formula(
    kind: str, function: FunctionType, source: str, parameters: Mapping[str, Any]
) -> tuple[Formula, dict[str, Any]]:
    """Return the formula of a function and the values of its parameters. Raise `InputError` for an invalid function."""
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
            raise InputError(
                f"{what} has the array {name}, but may have only numbers and vectors: use Body for arrays."
            )
        if not (1 <= len(shape) <= MOST_AXES and 0 < prod(shape) <= MOST_NUMBERS):
            wanted = f"one to {MOST_AXES} axes, and 1 to {MOST_NUMBERS} numbers"
            raise InputError(f"{what} has the array {name} of shape {shape}, but an array must have {wanted}.")
        entries = getattr(annotation, "dtype", Any)
        if entries not in (Any, float, wp.float32, wp.float64) or getattr(annotation, "ndim", len(shape)) != len(shape):
            found_one = f"{what} has the array {name} of shape {shape}, with an annotation that does not fit"
            raise InputError(f"{found_one}, but must be annotated as floats with {len(shape)} axes.")
        found[name] = shape
    if sum(map(prod, found.values())) > MOST_NUMBERS:
        raise InputError(f"{what} has arrays of more than {MOST_NUMBERS} numbers in total, but must have fewer.")
    return found


def _arguments(
    what: str, function: FunctionType, given: Mapping[str, Any], first: Inputs
) -> tuple[tuple[str, ...], dict[str, Any]]:
    signature, known = inspect.signature(function, follow_wrapped=False).parameters, (*first.names, "t")
    for argument in signature.values():
        if argument.kind is not argument.POSITIONAL_OR_KEYWORD:
            raise InputError(f"{what} has the argument {argument}, but must have only positional arguments.")
    if any(name in known and known.index(name) != place for place, name in enumerate(signature)):
        found = f"{what} has the arguments {', '.join(signature)}"
        raise InputError(f"{found}, but must have {', '.join(known[:2])} first, and then, optionally, {known[2]}.")
    for name in given:
        if name not in signature:
            found = f"({', '.join(signature)})"
            raise InputError(f"{what} is given a value of {name}, but has only the arguments {found}.")
    values = {n: given.get(n, a.default) for n, a in signature.items() if n in given or a.default is not a.empty}
    for name in known:
        if name in values:
            raise InputError(f"{what} is given a value of {name}, but the run sets {name}: leave out the value.")
    taken = tuple(name for name in signature if name not in values)
    inputs = tuple(name for name in taken if name not in first.fields or name in taken[:2])
    if lacking := [name for k, name in enumerate(inputs[2:]) if k > 0 or name not in TIME]:
        found = f"{what} is given no value of {', '.join(lacking)}"
        raise InputError(f"{found}, but must have a value of each parameter, as in {lacking[0]}=1.0.")
    if len(inputs) not in (2, 3) or tuple(signature)[: len(taken)] != taken or taken[: len(inputs)] != inputs:
        of_particles = f" and any of {', '.join(first.fields)}" if first.fields else ""
        wanted = f"two {first.kind}s first, then optionally time{of_particles}, and then parameters"
        found = f"{what} has {', '.join(taken) or 'nothing'} without a value"
        raise InputError(f"{found}, but must have {wanted} with values.")
    return taken, values


def compiled(what: str, module: Any, device: Any, returned: str = "vector") -> None:
    """Compile a module with a user-defined function. Raise `InputError` with the first message of Warp's compiler."""
    with TemporaryFile() as said:
        try:
            with c_stderr_to(said.fileno()):
                wp.load_module(module, device)
        except Exception as error:  # Warp raises any kind for a text that it does not understand
            said.seek(0)
            found = re.findall("error: (.*)", said.read().decode(errors="replace"))
            text = TYPES.sub(lambda t: "a vector" if "vec" in t[0] else "a number", found[0]) if found else str(error)
            reason = text.replace("\\n", "\n").strip().splitlines()[-1:] or [type(error).__name__]
            wanted = f"only numbers, vectors of three components and functions of Warp, and return a {returned}"
            first = reason[0].lstrip("; ").rstrip(".")
            raise InputError(f"{what} cannot be compiled: {first}; the function must use {wanted}.") from error
        said.seek(0)
        sys.stderr.write(said.read().decode(errors="replace"))


def applied(text: Formula, precision: Precision, dimension: int, module: Any) -> Any:
    """Make the Warp function that calls a user's function. In 2-D the z component of the function's result is 0."""
    timed, of_numbers = len(text.inputs) == 3, text.kind == "number"
    types = tuple(precision.vector if rank else precision.real for rank in text.ranks[timed:])
    terms, first = [], 0
    for rank in text.ranks:
        at = ", ".join(f"theta[{first + k}]" for k in range(WIDTH[rank]))
        terms.append(f"vector({at})" if rank else at)
        first += WIDTH[rank]
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
    made.__annotations__ = {"x": own_type, "v": own_type, "theta": theta_of(precision, text.ranks), **more}
    return wp.Function(func=made, key="applied", namespace="", module=module, source=source)
