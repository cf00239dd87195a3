"""Transforms of parameters: coordinates u of a parameter p(u) in which an optimiser may step freely.

Whatever u is, p(u) is a parameter that can be: fractions that add up to 1, a number that stays positive, a parameter
over time that changes slowly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Protocol

import numpy as np
from scipy.special import softmax

from cortado.arrays import as_numbers, read_only, require_whole
from cortado.errors import DivergedError, InputError
from cortado.fixed import FixedDict, fixed
from cortado.gradients import AdjointEstimator, Estimate, ForwardPass, GradientEstimator, estimate
from cortado.parameters.values import Arrays, Values, check_known
from cortado.problem import Problem
from cortado.rollout import BackwardStep, Observer

SMALLEST = 1e-4
"""Smaller fractions are replaced by this one where their coordinates are computed: that of 0 is minus infinity."""


class Bijector(Protocol):
    """A smooth map p(u) with its inverse and its adjoint."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        """p(u)."""

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        """The u for which p(u) is ``parameter``, or nearest to it."""

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        """The derivative of a loss with respect to u, given ``bar``, that with respect to p(u)."""


@dataclass(frozen=True)
class Logarithm:
    """p = exp(u): a step in u multiplies the parameter, which stays positive."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        return np.exp(u)

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        if (np.asarray(parameter) <= 0.0).any():
            raise InputError("A parameter that is changed by factors must be greater than 0.")
        return np.log(parameter)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return bar * np.exp(u)


@dataclass(frozen=True)
class Softmax:
    """p_k = exp(u_k) / sum_l exp(u_l), row by row: fractions (n, phases) that add up to 1."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        if np.ndim(u) != 2:
            raise InputError(f"coordinates have shape {np.shape(u)}, but must have a row for each particle.")
        return softmax(u, axis=1)

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        u = np.log(np.maximum(parameter, SMALLEST))
        return u - u.mean(axis=1, keepdims=True)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        p = self.parameter(u)
        return p * (bar - (p * bar).sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class TimeInterpolation:
    """p (steps, d) interpolated linearly in time between knots u (k, d) at even times from first to last step."""

    steps: int
    knots: int

    def __post_init__(self) -> None:
        require_whole("steps", self.steps, 1)
        require_whole("knots", self.knots, 1)

    @property
    def places(self) -> np.ndarray:
        """(k,) the steps at which the knots are, counted from 0; in between where the numbers do not fit."""
        return np.linspace(0.0, self.steps - 1.0, self.knots)

    @property
    def _weights(self) -> np.ndarray:
        """(steps, knots)"""
        places = np.linspace(0.0, self.knots - 1.0, self.steps)
        return np.maximum(1.0 - np.abs(places[:, None] - np.arange(self.knots)), 0.0)

    def parameter(self, u: np.ndarray) -> np.ndarray:
        _require_rows("knots", u, self.knots)
        return self._weights @ u

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        _require_rows("values over time", parameter, self.steps)
        return np.linalg.lstsq(self._weights, parameter, rcond=None)[0]

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return self._weights.T @ bar


@fixed
class Affine:
    """p = base + matrix u: such as accelerations after which a tank always stands where it shall, or a nozzle that
    follows commands with a lag."""

    def __init__(self, base: Any, matrix: Any):
        """``base`` of the parameter's shape, in its unit; ``matrix`` of that shape followed by the shape of u."""
        self.base, self.matrix = read_only("base", base), read_only("matrix", matrix)
        if self.matrix.shape[: self.base.ndim] != self.base.shape or self.matrix.ndim == self.base.ndim:
            wanted = f"{self.base.shape}, the shape of base, followed by the shape of the coordinates"
            raise InputError(f"matrix has shape {self.matrix.shape}, but must have {wanted}.")

    def __repr__(self) -> str:
        """With a checksum of its numbers, by which a search that is resumed knows it."""
        return f"Affine({sha256(self.base.tobytes() + self.matrix.tobytes()).hexdigest()[:16]})"

    def parameter(self, u: np.ndarray) -> np.ndarray:
        _require_shape("coordinates", u, self._shape)
        return self.base + np.tensordot(self.matrix, u, len(self._shape))

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        """The least of all u that come nearest to ``parameter``."""
        _require_shape("values", parameter, self.base.shape)
        matrix = self.matrix.reshape(self.base.size, -1)
        return np.linalg.lstsq(matrix, (parameter - self.base).ravel(), rcond=None)[0].reshape(self._shape)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return np.tensordot(bar, self.matrix, self.base.ndim)

    @property
    def _shape(self) -> tuple[int, ...]:
        """Of u."""
        return self.matrix.shape[self.base.ndim :]


@fixed
class Transformed:
    """A problem as a function of coordinates: those of the given bijectors, all other parameters as they are."""

    def __init__(self, problem: Problem, coordinates: Mapping[str, Bijector]):
        """Raises `InputError` for coordinates of a parameter that the scene does not have."""
        for name in coordinates:
            check_known(name, problem.simulation.scene, known=problem.simulation.known)
        self.problem, self.coordinates = problem, FixedDict(coordinates)
        self.simulation = problem.simulation

    @property
    def fingerprint(self) -> str:
        """A text that identifies the problem and its coordinates."""
        return f"{self.problem.fingerprint}; coordinates {sorted(self.coordinates.items(), key=str)}"

    def parameters(self, u: Mapping[str, Any]) -> Arrays:
        """p(u) by name."""
        known = {name: as_numbers(f"coordinate of {name}", u[name]) for name in self.coordinates.keys() & u.keys()}
        return {**u, **{name: self.coordinates[name].parameter(value) for name, value in known.items()}}

    def coordinate(self, parameters: Mapping[str, Any]) -> Arrays:
        """u by name."""
        names = self.coordinates.keys() & parameters.keys()
        known = {name: as_numbers(f"parameter {name}", parameters[name]) for name in names}
        return {**parameters, **{name: self.coordinates[name].coordinate(value) for name, value in known.items()}}

    def value(self, u: Mapping[str, Any]) -> float:
        """The loss, forward only."""
        return self.problem.value(self.parameters(u))

    def value_and_gradient(
        self, u: Mapping[str, Any], gradient: GradientEstimator | None = None
    ) -> tuple[float, Arrays]:
        """The loss and its derivatives with respect to the coordinates."""
        found = self.estimate(u, gradient)
        return found.loss, found.gradient

    def estimate(
        self, u: Mapping[str, Any], gradient: GradientEstimator | None = None, observe: Observer | None = None
    ) -> Estimate:
        """The same, with what the estimator reports. The spread of an ensemble is one of coordinates."""
        return estimate(self, u, gradient, observe)

    def forward_pass(self, u: Mapping[str, Any]) -> "TransformedPass":
        """A forward run that estimators can go back through."""
        return TransformedPass(self.problem.forward_pass(self.parameters(u)), self.coordinates, u)

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """See `Batchable.room`."""
        return self.problem.room(estimator)

    def together(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None
    ) -> list[Estimate | DivergedError]:
        """See `Batchable.together`."""
        found = self.problem.together([self.parameters(u) for u in points], estimator)
        for u, one in zip(points, found, strict=True):
            if isinstance(one, Estimate):
                one.gradient.update(by_coordinates(self.coordinates, u, one.gradient))
        return found


class TransformedPass:
    """A forward run of a problem, and the reverse pass to coordinates."""

    def __init__(self, forward_pass: ForwardPass, coordinates: Mapping[str, Bijector], u: Mapping[str, Any]):
        self._pass, self._coordinates, self._u = forward_pass, coordinates, u
        self.loss, self.rollout, self.derivative = forward_pass.loss, forward_pass.rollout, forward_pass.derivative

    def back(self, derivative: BackwardStep, observe: Observer | None = None) -> Arrays:
        """The gradient with respect to the coordinates."""
        gradient = self._pass.back(derivative, observe)
        return gradient | by_coordinates(self._coordinates, self._u, gradient)


def _require_shape(what: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise InputError(f"{what} have shape {np.shape(array)}, but must have {shape}.")


def _require_rows(what: str, array: np.ndarray, rows: int) -> None:
    if not np.ndim(array) or len(array) != rows:
        raise InputError(f"{what} have shape {np.shape(array)}, but must have {rows} rows.")


def by_coordinates(coordinates: Mapping[str, Bijector], u: Mapping[str, Any], gradient: Arrays) -> Arrays:
    """The derivatives with respect to coordinates, given those with respect to the parameters."""
    names = coordinates.keys() & gradient.keys()
    return {name: coordinates[name].adjoint(np.asarray(u[name]), gradient[name]) for name in names}
