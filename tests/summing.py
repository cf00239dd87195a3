"""Sums over neighbours evaluated by themselves, and all derivatives of them that are written by hand."""

import ast
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import cortado
from cortado.device.by_hand import BY_HAND, ByHand
from cortado.device.made_derivatives import made_adjoint, made_tangent
from cortado.device.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.pair_forces import laminar, pairwise

ROOT = Path(cortado.__file__).parent
OTHERS = {"phases": [3], "form": [pairwise, laminar], "sticks": [False]}
"""What factories of sums ask for beside a discretisation."""


def noting_factories() -> Iterator[tuple[Callable[..., Any], int]]:
    """All functions of the package in which derivatives are noted as written by hand, and how many."""
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef):
                noted = [one for one in ast.walk(node) if isinstance(one, ast.Call) and _is_note(one.func)]
                if noted and node.args.args and node.args.args[0].arg == "discretisation":
                    module = importlib.import_module(
                        ".".join(("cortado", *path.relative_to(ROOT).with_suffix("").parts))
                    )
                    yield getattr(module, node.name), len(noted)


def _is_note(function: ast.expr) -> bool:
    return isinstance(function, ast.Name) and function.id in ("tangent_of", "adjoint_of")


def by_hand(discretisation: Discretisation) -> list[ByHand]:
    """All derivatives by hand, made for a discretisation."""
    found = []
    for factory, noted in noting_factories():
        asked = [name for name in inspect.signature(factory).parameters if name in OTHERS]
        for values in _combinations([OTHERS[name] for name in asked]):
            before = len(BY_HAND)
            factory.__wrapped__(discretisation, *values)
            assert len(BY_HAND) == before + noted
            found += BY_HAND[before:]
    return found


def _combinations(lists: list[list[Any]]) -> Iterator[tuple[Any, ...]]:
    if not lists:
        yield ()
        return
    for first in lists[0]:
        for rest in _combinations(lists[1:]):
            yield (first, *rest)


class Caller:
    """A Warp function of a sum, in a kernel of its own."""

    def __init__(self, function: Any, names: Sequence[str], results: Sequence[Any], discretisation: Discretisation):
        """``names`` of its arguments between i and s, and the types of its results."""
        self._names, self._results = names, results
        kinds = list(function.adj.arg_types.values())[1:-1]
        assert len(kinds) == len(names)
        known: dict[str, Any] = {"function": function, "wp": wp, "s_type": neighbourhood_type(discretisation.precision)}
        known |= {f"type_{n}": kind for n, kind in enumerate(kinds)}
        known |= {f"result_{n}": wp.array(dtype=kind) for n, kind in enumerate(results)}
        given = "".join(f"a_{n}: type_{n}, " for n in range(len(kinds)))
        text = f"def call(s: s_type, {given}{', '.join(f'out_{n}: result_{n}' for n in range(len(results)))}):\n"
        text += "    i = s.first + wp.tid()\n"
        called = f"function(i, {''.join(f'a_{n}, ' for n in range(len(kinds)))}s)"
        text += f"    {', '.join(f'r_{n}' for n in range(len(results)))} = {called}\n"
        text += "".join(f"    out_{n}[i] = r_{n}\n" for n in range(len(results)))
        exec(text, known)
        module = wp.get_module(f"cortado_call_{function.key}_{id(function)}")
        module.options["enable_backward"] = False
        self._kernel = wp.Kernel(known["call"], key="call", module=module, source=text)

    def __call__(self, s: Any, values: Mapping[str, Any]) -> list[wp.array]:
        """The results for values by name."""
        particles, device = len(values["x"]), values["x"].device
        found = [wp.zeros(particles, dtype=kind, device=device) for kind in self._results]
        wp.launch(self._kernel, particles, [s, *(values[name] for name in self._names)], found, device=device)
        return found


class Both:
    """A derivative by hand and the made one, of the same values."""

    def __init__(self, one: ByHand):
        term, own, d = one.of.term, one.function.term, one.of.discretisation
        self.name = one.function.key
        arrays, others = dict(term.arrays), dict(term.others)
        if one.kind == "tangent":
            arrays, others = ({n: k for m, k in t.items() for n in (m, f"{m}_dot")} for t in (arrays, others))
            function, results = made_tangent(d)(term.function), term.results
        else:
            arrays["bar"] = term.results[0]
            function, results = made_adjoint(d)(term.function), (*term.arrays.values(), *term.others.values())
        more = [name for name in arrays if name not in term.arrays]
        assert len(own.arrays) == len(arrays)
        own_arrays = [name if name in term.arrays else more.pop(0) for name in own.arrays]
        self._d, self._arrays, self._others = d, arrays, others
        self._constant = [name for name in others if name.endswith("_dot") and name not in own.others]
        """Tangents of what the one by hand takes for constant."""
        self.compared = min(len(results), len(own.results))
        """Results that both have."""
        assert self.compared >= (len(results) if one.kind == "tangent" else len(term.arrays))
        self.made = Caller(function, [*arrays, *others], results, d)
        self.by_hand = Caller(one.function, [*own_arrays, *own.others], own.results, d)

    def values(self, x: wp.array, seed: int) -> dict[str, Any]:
        """Random arguments, numbers positive, at positions x."""
        random, device, real = np.random.default_rng(seed), x.device, self._d.precision.real

        def numbers(kind: Any) -> np.ndarray:
            return random.uniform(0.5, 1.5, len(x)) if kind is real else random.standard_normal((len(x), len(kind())))

        found = {name: wp.array(numbers(kind), dtype=kind, device=device) for name, kind in self._arrays.items()}
        found |= {
            name: 0.0 if name in self._constant else float(numbers(kind)[0]) for name, kind in self._others.items()
        }
        return {**found, "x": x}
