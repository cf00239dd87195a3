"""How far the picture of a state is from a target picture."""

from hashlib import sha256
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.arrays import read_only, require_methods
from cortado.device.threads import WARP
from cortado.errors import InputError
from cortado.files.srgb import LIGHT, check_light
from cortado.fixed import fixed
from cortado.losses.image_losses import ImageLoss, SquaredDifference
from cortado.losses.loss import Snapshot, SnapshotAdjoint


class Pictures(Protocol):
    """What makes pictures, such as `cortado.render.renderer.Renderer`."""

    def render(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> np.ndarray:
        """The picture (rows, columns, 3)."""

    def adjoint(self, image_bar: np.ndarray) -> Any:
        """``positions``, ``fractions`` and ``colours``: derivatives of a function of the last picture."""


@fixed
class Image:
    """How far the picture of a state is from a target picture."""

    def __init__(self, renderer: Pictures, target: np.ndarray, distance: ImageLoss | None = None):
        """``target`` (rows, columns, 3), linear RGB from 0 to 1; ``distance``:
        `cortado.image_losses.SquaredDifference`, the default, or `Pyramid`, whose gradient leads shapes to each other
        that do not overlap. Raises `InputError` for a target of another shape, or with values of a file up to 255."""
        require_methods("renderer", renderer, ("render", "adjoint"), "an object such as Simulation.renderer() gives")
        self.renderer, self.distance = renderer, _distance(distance)
        self.target = _target_image(target, getattr(renderer, "shape", None))
        parts = (self.distance.fingerprint, sha256(self.target.tobytes()).hexdigest())
        self.fingerprint = " ".join((*parts, getattr(renderer, "fingerprint", "")))
        """Tells one target, or one view of it, from another, for checkpoints."""

    def image(self, end: Snapshot) -> np.ndarray:
        """The picture (rows, columns, 3) of a state."""
        return self.renderer.render(end.state.positions, end.state.mass_fractions, end.colours)

    @WARP
    def value(self, end: Snapshot) -> float:
        return self.distance.value(self.image(end), self.target)

    @WARP
    def value_and_adjoint(self, end: Snapshot) -> tuple[float, SnapshotAdjoint]:
        image = self.image(end)
        found = self.renderer.adjoint(self.distance.adjoint(image, self.target))
        bar = end.state.like()
        wp.copy(bar.positions, found.positions)
        wp.copy(bar.mass_fractions, found.fractions)
        return self.distance.value(image, self.target), SnapshotAdjoint(bar, found.colours)


def _distance(distance: Any) -> ImageLoss:
    if distance is None:
        return SquaredDifference()
    require_methods("distance", distance, ("value", "adjoint"), "an object such as cortado.image_losses.Pyramid()")
    return distance


def _target_image(target: Any, shape: tuple[int, int, int] | None) -> np.ndarray:
    """A copy (rows, columns, 3) in float64, or an `InputError`; ``shape``: of the renderer's pictures, if known."""
    image = read_only("target", target)
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"target has shape {image.shape}, but must be a picture (rows, columns, 3).")
    if shape is not None and image.shape != shape:
        raise InputError(f"target has shape {image.shape}, but must have that of the renderer's pictures, {shape}.")
    if not np.isfinite(image).all():
        raise InputError("target has a value that is not finite, but must be made of finite numbers.")
    check_light("target", target)
    if image.min() < 0.0:
        raise InputError(f"target has a value of {image.min():g}, but must be {LIGHT}; clip noise at 0.")
    return image
