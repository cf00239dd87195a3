"""The text of loops over the neighbours of a particle, which Warp compiles. All loops over them are written here.

The lanes of a particle share its neighbours (`cortado.device.lanes`).
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions, sum_over_lanes
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions

SUM = """\
def {name}(i: int, {parameters}s: neighbourhood):
    {begin}
{loops}    return {results}
"""
OVER_FLUID = """\
    for first in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
        {load}
        for more in range(UNROLL):
            {index}
            x_ij = separation(x_i, {x_j}, s)
            {body}
"""
OVER_WALLS = """\
    for place in range(s.fluid_count[i] + lane(), s.count[i], LANES):
        b = neighbour(place, i, s)
        w_b = wall_weight(b, s)
        x_ij = separation(x_i, wall_position(b, s), s)
        {body}
"""

Types = Mapping[str, Any]
"""Types by name."""
Body = Callable[[Mapping[str, str]], Iterable[str]]
"""The lines of a loop, given the text of a neighbour's entry of each array. They know x_ij, and add to total_0, ..."""


def over_fluid(d: Discretisation, arrays: Types, body: Body, ahead: bool, numbered: bool) -> str:
    """A loop over the fluid, which reads entries of neighbours of these arrays.

    ``ahead`` loads what `UNROLL` neighbours have before any of it is used, so that loads do not wait for one another;
    ``numbered`` loops know the number j of a neighbour.
    """
    loads = {d.precision.vector: "vectors", d.precision.real: "numbers"} if ahead else {}
    loaded = {array: loads[kind] for array, kind in arrays.items() if kind in loads}
    of_j = {array: f"{array}_j[more]" if array in loaded else f"{array}[j]" for array in arrays}
    return OVER_FLUID.format(
        load=_lines(8, (f"{array}_j = {load}({array}, first, i, s)" for array, load in loaded.items())),
        index="j = neighbour(first + more, i, s)" if numbered or len(loaded) < len(arrays) else "",
        x_j=of_j["x"],
        body=_lines(12, body(of_j)),
    )


def over_walls(d: Discretisation, arrays: Types, body: Body) -> str:
    """A loop over the walls, whose particles have nothing but a place and a weight w_b."""
    return OVER_WALLS.format(body=_lines(8, body({array: zero(kind, d) for array, kind in arrays.items()})))


def summed(
    name: str,
    d: Discretisation,
    arrays: Types,
    others: Types,
    results: Iterable[Any],
    loops: str,
    scope: Types,
    module: Any,
) -> Any:
    """The Warp function ``name(i, *arrays, *others, s)`` of what loops add up, of these types."""
    results = tuple(results)
    begin = [f"{array}_i = {array}[i]" for array in arrays if re.search(rf"\b{array}_i\b", loops)]
    begin += [f"total_{n} = {zero(kind, d)}" for n, kind in enumerate(results)]
    text = SUM.format(
        name=name,
        parameters="".join(f"{name}: of_{name}, " for name in (*arrays, *others)),
        begin=_lines(4, begin),
        loops=loops,
        results=", ".join(f"add_up_{n}(total_{n})" for n in range(len(results))),
    )
    text = "".join(line for line in text.splitlines(keepends=True) if line.strip())
    known = {
        **_known(d),
        **{f"of_{name}": wp.array(dtype=kind) for name, kind in arrays.items()},
        **{f"of_{name}": kind for name, kind in others.items()},
        **{f"add_up_{n}": sum_over_lanes(kind, d.precision, d.lanes) for n, kind in enumerate(results)},
        **{type_name(kind, d): kind for kind in (*arrays.values(), *results)},
        **scope,
    }
    exec(text, known)
    made: Any = known[name]
    return wp.Function(made, name, "", module=module, source=text)


def _known(d: Discretisation) -> dict[str, Any]:
    pair = pair_functions(d)
    used = ("separation", "neighbour", "vectors", "numbers", "wall_position", "wall_weight")
    return {
        **{name: getattr(pair, name) for name in used},
        **{"real": d.precision.real, "vector": d.precision.vector, "neighbourhood": neighbourhood_type(d.precision)},
        **{"lane": lane_functions(d.precision, d.lanes).lane, "LANES": d.lanes, "UNROLL": UNROLL},
    }


def zero(kind: Any, d: Discretisation) -> str:
    """The text of a 0 of a type."""
    return "real(0.0)" if kind is d.precision.real else f"{type_name(kind, d)}()"


def type_name(kind: Any, d: Discretisation) -> str:
    """Of a type, in a text."""
    known = {d.precision.real: "real", d.precision.vector: "vector"}
    return known.get(kind) or f"numbers_{len(kind())}"


def _lines(indent: int, lines: Iterable[str]) -> str:
    return ("\n" + " " * indent).join(lines)
