"""Losses that compare an image (rows, columns, 3) with a target image, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.arrays import as_numbers, require_whole
from cortado.calls import face
from cortado.errors import InputError

__all__ = ["ImageLoss", "Pyramid", "SquaredDifference", "psnr"]

Image = NDArray[np.float64]
"""A linear RGB picture (rows, columns, 3)."""
SMALLEST = 2


class ImageLoss(Protocol):
    """Protocol of a differentiable loss that compares an image with a target image."""

    @property
    def fingerprint(self) -> str:
        """Return a text that identifies the loss and its settings, for checkpoints."""

    def value(self, image: ArrayLike, target: ArrayLike) -> float:
        """Return the loss of an image (rows, columns, 3)."""

    def adjoint(self, image: ArrayLike, target: ArrayLike) -> Image:
        """Return the gradient of the loss with respect to the image (rows, columns, 3)."""


@dataclass(frozen=True)
class SquaredDifference:
    """An image loss: the mean over pixels and channels of the squared difference.

    If a shape does not overlap its target, the gradient does not move the shape towards the target: use `Pyramid`.

    Example: ``loss = cortado.losses.Image(renderer, target, cortado.image_losses.SquaredDifference())``
    """

    @property
    def fingerprint(self) -> str:
        return "squared difference"

    def value(self, image: ArrayLike, target: ArrayLike) -> float:
        return float(np.mean(_difference(image, target) ** 2))

    def adjoint(self, image: ArrayLike, target: ArrayLike) -> Image:
        difference = _difference(image, target)
        return 2.0 / difference.size * difference


@dataclass(frozen=True)
class Pyramid:
    """An image loss: a weighted sum of mean squared differences at levels of a Gaussian pyramid (Burt & Adelson 1983).

    The first level is the image. Each further level is the previous level, blurred and halved in size. Coarse levels
    locate a shape that does not overlap its target. Fine levels compare outlines.

    ``levels`` is the number of levels. ``weights`` (levels,) go from fine to coarse, by default 1, 2, 4 ...

    Example: ``loss = cortado.losses.Image(renderer, target, cortado.image_losses.Pyramid())``
    """

    levels: int | None = None
    """Number of levels. The default is the number of weights, or levels down to at most 2 x 2 pixels."""
    weights: tuple[float, ...] | None = None
    """Weights of the levels (levels,) from fine to coarse. Weights should increase, as blur makes shapes fainter."""

    def __post_init__(self) -> None:
        if self.levels is not None:
            require_whole("levels", self.levels, 1)
        if self.weights is None:
            return
        numbers = np.atleast_1d(as_numbers("weights", self.weights))
        if numbers.ndim != 1:
            raise InputError(f"weights has shape {numbers.shape}, but must have one number for each level.")
        weights = tuple(numbers.tolist())
        object.__setattr__(self, "weights", weights)
        if not (np.isfinite(weights).all() and min(weights, default=-1.0) >= 0.0 and max(weights) > 0.0):
            raise InputError(f"weights is {weights}, but must be finite, not negative and not all zero.")
        if self.levels not in (None, len(weights)):
            raise InputError(f"There are {len(weights)} weights for {self.levels} levels; give one for each level.")

    @property
    def fingerprint(self) -> str:
        return f"pyramid, levels {self.levels}, weights {self.weights}"

    def value(self, image: ArrayLike, target: ArrayLike) -> float:
        return sum(weight * float(np.mean(level**2)) for weight, level in self._weighted_levels(image, target))

    def adjoint(self, image: ArrayLike, target: ArrayLike) -> Image:
        bar = None
        for weight, level in reversed(self._weighted_levels(image, target)):
            bar = np.zeros_like(level) if bar is None else reduce_transposed(bar, level.shape[:2])
            bar += 2.0 * weight / level.size * level
        assert bar is not None
        return bar

    def _weighted_levels(self, image: ArrayLike, target: ArrayLike) -> list[tuple[float, Image]]:
        wanted = self.levels or (len(self.weights) if self.weights else None)
        levels = [_difference(image, target)]
        while len(levels) < wanted if wanted else max(levels[-1].shape[:2]) > SMALLEST:
            levels.append(reduce(levels[-1]))
        return list(zip(self.weights or [2.0**k for k in range(len(levels))], levels, strict=True))


def psnr(image: ArrayLike, target: ArrayLike) -> float:
    """Return the peak signal-to-noise ratio [dB] for a peak of 1. The ratio is infinite if the images are equal.

    ``image`` and ``target`` are linear pictures (rows, columns, 3).

    Example: ``print(cortado.image_losses.psnr(renderer.render(frame), target))``
    """
    error = SquaredDifference().value(image, target)
    return float(-10.0 * np.log10(error)) if error > 0.0 else float("inf")


def reduce(image: Image) -> Image:
    """Return the next coarser level of a Gaussian pyramid (ceil(rows / 2), ceil(columns / 2), 3)."""
    return _along_columns(_along_rows(image, reduction(image.shape[0])), reduction(image.shape[1]))


def reduce_transposed(bar: Image, shape: tuple[int, ...]) -> Image:
    """Apply the transpose of `reduce` to an image ``bar``. The result has the ``shape`` (rows, columns)."""
    rows, columns = shape
    return _along_rows(_along_columns(bar, reduction(columns).T), reduction(rows).T)


@lru_cache(maxsize=64)
def reduction(size: int) -> Any:
    """Return a sparse matrix (ceil(size / 2), size) that blurs a line of pixels and keeps every second pixel.

    For an odd size, Burt and Adelson's weights 1 4 6 4 1 are centred on every second pixel, beginning with the first.
    For an even size, the weights of pixels are 1 3 3 1. At an edge the weights are normalised: a constant image remains
    constant.
    """
    from scipy.sparse import csr_array

    first, binomial = (-2, (1.0, 4.0, 6.0, 4.0, 1.0)) if size % 2 else (-1, (1.0, 3.0, 3.0, 1.0))
    rows, offsets = np.mgrid[: (size + 1) // 2, first:3]
    columns = 2 * rows + offsets
    there = (columns >= 0) & (columns < size)
    weights = np.where(there, binomial, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    return csr_array((weights[there], (rows[there], columns[there])), shape=(len(rows), size))


def _along_rows(image: Image, matrix: Any) -> Image:
    rows, columns, channels = image.shape
    return (matrix @ image.reshape(rows, columns * channels)).reshape(-1, columns, channels)


def _along_columns(image: Image, matrix: Any) -> Image:
    return _along_rows(image.swapaxes(0, 1), matrix).swapaxes(0, 1)


def _difference(image: ArrayLike, target: ArrayLike) -> Image:
    image, target = as_numbers("The image", image), as_numbers("The target", target)
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"The image has shape {image.shape}, but must be (rows, columns, 3).")
    if image.shape != target.shape:
        raise InputError(f"The image has shape {image.shape}, but must have the target's shape {target.shape}.")
    return image - target


__dir__ = face(globals())
