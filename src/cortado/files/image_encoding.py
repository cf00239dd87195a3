"""Encode linear images as 8-bit sRGB (IEC 61966-2-1), and as PNG files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from io import BytesIO
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.arrays import as_numbers
from cortado.errors import InputError

ROWS = 32
MOST_LIGHT = 2.0
"""A larger value in a user's linear picture probably means that the picture has byte values from 0 to 255."""
STEPS = 1 << 14
"""Number of intervals of linear light from 0 to 1. Each interval contains at most one boundary between byte values."""
LIGHT = "linear light from 0 to 1, as that of cortado.pictures.read_picture"


def check_light(what: str, image: ArrayLike) -> None:
    if np.asarray(image).dtype.kind in "iu":
        raise InputError(f"{what} is made of whole numbers, but must be {LIGHT}.")
    light = as_numbers(what, image)
    furthest = light.flat[np.abs(light).argmax()]
    if abs(furthest) > MOST_LIGHT:
        raise InputError(f"{what} has a value of {furthest:g}, but must be {LIGHT}.")


def to_srgb(image: ArrayLike, each: Callable[..., Iterable[Any]] = map) -> NDArray[np.uint8]:
    """Return the sRGB bytes of a linear image (rows, columns, 3), clipped to the range from 0 to 1. ``each`` is a
    function like `map`, which may convert parts of the image in parallel."""
    light = image if isinstance(image, np.ndarray) and image.dtype == np.float32 else as_numbers("The image", image)
    if light.ndim != 3 or light.shape[2] != 3 or not light.size:
        raise InputError(f"The image has shape {light.shape}, but must be (rows, columns, 3).")
    found = np.empty(light.shape, dtype=np.uint8)

    def convert(row: int) -> None:
        found[row : row + ROWS] = srgb_bytes(light[row : row + ROWS])

    for _ in each(convert, range(0, len(light), ROWS)):
        pass
    return found


def srgb_bytes(light: NDArray[Any]) -> NDArray[np.uint8]:
    if not np.isfinite(light).all():
        raise InputError("The image has values that are not finite; check how it was computed.")
    light = np.clip(light, light.dtype.type(0.0), light.dtype.type(1.0))
    bounds, values = _steps(light.dtype)
    steps = (light.dtype.type(STEPS) * light).astype(np.uint16)
    found = values.take(steps, mode="clip")  # all are there, and unchecked
    found += light >= bounds.take(found, mode="clip")  # at most one value begins within a step
    return found


@cache
def _steps(dtype: np.dtype[Any]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Return the least linear light that gives each byte value (256,). Also return the byte value at the start of each
    interval (STEPS + 1,)."""
    middles = (np.arange(1, 257) - 0.5) / 255.0
    exact = np.where(middles <= 0.04045, middles / 12.92, ((middles + 0.055) / 1.055) ** 2.4)
    rounded = exact.astype(dtype)
    bounds = np.where(rounded < exact, np.nextafter(rounded, dtype.type(2.0)), rounded)
    return bounds, np.searchsorted(bounds, np.arange(STEPS + 1) / STEPS, side="right").astype(np.uint8)


def from_srgb(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    curved = values / 255.0
    return np.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)


def png(image: ArrayLike) -> bytes:
    """Return an 8-bit sRGB PNG file of a linear image (rows, columns, 3)."""
    from PIL import Image

    pixels, content = to_srgb(image), BytesIO()
    check_light("The image", image)
    Image.fromarray(pixels).save(content, format="PNG")
    return content.getvalue()


class ShadedPicture(np.ndarray):
    """A linear picture (rows, columns, 3) with values from 0 to 1. Notebooks show this NumPy array as a picture. Use
    `cortado.pictures.write_picture` to save the picture."""

    @classmethod
    def of(cls, image: ArrayLike) -> Self:
        return np.asarray(image).view(cls)

    def _repr_png_(self) -> bytes | None:
        return png(self) if self.ndim == 3 and self.shape[2] == 3 else None
