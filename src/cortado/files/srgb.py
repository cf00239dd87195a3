"""Linear light and what files and screens hold: eight bits of sRGB (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.arrays import as_numbers
from cortado.errors import InputError

MOST_LIGHT = 2.0
"""Of a picture that somebody gives: more is taken for values of a file, up to 255; noise may leave 0 to 1."""
LIGHT = "linear light from 0 to 1, as that of cortado.pictures.read_picture"


def check_light(what: str, image: ArrayLike) -> None:
    """Raises `InputError`, in a sentence that begins with ``what``, for a picture of numbers with the values of a
    file."""
    if np.asarray(image).dtype.kind in "iu":
        raise InputError(f"{what} is made of whole numbers, but must be {LIGHT}.")
    light = as_numbers(what, image)
    furthest = light.flat[np.abs(light).argmax()]
    if abs(furthest) > MOST_LIGHT:
        raise InputError(f"{what} has a value of {furthest:g}, but must be {LIGHT}.")


def to_srgb(image: ArrayLike) -> NDArray[np.uint8]:
    """(rows, columns, 3) in 0..255, of a linear image of that shape; light below 0 and above 1 is clipped.

    Raises:
        InputError: another shape, or values that are not finite.
    """
    linear = as_numbers("The image", image)
    if linear.ndim != 3 or linear.shape[2] != 3 or not linear.size:
        raise InputError(f"The image has shape {linear.shape}, but must be (rows, columns, 3).")
    if not np.isfinite(linear).all():
        raise InputError("The image has values that are not finite; look where it was computed.")
    linear = np.clip(linear, 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * curved).astype(np.uint8)


def from_srgb(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Linear light from 0 to 1, of values in 0..255 of any shape."""
    curved = values / 255.0
    return np.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)
