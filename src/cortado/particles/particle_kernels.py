"""Kernels with one thread for each particle, made from functions whose parameter names define the kernel's arguments.

    @particle_kernel(module, "c_new", [over(spread, "total", w="m")], numbers=["scale"])
    def flux(total: fractions, c_i: fractions, m_i: real, time_step: real, scale: real) -> fractions:
        return c_i + (time_step * scale / m_i) * total

is a kernel that sums ``spread`` over the neighbours of particle i, with m as the array w, and writes the function's
result to c_new[i].

A parameter is the result of a sum, a value c_i of an array c, the particle's number ``i``, the scene's number
``member``, or the neighbourhood ``s``. Numbers and whole arrays of a launch are also parameters. Any other parameter,
such as ``time_step``, is an array with one value for each scene. A result "+x_bar" is added to x_bar[i]. A result
"acceleration:acceleration_in" is added to acceleration_in[i], and the sum is written to acceleration[i].

`sum_kernels` makes kernels that compute a multiple of a sum. `pointwise_kernels` lets Warp differentiate a function r =
f(x_i, ..., time_step, ...) of a particle's values:

    tangent:  r_dot[i] = df/dx x_dot[i] + ... + df/dtime_step time_step_dot[scene]
    adjoint:  x_bar[i] += (df/dx)^T r_bar[i],   time_step_bar[i] += df/dtime_step . r_bar[i]

For the adjoint of a scene's parameter, each particle stores a contribution, and the contributions are summed later. The
tangent of a rotation R is the vector w with R_dot u = w x (R u), and the adjoint of R is the adjoint of w.

Warp has two traps. After ``a, b = array[j], c`` writing to a component of ``a`` writes to the array, whereas ``a =
array[j]`` makes a copy. ``wp.grad`` does not compile in a function that the kernel's function calls.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from re import sub
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName, lane_functions
from cortado.particles.made_derivatives import bars_of, dot_of, warp_function, work_of
from cortado.particles.moving_walls import turn_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import Term, array_of

Types = Mapping[str, Any]
Names = Collection[str]
Modules = Sequence[Any]
Typed = TypesByName | None
Maker = Callable[[Any], Callable[..., Any]]
KERNEL = """\
def {name}({parameters}):
    {body}
"""
MADE = "made_"
MOST_ARRAYS = 8
"""Greatest number of separate array arguments. Kernels take further arrays in a struct."""
TANGENT = """\
_total_{n} = _kind_{n}()
    _components = int({components})
    for _k in range(_components):
        {unit} = _kind_{n}()
        {unit}[{entry}] = _one
        {gradient}
        _total_{n} += ({change}) * {unit}"""


def made_kernel(name: str, types: Types, body: Iterable[str], scope: Types, module: Any) -> Any:
    """Make a Warp kernel with arguments of given types from source lines. The lines may use names in ``scope``."""
    text = KERNEL.format(name=name, parameters=", ".join(types), body="\n    ".join(body))
    known = {"wp": wp, **scope}
    exec(text, known)
    made: Any = known[name]
    made.__annotations__ = dict(types)
    return wp.Kernel(made, key=name, module=module, source=text)


@dataclass(frozen=True)
class Over:
    function: Any
    names: Sequence[str]
    renamed: Mapping[str, str]

    def read(self, types: Types) -> dict[str, Any]:
        return {self.renamed.get(name, name): kind for name, kind in types.items()}

    def call(self, entries: Mapping[str, str], function: str) -> str:
        names = (*self.read(self.function.arrays), *self.read(self.function.others))
        results = ", ".join(f"_{name}" for name in self.names)
        return f"{results} = {function}(i, {', '.join(entries.get(name, name) for name in names)}, s)"


def over(function: Any, names: str, /, **renamed: str) -> Over:
    """``names`` are the names of the sum's results, separated by spaces. ``renamed`` are the kernel's names for
    arguments."""
    return Over(function, names.split(), renamed)


def dotted(names: Mapping[str, str]) -> dict[str, str]:
    return {f"{name}_dot": f"{other}_dot" for name, other in names.items()}


def particle_kernel(
    module: Any, results: str, sums: Sequence[Over] = (), numbers: Names = (), name: str = "", typed: Typed = None
) -> Callable[[Callable[..., Any]], Any]:
    """``results`` are the names of the arrays that the kernel writes, separated by spaces."""

    def make(function: Callable[..., Any]) -> Any:
        function = typed(function) if typed else function
        term, places = Term.of(function), function.__qualname__.split(".")
        called = sub(r"\W", "", "__".join((*places[:-1], name or places[-1])))  # as Warp calls kernels
        totals, of = {total for one in sums for total in one.names}, _Arguments([*sums], numbers)
        given = [f"_{each}" if each in totals else of.entry(each, kind) for each, kind in term.parameters.items()]
        found = [f"_found_{n}" for n in range(len(term.results))]
        lines = [f"{', '.join(found)} = _function({', '.join(given)})"]
        writes = zip(results.split(), found, term.results, strict=True)
        return of.kernel(called, lines, writes, {"_function": wp.func(function, module=module)}, module)

    return make


def sum_kernel(
    name: str, module: Any, arrays: str, total: Any, times: str = "", per: str = "", numbers: Names = (), **renamed: str
) -> Any:
    """The sum is multiplied by the source text ``times`` and divided by the source text ``per``."""
    arguments = _Arguments([Over(total, [f"total_{n}" for n in range(len(total.results))], renamed)], numbers)
    for number in numbers:
        arguments.entry(number, total.discretisation.precision.real)
    values = (f"{times} * _total_{n}" if times else f"_total_{n}" for n in range(len(total.results)))
    values = (f"{value} / {per}" if per else value for value in values)
    return arguments.kernel(f"{MADE}{name}", [], zip(arrays.split(), values, total.results, strict=True), {}, module)


def sum_kernels(
    name: str, modules: Modules, sums: Sequence[Any], result: str, before: str = "", written: Names = (), **named: Any
) -> Kernels:
    """The first of the kernels computes ``result`` = ``before`` + ``times`` sum / ``per``, with the array ``before``.
    Adjoints are added to the adjoints of the inputs, except for ``written`` arrays, which are overwritten. ``named``
    are the other arguments of `sum_kernel`."""
    total, tangent, adjoint = sums
    told = named | dotted({each: other for each, other in named.items() if each not in ("times", "per", "numbers")})
    numbers = named.get("numbers", ())
    known = [*total.arrays, *(name for name in total.others if name not in numbers)][: len(adjoint.results)]
    backs = (f"{'' if name in written else '+'}{told.get(name, name)}_bar" for name in known)
    bar = next(name for name in adjoint.arrays if name not in total.arrays)
    onto, onto_dot = (f":{before}{end}" if before else "" for end in ("", "_dot"))
    return Kernels(
        sum_kernel(name, modules[0], f"{result}{onto}", total, **told),
        sum_kernel(f"{name}_tangent", modules[1], f"{result}_dot{onto_dot}", tangent, **told),
        sum_kernel(f"{name}_adjoint", modules[2], " ".join(backs), adjoint, **{**told, bar: f"{result}_bar"}),
    )


def _arrays(read: Types, written: Types, taped: bool) -> tuple[dict[str, Any], list[str]]:
    if taped or len(read) + len(written) <= MOST_ARRAYS:
        return {each: wp.array(dtype=kind) for each, kind in {**read, **written}.items()}, []
    groups = {label: kinds for label, kinds in (("at", read), ("to", written)) if kinds}
    lines = [f"{each} = {label}.{each}" for label, kinds in groups.items() for each in kinds]
    return {label: bundle(**kinds) for label, kinds in groups.items()}, lines


class _Arguments:
    def __init__(self, sums: Sequence[Over], numbers: Names):
        self._sums, self._names = sums, numbers
        self._discretisation: Discretisation | None = sums[0].function.discretisation if sums else None
        self._around: Any = neighbourhood_type(self._discretisation.precision) if self._discretisation else None
        self._numbers, self._scenes, self._arrays = dict[str, Any](), dict[str, Any](), dict[str, Any]()
        self._calls, self._numbered = [], False
        for n, one in enumerate(sums):
            self._arrays |= one.read(one.function.arrays)
            entries = {each: self.entry(each, kind) for each, kind in one.read(one.function.others).items()}
            self._calls.append(one.call(entries, f"_sum_{n}"))

    def entry(self, name: str, kind: Any) -> str:
        if name == "s":
            self._around = kind
        self._numbered |= name == "member"
        if name in ("i", "s", "member"):
            return name
        if name in self._names or isinstance(kind, wp.array):
            self._numbers[name] = kind
            return name
        array = array_of(name)
        (self._arrays if array else self._scenes)[array or name] = kind
        return f"{array}[i]" if array else f"{name}[member]"

    def kernel(
        self, name: str, lines: Iterable[str], writes: Iterable[tuple[str, str, Any]], scope: Types, module: Any
    ) -> Any:
        stored, written, read = [], {}, {}
        for result, value, kind in writes:
            array, _, other = result.removeprefix("+").partition(":")
            other = array if result.startswith("+") else other
            stored.append((array, other, value))
            written[array] = kind
            if other and other != array:
                read[other] = kind
        first = {"s": self._around} if self._around else {"particles": int} if self._scenes or self._numbered else {}
        of_scenes = {each: wp.array(dtype=kind) for each, kind in self._scenes.items()}
        own = {each: kind for each, kind in (self._arrays | read).items() if each not in written}
        body = [f"i = s.first + wp.tid(){' // LANES' * bool(self._sums)}" if self._around else "i = wp.tid()"]
        if self._scenes or self._numbered:
            body.append(f"member = i // {'s.' * bool(self._around)}particles")
        arrays, names = _arrays(own, written, module.options["enable_backward"])
        body += [*names, *self._calls, *(["if lane() > 0:", "    return"] if self._sums else []), *lines]
        body += [f"{array}[i] = {f'{other}[i] + ' * bool(other)}{value}" for array, other, value in stored]
        types = {**first, **self._numbers, **of_scenes, **arrays}
        known = {f"_sum_{n}": one.function for n, one in enumerate(self._sums)}
        if self._discretisation:
            known["LANES"] = self._discretisation.lanes
            known["lane"] = lane_functions(self._discretisation.precision, self._discretisation.lanes).lane
        return made_kernel(name, types, body, {**known, **scope}, module)


def pointwise_kernels(
    precision: Precision, modules: Modules, make: Maker, results: Names, replaced: Types | None = None, **names: Any
) -> Kernels:
    """``make(module)`` returns the function of the kernel. ``results`` are the names of the arrays that the function
    writes. ``replaced`` maps a result to an input that shares its adjoint array. The remaining ``names`` are the fields
    of `Kinds`."""
    terms = [Term.of(make(module)) for module in modules]
    of = _Pointwise(precision, terms[0], results, Kinds(replaced or {}, **names), modules[0].options["enable_backward"])
    texts: Sequence[Any] = (of.forward(), of.tangent(), of.adjoint())
    made = []
    for k, ((name, types, lines), term, module) in enumerate(zip(texts, terms, modules, strict=True)):
        scope = {"_function": warp_function(term.function, module), **of.scope}
        if k > 0:
            scope["_work"] = work_of(term, precision, module)
        made.append(made_kernel(f"{MADE}{name}", types, lines, scope, module))
    return Kernels(*made)


@dataclass(frozen=True)
class Kinds:
    """Roles of parameters and results in pointwise kernels. All fields of `Kinds` are optional."""

    replaced: Types
    numbers: Names = ()
    """Parameters that are equal for all threads and have no derivatives."""
    written: Names = ()
    """Inputs with adjoints that the adjoint kernel overwrites."""
    known: Names = ()
    where: str = ""
    """Name of an array with one value for each particle. Tangents of results are 0 for particles with the value 0."""
    told: Names = ()
    """Input arrays with one column for each time step."""
    summed: Names = ()
    """Results that are summed over the particles of each scene."""
    turned: Mapping[str, str] = field(default_factory=dict)
    """Names of rotation matrices, with the names of their tangents, which are rotation vectors."""
    read: Mapping[str, str] = field(default_factory=dict)
    """Parameters with the source text that reads their value from a table (`cortado.sph.formula`)."""


class _Pointwise:
    def __init__(self, precision: Precision, term: Term, results: Names, kinds: Kinds, taped: bool):
        self._term, self._precision, self._kinds, self._taped = term, precision, kinds, taped
        self._before = dict(one.split(":") for one in results if ":" in one)
        self._results = dict(zip((one.partition(":")[0] for one in results), term.results, strict=True))
        self._overwritten = {*kinds.replaced.values(), *kinds.written}
        self._entries, self._indices, self._inputs = {}, {}, {}
        self._numbers: dict[str, Any] = {}
        self._arrays = {kinds.where: precision.real} if kinds.where else {}
        for name, kind in term.parameters.items():
            if name in kinds.numbers or name in kinds.read:
                self._entries[name] = kinds.read.get(name, name)
                self._numbers |= {name: kind} if name in kinds.numbers else {}
                continue
            array, self._indices[array] = array_of(name) or name, "i" if array_of(name) else "i // particles"
            if array in kinds.told:
                self._indices[array] = f"{self._indices[array]}, step[i]"
                self._numbers |= {"step": wp.array(dtype=wp.int32), array: wp.array2d(dtype=kind)}
            else:
                self._arrays[array] = kind
            self._entries[array] = f"{array}[{self._indices[array]}]"
            if array not in kinds.known:
                self._inputs[array] = kind
        turning, leaning = turn_functions(precision)
        self.scope = {"_turning": turning, "_leaning": leaning, "_one": wp.constant(precision.real(1.0))}
        self.scope["_no"] = wp.constant(precision.real(0.0))
        self.scope |= {f"_kind_{n}": self._change(name, kind) for n, (name, kind) in enumerate(self._results.items())}
        self.scope |= {f"_whole_{n}": kind for n, kind in enumerate(term.results)}
        found = ", ".join(f"_found_{n}" for n in range(len(self._results)))
        self._found = f"{found} = _function({', '.join(self._entries.values())})"

    def forward(self) -> tuple[str, Types, Iterable[str]]:
        writes = (f"{self._place(result)}_found_{n}" for n, result in enumerate(self._results))
        return self._term.name, *self._kernel(self._written(""), {}, [self._found, *writes])

    def tangent(self) -> tuple[str, Types, Iterable[str]]:
        real, turned, changes = self._precision.real, self._kinds.turned, []
        for name, kind in self._inputs.items():
            by = f"_turning({self._entries[name]}, _by_{name})" if name in turned else f"_by_{name}"
            change = self._change(name, kind)
            dot = self._changed(name, "dot", self._indices[name])
            changes.append(f"{by} * {dot}" if change is real else f"wp.{dot_of(change)}({by}, {dot})")
        changes += [f"_by_{name}" for name, text in self._kinds.read.items() if text == "_no"]
        lines, where = [self._found] if turned.keys() & self._results.keys() else [], self._kinds.where
        zeros = ["_no" if kind is real else f"_whole_{n}()" for n, kind in enumerate(self._term.results)]
        if where:
            none = (f"    {self._place(result, '_dot')}{zeros[n]}" for n, result in enumerate(self._results))
            lines += [f"if {where}[i] == _no:", *none, "    return"]
        for n, (result, kind) in enumerate(self._results.items()):
            unit = f"_unit{n or ''}"
            one = "_one" if kind is real else f"_leaning(_found_{n}, {unit})" if result in turned else unit
            gradient, change = self._gradient([*zeros[:n], one, *zeros[n + 1 :]]), " + ".join(changes)
            if kind is real:
                lines += [gradient, f"_total_{n} = {change}"]
            else:
                shape = self._change(result, kind)._shape_
                entry = "_k" if len(shape) == 1 else f"_k // {shape[1]}, _k % {shape[1]}"
                own = {"n": n, "components": prod(shape), "entry": entry, "unit": unit}
                lines.append(TANGENT.format(gradient=gradient, change=change, **own))
        lines += [f"{self._place(result, '_dot')}_total_{n}" for n, result in enumerate(self._results)]
        return f"{self._term.name}_tangent", *self._kernel(self._written("_dot"), self._changes("dot"), lines)

    def adjoint(self) -> tuple[str, Types, Iterable[str]]:
        turned, held, summed, bars, left = self._kinds.turned, self._kinds.replaced, self._kinds.summed, [], {}
        for n, (result, kind) in enumerate(self._results.items()):
            bar = self._changed(held[result], "bar") if result in held else f"{turned.get(result, result)}_bar[i]"
            if result in summed:
                bar = f"{result}_sum_bar[i // particles]"
            if result not in held:
                left[bar.partition("[")[0]] = self._change(result, kind)
            bars.append(f"_leaning(_found_{n}, {bar})" if result in turned else bar)
        lines = [self._found] if turned.keys() & self._results.keys() else []
        lines.append(self._gradient(bars))
        for name in self._inputs:
            bar, by = self._changed(name, "bar"), f"_by_{name}"
            by = f"_turning({self._entries[name]}, {by})" if name in turned else by
            lines.append(f"{bar} = {'' if name in self._overwritten else f'{bar} + '}{by}")
        name, more = f"{self._term.name}_adjoint", self._changes("bar")
        if not self._kinds.read:
            return name, *self._kernel(left, more, lines)
        types, (_, *body) = self._kernel(left, {**more, "rows": int}, [])
        start = ["_row = wp.tid()", "first = _row // rows * particles"]
        loop = "for i in range(first + _row % rows, first + particles, rows):"
        return name, types, [*body, *start, loop, *(f"    {line}" for line in lines)]

    def _kernel(self, others: Types, more: Types, lines: Iterable[str]) -> tuple[Types, Iterable[str]]:
        own, body = {name: kind for name, kind in self._arrays.items() if name not in others}, ["i = wp.tid()"]
        arrays, names = _arrays(own, others, self._taped)
        body += [*names, *(["_row = -1"] if self._kinds.read else [])]
        return {"particles": int, **self._numbers, **arrays, **more}, [*body, *lines]

    def _change(self, name: str, kind: Any) -> Any:
        return self._precision.vector if name in self._kinds.turned else kind

    def _changed(self, name: str, way: str, index: str = "i") -> str:
        if name in self._kinds.told:
            return f"{name}_{way}[i, step[i]]"
        return f"{way}.{self._kinds.turned.get(name, name)}[{index}]"

    def _changes(self, way: str) -> Types:
        kinds, told = {}, {}
        for name, kind in self._inputs.items():
            if name in self._kinds.told:
                told[f"{name}_{way}"] = wp.array2d(dtype=kind)
            else:
                kinds[self._kinds.turned.get(name, name)] = self._change(name, kind)
        return {**told, way: bundle(**kinds)}

    def _place(self, result: str, suffix: str = "") -> str:
        before = self._before.get(result)
        called = f"{self._kinds.turned.get(result, result) if suffix else result}{suffix}"
        return f"{called}[i] = " + (f"{before}{suffix}[i] + " if before else "")

    def _written(self, suffix: str) -> dict[str, Any]:
        written = {}
        for result, kind in self._results.items():
            if result in self._before:
                written[f"{self._before[result]}{suffix}"] = kind
            called = self._kinds.turned.get(result, result) if suffix else result
            written[f"{called}{suffix}"] = self._change(result, kind) if suffix else kind
        return written

    def _gradient(self, bars: Sequence[str]) -> str:
        names = ", ".join((*(f"_by_{name}" for name in self._entries), *bars_of(self._term)))
        return f"{names} = wp.grad(_work)({', '.join((*self._entries.values(), *bars))})"
