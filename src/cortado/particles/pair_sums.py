"""Sums over neighbours. A sum is made from a function that computes the term of one pair of particles. The parameter
names of the function are the inputs of the term.

    @pair_sum(discretisation)
    def force(x_ij: vector, c_i: real, c_j: real, s: neighbourhood) -> vector:
        return ((c_i + c_j) * slope(x_ij, s)) * x_ij

is the Warp function ``force(i, x, c, s)`` of particle i, the arrays x and c, and the neighbourhood s. Parameters are

    x_ij               the separation x_i - x_j of the nearest image
    c_i, c_j, v_ij     an array's value at the particle, its value at the neighbour, and v_i - v_j
    i, j               the numbers of the particles; j is -1 for a wall particle
    foot               for walls: the vector from a wall particle to the nearest point of the surface
    mirrored           for walls: 1 if the wall mirrors about particle i, otherwise 0
    turn_dot           for tangents of terms of walls: the tangent of the rotation of the wall's solid
    swept, swept_dot   for images by moving solids: the displacement of the mirror in a step, and its tangent
    direct, direct_dot for images: the separation from the mirrored particle, and its tangent
    s                  the neighbourhood
    any other          a value that is equal for all neighbours; its argument is between the arrays and s

A term that returns several values makes several sums in one loop. The term of a wall particle is multiplied by the
weight of the wall particle. If walls have no separate term, every value with index j is 0 for a wall particle. Names of
parameters must not begin with an underscore.

With ``ahead=False`` the values of a neighbour are loaded just before its term is computed. With ``ahead=True`` the
values of a neighbour are loaded earlier, which is quicker for cheap terms.

Derivatives of sums are handwritten (`tangent_of`, `adjoint_of`) where derivatives by Warp
(`cortado.particles.made_derivatives`) would slow down a step. Tests compare all derivatives in `BY_HAND` with Warp's.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import warp as wp

from cortado.device.precision import TypesByName, lane_functions, sum_over_lanes
from cortado.particles.mirrors import OF_IMAGES, OVER_IMAGES, OWNED, reflections
from cortado.particles.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions

NUMBERS = ("i", "j")
INDICES = ("i", "j", "ij")
OF_WALLS = {"foot": "_foot", "turn_dot": "_turn_dot", "mirrored": "_mirrored"}


@dataclass(frozen=True)
class Term:
    function: Callable[..., Any]
    parameters: Mapping[str, Any]
    results: tuple[Any, ...]

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "Term":
        types, names = inspect.get_annotations(function), (*inspect.signature(function).parameters, "return")
        for name in names:
            if name not in types or isinstance(types[name], str):
                found = "a text" if name in types else "no type"
                raise TypeError(f"term {function.__name__} has {found} for {name!r}, but must have a type for each.")
            if name.startswith("_"):
                raise TypeError(f"term {function.__name__} has {name!r}, but names must not begin with an underscore.")
        result = types.pop("return")
        return cls(function, types, get_args(result) or (result,))

    @property
    def name(self) -> str:
        return self.function.__name__

    @property
    def arrays(self) -> dict[str, Any]:
        return {array: self.parameters[name] for name in self.parameters if (array := array_of(name))}

    @property
    def of_neighbours(self) -> dict[str, Any]:
        read = {array_of(name) for name in self.parameters if name.endswith(("_j", "_ij"))}
        return {array: kind for array, kind in self.arrays.items() if array in read}

    @property
    def others(self) -> dict[str, Any]:
        known = (*NUMBERS, *OF_WALLS, *OF_IMAGES, "s")
        return {name: kind for name, kind in self.parameters.items() if not array_of(name) and name not in known}

    def seen_from_i(self, of_j: Mapping[str, str], j: str = "_j", back: bool = False) -> str:
        """Return the term's arguments as source text. With ``back``, the particles exchange roles."""
        known = {"x_ij": "_x_ij", "i": "i", "j": j, **OF_WALLS, **OF_IMAGES}
        if back:
            known = {"x_ij": "-_x_ij", "i": "_j", "j": "i"}
        found = []
        for name in self.parameters:
            ends = own_entry(array_of(name)), of_j.get(array_of(name), "")
            own, other = reversed(ends) if back else ends
            found.append(known.get(name) or between(name, own, other))
        return ", ".join(found)


def array_of(parameter: str) -> str:
    """Return the name of the array for a parameter such as ``c_i``, or an empty text without an array."""
    array, _, index = parameter.rpartition("_")
    return array if index in INDICES else ""


def own_entry(array: str) -> str:
    return f"_{array}_i"


def between(parameter: str, own: str, other: str) -> str:
    """``own`` is source text for the particle's value, and ``other`` is source text for the neighbour's value."""
    texts = {"i": own, "j": other, "ij": f"{own} - {other}"}
    return texts[parameter.rpartition("_")[2]] if array_of(parameter) else parameter


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
OVER_WALLS = """\
    for _place in range(s.fluid_count[i] + _lane(), s.count[i], _LANES):
        _b = _neighbour(_place, i, s)
        _w_b = {weight}
        _x_ij = _separation(_x_i, _load_vector(s.wall_positions, _b), s)
        {more}
        {body}
"""
ALL, RUBBING = "_load_number(s.wall_weights, _b)", "_load_number(s.wall_grips, _b)"
PLACE, FOOT = "_load_vector(s.wall_positions, _b)", "_load_vector(s.wall_feet, _b)"
TURN, GROWTH = "_load_vector(s.wall_turns_dot, _b)", "_load_number(s.wall_growths_dot, _b)"
MOVING = {"v": "velocities", "x_dot": "positions_dot", "v_dot": "velocities_dot"}
MOVING = {name: f"_load_vector(s.wall_{array}, _b)" for name, array in MOVING.items()}

Function = Callable[..., Any]
Kinds = tuple[Any, ...]
Decorator = Callable[[Function], Any]
Types = Mapping[str, Any]
Typed = TypesByName | None
Body = Callable[[Mapping[str, str]], Iterable[str]]
Loops = Callable[[Term, Term], str]


def over_fluid(
    term: Term, d: Discretisation, ahead: bool, arrays: Types | None = None, body: Body | None = None
) -> str:
    """Return the text of a loop over fluid neighbours that reads ``arrays``, and by default adds up the term. With
    ``ahead``, the loop loads the values of `UNROLL` neighbours before it uses any of these values."""
    arrays, body = arrays or term.of_neighbours, body or _adding_up(term)
    loads = {d.precision.vector: "_vectors", d.precision.real: "_numbers", d.precision.six: "_sixes"} if ahead else {}
    loaded = {array: loads[kind] for array, kind in arrays.items() if kind in loads}
    of_j = {array: f"_{array}_j[_more]" if array in loaded else f"{array}[_j]" for array in arrays}
    return OVER_FLUID.format(
        load=_lines(8, (f"_{array}_j = {load}({array}, _several_j)" for array, load in loaded.items())),
        index="_j = _several_j[_more]" if "j" in term.parameters or len(loaded) < len(arrays) else "",
        separation=f"_x_ij = _separation(_x_i, {of_j['x']}, s)" if "x_ij" in term.parameters else "",
        body=_lines(12, body(of_j)),
    )


def over_images(d: Discretisation, arrays: Types, body: Body) -> str:
    def of_j(array: str, kind: Any) -> str:
        of = array.removesuffix("_dot")
        if kind is d.precision.real or not _is_vector_of(d.precision.real, kind):
            turned = "" if kind is d.precision.real else "_R * " if d.moving else "wp.diag(_R) * "
            return f"{turned}{array}[_j]"
        if of in (array, "") or not d.moving:
            return f"_turned(_R, {array}[_j])"
        return f"_{'image' if of == 'x' else 'turned'}_dot(_one, {of}[_j], {array}[_j], _member, s)"

    return OVER_IMAGES.format(body=_lines(8, body({array: of_j(array, kind) for array, kind in arrays.items()})))


def over_walls(wall: Term, d: Discretisation, grows: Any, weight: str) -> str:
    if "x_ij" not in wall.parameters:
        raise TypeError(f"term {wall.name} has no x_ij, but needs x_ij for a sum over walls.")
    arrays = wall.of_neighbours
    of_b = {array: zero(kind, d) for array, kind in arrays.items()}
    of_b |= {array: text for array, text in MOVING.items() if d.moving and array in arrays} | {"x": PLACE}
    turned = TURN if d.moving else zero(d.precision.vector, d)
    more = {"foot": f"_foot = {FOOT}", "turn_dot": f"_turn_dot = {turned}"}
    lines = _added("_wall_term", wall, "_w_b * ", wall.seen_from_i(of_b, "-1"))
    if grows is not None and d.moving:
        grown = _added("_grown_term", grows.wall, "_w_b * _growth * ", grows.wall.seen_from_i(of_b, "-1"))
        lines += [f"_growth = {GROWTH}", "if _growth != _real(0.0):", *(f"    {line}" for line in grown)]
    told = _lines(8, (text for name, text in more.items() if name in wall.parameters))
    return OVER_WALLS.format(weight=weight, more=told, body=_lines(8, lines))


def summed(
    name: str, d: Discretisation, arrays: Types, others: Types, results: Kinds, loops: str, scope: Types, module: Any
) -> Any:
    """Make the Warp function ``name(i, *arrays, *others, s)``, which runs ``loops`` and returns the sums."""
    for kind in results:
        if kind is not d.precision.real and not _is_vector_of(d.precision.real, kind):
            raise TypeError(f"{name} returns {kind}, but must return numbers or vectors of the precision.")
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
        **scope_of(d),
        **{"wp": wp, "_REFLECTIONS": reflections(d.moving), "_LANES": d.lanes, "_UNROLL": UNROLL},
        "_lane": lane_functions(d.precision, d.lanes).lane,
        **{f"_of_{name}": wp.array(dtype=kind) for name, kind in arrays.items()},
        **{f"_of_{name}": kind for name, kind in others.items()},
        **{f"_add_up_{n}": sum_over_lanes(kind, d.precision, d.lanes) for n, kind in enumerate(results)},
        **{type_name(kind, d): kind for kind in (*arrays.values(), *results)},
        **scope,
    }
    exec(text, known)
    made: Any = wp.Function(known[name], name, "", module=module, source=text)
    made.shares_lanes = True  # which `cortado.device.precision.check_sum` looks for
    made.arrays, made.others, made.results, made.discretisation = arrays, others, results, d
    return made


def _is_vector_of(real: Any, kind: Any) -> bool:
    return getattr(kind, "_wp_scalar_type_", None) is real and len(kind._shape_) == 1


def scope_of(d: Discretisation) -> dict[str, Any]:
    precision = d.precision
    types = {"_real": precision.real, "_vector": precision.vector, "_neighbourhood": neighbourhood_type(precision)}
    return {**{f"_{name}": function for name, function in vars(pair_functions(d)).items()}, **types}


def zero(kind: Any, d: Discretisation) -> str:
    return "_real(0.0)" if kind is d.precision.real else f"{type_name(kind, d)}()"


def type_name(kind: Any, d: Discretisation) -> str:
    return {d.precision.real: "_real", d.precision.vector: "_vector"}.get(kind) or f"_vector_{len(kind())}"


def _lines(indent: int, lines: Iterable[str]) -> str:
    return ("\n" + " " * indent).join(lines)


def _summing(
    d: Discretisation, typed: Typed, loops: Loops, walls: Any = None, module: Any = None, grows: Any = None
) -> Decorator:
    def make(function: Function) -> Any:
        function = typed(function) if typed else function
        term, wall = Term.of(function), Term.of(walls or function)
        into = module or wp.get_module(function.__module__)
        terms = {"_term": term, "_wall_term": wall, "_grown_term": wall if grows is None else grows.wall}
        functions = {name: wp.func(one.function, module=into) for name, one in terms.items()}
        made = summed(term.name, d, term.arrays, term.others, term.results, loops(term, wall), functions, into)
        made.term, made.wall = term, wall
        return made

    return make


def pair_sum(
    d: Discretisation, typed: Typed = None, walls: Any = None, ahead: bool = True, rubs: bool = False, grows: Any = None
) -> Decorator:
    """Return a decorator that turns the term of a pair into the Warp function of its sum over fluid and walls.

    ``walls`` is a separate term for walls. The parameters of ``walls`` must also be parameters of the fluid's term.
    With ``rubs``, walls with free slip are excluded. ``grows`` is used only for tangents with moving walls.
    """

    def loops(term: Term, wall: Term) -> str:
        own = term.arrays | term.others
        more = [name for name, kind in (wall.arrays | wall.others).items() if own.get(name) != kind]
        if wall.results != term.results or more:
            found = f"has {', '.join(more)}" if more else f"returns {wall.results}"
            raise TypeError(f"term {wall.name} of walls {found}, but must have results and parameters of {term.name}.")
        return over_fluid(term, d, ahead) + over_walls(wall, d, grows, RUBBING if rubs else ALL)

    return _summing(d, typed, loops, walls, grows=grows)


def fluid_sum(d: Discretisation, typed: Typed = None, ahead: bool = True, module: Any = None) -> Decorator:
    """Return a decorator that turns the term of a pair into its sum over fluid neighbours."""
    return _summing(d, typed, lambda term, _: over_fluid(term, d, ahead), module=module)


def image_sum(d: Discretisation, typed: Typed = None) -> Decorator:
    """Return a decorator that turns the term of a pair into its sum over the mirror images of the fluid."""
    return _summing(d, typed, lambda term, _: over_images(d, term.of_neighbours, _adding_up(term)))


def image_sum_of_solid(total: Any) -> Any:
    """The number ``solid`` is an additional argument before s."""
    d, body = total.discretisation, _adding_up(total.term, f"{OWNED} * ")
    others, loop = {**total.others, "solid": int}, over_images(d, total.arrays, body)
    scope = {"_term": wp.func(total.term.function, module=total.module)}
    return summed(total.key, d, total.arrays, others, total.results, loop, scope, total.module)


def rubbing_sum(d: Discretisation, sticks: bool, typed: Typed) -> Callable[..., Decorator]:
    """If ``sticks``, the sums include the friction of no-slip walls."""

    def summed(walls: Function, ahead: bool = True, grows: Any = None) -> Decorator:
        return pair_sum(d, typed, walls, ahead, rubs=True, grows=grows) if sticks else fluid_sum(d, typed, ahead)

    return summed


def wall_sum(d: Discretisation, typed: Typed = None, grows: Any = None, weight: str = ALL) -> Decorator:
    """``weight`` is the source text for the weight of a wall particle."""
    return _summing(d, typed, lambda _, wall: over_walls(wall, d, grows, weight), grows=grows)


def solid_sum(d: Discretisation, typed: Typed = None) -> Decorator:
    return wall_sum(d, typed, weight=f"wp.where(s.wall_solids[_b] == solid, {ALL}, _real(0.0))")


def mirror_sum(d: Discretisation, typed: Typed = None, grows: Any = None) -> Decorator:
    return wall_sum(d, typed, grows, f"wp.where(_mirrors_in(_b, mirrors, s), {ALL}, _real(0.0))")


def _adding_up(term: Term, weight: str = "") -> Body:
    return lambda of_j: _added("_term", term, weight, term.seen_from_i(of_j))


def _added(called: str, term: Term, weight: str, arguments: str) -> list[str]:
    numbers = range(len(term.results))
    call = f"{', '.join(f'_term_{n}' for n in numbers)} = {called}({arguments})"
    return [call, *(f"_total_{n} += {weight}_term_{n}" for n in numbers)]


@dataclass(frozen=True)
class ByHand:
    kind: str
    of: Any
    function: Any


BY_HAND: list[ByHand] = []


def _noted(kind: str, sum_of: Any) -> Callable[[Any], Any]:
    def note(function: Any) -> Any:
        BY_HAND.append(ByHand(kind, sum_of, function))
        return function

    return note


tangent_of, adjoint_of = partial(_noted, "tangent"), partial(_noted, "adjoint")
