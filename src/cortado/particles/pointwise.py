"""Kernels of a function of one particle, with both derivatives, which Warp makes from the function.

The parameters of the function say by their names what they are: x_i is the particle's entry of the array x, and any
other, such as time_step, is the entry of its scene. For results r = f(x_i, ..., time_step, ...) the kernels are

    forward:  r[i] = f(x[i], ..., time_step[scene], ...)
    tangent:  r_dot[i] = df/dx x_dot[i] + ... + df/dtime_step time_step_dot[scene]
    adjoint:  x_bar[i] += (df/dx)^T r_bar[i],   time_step_bar[i] += df/dtime_step . r_bar[i]

so that particles keep their shares of the adjoints of a scene's parameters, which are summed later. Both derivatives
are exact; the tangent is put together of the gradients of the components of r. A launch finds the arrays by these
names.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.made_derivatives import bars_of, work_of
from cortado.particles.terms import Term, array_of

Types = Mapping[str, Any]
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


def pointwise_kernels(
    precision: Precision,
    modules: Sequence[Any],
    make: Callable[[Any], Callable[..., Any]],
    results: Sequence[str],
    replaced: Mapping[str, str] | None = None,
    numbers: Collection[str] = (),
) -> Kernels:
    """The three kernels, each in its own of the Warp ``modules``, of the function that ``make`` makes for a module.

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
