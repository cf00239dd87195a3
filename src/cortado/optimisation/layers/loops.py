"""Closed loops, such as a policy's, as problems of `cortado.gradients`: their losses and gradients, smoothed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import require_arguments
from cortado.errors import ComputationError, InputError
from cortado.gradients import AdjointEstimator, Estimate, GradientEstimator, Observer, estimate
from cortado.gradients.estimator import Point
from cortado.optimisation.layers.calls import Bridge, steps_layer, table_of
from cortado.optimisation.layers.calls import state as first_state
from cortado.optimisation.layers.layer import check_state, kept_or_made
from cortado.scene.parameter_values import Arrays, Values
from cortado.simulation import Simulation

DISPLACED = "initial_positions"
"""Name of the first positions, which ensembles scatter, among the weights of a sample."""
KEPT = 4
"""Most compiled losses that are kept, by estimator."""
CHECKPOINTS = 2**30
"""Most bytes of states kept for the ways back of a batch of loops."""


class Loop:
    """A user's loss of weights and of a first state, as estimators know problems: many loops are one mapped call."""

    def __init__(
        self, bridge: Bridge, simulation: Simulation, loss: Callable[..., Any], state: Mapping[str, Any] | None
    ):
        self._layer = steps_layer(simulation, 1)
        self.simulation, self._bridge = simulation, bridge
        require_arguments("loss", loss, ("weights", "a state", "an estimator"))
        self._loss = loss
        given = first_state(bridge, simulation, None, None) if state is None else table_of("state", state)
        self._state = {name: bridge.array(f"state {name}", array, self._layer) for name, array in given.items()}
        check_state({name: tuple(array.shape) for name, array in self._state.items()}, self._layer.states.shapes)
        self._positions = bridge.numbers("state positions", self._state["positions"])
        self._mapped: dict[Any, Callable[..., tuple[Any, Any]]] = {}

    def value(self, parameters: Values) -> float:
        """Return the loss of these weights."""
        return float(self.at([parameters])[0][0])

    def forward_pass(self, parameters: Values) -> "OneLoop":
        """Return the evaluation of one loop, which goes back by any estimator."""
        return OneLoop(self, [parameters])

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """Return the number of loops worth one launch."""
        return self.simulation.room(1, CHECKPOINTS if estimator else 0.0)

    def together(self, points: Sequence[Values], estimator: AdjointEstimator | None = None) -> list[Estimate]:
        """Return estimates of several loops in one launch; one whose loss is not finite has its error in it."""
        loops, gradient = LoopPass(self, points), dict[str, Any]()
        if estimator is not None:
            gradient = estimator.back(loops)
        found = []
        for b, (point, loss) in enumerate(zip(points, loops.loss, strict=True)):
            error = ComputationError(f"the loss of loop {b} is {loss}, but must be finite.")
            lost = Point(point, estimator).without_a_run(error)
            found.append(Estimate(loss, {n: g[b] for n, g in gradient.items()}) if np.isfinite(loss) else lost)
        return found

    def at(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None, slope: bool = False
    ) -> tuple[np.ndarray, Arrays]:
        """Return the losses (k,) of several loops, and, with ``slope``, their gradients by name (k, ...), float64."""

        def loss(weights: Any, positions: Any) -> Any:
            return self._loss(weights, {**self._state, "positions": positions}, estimator)

        run = kept_or_made(self._mapped, (estimator, slope), lambda _: self._bridge.mapped(loss, slope), KEPT)
        names = [name for name in points[0] if name != DISPLACED]
        weights = {name: np.stack([np.asarray(point[name], dtype=np.float64) for point in points]) for name in names}
        first = self.simulation.positions
        positions = np.stack([self._positions + (point.get(DISPLACED, first) - first) for point in points])
        given = {name: self._bridge.array(name, array, self._layer) for name, array in weights.items()}
        losses, gradient = run(given, self._bridge.array("positions", positions, self._layer))
        found = self._bridge.numbers("the loss", losses)
        if found.shape != (len(points),):
            raise InputError(f"loss returned an array {found.shape[1:]}, but must return one number.")
        return found, {name: self._bridge.numbers(name, array) for name, array in gradient.items()}


class LoopPass:
    """A forward run of several loops, as `ForwardPass` is one of a problem."""

    def __init__(self, loop: Loop, points: Sequence[Values]):
        self._loop, self._points = loop, points
        self._losses: np.ndarray | None = None

    @property
    def loss(self) -> Any:
        """Losses (k,), known from a way back if there was one."""
        if self._losses is None:
            self._losses, _ = self._loop.at(self._points)
        return self._losses

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        """Return the gradients (k, ...) by name, by an estimator; the loops run anew, as a layer's gradient does."""
        self._losses, gradient = self._loop.at(self._points, estimator, slope=True)
        return gradient


class OneLoop(LoopPass):
    """The `ForwardPass` of a single loop."""

    @property
    def loss(self) -> float:
        """Loss of the loop."""
        return float(super().loss[0])

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        """Return the gradient by name, by an estimator."""
        return {name: array[0] for name, array in super().back(estimator).items()}


class Smoothed:
    """A loss of a closed loop smoothed by an estimator over an ensemble: see `smoothed`."""

    def __init__(self, bridge: Bridge, estimator: GradientEstimator, loop: Loop):
        self._bridge, self._estimator, self._loop = bridge, estimator, loop

    def __call__(self, weights: Mapping[str, Any]) -> Any:
        """Return the mean of the loss over the ensemble; its derivative in reverse mode is that of `estimate`."""

        def found(given: Mapping[str, Any]) -> tuple[float, Arrays]:
            own = self.estimate(given)
            return own.loss if own.mean_loss is None else own.mean_loss, own.gradient

        return self._bridge.with_gradient(found, table_of("weights", weights))

    def estimate(self, weights: Mapping[str, Any]) -> Estimate:
        """Return the loss at the weights and the smoothed gradient with its standard error, in NumPy arrays by name.

        Raises `InputError` for weights that are no numbers, and for a name that ensembles use.
        """
        given = table_of("weights", weights)
        own = {name: self._bridge.numbers(f"weight {name}", array) for name, array in given.items()}
        if DISPLACED in own:
            raise InputError(f"weights has {DISPLACED}, but must have another name for it, as ensembles scatter these.")
        return estimate(self._loop, own, self._estimator)


def smoothed(
    bridge: Bridge,
    simulation: Simulation,
    loss: Callable[..., Any],
    estimator: GradientEstimator,
    state: Mapping[str, Any] | None = None,
) -> Smoothed:
    """Return the loss of a closed loop smoothed over an ensemble, as a function of ``weights``, arrays by name.

    Its value is the mean of the loss, and its gradient the smoothed one; its method ``estimate(weights)`` returns both
    in an `Estimate`, with the standard error. ``loss(weights, state, gradient)`` returns a number, and hands
    ``gradient`` on to `step` or `rollout`. The ``estimator`` says how to smooth, over which spread of the weights, in
    their units, and which scatter of first positions. `gradients.EnsembleMean` has the mean gradient of scattered
    loops, whose sizes `gradients.Guided` corrects by differences of the loss. Loops run as batches, by `jax.vmap` in
    programs that are compiled, or by `torch.vmap`. They begin at ``state``, the scene's first one if left out. Raises
    `InputError` for what does not fit, and within a program that is compiled.
    """
    return Smoothed(bridge, estimator, Loop(bridge, simulation, loss, state))
