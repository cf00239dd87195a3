"""Linear light and what files and screens hold: eight bits of sRGB (IEC 61966-2-1)."""

from collections.abc import Callable, Iterable
from functools import cache
from io import BytesIO
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.arrays import as_numbers
from cortado.errors import InputError

ROWS = 32
"""Of a picture that are converted at a time, whose numbers stay near the processor."""
MOST_LIGHT = 2.0
"""Of a picture that somebody gives: more is taken for values of a file, up to 255; noise may leave 0 to 1."""
STEPS = 1 << 14
"""Equal parts of the light from 0 to 1, short against what one of 256 values stands for."""
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


def to_srgb(image: ArrayLike, each: Callable[..., Iterable[Any]] = map) -> NDArray[np.uint8]:
    """(rows, columns, 3) in 0..255, of a linear image of that shape; light below 0 and above 1 is clipped. ``each``:
    what does something for each of many parts, such as ``map`` of an executor, whose threads share them.

    Raises:
        InputError: another shape, or values that are not finite.
    """
    light = image if isinstance(image, np.ndarray) and image.dtype == np.float32 else as_numbers("The image", image)
    if light.ndim != 3 or light.shape[2] != 3 or not light.size:
        raise InputError(f"The image has shape {light.shape}, but must be (rows, columns, 3).")
    found = np.empty(light.shape, dtype=np.uint8)

    def convert(row: int) -> None:
        found[row : row + ROWS] = _values(light[row : row + ROWS])

    for _ in each(convert, range(0, len(light), ROWS)):
        pass
    return found


def _values(light: NDArray[Any]) -> NDArray[np.uint8]:
    if not np.isfinite(light).all():
        raise InputError("The image has values that are not finite; look where it was computed.")
    light = np.clip(light, light.dtype.type(0.0), light.dtype.type(1.0))
    bounds, values = _steps(light.dtype)
    steps = (light.dtype.type(STEPS) * light).astype(np.uint16)
    found = values.take(steps, mode="clip")  # all are there, and unchecked
    found += light >= bounds.take(found, mode="clip")  # at most one value begins within a step
    return found


@cache
def _steps(dtype: np.dtype[Any]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """(256,) the least light for which each next value is the nearest, and (STEPS + 1,) the value where a step
    begins."""
    middles = (np.arange(1, 257) - 0.5) / 255.0
    exact = np.where(middles <= 0.04045, middles / 12.92, ((middles + 0.055) / 1.055) ** 2.4)
    rounded = exact.astype(dtype)
    bounds = np.where(rounded < exact, np.nextafter(rounded, dtype.type(2.0)), rounded)
    return bounds, np.searchsorted(bounds, np.arange(STEPS + 1) / STEPS, side="right").astype(np.uint8)


def from_srgb(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Linear light from 0 to 1, of values in 0..255 of any shape."""
    curved = values / 255.0
    return np.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)


def png(image: ArrayLike) -> bytes:
    """The bytes of a PNG file with 8 bits of sRGB, of a linear image (rows, columns, 3), clipped to 0..1; errors as of
    `to_srgb` and `check_light`."""
    from PIL import Image

    pixels, content = to_srgb(image), BytesIO()
    check_light("The image", image)
    Image.fromarray(pixels).save(content, format="PNG")
    return content.getvalue()


class ShadedPicture(np.ndarray):
    """A picture (rows, columns, 3), linear from 0 to 1: an array that a notebook shows as a picture."""

    @classmethod
    def of(cls, image: ArrayLike) -> Self:
        """A view of the same numbers."""
        return np.asarray(image).view(cls)

    def _repr_png_(self) -> bytes | None:
        """The PNG of it; None for a part of another shape, such as one row."""
        return png(self) if self.ndim == 3 and self.shape[2] == 3 else None
