"""Sums over neighbours, each made from the term of one pair (`cortado.particles.terms`).

    @pair_sum(discretisation)
    def force(x_ij: vector, c_i: real, c_j: real, s: neighbourhood) -> vector:
        return ((c_i + c_j) * slope(x_ij, s)) * x_ij

is the Warp function ``force(i, x, c, s)`` of particle i, the arrays x and c, and the neighbourhood s; parameters that
are the same for all neighbours stand between the arrays and s. A term that returns several things makes as many sums in
one loop. For a particle of a wall, which is at rest and has no pressure, all that has an index j is 0, and its term
counts w_b times; walls that act in another way have a term of their own.

With ``ahead=False`` entries of a neighbour are loaded when it is its turn, and not ahead of it. Loading ahead saves a
tenth of a step on a GPU, but is of little use where terms take longer than loads.
"""

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

from cortado.particles.neighbourhood import Discretisation
from cortado.particles.pair_loops import Body, over_fluid, over_images, over_walls, summed
from cortado.particles.terms import Term

Function = Callable[..., Any]
Decorator = Callable[[Function], Any]


def pair_sum(
    d: Discretisation, walls: Function | None = None, ahead: bool = True, rubs: bool = False, grows: Any = None
) -> Decorator:
    """A decorator that makes of a term the Warp function of its sum over fluid and walls. ``walls`` is the term of
    walls if they act in another way; its parameters are among those of the fluid's. A sum that ``rubs`` has nothing of
    walls that slip freely. A tangent is given the sum that it is of, which ``grows`` with the weights of walls: their
    tangents count as many times as the term of that."""

    def make(function: Function) -> Any:
        term, wall = Term.of(function), Term.of(walls or function)
        _check_walls(wall, term)
        return _made(term, d, _over_fluid(term, d, ahead) + _over_walls(wall, d, rubs, grows), wall, grows=grows)

    return make


def fluid_sum(d: Discretisation, ahead: bool = True, module: Any = None) -> Decorator:
    """As `pair_sum`, over the fluid alone. ``module`` is the Warp module of the function, if not that of the file."""

    def make(function: Function) -> Any:
        term = Term.of(function)
        return _made(term, d, _over_fluid(term, d, ahead), term, module)

    return make


def image_sum(d: Discretisation) -> Decorator:
    """As `fluid_sum`, over the images of the fluid in flat walls that mirror it (`cortado.particles.mirrors`)."""

    def make(function: Function) -> Any:
        term = Term.of(function)
        return _made(term, d, over_images(d, term.of_neighbours, _adding_up(term)), term)

    return make


def rubbing_sum(d: Discretisation, sticks: bool) -> Callable[..., Decorator]:
    """What gives the decorator of a sum over what the fluid rubs against, for the term of walls: `pair_sum` where some
    walls have no slip, and `fluid_sum` where all slip freely."""

    def summed(walls: Function, ahead: bool = True, grows: Any = None) -> Decorator:
        return pair_sum(d, walls, ahead, rubs=True, grows=grows) if sticks else fluid_sum(d, ahead)

    return summed


def wall_sum(d: Discretisation, grows: Any = None) -> Decorator:
    """As `pair_sum`, over the walls alone."""

    def make(function: Function) -> Any:
        term = Term.of(function)
        return _made(term, d, _over_walls(term, d, rubs=False, grows=grows), term, grows=grows)

    return make


def solid_sum(d: Discretisation) -> Decorator:
    """As `wall_sum`, over the walls of the one moving solid that the term's parameter ``solid`` is the number of."""

    def make(function: Function) -> Any:
        term = Term.of(function)
        return _made(term, d, _over_walls(term, d, rubs=False, of_one=True), term)

    return make


def _check_walls(wall: Term, term: Term) -> None:
    """Raises `TypeError` for a term of walls that does not fit that of the fluid."""
    more = [name for name, kind in (wall.arrays | wall.others).items() if (term.arrays | term.others).get(name) != kind]
    if wall.results != term.results or more:
        found = f"has {', '.join(more)}" if more else f"returns {wall.results}"
        raise TypeError(f"term {wall.name} of walls {found}, but must have results and parameters of {term.name}.")


def _adding_up(term: Term) -> Body:
    def body(of_j: Mapping[str, str]) -> list[str]:
        called = f"{_terms(term)} = _term({term.seen_from_i(of_j)})"
        return [called, *(f"_total_{n} += _term_{n}" for n in _numbers(term))]

    return body


def _over_fluid(term: Term, d: Discretisation, ahead: bool) -> str:
    knows = ("j" in term.parameters, "x_ij" in term.parameters)
    return over_fluid(d, term.of_neighbours, _adding_up(term), ahead, *knows)


def _over_walls(wall: Term, d: Discretisation, rubs: bool, grows: Any = None, of_one: bool = False) -> str:
    def body(of_b: Mapping[str, str]) -> list[str]:
        return [*added("_wall_term", wall, "_w_b", of_b), *growth(of_b)]

    def growth(of_b: Mapping[str, str]) -> list[str]:
        if grows is None or not d.moving:
            return []
        lines = added("_grown_term", grows.wall, "_w_b * _growth", of_b)
        return ["_growth = _wall_growth_dot(_b, s)", "if _growth != _real(0.0):", *(f"    {line}" for line in lines)]

    def added(called: str, term: Term, weight: str, of_b: Mapping[str, str]) -> list[str]:
        call = f"{_terms(term)} = {called}({term.seen_from_i(of_b, '-1')})"
        return [call, *(f"_total_{n} += {weight} * _term_{n}" for n in _numbers(term))]

    if "x_ij" not in wall.parameters:
        raise TypeError(f"term {wall.name} has no x_ij, but must have it where it is summed over walls.")
    return over_walls(d, wall.of_neighbours, body, wall.parameters, rubs, of_one)


def _terms(term: Term) -> str:
    return ", ".join(f"_term_{n}" for n in _numbers(term))


def _numbers(term: Term) -> range:
    return range(len(term.results))


def _made(term: Term, d: Discretisation, loops: str, wall: Term, module: Any = None, grows: Any = None) -> Any:
    module = module or wp.get_module(term.function.__module__)
    terms = {"_term": term, "_wall_term": wall, "_grown_term": wall if grows is None else grows.wall}
    functions = {name: wp.func(one.function, module=module) for name, one in terms.items()}
    made = summed(term.name, d, term.arrays, term.others, term.results, loops, functions, module)
    made.term, made.wall, made.discretisation = term, wall, d
    return made
