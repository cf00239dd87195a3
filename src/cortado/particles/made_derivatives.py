"""Makes derivatives of sums over neighbours (`cortado.particles.pair_sums`) by Warp's automatic differentiation.

The sum S_i = sum_j T_ij of particle i adds a term T_ij for each neighbour j. The term T_ij depends on the separation
x_ij, on values c_i and c_j of both particles, and on parameters. Let S_i^ be the adjoint of the sum, and <a, b> the
scalar product. The position and the value of particle i have the adjoints

    x_i^ = sum_j d<T_ij, S_i^> / dx_ij - d<T_ji, S_j^> / dx_ji
    c_i^ = sum_j d<T_ij, S_i^> / dc_i + d<T_ji, S_j^> / dc_i

Derivatives by Warp are exact, but slower than handwritten derivatives. Only a Warp kernel may call a made derivative:
if a `wp.func` calls the derivative, the generated C++ code does not compile.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.pair_sums import Term, array_of, between, over_fluid, own_entry, summed, type_name, zero

TermMaker = Callable[[Discretisation], Callable[..., Any]]


def made_adjoint(d: Discretisation, make: TermMaker, module: Any = None) -> Any:
    """Make the Warp function ``f(i, *arrays, *bars, *others, s)`` of the adjoint of a sum over neighbours. ``bars`` are
    the adjoints of the sums. The function returns the adjoints of the element i of each array, and of ``others``."""
    term = _differentiable(make, d)
    bars, results = bars_of(term), (*term.arrays.values(), *term.others.values())

    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        yield _gradient("own", term, term.seen_from_i(of_j), map(own_entry, bars))
        yield _gradient("other", term, term.seen_from_i(of_j, back=True), (of_j[bar] for bar in bars))
        for n, array in enumerate(term.arrays):
            shares = {
                f"{array}_i": f"_own_{array}_i",
                f"{array}_j": f"_other_{array}_j",
                f"{array}_ij": f"_own_{array}_ij - _other_{array}_ij",
            }
            yield f"_total_{n} += {' + '.join(share for name, share in shares.items() if name in term.parameters)}"
        for n, name in enumerate(term.others, len(term.arrays)):
            yield f"_total_{n} += _own_{name}"

    arrays = {**term.arrays, **bars}
    return _made(term, d, arrays, term.others, results, over_fluid(term, d, True, arrays, body), module)


def made_tangent(d: Discretisation, make: TermMaker, module: Any = None) -> Any:
    """In the arguments of the Warp function, each input of the sum is followed by its tangent."""
    term = _differentiable(make, d)
    arrays, others = (
        {each: kind for name, kind in types.items() for each in (name, f"{name}_dot")}
        for types in (term.arrays, term.others)
    )
    if len(arrays) + len(others) < 2 * len(term.arrays | term.others):
        raise TypeError(f"term {term.name} has names x and x_dot, but x_dot must be the tangent of x.")
    kinds, real = {**term.parameters, **bars_of(term)}, d.precision.real
    moved = [name for name in term.parameters if name not in ("i", "j", "s")]

    def unit(kind: Any, k: int) -> str:
        ones = ", ".join(f"_real({float(m == k)})" for m in range(1 if kind is real else len(kind())))
        return ones if kind is real else f"{type_name(kind, d)}({ones})"

    def product(by: str, name: str, of_j: Mapping[str, str]) -> str:
        dot = f"{array_of(name)}_dot"
        change = between(name, own_entry(dot), of_j[dot]) if array_of(name) else f"{name}_dot"
        return f"{by} * ({change})" if kinds[name] is real else f"_wp.{dot_of(kinds[name])}({by}, {change})"

    def body(of_j: Mapping[str, str]) -> Iterator[str]:
        for n, kind in enumerate(term.results):
            for k in range(1 if kind is real else len(kind())):
                bars = [unit(each, k) if m == n else zero(each, d) for m, each in enumerate(term.results)]
                yield _gradient(f"by_{n}_{k}", term, term.seen_from_i(of_j), bars)
                terms = (product(f"_by_{n}_{k}_{name}", name, of_j) for name in moved)
                yield f"_total_{n} += ({' + '.join(terms)}) * {unit(kind, k)}"

    return _made(term, d, arrays, others, term.results, over_fluid(term, d, False, arrays, body), module)


def _differentiable(make: TermMaker, d: Discretisation) -> Term:
    term = Term.of(make(replace(d, taped=True)))
    if "x_ij" not in term.parameters:
        raise TypeError(f"term {term.name} has no x_ij, but needs x_ij for derivatives by Warp.")
    return term


def _made(
    term: Term, d: Discretisation, arrays: dict[str, Any], others: dict[str, Any], results: Any, loop: str, module: Any
) -> Any:
    module = module or wp.get_module(term.function.__module__)
    scope = {"_work": work_of(term, d.precision, module), "_wp": wp}
    return summed(term.name, d, arrays, others, results, loop, scope, module)


def work_of(term: Term, precision: Precision, module: Any) -> Any:
    """Make the Warp function that multiplies the results of a term by their adjoints and adds up the products."""
    types, bars = {**term.parameters, **bars_of(term)}, bars_of(term)
    products = (
        f"_term_{n} * {bar}" if kind is precision.real else f"_wp.{dot_of(kind)}(_term_{n}, {bar})"
        for n, (bar, kind) in enumerate(bars.items())
    )
    text = f"""\
def _work({", ".join(types)}):
    {", ".join(f"_term_{n}" for n in range(len(bars)))} = _term({", ".join(term.parameters)})
    return {" + ".join(products)}
"""
    known: dict[str, Any] = {"_term": warp_function(term.function, module), "_wp": wp}
    exec(text, known)
    made: Any = known["_work"]
    made.__annotations__ = {**types, "return": precision.real}
    return wp.Function(made, f"{term.name}_work", "", module=module, source=text)


def warp_function(function: Callable[..., Any], module: Any) -> Any:
    if not hasattr(function, "source"):
        return wp.func(function, module=module)
    return wp.Function(function, function.__name__, "", module=module, source=function.source)


def dot_of(kind: Any) -> str:
    return "dot" if len(kind._shape_) == 1 else "ddot"


def bars_of(term: Term) -> dict[str, Any]:
    return {f"_bar_{n}": kind for n, kind in enumerate(term.results)}


def _gradient(label: str, term: Term, arguments: str, bars: Iterable[str]) -> str:
    names = ", ".join(f"_{label}_{name}" for name in (*term.parameters, *bars_of(term)))
    return f"{names} = _wp.grad(_work)({arguments}, {', '.join(bars)})"
