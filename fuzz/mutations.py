"""Changes of a scene or a task as a dictionary, each in place and with words that say what was done."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

from fuzz import oddities
from fuzz.bases import Tables
from fuzz.oddities import Random

Path = tuple[str | int, ...]
Mutation = Callable[[Tables, Sequence[Tables], Random], str | None]
"""Changes tables, given others to take from; None where the tables have nothing that it could change."""

LENGTHS = ("lower", "upper", "centre", "base", "outlet", "radius", "height", "length", "position", "look_at")
"""Keys of what is measured in metres."""
EDGES: Mapping[str, Sequence[Any]] = {
    "support": (1.2, 4.0, 1.1999, 4.0001),
    "dimension": (2, 3, 1, 4),
    "minimum_iterations": (1, 50, 1000, 0),
    "maximum_iterations": (1, 3, 1000, 0),
    "resolution": ([1, 1], [1, 64], [4096, 1], [0, 1], [16]),
    "field_of_view": (170.0, 1e-3, 180.0),
    "frames": (1, 4, 5),
    "steps": (0, 1, 2, 7),
    "knots": (2, 4, 5),
    "colour": ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0000001]),
    "strength": (1.0, 0.0, 0.5),
    "samples": (1, 4, 5, 6),
    "iterations": (1, 3, 0),
    "learning_rate": (1e-12, 1.0, 100.0, 1e30),
    "extinction_schedule": ([0.5, 1.0], [1.0], [1.0, 0.5]),
    "gravity": ([0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1e4], [0.0, -1e4, 0.0]),
    "viscosity": (0.0, 1e3, "none", "laminar", "pairwise", [0.1]),
    "kernel": ("cubic_spline", "wendland_c2", "wendland_c4"),
    "optimiser": ("adam", "gradient_descent", "lbfgs"),
    "name": ("exact", "adjoint_viscosity", "water"),
    "periodic": ([True, True], [True, False, True], [False, False, True]),
    "pressure": (False,),
    "lid": (False, True),
    "shape": ("box", "sphere", "cylinder", "points", "none"),
    "view": ("top", "plane", "volume"),
    "distance": ("pyramid", "squared_difference"),
    "loss": ("positions", "image"),
}
"""By key: values at the edge of what is allowed, on both sides of it."""


def mutate(tables: Tables, others: Sequence[Tables], random: Random) -> list[str]:
    """Change tables in one to three ways; returns what was done."""
    done: list[str] = []
    count = int(random.choice([1, 1, 1, 2, 3]))
    while len(done) < count:
        mutation = _any(MUTATIONS, random)
        words = mutation(tables, others, random)
        if words is not None:
            done.append(words)
    return done


def _odd_value(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any(_paths(tables), random)
    return None if path is None else _replace(tables, path, oddities.value(random))


def _odd_number(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any([path for path, value in _leaves(tables) if _is_number(value)], random)
    return None if path is None else _replace(tables, path, oddities.number(random))


def _scaled(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    """A number is multiplied: mostly by a little, as someone does who looks for what is possible."""
    path = _any([path for path, value in _leaves(tables) if _is_number(value)], random)
    if path is None:
        return None
    factor = float(random.choice([-1.0, 1e-3, 0.1, 0.5, 0.7, 0.9, 0.99, 1.01, 1.1, 1.5, 2.0, 3.0, 10.0, 1000.0]))
    return _replace(tables, path, _times(_get(tables, path), factor))


def _other_unit(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    """Milliseconds for seconds, millimetres for metres, or a place that is metres away."""
    kind = random.integers(4)
    if kind == 0:
        return _multiply(tables, ("time_step",), float(random.choice([0.1, 2.0, 10.0, 1000.0])))
    if kind == 1:
        return _multiply(tables, ("gravity",), 1000.0)
    if kind == 2:
        keys = (*LENGTHS, "spacing") if random.random() < 0.5 else LENGTHS
        return _multiply(tables, keys, float(random.choice([1e-3, 1000.0])))
    return _move(tables, float(random.choice([0.3, 5.0, 1e4, 1e7])))


def _deleted(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any(_paths(tables), random)
    if path is None:
        return None
    del _get(tables, path[:-1])[path[-1]]
    return f"{_name(path)} deleted"


def _renamed(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any([path for path in _paths(tables) if isinstance(path[-1], str)], random)
    if path is None:
        return None
    key = str(path[-1])
    new = [key.upper(), key + "s", key[:-1], key[1:], key.replace("_", "-"), " " + key, oddities.text(random)]
    name, holder = _any(new, random), _get(tables, path[:-1])
    holder[name] = holder.pop(key)
    return f"{_name(path)} renamed to {name[:40]!r}"


def _unknown_key(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    holders = [(), *(path for path in _paths(tables) if isinstance(_get(tables, path), dict))]
    path = _any(holders, random)
    key = str(random.choice(["density", "surface_tension", "Time_step", "problem", "target", "x"]))
    _get(tables, path or ())[key] = oddities.value(random)
    return f"{_name((*(path or ()), key))} added"


def _other_length(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any([path for path in _paths(tables) if isinstance(_get(tables, path), list)], random)
    if path is None:
        return None
    value = _get(tables, path)
    changed = [value[:-1], value + value[-1:], [], value * 2, [value], value[::-1]]
    return _replace(tables, path, _any(changed, random))


def _at_an_edge(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    path = _any([path for path in _paths(tables) if path[-1] in EDGES], random)
    if path is None:
        return None
    values = EDGES[str(path[-1])]
    return _replace(tables, path, _any(values, random))


def _table_of_another(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    """Two files that are right, put together."""
    other = _any(others, random)
    key = _any(sorted(other), random)
    if key is None:
        return None
    both = isinstance(other[key], list) and isinstance(tables.get(key), list) and random.random() < 0.5
    tables[key] = [*tables[key], *other[key]] if both else other[key]
    return f"{key} {'with that' if both else 'taken'} of {other.get('name')!r}"


def _swapped(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    paths = [path for path, _ in _leaves(tables)]
    first, second = _any(paths, random), _any(paths, random)
    if first is None or second is None or first == second:
        return None
    one, two = _get(tables, first), _get(tables, second)
    _get(tables, first[:-1])[first[-1]], _get(tables, second[:-1])[second[-1]] = two, one
    return f"{_name(first)} and {_name(second)} swapped"


def _other_kind(tables: Tables, others: Sequence[Tables], random: Random) -> str | None:
    """The same in another type: "0.1", [0.1], {x = 0.1}."""
    path = _any(_paths(tables), random)
    if path is None:
        return None
    value = _get(tables, path)
    made: list[Any] = [[value], {"x": value}, True]
    if isinstance(value, list):
        made.append({str(index): entry for index, entry in enumerate(value)})
    elif not isinstance(value, dict):
        made.append(str(value))
    return _replace(tables, path, made[random.integers(len(made))])


MUTATIONS: tuple[Mutation, ...] = (
    _odd_value,
    _odd_number,
    _scaled,
    _scaled,
    _scaled,
    _other_unit,
    _other_unit,
    _deleted,
    _renamed,
    _unknown_key,
    _other_length,
    _at_an_edge,
    _at_an_edge,
    _at_an_edge,
    _table_of_another,
    _table_of_another,
    _swapped,
    _other_kind,
)


def _paths(value: Any, above: Path = ()) -> list[Path]:
    """Where everything in tables and lists is, in the order of the file."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found: list[Path] = []
    for key, entry in entries:
        found += [(*above, key), *_paths(entry, (*above, key))]
    return found


def _leaves(tables: Tables) -> list[tuple[Path, Any]]:
    """Values that are neither tables nor lists."""
    return [(path, value) for path in _paths(tables) if not isinstance(value := _get(tables, path), (dict, list))]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _times(value: int | float, factor: float) -> int | float:
    """A product, whole where it can be if the value is."""
    product = float(max(min(value, 10**300), -(10**300))) * factor if isinstance(value, int) else value * factor
    return int(product) if isinstance(value, int) and product.is_integer() else product


def _get(tables: Any, path: Path) -> Any:
    for key in path:
        tables = tables[key]
    return tables


def _any(choices: Sequence[Any], random: Random) -> Any:
    return choices[int(random.integers(len(choices)))] if choices else None


def _name(path: Path) -> str:
    return ".".join(map(str, path))[:80]


def _replace(tables: Tables, path: Path, value: Any) -> str:
    old = _get(tables, path)
    _get(tables, path[:-1])[path[-1]] = deepcopy(value)  # as later mutations change it in place
    return f"{_name(path)}: {_short(old)} -> {_short(value)}"


def _short(value: Any) -> str:
    if isinstance(value, int) and abs(value) > 10**30:
        return "a long number"
    text = repr(value)
    return text if len(text) <= 50 else f"{text[:50]}..."


def _multiply(tables: Tables, keys: Sequence[str], factor: float) -> str | None:
    """All numbers under these keys, wherever they are."""
    paths = [path for path, value in _leaves(tables) if _is_number(value) and set(path) & set(keys)]
    for path in paths:
        _get(tables, path[:-1])[path[-1]] = _times(_get(tables, path), factor)
    return f"{', '.join(keys[:2])} x {factor:g}" if paths else None


def _move(tables: Tables, distance: float) -> str:
    """Everything that has a place is moved along the first axis: a scene far from the origin."""
    for path, value in _leaves(tables):
        if path[-1] == 0 and len(path) > 1 and path[-2] in LENGTHS and _is_number(value):
            _get(tables, path[:-1])[0] = value + distance
    return f"moved by {distance:g} m"
