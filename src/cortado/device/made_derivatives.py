"""Derivatives of sums over the fluid, made by Warp from the term of one pair (`cortado.device.terms`).

For the sums S_i = sum_j T(x_ij, c_i, c_j, v_ij, theta) and their adjoints S_i^, the adjoint gathers what the pair gives
to particle i, from its own sum and from that of its neighbour:

    x_i^ = sum_j d(T_ij . S_i^) / dx_ij - d(T_ji . S_j^) / dx_ji
    c_i^ = sum_j d(T_ij . S_i^) / dc_i + d(T_ji . S_j^) / dc_i

and likewise for all entries of arrays; theta^ is sum_j d(T_ij . S_i^) / dtheta of each particle. The tangent is put
together of the gradients of the components of T. Both are exact. They are slower than what one can write by hand, and
are meant for forces of one's own and for what is seldom computed.

A term that is differentiated must call functions that Warp can differentiate: those of a `Discretisation` that is
``taped``. Warp writes the gradient of a function in time only where `warp.grad` stands in a function that a kernel
calls itself, as it does here.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import warp as wp

from cortado.device.neighbourhood import Discretisation
from cortado.device.pair_loops import Body, Types, over_fluid, summed, type_name, zero
from cortado.device.terms import Term, array_of

Decorator = Callable[[Callable[..., Any]], Any]


def made_adjoint(d: Discretisation, module: Any = None) -> Decorator:
    """A decorator that makes of a term the Warp function ``f(i, *arrays, *bars, *others, s)``, given the arrays of the
    adjoints of its sums. It returns the adjoints of the entries of particle i in each array, and of each of the others.
    ``module`` is the Warp module of the function, if not that of the file."""

    def make(function: Callable[..., Any]) -> Any:
        term = Term.of(function)
        arrays = {**term.arrays, **_bars(term)}
        loop = over_fluid(d, arrays, _adjoint(term), ahead=True, numbered="j" in term.parameters)
        return _made(term, d, arrays, term.others, (*term.arrays.values(), *term.others.values()), loop, module)

    return make


def made_tangent(d: Discretisation, module: Any = None) -> Decorator:
    """A decorator that makes of a term the Warp function ``f(i, *arrays, *others, s)`` of the tangents of its sums, in
    which each array and each of the others is followed by its tangent."""

    def make(function: Callable[..., Any]) -> Any:
        term = Term.of(function)
        arrays, others = _with_tangents(term.arrays), _with_tangents(term.others)
        loop = over_fluid(d, arrays, _tangent(term, d), ahead=False, numbered="j" in term.parameters)
        return _made(term, d, arrays, others, term.results, loop, module)

    return make


def _made(
    term: Term, d: Discretisation, arrays: Types, others: Types, results: Iterable[Any], loop: str, module: Any
) -> Any:
    module = module or wp.get_module(term.function.__module__)
    return summed(term.name, d, arrays, others, results, loop, {"work": _work(term, d, module), "wp": wp}, module)


def _work(term: Term, d: Discretisation, module: Any) -> Any:
    """The Warp function T . bar of the arguments of a term and of an adjoint of each of its results."""
    types, bars = {**term.parameters, **_bars(term)}, _bars(term)
    products = (
        f"term_{n} * {bar}" if kind is d.precision.real else f"wp.dot(term_{n}, {bar})"
        for n, (bar, kind) in enumerate(bars.items())
    )
    text = f"""\
def work({", ".join(types)}):
    {", ".join(f"term_{n}" for n in range(len(bars)))} = term({", ".join(term.parameters)})
    return {" + ".join(products)}
"""
    known: dict[str, Any] = {"term": wp.func(term.function, module=module), "wp": wp}
    exec(text, known)
    made: Any = known["work"]
    made.__annotations__ = {**types, "return": d.precision.real}
    return wp.Function(made, f"{term.name}_work", "", module=module, source=text)


def _bars(term: Term) -> dict[str, Any]:
    """Names and types of the adjoints of the results."""
    return {f"bar_{n}": kind for n, kind in enumerate(term.results)}


def _with_tangents(types: Types) -> dict[str, Any]:
    return {each: kind for name, kind in types.items() for each in (name, f"{name}_dot")}


def _gradient(label: str, term: Term, arguments: str, bars: Iterable[str]) -> str:
    """The line that assigns the derivative of T . bar by each parameter to ``label_parameter``."""
    names = ", ".join(f"{label}_{name}" for name in (*term.parameters, *_bars(term)))
    return f"{names} = wp.grad(work)({arguments}, {', '.join(bars)})"


def _adjoint(term: Term) -> Body:
    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        yield _gradient("own", term, term.seen_from_i(of_j), (f"{bar}_i" for bar in _bars(term)))
        yield _gradient("other", term, term.seen_from_j(of_j), (of_j[bar] for bar in _bars(term)))
        for n, array in enumerate(term.arrays):
            shares = {
                f"{array}_i": f"own_{array}_i",
                f"{array}_j": f"other_{array}_j",
                f"{array}_ij": f"own_{array}_ij - other_{array}_ij",
            }
            yield f"total_{n} += {' + '.join(share for name, share in shares.items() if name in term.parameters)}"
        for n, name in enumerate(term.others, len(term.arrays)):
            yield f"total_{n} += own_{name}"

    return body


def _tangent(term: Term, d: Discretisation) -> Body:
    """Of each component of each result the gradient times the tangents of the parameters."""
    kinds = {**term.parameters, **_bars(term)}

    def change_of(name: str, of_j: Mapping[str, str]) -> str:
        array = array_of(name)
        if not array:
            return f"{name}_dot"
        own, other = f"{array}_dot_i", of_j[f"{array}_dot"]
        return {"i": own, "j": other, "ij": f"{own} - {other}"}[name.rpartition("_")[2]]

    def product(first: str, name: str, second: str) -> str:
        return f"{first} * ({second})" if kinds[name] is d.precision.real else f"wp.dot({first}, {second})"

    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        moved = [name for name in term.parameters if name not in "ijs"]
        for n, kind in enumerate(term.results):
            components = 1 if kind is d.precision.real else len(kind())
            for k in range(components):
                bars = [_unit(each, d, k) if m == n else zero(each, d) for m, each in enumerate(term.results)]
                yield _gradient(f"by_{n}_{k}", term, term.seen_from_i(of_j), bars)
                terms = (product(f"by_{n}_{k}_{name}", name, change_of(name, of_j)) for name in moved)
                yield f"total_{n} += ({' + '.join(terms)}) * {_unit(kind, d, k)}"

    return body


def _unit(kind: Any, d: Discretisation, k: int) -> str:
    """The text of a result whose component k is 1, and all others 0."""
    if kind is d.precision.real:
        return "real(1.0)"
    return f"{type_name(kind, d)}({', '.join(f'real({float(m == k)})' for m in range(len(kind())))})"
