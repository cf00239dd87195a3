"""What a rollout is judged by: objects with a value and an adjoint at the end of the trajectory, or on the way."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.arrays import as_numbers
from cortado.errors import InputError, shown
from cortado.image_losses import ImageLoss, SquaredDifference
from cortado.launching import launch, sum_of
from cortado.particles import State, to_device
from cortado.physics.matching import matching_kernels
from cortado.precision import FLOAT32, FLOAT64, Precision
from cortado.threads import WARP
from cortado.words import counted

__all__ = [
    "CentreOfMass",
    "CentreOfMassAlong",
    "EndAdjoint",
    "FinalPositions",
    "Frames",
    "Image",
    "Loss",
    "Recorded",
    "TrajectoryEnd",
]


@dataclass(frozen=True)
class TrajectoryEnd:
    """A state of a rollout, the last one as a rule, as NumPy arrays or as Warp arrays, in the scene's order."""

    state: State
    """Warp arrays (n,): positions [m], velocities [m / s], mass fractions [-]."""
    dimension: int
    colours: np.ndarray
    """(phases, 3) of the phases: red, green and blue, linear, from 0 to 1."""

    def __repr__(self) -> str:
        return f"TrajectoryEnd({counted(len(self.state.positions), 'particle')}, {self.precision.name})"

    @property
    def precision(self) -> Precision:
        """Of the Warp arrays."""
        return FLOAT64 if self.state.positions.dtype == FLOAT64.vector else FLOAT32

    @cached_property
    def positions(self) -> np.ndarray:
        """(n, d) [m], float64"""
        return self.state.positions.numpy()[:, : self.dimension].astype(np.float64)

    @cached_property
    def velocities(self) -> np.ndarray:
        """(n, d) [m / s], float64"""
        return self.state.velocities.numpy()[:, : self.dimension].astype(np.float64)

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        """(n, phases) [-], float64"""
        return self.state.mass_fractions.numpy().astype(np.float64)


@dataclass(frozen=True, repr=False)
class EndAdjoint:
    """Derivatives of a loss that also looks at the colours."""

    state: State
    """With respect to positions, velocities and mass fractions, as Warp arrays."""
    colours: np.ndarray
    """(phases, 3)"""


Adjoint = State | EndAdjoint | tuple[np.ndarray, ...]
"""Derivatives of a loss with respect to positions and velocities, (n, d) each, and, if there is a third array, mass
fractions (n, phases); or as Warp arrays."""


class Loss(Protocol):
    """A differentiable number of the end of a trajectory.

    A loss of your own may have a method ``adjoint(end)`` in the place of `value_and_adjoint`.
    """

    def value(self, end: TrajectoryEnd) -> float:
        """The loss."""

    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, Adjoint]:
        """The loss and its derivatives, which share what both need."""


class Frames:
    """The sum of losses of several states on the way, by the number of steps before each."""

    def __init__(self, losses: Mapping[int, Loss]):
        """``losses`` {number of steps: loss}; 0 is the first state."""
        if not isinstance(losses, Mapping) or not losses:
            raise InputError(f"losses is {shown(losses)}, but must be a table with a loss for at least one frame.")
        self.losses = dict(losses)

    @property
    def fingerprint(self) -> str:
        """Tells one set of targets from another, for checkpoints."""
        return " ".join(f"{step}:{fingerprint(loss)}" for step, loss in sorted(self.losses.items()))


def fingerprint(loss: Any) -> str:
    """A text that tells one loss from another; of a loss without its own ``fingerprint`` only the type."""
    return getattr(loss, "fingerprint", type(loss).__qualname__)


class FinalPositions:
    """Mean over particles of the squared distance to their targets [m2] (the report's 6.2.2, for one particle)."""

    def __init__(self, target: np.ndarray):
        """``target`` (n, d) [m], in the scene's order."""
        self.target = as_numbers("target", target).copy()
        if self.target.ndim != 2 or not np.isfinite(self.target).all():
            raise InputError(f"target has shape {self.target.shape}, but must be (particles, dimension) and finite.")
        self.target.setflags(write=False)
        self.fingerprint = sha256(self.target.tobytes()).hexdigest()
        """Tells one target from another, for checkpoints."""
        self._on_device: dict[Any, wp.array] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FinalPositions, (self.target,)

    @WARP
    def value(self, end: TrajectoryEnd) -> float:
        x, target, device = self._positions_and_target(end)
        return self._mean_square(x, target, device, end.precision)

    @WARP
    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, State]:
        x, target, device = self._positions_and_target(end)
        bar = end.state.like()
        bar.clear()
        factor, kernel = 2.0 / len(x), matching_kernels(end.precision).difference
        launch(kernel, len(x), device, factor=factor, x=x, target=target, bar=bar.positions)
        return self._mean_square(x, target, device, end.precision), bar

    def _mean_square(self, x: wp.array, target: wp.array, device: Any, precision: Precision) -> float:
        squares = wp.empty(len(x), dtype=wp.float64, device=device)
        launch(matching_kernels(precision).squared_distance, len(x), device, x=x, target=target, squares=squares)
        total = sum_of(wp.float64, len(x), device)(squares)
        return float(total.numpy()[0]) / len(x)

    def _positions_and_target(self, end: TrajectoryEnd) -> tuple[wp.array, wp.array, Any]:
        x = end.state.positions
        if (len(x), end.dimension) != self.target.shape:
            raise InputError(f"target has shape {self.target.shape}, but must be {(len(x), end.dimension)}.")
        key = (str(x.device), end.precision)
        if key not in self._on_device:
            self._on_device[key] = to_device(self.target, end.precision, x.device)
        return x, self._on_device[key], x.device


class CentreOfMass:
    """Squared distance of the centre of mass to a target [m2]."""

    def __init__(self, target: Any, masses: np.ndarray | None = None):
        """``target`` (d,) [m]; ``masses`` (n,) of the particles in any unit, None where they are all the same."""
        self.target, self._weights = _finite("target", target, 1), _weights(masses)
        self.fingerprint = _checksum(self.target, self._weights)
        """Tells one target from another, for checkpoints."""

    def value(self, end: TrajectoryEnd) -> float:
        return float((self._miss(end) ** 2).sum())

    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, Adjoint]:
        bar = 2.0 * _shares(self._weights, end)[:, None] * self._miss(end)
        return self.value(end), (bar, np.zeros_like(end.velocities))

    def _miss(self, end: TrajectoryEnd) -> np.ndarray:
        if self.target.shape != (end.dimension,):
            raise InputError(f"target has shape {self.target.shape}, but must be {(end.dimension,)}.")
        return _shares(self._weights, end) @ end.positions - self.target


class CentreOfMassAlong:
    """Component of the centre of mass along a direction [m]: its gradient is that of the centre of mass itself."""

    def __init__(self, direction: Any, masses: np.ndarray | None = None):
        """``direction`` (d,) [-]; ``masses`` as those of `CentreOfMass`."""
        self.direction, self._weights = _finite("direction", direction, 1), _weights(masses)
        self.fingerprint = _checksum(self.direction, self._weights)
        """Tells one direction from another, for checkpoints."""

    def value(self, end: TrajectoryEnd) -> float:
        return float((self._slopes(end) * end.positions).sum())

    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, Adjoint]:
        return self.value(end), (self._slopes(end), np.zeros_like(end.velocities))

    def _slopes(self, end: TrajectoryEnd) -> np.ndarray:
        if self.direction.shape != (end.dimension,):
            raise InputError(f"direction has shape {self.direction.shape}, but must be {(end.dimension,)}.")
        return _shares(self._weights, end)[:, None] * self.direction


def _finite(what: str, value: Any, dimensions: int) -> np.ndarray:
    """A read-only copy in float64, or an `InputError`."""
    array = as_numbers(what, value).copy()
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise InputError(f"{what} has shape {array.shape}, but must have {dimensions} dimension and be finite.")
    array.setflags(write=False)
    return array


def _weights(masses: np.ndarray | None) -> np.ndarray | None:
    if masses is None:
        return None
    array = _finite("masses", masses, 1)
    if not (array >= 0.0).all() or not array.any():
        raise InputError("masses has a number below 0, or only zeros, but must be the masses of particles.")
    return array


def _shares(weights: np.ndarray | None, end: TrajectoryEnd) -> np.ndarray:
    """(n,) of the particles in the mass of all."""
    n = len(end.positions)
    if weights is None:
        return np.full(n, 1.0 / n)
    if weights.shape != (n,):
        raise InputError(f"masses has shape {weights.shape}, but must be {(n,)}.")
    return weights / weights.sum()


def _checksum(*arrays: np.ndarray | None) -> str:
    return sha256(b" ".join(b"" if array is None else array.tobytes() for array in arrays)).hexdigest()


class Pictures(Protocol):
    """What makes pictures, such as `cortado.render.renderer.Renderer`."""

    def render(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> np.ndarray:
        """The picture (rows, columns, 3)."""

    def adjoint(self, image_bar: np.ndarray) -> Any:
        """``positions``, ``fractions`` and ``colours``: derivatives of a function of the last picture."""


class Image:
    """How far the picture of a state is from a target picture."""

    def __init__(self, renderer: Pictures, target: np.ndarray, distance: ImageLoss | None = None):
        """``target`` (rows, columns, 3), linear RGB; ``distance``: `cortado.image_losses.SquaredDifference`, the
        default (the report's 6.2.2), or `Pyramid`, whose gradient leads shapes to each other that do not overlap."""
        self.renderer, self.distance = renderer, SquaredDifference() if distance is None else distance
        self.target = _target_image(target, getattr(renderer, "shape", None))
        self.target.setflags(write=False)
        parts = (self.distance.fingerprint, sha256(self.target.tobytes()).hexdigest())
        self.fingerprint = " ".join((*parts, getattr(renderer, "fingerprint", "")))
        """Tells one target, or one view of it, from another, for checkpoints."""

    def image(self, end: TrajectoryEnd) -> np.ndarray:
        """The picture (rows, columns, 3) of a state."""
        return self.renderer.render(end.state.positions, end.state.mass_fractions, end.colours)

    @WARP
    def value(self, end: TrajectoryEnd) -> float:
        return self.distance.value(self.image(end), self.target)

    @WARP
    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, EndAdjoint]:
        image = self.image(end)
        found = self.renderer.adjoint(self.distance.adjoint(image, self.target))
        bar = end.state.like()
        bar.velocities.zero_()
        wp.copy(bar.positions, found.positions)
        wp.copy(bar.mass_fractions, found.fractions)
        return self.distance.value(image, self.target), EndAdjoint(bar, found.colours)


def _target_image(target: Any, shape: tuple[int, int, int] | None) -> np.ndarray:
    """A copy (rows, columns, 3) in float64, or an `InputError`; ``shape``: of the renderer's pictures, if known."""
    image = as_numbers("target", target).copy()
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"target has shape {image.shape}, but must be a picture (rows, columns, 3).")
    if shape is not None and image.shape != shape:
        raise InputError(f"target has shape {image.shape}, but must have that of the renderer's pictures, {shape}.")
    if not np.isfinite(image).all():
        raise InputError("target has a value that is not finite, but must be made of finite numbers.")
    return image


WarpFunction = Callable[[wp.array, wp.array, wp.array], Any]


class Recorded:
    """A loss that is any function of Warp arrays, differentiated by Warp's tape.

    ``function(positions, velocities, loss)`` launches kernels that add to ``loss``, an array (1,) of the precision of
    the (n,) vectors it is given. Mind Warp's rules for kernels that loop: a sum that is used non-linearly belongs
    into a function of its own.
    """

    def __init__(self, function: WarpFunction):
        self.function = function

    @WARP
    def value(self, end: TrajectoryEnd) -> float:
        loss, _, _ = self._run(end)
        return float(loss.numpy()[0])

    @WARP
    def value_and_adjoint(self, end: TrajectoryEnd) -> tuple[float, Adjoint]:
        with wp.Tape() as tape:
            loss, positions, velocities = self._run(end)
        tape.backward(loss)
        bars = tuple(array.grad.numpy()[:, : end.dimension].astype(np.float64) for array in (positions, velocities))
        return float(loss.numpy()[0]), bars

    def _run(self, end: TrajectoryEnd) -> tuple[wp.array, wp.array, wp.array]:
        copies = [wp.clone(a, requires_grad=True) for a in (end.state.positions, end.state.velocities)]
        loss = wp.zeros(1, dtype=end.precision.real, device=copies[0].device, requires_grad=True)
        self.function(copies[0], copies[1], loss)
        return loss, copies[0], copies[1]


def __dir__() -> list[str]:
    return __all__
