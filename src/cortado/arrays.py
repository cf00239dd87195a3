"""Convert numbers from users to float64 arrays, and check arguments."""

import math
from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from numbers import Real
from typing import Any

import numpy as np

from cortado.errors import InputError, Words, shown

REFUSED = {"c": "complex numbers", "b": "True and False", "U": "text", "S": "text", "M": "dates", "m": "spans of time"}
GREATEST_NUMBER = 10**18


def as_number(value: Any) -> float | None:
    """Return a finite number as a float, and None for any other value, such as a bool."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def as_numbers(what: str, value: Any) -> np.ndarray:
    """Convert real numbers to a float64 array, without a copy of float64 arrays."""
    try:
        array = np.asarray(value)
        kind = array.dtype.kind
        if _is_masked(value):
            found: Any = Words("partly masked")
        elif kind in "fiu" or (kind == "O" and all(map(_is_real, array.flat))):
            return np.asarray(array, dtype=np.float64)
        else:
            found = Words(f"made of {REFUSED[kind]}") if array.ndim and kind in REFUSED else value
    except Exception:  # whatever another library raises when it is asked for an array
        found = value
    listed = value if isinstance(value, (list, tuple)) else ()
    advice = ": make one with jax.numpy.stack" if any("Tracer" in type(one).__name__ for one in listed) else ""
    raise InputError(f"{what} is {shown(found)}, but must be a number or an array of real numbers{advice}.")


def is_same(one: np.ndarray, other: np.ndarray) -> bool:
    """Test if two arrays of one data type have equal shapes and equal bits."""
    return one.shape == other.shape and one.tobytes() == other.tobytes()


def as_precise_numbers(what: str, value: Any) -> np.ndarray:
    kind = str(getattr(value, "dtype", ""))
    if kind.endswith("float16"):  # bfloat16 too
        raise InputError(f"{what} is {kind}, but must be float32 or float64, as half precision rounds to three digits.")
    return as_numbers(what, value)


def read_only(what: str, value: Any) -> np.ndarray:
    array = as_numbers(what, value).copy()
    array.setflags(write=False)
    return array


def as_one_number(what: str, value: Any) -> float:
    array = as_numbers(what, value)
    if array.shape:
        raise InputError(f"{what} has shape {array.shape}, but must be one number.")
    return float(array)


def is_whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def require_whole(what: str, value: object, least: int) -> None:
    if not is_whole(value) or value < least:  # type: ignore[operator]
        raise InputError(f"{what} is {shown(value)}, but must be a whole number of at least {least}.")


def require_at_most(what: str, value: Any, most: int) -> None:
    if value > most:
        raise InputError(f"{what} is {shown(value)}, but must be at most {most:,}.")


def whole_number(what: str, value: Any, least: int) -> int:
    """Convert a whole number, such as 3 or 3.0, to an int."""
    whole = is_whole(value) or (isinstance(value, (float, np.floating)) and value.is_integer())
    if not whole or value < least:
        raise InputError(f"{what} is {shown(value)}, but must be a whole number of at least {least}.")
    if value > GREATEST_NUMBER:
        raise InputError(f"{what} is {shown(value)}, but must be at most {GREATEST_NUMBER:g}.")
    return int(value)


def require_function(what: str, value: Any, *arguments: str) -> None:
    if value is not None:
        require_arguments(what, value, arguments, "; or leave it out")


def require_arguments(what: str, function: Callable[..., Any], wanted: tuple[str, ...], other: str = "") -> None:
    """Raise `InputError` unless ``function`` takes the arguments ``wanted``. The error message ends with ``other``."""
    if not callable(function) or isinstance(function, type):
        said = f"{what} is {shown(function)}"
        raise InputError(f"{said}, but must be a function of {', '.join(wanted) or 'nothing'}{other}.")
    try:
        takes = signature(function)
    except (TypeError, ValueError):
        return
    try:
        takes.bind(*wanted)
    except TypeError:
        found = f"{what} takes the arguments {shown(str(takes))}"
        number = f"{len(wanted)}: {', '.join(wanted)}" if wanted else "none"
        raise InputError(f"{found}, but must take {number}{other}.") from None


def require_truth(what: str, value: object) -> None:
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{what} is {shown(value)}, but must be True or False.")


def require_methods(what: str, value: object, names: tuple[str, ...], wanted: str) -> None:
    """Raise `InputError` unless ``value`` has the methods ``names``. ``wanted`` describes a valid value."""
    if isinstance(value, type) or not all(callable(getattr(value, name, None)) for name in names):
        raise InputError(f"{what} is {shown(value)}, but must be {wanted}.")


def require_table(what: str, value: object, example: str) -> None:
    if not isinstance(value, Mapping):
        raise InputError(f"{what} is {shown(value)}, but must be a dictionary, such as {example}.")


def check_steps(steps: int, least: int = 1) -> int:
    return whole_number("steps", steps, least)


def check_step_numbers(steps: Iterable[int], most: int) -> list[int]:
    if not isinstance(steps, Iterable) or isinstance(steps, (str, bytes)):
        raise InputError(f"steps is {shown(steps)}, but must be a list of step numbers.")
    found = [whole_number("a number of steps", step, 0) for step in steps]
    for step in found:
        require_at_most("a number of steps", step, most)
    return found


def _is_masked(value: Any) -> bool:
    if isinstance(value, np.ma.MaskedArray):
        return bool(np.ma.is_masked(value))
    return isinstance(value, (list, tuple)) and any(map(_is_masked, value))


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def require_names(what: str, names: Any) -> list[Any]:
    if isinstance(names, (str, bytes)) or not isinstance(names, Iterable):
        raise InputError(f"{what} is {shown(names)}, but must be a list of names.")
    return list(names)


def unit(vector: np.ndarray) -> np.ndarray:
    """Scale a finite non-zero vector (d,) to length 1, without overflow or underflow."""
    size = np.linalg.norm(vector)
    if not 0.0 < size < np.inf:
        vector = vector / np.abs(vector).max()
        size = np.linalg.norm(vector)
    return np.asarray(vector / size)
