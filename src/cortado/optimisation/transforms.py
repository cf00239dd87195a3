"""Transforms of parameters, and problems with fixed parameters.

A transform p(u) maps unconstrained coordinates u to a valid parameter p, such as fractions that sum to 1, a positive
number, or values over time that are interpolated between knots.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from scipy.special import softmax

from cortado.arrays import as_numbers, read_only, require_methods, require_table, require_whole
from cortado.calls import FixedDict, fixed
from cortado.errors import DivergedError, InputError
from cortado.gradients import AdjointEstimator, Estimate, ForwardPass, GradientEstimator, estimate
from cortado.problem import Problem
from cortado.rollout.rollout import Observer
from cortado.scene.parameter_values import Arrays, Values, check_known, require_points

SMALLEST = 1e-4
"""Lower limit of fractions in `Softmax.coordinate`."""


class Bijector(Protocol):
    """A smooth map p(u) from coordinates u to a parameter p, with its inverse and its adjoint."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        """Return the parameter p(u) at coordinates u."""

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        """Return the coordinates u whose parameter p(u) is nearest to ``parameter``."""

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        """Return the derivative of a loss with respect to u, given its derivative ``bar`` with respect to p(u)."""


@dataclass(frozen=True)
class Logarithm:
    """The transform p = exp(u) for positive parameters p."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):  # a problem refuses a parameter that is not finite
            return np.exp(as_numbers("a coordinate", u))

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        number = as_numbers("a parameter", parameter)
        if not (number > 0.0).all():
            raise InputError("A parameter that is searched by its logarithm must be greater than 0.")
        return np.log(number)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return bar * np.exp(u)


@dataclass(frozen=True)
class Softmax:
    """The transform p_k = exp(u_k) / sum_l exp(u_l) of coordinates u (n, phases) to fractions p (n, phases)."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        return softmax(_shaped("coordinates", u, lambda shape: len(shape) == 2, "a row for each particle"), axis=1)

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        fractions = _shaped("fractions", parameter, lambda shape: len(shape) == 2, "a row for each particle")
        u = np.log(np.maximum(fractions, SMALLEST))
        return u - u.mean(axis=1, keepdims=True)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        p = self.parameter(u)
        return p * (bar - (p * bar).sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class TimeInterpolation:
    """Linear interpolation in time, from values u (k, d) at evenly spaced knots to values p (steps, d)."""

    steps: int
    knots: int

    def __post_init__(self) -> None:
        require_whole("steps", self.steps, 1)
        require_whole("knots", self.knots, 1)

    @property
    def places(self) -> np.ndarray:
        """Return the times (k,) of the knots, measured in time steps from the start."""
        return np.linspace(0.0, self.steps - 1.0, self.knots)

    @property
    def _weights(self) -> np.ndarray:
        places = np.linspace(0.0, self.knots - 1.0, self.steps)
        return np.maximum(1.0 - np.abs(places[:, None] - np.arange(self.knots)), 0.0)

    def parameter(self, u: np.ndarray) -> np.ndarray:
        return self._weights @ _shaped("knots", u, lambda shape: shape[:1] == (self.knots,), f"{self.knots} rows")

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        rows = f"{self.steps} rows"
        values = _shaped("values over time", parameter, lambda shape: shape[:1] == (self.steps,), rows)
        return np.linalg.lstsq(self._weights, values, rcond=None)[0]

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return self._weights.T @ bar


@fixed
class Affine:
    """The affine transform p = base + matrix u. An example is the acceleration of a tank with a fixed end position."""

    def __init__(self, base: Any, matrix: Any):
        """``base`` has the shape and unit of the parameter. ``matrix`` has the shape ``base.shape + u.shape``."""
        self.base, self.matrix = read_only("base", base), read_only("matrix", matrix)
        if self.matrix.shape[: self.base.ndim] != self.base.shape or self.matrix.ndim == self.base.ndim:
            wanted = f"{self.base.shape}, the shape of base, followed by the shape of the coordinates"
            raise InputError(f"matrix has shape {self.matrix.shape}, but must have {wanted}.")

    def __repr__(self) -> str:
        return f"Affine({sha256(self.base.tobytes() + self.matrix.tobytes()).hexdigest()[:16]})"

    def parameter(self, u: np.ndarray) -> np.ndarray:
        coordinates = _shaped("coordinates", u, self._shape.__eq__, self._shape)
        return self.base + np.tensordot(self.matrix, coordinates, len(self._shape))

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        """Return the coordinates u of least norm whose parameter p(u) is nearest to ``parameter``."""
        offset = _shaped("values", parameter, self.base.shape.__eq__, self.base.shape) - self.base
        matrix = self.matrix.reshape(self.base.size, -1)
        return np.linalg.lstsq(matrix, offset.ravel(), rcond=None)[0].reshape(self._shape)

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return np.tensordot(bar, self.matrix, self.base.ndim)

    @property
    def _shape(self) -> tuple[int, ...]:
        return self.matrix.shape[self.base.ndim :]


class OtherParameters:
    """Base class of problems with parameters that are converted to the parameters of an original ``problem``."""

    problem: Problem

    def parameters(self, u: Values) -> Values:
        """Convert parameters of this problem to parameters of the original problem."""
        raise NotImplementedError

    def value(self, u: Values) -> Any:
        return self.problem.value(self.parameters(u))

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """Return the greatest number of points in a batch. See `Batchable.room`."""
        return self.problem.room(estimator)

    def together(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None
    ) -> list[Estimate | DivergedError]:
        """Estimate losses and gradients at several points in one batch. See `Batchable.together`."""
        require_points(points)
        return self.problem.together([self.parameters(u) for u in points], estimator)


@fixed
class Transformed(OtherParameters):
    """A problem as a function of coordinates of some parameters. The remaining parameters are unchanged."""

    def __init__(self, problem: Problem, coordinates: Mapping[str, Bijector]):
        """Store a ``problem``, and a bijector for each parameter in ``coordinates``, or raise `InputError`."""
        require_methods("problem", problem, ("value", "forward_pass"), "a cortado.Problem")
        require_table("coordinates", coordinates, "{'viscosity': Logarithm()}")
        for name, bijector in coordinates.items():
            check_known(name, problem.simulation.scene, known=problem.simulation.known)
            wanted = "an object such as Logarithm()"
            require_methods(f"the coordinate of {name}", bijector, ("parameter", "coordinate", "adjoint"), wanted)
        self.problem, self.coordinates = problem, FixedDict(coordinates)
        self.simulation: Any = problem.simulation

    def __reduce__(self) -> tuple[Any, ...]:
        return Transformed, (self.problem, self.coordinates)

    @property
    def fingerprint(self) -> str:
        return f"{self.problem.fingerprint}; coordinates {sorted(self.coordinates.items(), key=str)}"

    def parameters(self, u: Mapping[str, Any]) -> Arrays:
        """Convert coordinates u to parameters p(u) by name."""
        require_table("u", u, "{'viscosity': value}")
        known = {name: as_numbers(f"coordinate of {name}", u[name]) for name in self.coordinates.keys() & u.keys()}
        return {**u, **{name: self.coordinates[name].parameter(value) for name, value in known.items()}}

    def coordinate(self, parameters: Mapping[str, Any]) -> Arrays:
        require_table("parameters", parameters, "{'viscosity': value}")
        names = self.coordinates.keys() & parameters.keys()
        known = {name: as_numbers(f"parameter {name}", parameters[name]) for name in names}
        return {**parameters, **{name: self.coordinates[name].coordinate(value) for name, value in known.items()}}

    def value_and_gradient(self, u: Values, gradient: GradientEstimator | None = None) -> tuple[float, Arrays]:
        """Return the loss and its derivatives with respect to the coordinates."""
        found = self.estimate(u, gradient)
        return found.loss, found.gradient

    def estimate(
        self, u: Mapping[str, Any], gradient: GradientEstimator | None = None, observe: Observer | None = None
    ) -> Estimate:
        """Estimate loss and gradient at coordinates u. The spread of an ensemble is in units of the coordinates."""
        return estimate(self, u, gradient, observe)

    def forward_pass(self, u: Mapping[str, Any]) -> "TransformedPass":
        return TransformedPass(self.problem.forward_pass(self.parameters(u)), self.coordinates, u)

    def together(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None
    ) -> list[Estimate | DivergedError]:
        found = super().together(points, estimator)
        for u, one in zip(points, found, strict=True):
            if isinstance(one, Estimate):
                one.gradient.update(by_coordinates(self.coordinates, u, one.gradient))
        return found


class TransformedPass:
    def __init__(self, forward_pass: ForwardPass, coordinates: Mapping[str, Bijector], u: Mapping[str, Any]):
        self._pass, self._coordinates, self._u = forward_pass, coordinates, u
        self.loss = forward_pass.loss

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        gradient = self._pass.back(estimator, observe)
        return gradient | by_coordinates(self._coordinates, self._u, gradient)


def _shaped(what: str, value: Any, fits: Callable[[tuple[int, ...]], bool], wanted: object) -> np.ndarray:
    array = as_numbers(what, value)
    if not fits(array.shape):
        raise InputError(f"{what} have shape {array.shape}, but must have {wanted}.")
    return array


def by_coordinates(coordinates: Mapping[str, Bijector], u: Mapping[str, Any], gradient: Arrays) -> Arrays:
    names = coordinates.keys() & gradient.keys()
    return {name: coordinates[name].adjoint(np.asarray(u[name]), gradient[name]) for name in names}


class FixedParameters(OtherParameters):
    """A problem with some parameters fixed, as a function of the remaining parameters."""

    def __init__(self, problem: Problem, fixed: Arrays):
        """``fixed`` must include ``initial_positions`` (n, d) [m]."""
        self.problem, self._fixed, of = problem, fixed, problem.simulation
        self.simulation = SimpleNamespace(
            batch=None, scene=of.scene, positions=fixed["initial_positions"], precision=of.precision, known=of.known
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return FixedParameters, (self.problem, self._fixed)

    @property
    def fingerprint(self) -> str:
        return f"{self.problem.fingerprint}; fixed {', '.join(self._fixed)}"

    def parameters(self, u: Values) -> Values:
        return {**self._fixed, **u}

    def forward_pass(self, parameters: Values) -> ForwardPass:
        return self.problem.forward_pass(self.parameters(parameters))
