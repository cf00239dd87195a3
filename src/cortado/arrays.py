"""Numbers that a user gives in whatever form, as arrays in float64."""

from numbers import Real
from typing import Any

import numpy as np

from cortado.errors import InputError, Words, shown

REFUSED = {
    "c": "complex numbers",
    "b": "True and False",
    "U": "text",
    "S": "text",
    "M": "dates",
    "m": "spans of time",
}
"""What an array holds whose entries are not real numbers, by the kind of its type."""


def as_numbers(what: str, value: Any) -> np.ndarray:
    """A real number or an array of them in float64, or an `InputError` in a sentence that begins with ``what``.

    Takes whatever NumPy makes an array of: numbers, lists, arrays of other libraries. An array of float64 is not
    copied. Complex numbers, text, truth values and masked entries are refused, as NumPy would convert them without a
    word, and drop what they say.
    """
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
    raise InputError(f"{what} is {shown(found)}, but must be a number or an array of real numbers.")


def as_one_number(what: str, value: Any) -> float:
    """A real number, or an `InputError` in a sentence that begins with ``what``; an array of shape () is one."""
    array = as_numbers(what, value)
    if array.shape:
        raise InputError(f"{what} has shape {array.shape}, but must be one number.")
    return float(array)


def is_whole(value: object) -> bool:
    """Whether a value is a whole number, of Python or of NumPy; a truth value is none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _is_masked(value: Any) -> bool:
    """Whether entries are masked, of a masked array or of a list with masked arrays in it."""
    if isinstance(value, np.ma.MaskedArray):
        return bool(np.ma.is_masked(value))
    return isinstance(value, (list, tuple)) and any(map(_is_masked, value))


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
