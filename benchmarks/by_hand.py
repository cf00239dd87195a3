"""Derivatives of sums that are written by hand beside those that Warp makes: ``python benchmarks/by_hand.py``.

A derivative by hand is worth its lines where it makes a step faster. Each is timed in a kernel of its own on the
neighbours of a dam break, and so is the made one of the same sum. A line has the time by hand and that of the made one
[us], and how many times as long the made one takes.
"""

import argparse
import ast
import importlib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import cortado
from benchmarks.bench.scene import dam_break
from benchmarks.bench.timing import median_seconds
from cortado import Simulation
from cortado.device.precision import lane_functions
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import BY_HAND, ByHand

ROOT = Path(cortado.__file__).parent
NOTE = re.compile(r"\b(tangent_of|adjoint_of)\(")
ASKED: dict[str, list[Any]] = {"phases": [3], "sticks": [False]}
"""What the factories of sums ask for beside a discretisation."""
KINDS: dict[str, Callable[..., Any]] = {"tangent": made_tangent, "adjoint": made_adjoint}


@cache
def noting_factories() -> list[tuple[Callable[..., Any], int]]:
    """All functions of the package that note derivatives by hand, and how many each notes."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        text = path.read_text()
        for node in ast.parse(text).body if NOTE.search(text) else ():
            notes = [one for one in ast.walk(node) if isinstance(one, ast.Call) and _is_note(one.func)]
            if isinstance(node, ast.FunctionDef) and notes:
                parts = path.relative_to(ROOT).with_suffix("").parts
                factory = getattr(importlib.import_module(".".join(("cortado", *parts))), node.name)
                found.append((factory, len(notes)))
    return found


def _is_note(function: ast.expr) -> bool:
    return isinstance(function, ast.Name) and NOTE.match(f"{function.id}(") is not None


def by_hand(d: Discretisation) -> dict[str, ByHand]:
    """All derivatives by hand, made for a discretisation, by what tells them apart."""
    found = {}
    for factory, notes in noting_factories():
        asked = [name for name in inspect.signature(factory).parameters if name in ASKED]
        for values in product(*(ASKED[name] for name in asked)):
            before = len(BY_HAND)
            inspect.unwrap(factory)(d, *values)
            assert len(BY_HAND) == before + notes
            for one in BY_HAND[before:]:
                form = "".join(f" {getattr(value, '__name__', value)}" for value in values)
                found[f"{factory.__module__}.{one.function.key}{form}: {one.kind}"] = one
    return found


class Caller:
    """A Warp function of a sum, in a kernel of its own."""

    def __init__(self, name: str, function: Any, names: Sequence[str], results: Sequence[Any], d: Discretisation):
        """``names`` of its arguments between i and s, and the types of its results. ``name`` is that of its Warp
        module, by which the cache of kernels knows it in the next process."""
        self._names, self._results, self._lanes = names, results, d.lanes
        kinds = list(function.adj.arg_types.values())[1:-1]
        assert len(kinds) == len(names)
        known = {"function": function, "wp": wp, "s_type": neighbourhood_type(d.precision), "LANES": d.lanes}
        known |= {f"type_{n}": kind for n, kind in enumerate(kinds)}
        known |= {f"result_{n}": wp.array(dtype=kind) for n, kind in enumerate(results)}
        known["lane"] = lane_functions(d.precision, d.lanes).lane
        given = "".join(f"a_{n}: type_{n}, " for n in range(len(kinds)))
        text = f"def call(s: s_type, {given}{', '.join(f'out_{n}: result_{n}' for n in range(len(results)))}):\n"
        text += "    i = s.first + wp.tid() // LANES\n"
        called = f"function(i, {''.join(f'a_{n}, ' for n in range(len(kinds)))}s)"
        text += f"    {', '.join(f'r_{n}' for n in range(len(results)))} = {called}\n"
        text += "    if lane() > 0:\n        return\n"
        text += "".join(f"    out_{n}[i] = r_{n}\n" for n in range(len(results)))
        exec(text, known)
        self.module = wp.get_module(f"cortado_call_{re.sub('[^a-z_0-9]+', '_', name)}_{d.precision.name}")
        self.module.options["enable_backward"] = False
        self._kernel = wp.Kernel(known["call"], key="call", module=self.module, source=text)

    def outputs(self, x: wp.array) -> list[wp.array]:
        """Room for the results."""
        return [wp.zeros(len(x), dtype=kind, device=x.device) for kind in self._results]

    def __call__(self, s: Any, values: Mapping[str, Any], outputs: Sequence[wp.array]) -> None:
        """Write the results for values by name."""
        x = values["x"]
        inputs = [s, *(values[name] for name in self._names)]
        wp.launch(self._kernel, len(x) * self._lanes, inputs, outputs, device=x.device)


class Pair:
    """A derivative by hand and the made one, of the same values."""

    def __init__(self, name: str, one: ByHand, differentiable: ByHand):
        """``differentiable``: the same of a discretisation that is taped."""
        term, own, d = differentiable.of.term, one.function.term, one.of.discretisation
        self.name, self._d = name, d
        arrays, others = dict(term.arrays), dict(term.others)
        if one.kind == "tangent":
            arrays, others = ({n: k for m, k in t.items() for n in (m, f"{m}_dot")} for t in (arrays, others))
            results = term.results
        else:
            arrays["bar"] = term.results[0]
            results = (*term.arrays.values(), *term.others.values())
        more = [name for name in arrays if name not in term.arrays]
        assert len(own.arrays) == len(arrays)
        own_arrays = [name if name in term.arrays else more.pop(0) for name in own.arrays]
        self._arrays, self._others = arrays, others
        self._constant = [name for name in others if name.endswith("_dot") and name not in own.others]
        """Tangents of what the one by hand takes for constant."""
        self.compared = min(len(results), len(own.results))
        """Results that both have."""
        assert self.compared >= (len(results) if one.kind == "tangent" else len(term.arrays))
        self.made = Caller(f"made {name}", KINDS[one.kind](d, lambda _: term.function), [*arrays, *others], results, d)
        self.by_hand = Caller(f"by hand {name}", one.function, [*own_arrays, *own.others], own.results, d)

    def values(self, x: wp.array, seed: int) -> dict[str, Any]:
        """Random arguments, numbers positive, at positions x."""
        random, device, real = np.random.default_rng(seed), x.device, self._d.precision.real

        def numbers(kind: Any) -> np.ndarray:
            return random.uniform(0.5, 1.5, len(x)) if kind is real else random.standard_normal((len(x), *kind._shape_))

        found = {name: wp.array(numbers(kind), dtype=kind, device=device) for name, kind in self._arrays.items()}
        found |= {
            name: 0.0 if name in self._constant else float(numbers(kind)[0]) for name, kind in self._others.items()
        }
        return {**found, "x": x}


def pairs(d: Discretisation) -> list[Pair]:
    """All derivatives by hand with the made ones."""
    taped = by_hand(replace(d, taped=True))
    return [Pair(name, one, taped[name]) for name, one in by_hand(d).items()]


def without_walls(neighbourhood: Any) -> Any:
    """A neighbourhood of the fluid alone, which made derivatives are of."""
    s = neighbourhood._cls()
    for name in neighbourhood._cls.vars:
        setattr(s, name, getattr(neighbourhood, name))
    s.count = s.fluid_count
    return s


def seconds(called: Caller, s: Any, values: Mapping[str, Any], repeats: int) -> float:
    """The median of a call."""
    outputs, device = called.outputs(values["x"]), values["x"].device
    return median_seconds(lambda: called(s, values, outputs), repeats, lambda: wp.synchronize_device(device))


def main() -> None:
    """Measure all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=8000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", default="float32", choices=("float32", "float64"))
    parser.add_argument("--repeats", type=int, default=31)
    options = parser.parse_args()
    simulation = Simulation(dam_break(options.particles), options.device, options.precision)
    rollout = simulation.rollout(3)
    rollout.forward()
    solver: Any = rollout.solver
    s, x = without_walls(solver.context(rollout.parameters).neighbourhood), solver.fields["x"]
    for pair in pairs(solver.discretisation):
        values = pair.values(x, 1)
        times = [seconds(called, s, values, options.repeats) for called in (pair.by_hand, pair.made)]
        print(f"{pair.name:75s} {1e6 * times[0]:9.1f} {1e6 * times[1]:9.1f} {times[1] / times[0]:6.2f}", flush=True)


if __name__ == "__main__":
    main()
