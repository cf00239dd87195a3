"""Derivatives that Warp makes, of sums over the fluid and of functions of one particle (`pointwise_kernels`).

Those of sums are made from the term of one pair (`cortado.particles.terms`).

For the sums S_i = sum_j T(x_ij, c_i, c_j, v_ij, theta) and their adjoints S_i^, the adjoint gathers what the pair gives
to particle i, from its own sum and from that of its neighbour:

    x_i^ = sum_j d(T_ij . S_i^) / dx_ij - d(T_ji . S_j^) / dx_ji
    c_i^ = sum_j d(T_ij . S_i^) / dc_i + d(T_ji . S_j^) / dc_i

and likewise for all entries of arrays; theta^ is sum_j d(T_ij . S_i^) / dtheta of each particle. The tangent is put
together of the gradients of the components of T. Both are exact. They are slower than what one can write by hand, and
are meant for forces of one's own and for what is seldom computed.

A term is given as the function that makes it for a `Discretisation`, and is made for one that is ``taped``, whose
functions Warp can differentiate. Call a made derivative from the kernel itself: from a `wp.func` that the kernel calls,
its C++ does not compile.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.pair_sums import Body, Types, over_fluid, summed, type_name, zero
from cortado.particles.terms import NUMBERS, Term, array_of, own_entry

TermMaker = Callable[[Discretisation], Callable[..., Any]]
KERNEL = """\
def {name}({parameters}):
    i = wp.tid()
    {body}
"""
TANGENT = """\
_total_{n} = _kind_{n}()
    _components = int({components})
    for _k in range(_components):
        _unit = _kind_{n}()
        _unit[_k] = _one
        {gradient}
        _total_{n} += ({change}) * _unit
    {result}_dot[i] = _total_{n}"""
"""Of a result that is a vector. The number of components is a variable, as Warp would write each gradient out."""


def made_adjoint(d: Discretisation, make: TermMaker, module: Any = None) -> Any:
    """The Warp function ``f(i, *arrays, *bars, *others, s)`` of the term that is made, given the arrays of the adjoints
    of its sums. It returns the adjoints of the entries of particle i in each array, and of each of the others.
    ``module`` is the Warp module of the function, if not that of the file."""
    term = _differentiable(make, d)
    arrays = {**term.arrays, **bars_of(term)}
    loop = over_fluid(d, arrays, _adjoint(term), ahead=True, numbered="j" in term.parameters)
    return _made(term, d, arrays, term.others, (*term.arrays.values(), *term.others.values()), loop, module)


def made_tangent(d: Discretisation, make: TermMaker, module: Any = None) -> Any:
    """The Warp function ``f(i, *arrays, *others, s)`` of the tangents of the sums of the term that is made, in which
    each array and each of the others is followed by its tangent."""
    term = _differentiable(make, d)
    arrays, others = _with_tangents(term.arrays), _with_tangents(term.others)
    if len(arrays) + len(others) < 2 * len(term.arrays | term.others):
        raise TypeError(f"term {term.name} has a name and the same with _dot, but tangents have such names.")
    loop = over_fluid(d, arrays, _tangent(term, d), ahead=False, numbered="j" in term.parameters)
    return _made(term, d, arrays, others, term.results, loop, module)


def _differentiable(make: TermMaker, d: Discretisation) -> Term:
    term = Term.of(make(replace(d, taped=True)))
    if "x_ij" not in term.parameters:
        raise TypeError(f"term {term.name} has no x_ij, but must have it for derivatives to be made of it.")
    return term


def _made(
    term: Term, d: Discretisation, arrays: Types, others: Types, results: Iterable[Any], loop: str, module: Any
) -> Any:
    module = module or wp.get_module(term.function.__module__)
    return summed(
        term.name, d, arrays, others, results, loop, {"_work": work_of(term, d.precision, module), "_wp": wp}, module
    )


def work_of(term: Term, precision: Precision, module: Any) -> Any:
    """The Warp function T . bar of the arguments of a term and of an adjoint of each of its results."""
    types, bars = {**term.parameters, **bars_of(term)}, bars_of(term)
    products = (
        f"_term_{n} * {bar}" if kind is precision.real else f"_wp.dot(_term_{n}, {bar})"
        for n, (bar, kind) in enumerate(bars.items())
    )
    text = f"""\
def _work({", ".join(types)}):
    {", ".join(f"_term_{n}" for n in range(len(bars)))} = _term({", ".join(term.parameters)})
    return {" + ".join(products)}
"""
    known: dict[str, Any] = {"_term": wp.func(term.function, module=module), "_wp": wp}
    exec(text, known)
    made: Any = known["_work"]
    made.__annotations__ = {**types, "return": precision.real}
    return wp.Function(made, f"{term.name}_work", "", module=module, source=text)


def bars_of(term: Term) -> dict[str, Any]:
    """Names and types of the adjoints of the results."""
    return {f"_bar_{n}": kind for n, kind in enumerate(term.results)}


def _with_tangents(types: Types) -> dict[str, Any]:
    return {each: kind for name, kind in types.items() for each in (name, f"{name}_dot")}


def _gradient(label: str, term: Term, arguments: str, bars: Iterable[str]) -> str:
    """The line that assigns the derivative of T . bar by each parameter to ``label_parameter``."""
    names = ", ".join(f"_{label}_{name}" for name in (*term.parameters, *bars_of(term)))
    return f"{names} = _wp.grad(_work)({arguments}, {', '.join(bars)})"


def _adjoint(term: Term) -> Body:
    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        yield _gradient("own", term, term.seen_from_i(of_j), map(own_entry, bars_of(term)))
        yield _gradient("other", term, term.seen_from_j(of_j), (of_j[bar] for bar in bars_of(term)))
        for n, array in enumerate(term.arrays):
            shares = {
                f"{array}_i": f"_own_{array}_i",
                f"{array}_j": f"_other_{array}_j",
                f"{array}_ij": f"_own_{array}_ij - _other_{array}_ij",
            }
            yield f"_total_{n} += {' + '.join(share for name, share in shares.items() if name in term.parameters)}"
        for n, name in enumerate(term.others, len(term.arrays)):
            yield f"_total_{n} += _own_{name}"

    return body


def _tangent(term: Term, d: Discretisation) -> Body:
    """Of each component of each result the gradient times the tangents of the parameters."""
    kinds = {**term.parameters, **bars_of(term)}

    def change_of(name: str, of_j: Mapping[str, str]) -> str:
        array = array_of(name)
        if not array:
            return f"{name}_dot"
        own, other = own_entry(f"{array}_dot"), of_j[f"{array}_dot"]
        return {"i": own, "j": other, "ij": f"{own} - {other}"}[name.rpartition("_")[2]]

    def product(first: str, name: str, second: str) -> str:
        if kinds[name] is d.precision.real:
            return f"{first} * ({second})"
        return f"_wp.{'dot' if len(kinds[name]._shape_) == 1 else 'ddot'}({first}, {second})"

    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        moved = [name for name in term.parameters if name not in (*NUMBERS, "s")]
        for n, kind in enumerate(term.results):
            components = 1 if kind is d.precision.real else len(kind())
            for k in range(components):
                bars = [_unit(each, d, k) if m == n else zero(each, d) for m, each in enumerate(term.results)]
                yield _gradient(f"by_{n}_{k}", term, term.seen_from_i(of_j), bars)
                terms = (product(f"_by_{n}_{k}_{name}", name, change_of(name, of_j)) for name in moved)
                yield f"_total_{n} += ({' + '.join(terms)}) * {_unit(kind, d, k)}"

    return body


def _unit(kind: Any, d: Discretisation, k: int) -> str:
    """The text of a result whose component k is 1, and all others 0."""
    if kind is d.precision.real:
        return "_real(1.0)"
    return f"{type_name(kind, d)}({', '.join(f'_real({float(m == k)})' for m in range(len(kind())))})"


def pointwise_kernels(
    precision: Precision,
    modules: Sequence[Any],
    make: Callable[[Any], Callable[..., Any]],
    results: Sequence[str],
    replaced: Mapping[str, str] | None = None,
    numbers: Collection[str] = (),
) -> Kernels:
    """The kernels of a function of one particle, with both derivatives, each in its own of the Warp ``modules``.

    The parameters of the function, which ``make`` makes for a module, say by their names what they are: x_i is the
    particle's entry of the array x, and any other, such as time_step, is the entry of its scene. For results
    r = f(x_i, ..., time_step, ...) the kernels are

        forward:  r[i] = f(x[i], ..., time_step[scene], ...)
        tangent:  r_dot[i] = df/dx x_dot[i] + ... + df/dtime_step time_step_dot[scene]
        adjoint:  x_bar[i] += (df/dx)^T r_bar[i],   time_step_bar[i] += df/dtime_step . r_bar[i]

    so that particles keep their shares of the adjoints of a scene's parameters, which are summed later. Both
    derivatives are exact; the tangent is put together of the gradients of the components of r. A launch finds the
    arrays by these names.

    The function has a type at each parameter, and ``results`` are the arrays that it writes. ``replaced`` maps a result
    to the input in whose place its adjoint stands at first, and the adjoint kernel leaves that of the input there.
    Parameters among ``numbers`` are numbers of a launch, without derivatives. A tape cannot differentiate the forward
    kernel."""
    forward, along, back = (Term.of(make(module)) for module in modules)
    of = _Pointwise(precision, forward, results, replaced or {}, numbers)
    known = (
        {"_function": wp.func(forward.function, module=modules[0])},
        {"_work": work_of(along, precision, modules[1]), **of.units},
        {"_work": work_of(back, precision, modules[2])},
    )
    made = zip((of.forward(), of.tangent(), of.adjoint()), known, modules, strict=True)
    return Kernels(*(_kernel(*text, scope, module) for text, scope, module in made))


def _kernel(name: str, kinds: Types, body: Iterable[str], scope: Types, module: Any) -> Any:
    types = {"particles": int, **kinds}
    text = KERNEL.format(name=name, parameters=", ".join(types), body="\n    ".join(body))
    known = {"wp": wp, **scope}
    exec(text, known)
    made: Any = known[name]
    made.__annotations__ = types
    return wp.Kernel(made, key=name, module=module, options={"enable_backward": False}, source=text)


class _Pointwise:
    """Name, types of arguments, and lines of each of the three kernels."""

    def __init__(
        self,
        precision: Precision,
        term: Term,
        results: Sequence[str],
        replaced: Mapping[str, str],
        numbers: Collection[str],
    ):
        self._term, self._real = term, precision.real
        self._results, self._replaced = dict(zip(results, term.results, strict=True)), replaced
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
        writes = (f"{result}[i] = {value}" for result, value in zip(self._results, found, strict=True))
        return self._term.name, {**self._given, **self._written("")}, [call, *writes]

    def tangent(self) -> tuple[str, Types, Iterable[str]]:
        changes = (
            self._product(kind).format(f"_by_{name}", f"dot.{self._entries[name]}")
            for name, kind in self._inputs.items()
        )
        change, lines = " + ".join(changes), []
        zeros = ["_no" if kind is self._real else f"_kind_{n}()" for n, kind in enumerate(self._term.results)]
        for n, (result, kind) in enumerate(self._results.items()):
            if kind is self._real:
                lines += [self._gradient([*zeros[:n], "_one", *zeros[n + 1 :]]), f"{result}_dot[i] = {change}"]
            else:
                gradient = self._gradient([*zeros[:n], "_unit", *zeros[n + 1 :]])
                own = {"n": n, "components": len(kind()), "result": result}
                lines.append(TANGENT.format(gradient=gradient, change=change, **own))
        kinds = {**self._given, "dot": bundle(**self._inputs), **self._written("_dot")}
        return f"{self._term.name}_tangent", kinds, lines

    def adjoint(self) -> tuple[str, Types, Iterable[str]]:
        held = self._replaced
        bars = [f"bar.{held[result]}[i]" if result in held else f"{result}_bar[i]" for result in self._results]
        added = {name: "" if name in held.values() else f"bar.{name}[i] + " for name in self._inputs}
        writes = (f"bar.{name}[i] = {before}_by_{name}" for name, before in added.items())
        left = {name: kind for name, kind in self._written("_bar").items() if name.removesuffix("_bar") not in held}
        kinds = {**self._given, **left, "bar": bundle(**self._inputs)}
        return f"{self._term.name}_adjoint", kinds, [self._gradient(bars), *writes]

    def _product(self, kind: Any) -> str:
        if kind is self._real:
            return "{} * {}"
        return "wp.dot({}, {})" if len(kind._shape_) == 1 else "wp.ddot({}, {})"

    def _written(self, suffix: str) -> dict[str, Any]:
        return {f"{result}{suffix}": wp.array(dtype=kind) for result, kind in self._results.items()}

    def _gradient(self, bars: Sequence[str]) -> str:
        names = ", ".join((*(f"_by_{name}" for name in self._entries), *bars_of(self._term)))
        return f"{names} = wp.grad(_work)({', '.join((*self._entries.values(), *bars))})"
