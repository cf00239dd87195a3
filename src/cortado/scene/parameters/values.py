"""Values of parameters as users write them: checked against the registry, with one sentence where one is wrong.

n counts fluid particles in the order in which the scene lists them, d is the scene's dimension. Without Warp.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, require_table
from cortado.errors import InputError, OutOfRangeError, shown
from cortado.scene.parameters.known import REGISTRY, Known
from cortado.scene.parameters.parameter import Axis, Range, Role, Source
from cortado.scene.parameters.registry import BY_NAME, names

Values = Mapping[str, Any]
Arrays = dict[str, np.ndarray]

NAMES = names()
"""Every parameter."""
UNITS = {name: parameter.unit for name, parameter in BY_NAME.items()}
"""Every parameter with its unit."""
OVER_TIME = names(axis=Axis.STEP)
"""Parameters that may have a row for each step; a tilt takes the place of gravity."""
SUM_TOLERANCE = 0.01
"""How far the mass fractions of a particle may add up to something else than 1: differences need some room."""


def scene_values(source: Source, known: Known = REGISTRY) -> Arrays:
    """Every parameter of the ``known`` that a scene has, as it has it, in the shape that a user would write; without a
    tilt, which is another way to write gravity."""
    phases, positions = len(source.scene.phase), source.positions.shape
    found = {}
    for name, parameter in known.items():
        if parameter.present(source.scene) and parameter.role not in (Role.VIEW, Role.CLOCK):
            shape = parameter.shapes(0, phases, positions)[0]
            found[name] = np.asarray(parameter.value(source), dtype=np.float64).reshape(shape)
    return found


def check_known(name: str, scene: Any, what: str = "parameter", known: Known = REGISTRY) -> None:
    """Whether there is such a parameter, and a scene has it; raises `InputError`."""
    if name not in known or known[name].role is Role.CLOCK:
        owner = str(name).rpartition(".")[0]
        if owner in (solid.name for solid in scene.solid if not solid.moves):
            wanted = 'only those whose motion is "path" or "free" have parameters'
            raise InputError(f"{what} {name!r} is unknown, as the solid {owner!r} is at rest: {wanted}.")
        present = [p.name for p in known.values() if p.present(scene) and p.role is not Role.CLOCK]
        raise InputError(f"{what} {name!r} is unknown, but must be one of {', '.join(present)} in this scene.")
    parameter = known[name]
    if not parameter.present(scene):
        raise InputError(f"{what} {name} is given, but must be left out, as the scene {parameter.absent}.")


def require_points(points: object) -> None:
    """Raises `InputError` unless these are parameters by name, of at least one point."""
    if not isinstance(points, Sequence) or isinstance(points, (str, bytes)) or not points:
        raise InputError(f"points is {shown(points)}, but must be a list of parameters by name.")
    for point in points:
        require_table("a point", point, "{'gravity': value}")


def is_too_small(array: np.ndarray, allowed: Range) -> bool:
    """Whether a number is below a range that begins at 0."""
    if allowed is Range.POSITIVE:
        return bool((array <= 0.0).any())
    return allowed is Range.NOT_NEGATIVE and bool((array < 0.0).any())


def checked_value(
    name: str, value: Any, shapes: list[tuple[int, ...]], what: str = "parameter", known: Known = REGISTRY
) -> np.ndarray:
    """A value as a float64 array of one of the shapes, finite and in range, or an `InputError` in a sentence: an
    `OutOfRangeError` where only the value is wrong. A ``what`` of "direction" may be negative."""
    array, parameter = as_numbers(f"{what} {name}", value), known[name]
    unit = f" in {parameter.unit}" if parameter.unit else ""
    if array.shape not in shapes:
        raise InputError(f"{what} {name} has shape {array.shape}, but must be {' or '.join(map(str, shapes))}{unit}.")
    if not np.isfinite(array).all():
        raise OutOfRangeError(f"{what} {name} has a value that is not finite, but must be numbers{unit}.")
    if what != "direction":
        _check_range(name, array, parameter.range, what)
    return array


def _check_range(name: str, array: np.ndarray, allowed: Range, what: str) -> None:
    if is_too_small(array, allowed):
        raise OutOfRangeError(f"{what} {name} is {shown(float(array.min()))}, but must be {allowed.value}.")
    if allowed is Range.FRACTIONS:
        totals = array.sum(axis=-1)
        worst = np.unravel_index(np.abs(totals - 1.0).argmax(), totals.shape)
        if abs(totals[worst] - 1.0) > SUM_TOLERANCE:
            place = f"particle {worst[-1]}" + (f" of scene {worst[0]}" if totals.ndim > 1 else "")
            raise OutOfRangeError(f"{what} {name} of {place} add up to {totals[worst]:g}, but must to 1.")


def stacked(tables: Sequence[Arrays]) -> Arrays:
    """Arrays of the same names with a first axis for each of the tables."""
    return {name: np.stack([one[name] for one in tables]) for name in tables[0]}


def entry(arrays: Arrays, number: int) -> Arrays:
    """One entry of the first axis of each array."""
    return {name: array[number] for name, array in arrays.items()}
