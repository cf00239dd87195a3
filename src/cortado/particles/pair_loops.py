"""The text of loops over the neighbours of a particle, which Warp compiles. All loops over them are written here.

The lanes of a particle share its neighbours (`cortado.device.lanes`). All names in a text but those of parameters begin
with an underscore, which those of parameters must not.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions, sum_over_lanes
from cortado.particles.mirrors import REFLECTIONS
from cortado.particles.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.particles.terms import own_entry

SUM = """\
def {name}(i: int, {parameters}s: _neighbourhood):
    {begin}
{loops}    return {results}
"""
OVER_FLUID = """\
    for _first in range(_lane() * _UNROLL, s.fluid_count[i], _UNROLL * _LANES):
        _several_j = _several(_first, i, s)
        {load}
        for _more in range(_UNROLL):
            {index}
            {separation}
            {body}
"""
OVER_IMAGES = """\
    for _place in range(s.count[i] + _lane(), s.all_count[i], _LANES):
        _image = _neighbour(_place, i, s)
        _j = _image // _REFLECTIONS
        _flip, _offset = _reflection(_image % _REFLECTIONS, s)
        _x_ij = _separation(_x_i, _times(_flip, x[_j]) + _offset, s)
        {body}
"""
OVER_WALLS = """\
    for _place in range(s.fluid_count[i] + _lane(), s.count[i], _LANES):
        _b = _neighbour(_place, i, s)
        _w_b = {weight}
        _x_ij = _separation(_x_i, _wall_position(_b, s), s)
        {more}
        {body}
"""
MOVING = {"v": "_wall_velocity(_b, s)", "x_dot": "_wall_position_dot(_b, s)", "v_dot": "_wall_velocity_dot(_b, s)"}
"""Entries of arrays that wall particles have where they move."""

Types = Mapping[str, Any]
"""Types by name."""
Body = Callable[[Mapping[str, str]], Iterable[str]]
"""The lines of a loop, given the text of a neighbour's entry of each array. They know _x_ij, and add to _total_0 ..."""


def over_fluid(
    d: Discretisation, arrays: Types, body: Body, ahead: bool, numbered: bool, separated: bool = True
) -> str:
    """A loop over the fluid, which reads entries of neighbours of these arrays.

    ``ahead`` loads what `UNROLL` neighbours have before any of it is used, so that loads do not wait for one another;
    ``numbered`` loops know the number _j of a neighbour, ``separated`` ones _x_ij.
    """
    kinds = {d.precision.vector: "_vectors", d.precision.real: "_numbers", d.precision.six: "_sixes"}
    loads = kinds if ahead else {}
    loaded = {array: loads[kind] for array, kind in arrays.items() if kind in loads}
    of_j = {array: f"_{array}_j[_more]" if array in loaded else f"{array}[_j]" for array in arrays}
    return OVER_FLUID.format(
        load=_lines(8, (f"_{array}_j = {load}({array}, _several_j)" for array, load in loaded.items())),
        index="_j = _several_j[_more]" if numbered or len(loaded) < len(arrays) else "",
        separation=f"_x_ij = _separation(_x_i, {of_j['x']}, s)" if separated else "",
        body=_lines(12, body(of_j)),
    )


def over_images(d: Discretisation, arrays: Types, body: Body) -> str:
    """A loop over the images of the fluid and of the particle itself, which have the numbers of their particles and
    their vectors, mirrored."""
    of_j = {
        array: f"{array}[_j]" if kind is d.precision.real else f"_times(_flip, {array}[_j])"
        for array, kind in arrays.items()
    }
    return OVER_IMAGES.format(body=_lines(8, body(of_j)))


def over_walls(d: Discretisation, arrays: Types, body: Body, known: Iterable[str], rubs: bool, of_one: bool) -> str:
    """A loop over the walls, whose particles have nothing but a place, a weight _w_b, what is ``known`` of
    `cortado.particles.terms.OF_WALLS`, and, where walls move, a velocity, which is their entry of the array v, and
    tangents of both. Where it ``rubs``, walls that slip freely have no weight, and where it is ``of_one`` all that are
    not of the moving ``solid``."""
    of_b = {array: zero(kind, d) for array, kind in arrays.items()}
    of_b |= {array: text for array, text in MOVING.items() if d.moving and array in arrays}
    turned = "_wall_turn_dot(_b, s)" if d.moving else zero(d.precision.vector, d)
    more = {"foot": "_foot = _wall_foot(_b, s)", "turn_dot": f"_turn_dot = {turned}"}
    return OVER_WALLS.format(
        weight="_wall_grip(_b, s)" if rubs else "_weight_in(_b, solid, s)" if of_one else "_wall_weight(_b, s)",
        more=_lines(8, (text for name, text in more.items() if name in known)),
        body=_lines(8, body({**of_b, "x": "_wall_position(_b, s)"})),
    )


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
    for kind in results:
        if kind is not d.precision.real and not _is_vector_of(d.precision.real, kind):
            raise TypeError(f"{name} returns {kind}, but a sum must be of numbers or vectors of the precision.")
    begin = [f"{own_entry(array)} = {array}[i]" for array in arrays if re.search(rf"\b{own_entry(array)}\b", loops)]
    begin += [f"_total_{n} = {zero(kind, d)}" for n, kind in enumerate(results)]
    text = SUM.format(
        name=name,
        parameters="".join(f"{name}: _of_{name}, " for name in (*arrays, *others)),
        begin=_lines(4, begin),
        loops=loops,
        results=", ".join(f"_add_up_{n}(_total_{n})" for n in range(len(results))),
    )
    text = "".join(line for line in text.splitlines(keepends=True) if line.strip())
    known = {
        **_known(d),
        **{f"_of_{name}": wp.array(dtype=kind) for name, kind in arrays.items()},
        **{f"_of_{name}": kind for name, kind in others.items()},
        **{f"_add_up_{n}": sum_over_lanes(kind, d.precision, d.lanes) for n, kind in enumerate(results)},
        **{type_name(kind, d): kind for kind in (*arrays.values(), *results)},
        **scope,
    }
    exec(text, known)
    made: Any = wp.Function(known[name], name, "", module=module, source=text)
    made.shares_lanes = True  # which `cortado.device.lanes.check_lanes` looks for
    return made


def _is_vector_of(real: Any, kind: Any) -> bool:
    return getattr(kind, "_wp_scalar_type_", None) is real and len(kind._shape_) == 1


def _known(d: Discretisation) -> dict[str, Any]:
    pair = pair_functions(d)
    used = (
        "reflection",
        "separation",
        "neighbour",
        "several",
        "vectors",
        "numbers",
        "sixes",
        "wall_position",
        "wall_weight",
        "wall_grip",
        "wall_foot",
        "wall_velocity",
        "weight_in",
        "wall_position_dot",
        "wall_velocity_dot",
        "wall_turn_dot",
        "wall_growth_dot",
    )
    return {
        **{f"_{name}": getattr(pair, name) for name in used},
        **{"_times": wp.cw_mul, "_REFLECTIONS": REFLECTIONS},
        **{"_real": d.precision.real, "_vector": d.precision.vector, "_neighbourhood": neighbourhood_type(d.precision)},
        **{"_lane": lane_functions(d.precision, d.lanes).lane, "_LANES": d.lanes, "_UNROLL": UNROLL},
    }


def zero(kind: Any, d: Discretisation) -> str:
    """The text of a 0 of a type."""
    return "_real(0.0)" if kind is d.precision.real else f"{type_name(kind, d)}()"


def type_name(kind: Any, d: Discretisation) -> str:
    """Of a type, in a text."""
    known = {d.precision.real: "_real", d.precision.vector: "_vector"}
    return known.get(kind) or f"_vector_{len(kind())}"


def _lines(indent: int, lines: Iterable[str]) -> str:
    return ("\n" + " " * indent).join(lines)
