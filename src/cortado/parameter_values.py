"""Parameters by name: their units, shapes and ranges, and one sentence where a value is wrong. Without Warp.

n counts fluid particles in the order in which the scene lists them, d is the scene's dimension.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cortado.arrays import as_numbers
from cortado.errors import InputError, shown

Values = Mapping[str, Any]
Arrays = dict[str, np.ndarray]

UNITS = {
    "gravity": "m/s²",
    "tilt": "°",
    "initial_positions": "m",
    "initial_velocities": "m/s",
    "mass_fractions": "",
    "rest_density": "kg/m³",
    "viscosity": "Pa s",
    "time_step": "s",
    "mobility": "m²/s",
    "interface_width": "m",
    "nozzle_path": "m",
    "flow_rate": "m³/s",
    "colours": "",
}
"""Every parameter with its unit."""
NAMES = tuple(UNITS)
STATES = ("initial_positions", "initial_velocities", "mass_fractions")
"""Parameters that are the first state, in the order in which `State` keeps them."""
MATERIALS = ("rest_density", "viscosity")
"""Parameters of each phase: a number with one phase, else (phases,)."""
NUMBERS = ("time_step", "mobility", "interface_width", "flow_rate")
OF_EMITTER = ("nozzle_path", "flow_rate")
"""Parameters of scenes with an emitter."""
POSITIVE = ("rest_density", "time_step", "interface_width", "flow_rate")
"""Parameters that must be greater than 0."""
NOT_NEGATIVE = ("viscosity", "mobility")
SUM_TOLERANCE = 0.01
"""How far the mass fractions of a particle may add up to something else than 1: differences need some room."""
TABLES = ("gravity", "nozzle_path")
"""Parameters that are a vector for each step."""
OVER_TIME = (*TABLES, "tilt")
"""Parameters that may have a row for each step; a tilt takes the place of gravity."""


def parameter_shapes(name: str, steps: int, phases: int, positions: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The shapes that a parameter may have, () for a number, where positions are (n, d)."""
    n, d = positions
    if name in OVER_TIME:
        components = d - 1 if name == "tilt" else d
        return [(components,), (steps, components)] if steps > 0 else [(components,)]
    if name in MATERIALS:
        return [() if phases == 1 else (phases,)]
    several = {"mass_fractions": (n, phases), "colours": (phases, 3)}
    return [several.get(name, (n, d) if name in STATES else ())]


def checked_parameter(name: str, value: Any, shapes: list[tuple[int, ...]], what: str = "parameter") -> np.ndarray:
    """A value as a float64 array of one of the shapes, finite and in range, or an `InputError` in a sentence. A
    ``what`` of "direction" may be negative."""
    array = as_numbers(f"{what} {name}", value)
    unit = f" in {UNITS[name]}" if UNITS[name] else ""
    if array.shape not in shapes:
        raise InputError(f"{what} {name} has shape {array.shape}, but must be {' or '.join(map(str, shapes))}{unit}.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} {name} has a value that is not finite, but must be numbers{unit}.")
    if what != "direction":
        _check_range(name, array, what)
    return array


def _check_range(name: str, array: np.ndarray, what: str) -> None:
    if name in POSITIVE and (array <= 0.0).any():
        raise InputError(f"{what} {name} is {shown(float(array.min()))}, but must be greater than 0.")
    if name in NOT_NEGATIVE and (array < 0.0).any():
        raise InputError(f"{what} {name} is {shown(float(array.min()))}, but must be at least 0.")
    if name == "mass_fractions":
        miss = np.abs(array.sum(axis=1) - 1.0)
        if miss.max() > SUM_TOLERANCE:
            worst = int(miss.argmax())
            total = array[worst].sum()
            raise InputError(f"{what} mass_fractions of particle {worst} add up to {total:g}, but must to 1.")
