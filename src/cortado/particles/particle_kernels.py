"""Kernels with a thread for each particle, made of what they compute: names say what arguments are.

    @particle_kernel(module, "c_new", [over(spread, "total", w="m")], numbers=["scale"])
    def flux(total: fractions, c_i: fractions, m_i: real, time_step: real, scale: real) -> fractions:
        return c_i + (time_step * scale / m_i) * total

is a kernel that sums ``spread`` over the neighbours of particle i, and then writes what the function returns to
c_new[i]. Parameters of the function are results of its sums; entries c_i of arrays c; ``i``, and ``member``, the number
of its scene; the neighbourhood ``s``; numbers and whole arrays of a launch; and all others, such as ``time_step``,
entries of the particle's scene. A sum finds its arrays by the names that they have in its term, unless it is told
others. A result "+x_bar" is added to the array's entry, and "acceleration:acceleration_in" is the result added to the
entry of acceleration_in.

A sum whose derivatives are known needs no function where what is computed of it is a multiple (`sum_kernels`), and a
function of a particle's own numbers none for its derivatives, which Warp makes (`pointwise_kernels`): of results
r = f(x_i, ..., time_step, ...) they are

    tangent:  r_dot[i] = df/dx x_dot[i] + ... + df/dtime_step time_step_dot[scene]
    adjoint:  x_bar[i] += (df/dx)^T r_bar[i],   time_step_bar[i] += df/dtime_step . r_bar[i]

so that particles keep their shares of the adjoints of a scene's parameters, which are summed later. Both are exact; the
tangent is put together of the gradients of the components of r.

Two traps of Warp: after ``a, b = array[j], c`` the name ``a`` is no copy, and writing to its component writes to the
array, where after ``a = array[j]`` it is one. And ``wp.grad`` stands in the function that a kernel calls: in one that
this function calls it does not compile.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from re import sub
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.made_derivatives import bars_of, dot_of, work_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import Term, array_of

Types = Mapping[str, Any]
KERNEL = """\
def {name}({parameters}):
    {body}
"""
MADE = "made_"
"""Begins the names of kernels that nobody has written."""
MOST_ARRAYS = 8
"""Arrays of particles that a kernel which no tape differentiates takes one by one. More are bundles, as each takes 2 us
of a launch on a CPU."""
TANGENT = """\
_total_{n} = _kind_{n}()
    _components = int({components})
    for _k in range(_components):
        _unit = _kind_{n}()
        _unit[{entry}] = _one
        {gradient}
        _total_{n} += ({change}) * _unit
    {place}_total_{n}"""
"""The text of the tangent of a vector or a matrix. The number of components is a variable, as Warp would write each
gradient out."""


def made_kernel(name: str, types: Types, body: Iterable[str], scope: Types, module: Any) -> Any:
    """Make the Warp kernel with arguments of these types from lines of text that know the names in ``scope``."""
    text = KERNEL.format(name=name, parameters=", ".join(types), body="\n    ".join(body))
    known = {"wp": wp, **scope}
    exec(text, known)
    made: Any = known[name]
    made.__annotations__ = dict(types)
    return wp.Kernel(made, key=name, module=module, source=text)


@dataclass(frozen=True)
class Over:
    """A sum over neighbours in a kernel, with the names of its results and renamed arguments."""

    function: Any
    names: Sequence[str]
    """Names of its results in the kernel."""
    renamed: Mapping[str, str]

    def read(self, types: Types) -> dict[str, Any]:
        """Return types by the names that arguments have in the kernel."""
        return {self.renamed.get(name, name): kind for name, kind in types.items()}

    def call(self, entries: Mapping[str, str], function: str) -> str:
        """Return the line that computes the sum, given the texts of arguments that are equal for all neighbours."""
        names = (*self.read(self.function.arrays), *self.read(self.function.others))
        results = ", ".join(f"_{name}" for name in self.names)
        return f"{results} = {function}(i, {', '.join(entries.get(name, name) for name in names)}, s)"


def over(function: Any, names: str, /, **renamed: str) -> Over:
    """Name a sum over neighbours (`cortado.particles.pair_sums`) for a kernel: its results, one word each, and
    arguments that have other names in the kernel."""
    return Over(function, names.split(), renamed)


def dotted(names: Mapping[str, str]) -> dict[str, str]:
    """Return the renamed arguments of a sum for their tangents, with _dot behind both names."""
    return {f"{name}_dot": f"{other}_dot" for name, other in names.items()}


def particle_kernel(
    module: Any,
    results: str,
    sums: Sequence[Over] = (),
    numbers: Collection[str] = (),
    name: str | None = None,
) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that turns a function of one particle, with a type at each parameter, into a kernel in a Warp
    module; ``results``: the arrays that it writes, one word each. The kernel is called as the function, unless it has a
    ``name``."""

    def make(function: Callable[..., Any]) -> Any:
        term, places = Term.of(function), function.__qualname__.split(".")
        called = sub(r"\W", "", "__".join((*places[:-1], name or places[-1])))  # as Warp calls kernels
        totals = {total for one in sums for total in one.names}
        arguments = _Arguments([*sums], numbers)
        given = [
            f"_{each}" if each in totals else arguments.entry(each, kind) for each, kind in term.parameters.items()
        ]
        found = [f"_found_{n}" for n in range(len(term.results))]
        lines = [f"{', '.join(found)} = _function({', '.join(given)})"]
        writes = zip(results.split(), found, term.results, strict=True)
        return arguments.kernel(called, lines, writes, {"_function": wp.func(function, module=module)}, module)

    return make


def sum_kernel(
    name: str,
    module: Any,
    results: str,
    total: Any,
    times: str = "",
    per: str = "",
    numbers: Collection[str] = (),
    **renamed: str,
) -> Any:
    """Make the kernel of one sum, each of whose results is written, or added, ``times`` a text such as "s.volume", and
    divided by another one."""
    arguments = _Arguments([Over(total, [f"total_{n}" for n in range(len(total.results))], renamed)], numbers)
    for number in numbers:
        arguments.entry(number, total.discretisation.precision.real)
    values = (f"{times} * _total_{n}" if times else f"_total_{n}" for n in range(len(total.results)))
    values = (f"{value} / {per}" if per else value for value in values)
    writes = zip(results.split(), values, total.results, strict=True)
    return arguments.kernel(f"{MADE}{name}", [], writes, {}, module)


def sum_kernels(
    name: str,
    modules: Sequence[Any],
    sums: Sequence[Any],
    result: str,
    before: str = "",
    times: str = "",
    per: str = "",
    numbers: Collection[str] = (),
    written: Collection[str] = (),
    **renamed: str,
) -> Kernels:
    """Make the three kernels of one sum, each in its own of the Warp ``modules``, given the sum with its tangent and
    its adjoint, as `cortado.particles.pair_sums` notes them. It is of ``result`` = ``before`` + ``times`` the sum /
    ``per``, where ``before`` is an array, and the others are texts, all of which may be left out. Adjoints are added to
    those of arrays and of scenes, but for those of arrays that are ``written``."""
    total, tangent, adjoint = sums
    told = {**renamed, **dotted(renamed)}
    known = [*total.arrays, *(name for name in total.others if name not in numbers)][: len(adjoint.results)]
    backs = (f"{'' if name in written else '+'}{told.get(name, name)}_bar" for name in known)
    bar = next(name for name in adjoint.arrays if name not in total.arrays)
    onto, onto_dot = (f":{before}{end}" if before else "" for end in ("", "_dot"))
    scaled: dict[str, Any] = {"times": times, "per": per, "numbers": numbers, **told}
    return Kernels(
        sum_kernel(name, modules[0], f"{result}{onto}", total, **scaled),
        sum_kernel(f"{name}_tangent", modules[1], f"{result}_dot{onto_dot}", tangent, **scaled),
        sum_kernel(f"{name}_adjoint", modules[2], " ".join(backs), adjoint, **{**scaled, bar: f"{result}_bar"}),
    )


class _Arguments:
    """The arguments of a kernel that is being made, collected as the function's parameters are read."""

    def __init__(self, sums: Sequence[Over], numbers: Collection[str]):
        self._sums, self._names = sums, numbers
        self._discretisation: Discretisation | None = sums[0].function.discretisation if sums else None
        self._around: Any = neighbourhood_type(self._discretisation.precision) if self._discretisation else None
        self._numbers: dict[str, Any] = {}
        self._scenes: dict[str, Any] = {}
        self._arrays: dict[str, Any] = {}
        self._calls, self._numbered = [], False
        for n, one in enumerate(sums):
            self._arrays |= one.read(one.function.arrays)
            entries = {each: self.entry(each, kind) for each, kind in one.read(one.function.others).items()}
            self._calls.append(one.call(entries, f"_sum_{n}"))

    def entry(self, name: str, kind: Any) -> str:
        """Return the text of a parameter's value in the kernel, and note the argument that it needs."""
        if name == "s":
            self._around = kind
        if name == "member":
            self._numbered = True
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
        """Make the kernel that computes the sums, goes on with some lines, and writes values to arrays."""
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
        if len(own) + len(written) > MOST_ARRAYS and not module.options["enable_backward"]:
            arrays = {label: bundle(**kinds) for label, kinds in (("at", own), ("to", written)) if kinds}
            body += [f"{each} = {label}.{each}" for label, kinds in (("at", own), ("to", written)) for each in kinds]
        else:
            arrays = {each: wp.array(dtype=kind) for each, kind in (own | written).items()}
        body += [*self._calls, *(["if lane() > 0:", "    return"] if self._sums else []), *lines]
        body += [f"{array}[i] = {f'{other}[i] + ' * bool(other)}{value}" for array, other, value in stored]
        types = {**first, **self._numbers, **of_scenes, **arrays}
        known = {f"_sum_{n}": one.function for n, one in enumerate(self._sums)}
        if self._discretisation:
            known["LANES"] = self._discretisation.lanes
            known["lane"] = lane_functions(self._discretisation.precision, self._discretisation.lanes).lane
        return made_kernel(name, types, body, {**known, **scope}, module)


def pointwise_kernels(
    precision: Precision,
    modules: Sequence[Any],
    make: Callable[[Any], Callable[..., Any]],
    results: Sequence[str],
    replaced: Mapping[str, str] | None = None,
    numbers: Collection[str] = (),
    written: Collection[str] = (),
) -> Kernels:
    """Make forward, tangent and adjoint kernels, each in its own of the Warp ``modules``, of the function that ``make``
    makes for a module.

    The function has a type at each parameter, and ``results`` are the arrays that it writes; what it returns for
    "acceleration:acceleration_in" is added to the latter. ``replaced`` maps a result to the input in whose place its
    adjoint stands at first, and the adjoint kernel leaves that of the input there. Adjoints of other inputs are added
    to, but for those that are ``written``. Parameters among ``numbers`` are numbers of a launch, without
    derivatives."""
    forward, along, back = (Term.of(make(module)) for module in modules)
    of = _Pointwise(precision, forward, results, replaced or {}, numbers, written)
    known = (
        {"_function": wp.func(forward.function, module=modules[0])},
        {"_work": work_of(along, precision, modules[1]), **of.units},
        {"_work": work_of(back, precision, modules[2])},
    )
    texts: Sequence[Any] = (of.forward(), of.tangent(), of.adjoint())
    made = zip(texts, known, modules, strict=True)
    return Kernels(*(made_kernel(f"{MADE}{name}", *rest, *one) for (name, *rest), *one in made))


class _Pointwise:
    """The name, the arguments and the lines of each of the three kernels of a pointwise function."""

    _first = "i = wp.tid()"

    def __init__(
        self,
        precision: Precision,
        term: Term,
        results: Sequence[str],
        replaced: Mapping[str, str],
        numbers: Collection[str],
        written: Collection[str],
    ):
        self._term, self._real = term, precision.real
        self._before = dict(one.split(":") for one in results if ":" in one)
        names = (one.partition(":")[0] for one in results)
        self._results, self._replaced = dict(zip(names, term.results, strict=True)), replaced
        self._overwritten = {*replaced.values(), *written}
        self._inputs, self._entries, self._given = {}, {}, {}
        for name, kind in term.parameters.items():
            if name in numbers:
                self._entries[name], self._given[name] = name, kind
                continue
            array = array_of(name) or name
            self._entries[array] = f"{array}[{'i' if array_of(name) else 'i // particles'}]"
            self._inputs[array], self._given[array] = kind, wp.array(dtype=kind)
        self.units = {"_one": wp.constant(precision.real(1.0)), "_no": wp.constant(precision.real(0.0))}
        """What tangents call types of results, 1 and 0."""
        self.units |= {f"_kind_{n}": kind for n, kind in enumerate(term.results)}

    def forward(self) -> tuple[str, Types, Iterable[str]]:
        found = [f"_result_{n}" for n in range(len(self._results))]
        call = f"{', '.join(found)} = _function({', '.join(self._entries.values())})"
        writes = (f"{self._place(result)}{value}" for result, value in zip(self._results, found, strict=True))
        return self._term.name, self._types(self._written("")), [self._first, call, *writes]

    def tangent(self) -> tuple[str, Types, Iterable[str]]:
        changes = (
            self._product(kind).format(f"_by_{name}", f"dot.{self._entries[name]}")
            for name, kind in self._inputs.items()
        )
        change, lines = " + ".join(changes), [self._first]
        zeros = ["_no" if kind is self._real else f"_kind_{n}()" for n, kind in enumerate(self._term.results)]
        for n, (result, kind) in enumerate(self._results.items()):
            if kind is self._real:
                lines += [
                    self._gradient([*zeros[:n], "_one", *zeros[n + 1 :]]),
                    f"{self._place(result, '_dot')}{change}",
                ]
            else:
                gradient = self._gradient([*zeros[:n], "_unit", *zeros[n + 1 :]])
                shape = kind._shape_
                entry = "_k" if len(shape) == 1 else f"_k // {shape[1]}, _k % {shape[1]}"
                own = {"n": n, "components": prod(shape), "entry": entry, "place": self._place(result, "_dot")}
                lines.append(TANGENT.format(gradient=gradient, change=change, **own))
        more = {"dot": bundle(**self._inputs), **self._written("_dot")}
        return f"{self._term.name}_tangent", self._types(more), lines

    def adjoint(self) -> tuple[str, Types, Iterable[str]]:
        held = self._replaced
        bars = [f"bar.{held[result]}[i]" if result in held else f"{result}_bar[i]" for result in self._results]
        added = {name: "" if name in self._overwritten else f"bar.{name}[i] + " for name in self._inputs}
        writes = (f"bar.{name}[i] = {before}_by_{name}" for name, before in added.items())
        left = {f"{name}_bar": wp.array(dtype=kind) for name, kind in self._results.items() if name not in held}
        types = self._types({**left, "bar": bundle(**self._inputs)})
        return f"{self._term.name}_adjoint", types, [self._first, self._gradient(bars), *writes]

    def _types(self, more: Types) -> Types:
        return {"particles": int, **self._given, **more}

    def _product(self, kind: Any) -> str:
        if kind is self._real:
            return "{} * {}"
        return f"wp.{dot_of(kind)}({{}}, {{}})"

    def _place(self, result: str, suffix: str = "") -> str:
        before = self._before.get(result)
        return f"{result}{suffix}[i] = " + (f"{before}{suffix}[i] + " if before else "")

    def _written(self, suffix: str) -> dict[str, Any]:
        names = (name for result in self._results for name in (self._before.get(result), result) if name)
        return {f"{name}{suffix}": wp.array(dtype=self._kind(name)) for name in names}

    def _kind(self, name: str) -> Any:
        return self._results.get(name) or next(self._results[one] for one, at in self._before.items() if at == name)

    def _gradient(self, bars: Sequence[str]) -> str:
        names = ", ".join((*(f"_by_{name}" for name in self._entries), *bars_of(self._term)))
        return f"{names} = wp.grad(_work)({', '.join((*self._entries.values(), *bars))})"
