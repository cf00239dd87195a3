"""Many ways to compute the gradient of a problem, with one interface: ``source(problem, parameters)``.

`ByEstimator` (Warp's tape, the gather adjoint, a smoothed loss, any estimator), `WarpTangent`, `ReferenceAdjoint`,
`ReferenceTangent` (each precision and method), and `FiniteDifference`, of any step, on either engine.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado import reference
from cortado.gradients import AdjointEstimator, AdjointNorms, GradientEstimator
from cortado.losses import Frames
from cortado.losses.run_losses import as_loss
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.scene import Scene
from experiments.reference_losses import reference_loss


@dataclass(frozen=True, eq=False)
class Norms:
    """Norms over all particles of the tangents or adjoints of each state of a run; of several tangents, the joint
    norm."""

    positions: NDArray[np.float64]
    """(steps + 1,) of the positions of each state."""
    velocities: NDArray[np.float64]
    """(steps + 1,) of the velocities of each state."""


class Found(NamedTuple):
    """A loss and its gradient from a source."""

    loss: float
    gradient: Arrays
    """For each parameter an array of its shape."""
    history: Norms | None
    """None where a source does not differentiate state by state."""


class Source(Protocol):
    """Computes the gradient of a problem."""

    def __call__(self, problem: Problem, parameters: Values) -> Found:
        """The loss of a problem and its gradient."""


@dataclass(frozen=True)
class ByEstimator:
    """An estimator of Cortado's: `Exact` is the gather adjoint, `Tape` Warp's own."""

    estimator: GradientEstimator

    def __call__(self, problem: Problem, parameters: Values) -> Found:
        if not isinstance(self.estimator, AdjointEstimator):
            estimate = problem.estimate(parameters, self.estimator)
            return Found(estimate.loss, estimate.gradient, None)
        norms = AdjointNorms(problem.simulation.solver, problem.steps)
        estimate = problem.estimate(parameters, self.estimator, norms)
        return Found(estimate.loss, estimate.gradient, Norms(*norms.numpy().T))


@dataclass(frozen=True)
class ReferenceAdjoint:
    """The adjoint of the reference engine."""

    precision: str = "float64"
    terms: reference.Terms | None = None
    """The terms of the derivative that are kept; all where it is None."""

    def __call__(self, problem: Problem, parameters: Values) -> Found:
        engine = reference.Simulation(problem.simulation.scene, self.precision)
        loss = reference_loss(problem)
        found = engine.gradient(parameters, problem.steps, loss, self.terms, record_every=max(problem.steps, 1))
        gradient = {name: digits.high for name, digits in found.parameters.items()}
        return Found(found.value, gradient, _norms(found.history))


class Along(NamedTuple):
    """The derivative of a problem along one direction."""

    loss: float
    slope: float
    """The derivative of the loss."""
    history: Norms


class Forward(ABC):
    """A source that computes derivatives along one direction at a time."""

    @abstractmethod
    def along(self, problem: Problem, parameters: Values, directions: Values) -> Along:
        """The derivative along ``directions``, any of the parameters."""

    def __call__(self, problem: Problem, parameters: Values) -> Found:
        gradient = {name: np.zeros(np.shape(value)) for name, value in parameters.items()}
        squares = np.zeros((2, problem.steps + 1))
        loss = np.nan
        for name, index, direction in _units(gradient):
            loss, slope, norms = self.along(problem, parameters, {name: direction})
            gradient[name][index] = slope
            squares += np.square([norms.positions, norms.velocities])
        return Found(loss, gradient, Norms(*np.sqrt(squares)))


def _units(shapes: Arrays) -> Iterator[tuple[str, tuple[int, ...], NDArray[np.float64]]]:
    """For every component of every parameter: the name, the index, and the unit vector along it."""
    for name, array in shapes.items():
        for index in np.ndindex(array.shape):
            direction = np.zeros(array.shape)
            direction[index] = 1.0
            yield name, index, direction


@dataclass(frozen=True)
class WarpTangent(Forward):
    """Forward mode of the Warp engine."""

    def along(self, problem: Problem, parameters: Values, directions: Values) -> Along:
        norms = np.zeros((2, problem.steps + 1))

        def observe(step: int, dot: State) -> None:
            fields = dot.numpy(problem.simulation.dimension)
            norms[:, step] = [np.linalg.norm(fields[name]) for name in ("positions", "velocities")]

        problem.tangents(parameters, directions, observe)
        return Along(problem.value(parameters), problem.tangent(parameters, directions), Norms(*norms))


@dataclass(frozen=True)
class ReferenceTangent(Forward):
    """A tangent of the reference engine."""

    precision: str = "float64"
    method: str = "analytic"
    """One of `cortado.reference.METHODS`."""
    terms: reference.Terms | None = None
    """The terms of the analytic derivative that are kept; all where it is None."""
    difference: float = 1e-6
    """Step of finite differences of the states, in directions."""

    def run(self, scene: Scene, steps: int, parameters: Values, directions: Values) -> reference.History:
        """The tangents of the first and the last state of a scene, and the norms of all."""
        engine = reference.Simulation(scene, self.precision)
        return engine.tangent(
            parameters, directions, steps, self.method, self.terms, self.difference, record_every=max(steps, 1)
        )

    def along(self, problem: Problem, parameters: Values, directions: Values) -> Along:
        history = self.run(problem.simulation.scene, problem.steps, parameters, directions)
        loss, state = reference_loss(problem), (history.positions[-1], history.velocities[-1])
        assert history.position_tangents is not None and history.velocity_tangents is not None
        dots = (history.position_tangents[-1], history.velocity_tangents[-1])
        slope = sum(np.sum(np.asarray(bar) * dot.high) for bar, dot in zip(loss.adjoint(*state), dots, strict=True))
        return Along(loss.value(*state), float(slope), _norms(history))


class Engine(Protocol):
    """An engine that runs forward."""

    def run(self, problem: Problem, parameters: Values) -> tuple[float, Any, Any]:
        """The loss, and positions and velocities (steps + 1, n, d), which can be subtracted from others."""


@dataclass(frozen=True)
class Warp:
    """The problem's own engine, in its own precision."""

    def run(self, problem: Problem, parameters: Values) -> tuple[float, Any, Any]:
        ends = problem.states(parameters, range(problem.steps + 1))
        losses = problem.loss.losses if isinstance(problem.loss, Frames) else {problem.steps: problem.loss}
        loss = sum(as_loss(one).value(ends[step]) for step, one in losses.items())
        states = [ends[step] for step in range(problem.steps + 1)]
        return loss, np.stack([end.positions for end in states]), np.stack([end.velocities for end in states])


@dataclass(frozen=True)
class Reference:
    """The reference engine in any precision."""

    precision: str = "float64"

    def run(self, problem: Problem, parameters: Values) -> tuple[float, Any, Any]:
        history = reference.Simulation(problem.simulation.scene, self.precision).run(problem.steps, parameters)
        loss = reference_loss(problem).value(history.positions[-1], history.velocities[-1])
        return loss, history.positions, history.velocities


@dataclass(frozen=True)
class FiniteDifference(Forward):
    """Central differences of the loss; its value is the mean of both sides."""

    step: float
    """In units of each parameter."""
    engine: Engine = Warp()
    """The engine that runs forward."""

    def along(self, problem: Problem, parameters: Values, directions: Values) -> Along:
        def run(step: float) -> tuple[float, Any, Any]:
            moved = {name: np.asarray(parameters[name]) + step * directions[name] for name in directions}
            return self.engine.run(problem, {**parameters, **moved})

        (above, *after), (below, *before) = run(self.step), run(-self.step)
        dots = [(a - b) / (2.0 * self.step) for a, b in zip(after, before, strict=True)]
        norms = Norms(*(np.linalg.norm(dot, axis=(1, 2)) for dot in dots))
        return Along(0.5 * (above + below), (above - below) / (2.0 * self.step), norms)


def _norms(history: reference.History) -> Norms:
    assert history.position_norms is not None and history.velocity_norms is not None
    return Norms(history.position_norms, history.velocity_norms)
