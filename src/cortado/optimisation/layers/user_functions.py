"""The functions of `cortado.jax` and `cortado.torch`: states, steps, rollouts and losses as functions of arrays, and
smoothed losses of closed loops."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from cortado.arrays import as_precise_numbers, require_arguments, require_table, whole_number
from cortado.errors import ComputationError, InputError, shown
from cortado.gradients import AdjointEstimator, Estimate, GradientEstimator, Observer, estimate
from cortado.gradients.estimator import Point, checked_reverse
from cortado.optimisation.layers.functions import LOSS, PICTURE, READING, Measure, Picture, Steps, Value
from cortado.optimisation.layers.layer import PARAMETER, STATE, Layer, Named, check_state, kept_or_made, named, part
from cortado.problem import Problem
from cortado.render import Renderer
from cortado.rollout.device_states import DeviceState, Given
from cortado.rollout.stepper import require_hash
from cortado.runs.sensor import Sensor
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.restart import RestartState
from cortado.simulation import Simulation

Table = Mapping[str, Any]
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
KEPT = 4


class Bridge(ABC):
    """Base class of the code that is specific to JAX or PyTorch."""

    stack: Callable[[list[Any]], Any]

    @abstractmethod
    def apply(self, layer: Layer, given: dict[str, Any]) -> dict[str, Any]:
        """Return the results of a layer by name, as a differentiable function of the given arrays."""

    @abstractmethod
    def array(self, what: str, value: Any, layer: Layer) -> Any:
        """Return an array of the layer's precision unchanged, or convert numbers to an array. Raises `InputError` for
        any other value."""

    @abstractmethod
    def made(self, found: Named, layer: Layer) -> dict[str, Any]:
        """Copy arrays of a layer to arrays of JAX or PyTorch."""

    @abstractmethod
    def mapped(self, loss: Callable[[Any, Any], Any], slope: bool) -> Callable[[Any, Any], tuple[Any, Any]]:
        """Return a function of k sets of weights and initial positions, stacked along a first axis. The function
        returns the losses (k,). If ``slope`` is true, the function also returns the gradients by name.
        """

    @abstractmethod
    def with_gradient(self, found: Callable[[Any], tuple[float, Mapping[str, np.ndarray]]], weights: Any) -> Any:
        """Return the value of a function at ``weights`` as an array of JAX or PyTorch. In reverse mode, the derivative
        of the returned array is the function's gradient."""

    def numbers(self, what: str, value: Any) -> np.ndarray:
        """Copy an array to the host in float64. Raises `InputError` if ``value`` is not an array of numbers."""
        return as_precise_numbers(what, value)

    def repeated(
        self, step: Callable[[Any, Any], Any], state: dict[str, Any], rows: dict[str, Any], count: int
    ) -> dict[str, Any]:
        """Apply a step ``count`` times. Step k uses element k of each array in ``rows``. Return the states after all
        steps, stacked along a first axis."""
        states = [state]
        for k in range(count):
            states.append(step(states[-1], {name: row[k] for name, row in rows.items()}))
        return {name: self.stack([one[name] for one in states]) for name in state}


def bound(
    function: Callable[Concatenate[Bridge, Arguments], Result], bridge: Bridge, module: str
) -> Callable[Arguments, Result]:
    """Return ``function`` with its first argument set to ``bridge``, as a public function of ``module``."""

    def call(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        return function(bridge, *arguments, **named)

    own: Any = call
    own.__name__ = own.__qualname__ = function.__name__
    own.__doc__, own.__module__ = function.__doc__, module
    own.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if name != "bridge"}
    takes = signature(function)
    own.__signature__ = takes.replace(parameters=list(takes.parameters.values())[1:])
    return call


def steps_layer(simulation: Simulation, steps: int, gradient: AdjointEstimator | None = None) -> Steps:
    if not isinstance(simulation, Simulation):
        raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
    steps = whole_number("steps", steps, 1)
    layers: dict[Any, Steps] = simulation.__dict__.setdefault("_layers", {})
    if gradient is not None:
        require_hash(checked_reverse(gradient))
    return kept_or_made(layers, (steps, gradient), lambda key: Steps(simulation, *key), KEPT)


def state(
    bridge: Bridge, simulation: Simulation, given: Given | DeviceState = None, parameters: Values | None = None
) -> dict[str, Any]:
    """Return a state of a ``simulation`` as arrays: the initial state, or a ``given`` state, such as
    ``trajectory.last_state``.

    ``parameters`` are values that affect the initial state, such as ``initial_velocities``. For a ``given`` state,
    ``parameters`` are the parameters of the run that produced the state.

    The result has positions [m] and velocities [m / s] (n, d), mass_fractions (n, phases), reference_density (n,), time
    () [s], and further fields of the solver. In a batch the first axis is the scene. Raises `InputError` for unsuitable
    arguments.

    Example: ``first = state(simulation)  # first["positions"]: (n, d)``
    """
    layer = steps_layer(simulation, 1)
    with layer.turn:
        first = simulation.on_device(given, parameters=dict(table_of("parameters", parameters)))
        return part(bridge.made(named(STATE, layer.states.arrays(first)), layer), STATE)


def restart_state(
    bridge: Bridge, simulation: Simulation, given: Table, parameters: Values | None = None
) -> RestartState | tuple[RestartState, ...]:
    """Convert a state made of arrays to a restart state for `Simulation.run`, for files and for other processes. For a
    batch, return a tuple with a restart state for each scene.

    ``given`` is a state of ``simulation``. ``parameters`` contains the parameters of the run that affect the state.

    Example: ``run = simulation.run(100, state=restart_state(simulation, end))``
    """
    layer = steps_layer(simulation, 1)
    arrays = {name: bridge.numbers(f"state {name}", value) for name, value in table_of("state", given).items()}
    check_state({name: array.shape for name, array in arrays.items()}, layer.states.shapes)
    own = {
        name: bridge.numbers(f"parameter {name}", value) for name, value in table_of("parameters", parameters).items()
    }
    with layer.turn:
        found = layer.states.restart_states(arrays, own)
        return found[0] if simulation.batch is None else found


def step(
    bridge: Bridge,
    simulation: Simulation,
    given: Table,
    parameters: Table | None = None,
    steps: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, Any]:
    """Take ``steps`` time steps from the state ``given`` and return the last state, as a function of arrays. See also
    `Simulation.step`.

    Args:
        simulation: the simulation that takes the steps.
        given: the state before the steps.
        parameters: values for any parameters of `Problem` except initial values. A parameter over time
            has one value for each step.
        steps: number of steps.
        gradient: estimator for reverse mode, such as `gradients.AdjointViscosity`. The default is the exact adjoint.
            Forward mode is always exact.

    Exact derivatives of chained steps are useful up to a horizon of some hundred steps. The command `cortado gradients
    check` finds the horizon of a scene. A warning is given if adjoints grow by more than a factor of e^10 over several
    chained steps. Raises `InputError` for unsuitable arguments, and `DivergedError` if a particle is lost.

    Example: ``end = step(simulation, state(simulation), {"viscosity": 0.1}, steps=5)``
    """
    return part(_applied(bridge, steps_layer(simulation, steps, gradient), given, parameters), STATE)


def rollout(
    bridge: Bridge,
    simulation: Simulation,
    given: Table,
    parameters: Table | None = None,
    steps: int = 1,
    record_every: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, Any]:
    """Take ``steps`` steps and return the initial state and the state after every ``record_every`` steps, along a first
    axis (frames, ...).

    ``simulation``, ``given``, ``parameters`` and ``gradient`` are the same as in `step`.

    Example: ``states = rollout(simulation, state(simulation), steps=20, record_every=5)  # ["positions"]: (5, n, d)``
    """
    steps, every = whole_number("steps", steps, 1), whole_number("record_every", record_every, 1)
    if steps % every:
        raise InputError(f"record_every is {every}, but must divide the {steps} steps.")
    layer, count = steps_layer(simulation, every, gradient), steps // every
    table = table_of("parameters", parameters)
    arrays = {name: bridge.array(PARAMETER + name, value, layer) for name, value in table.items()}
    if simulation.batch is not None and any(name in simulation.known.over_time for name in arrays):
        over_time = ", ".join(name for name in arrays if name in simulation.known.over_time)
        raise InputError(f"parameter {over_time} is given, but must be left out in a rollout of a batch: use step.")
    known = simulation.known
    rows = {n: a for n, a in arrays.items() if n in known.over_time and len(a.shape) > known[n].rank}
    for name, array in rows.items():
        if array.shape[0] != steps:
            raise InputError(f"parameter {name} has {array.shape[0]} rows, but must have {steps}, one for each step.")
    pieces = {name: array.reshape((count, every, *array.shape[1:])) for name, array in rows.items()}
    others = {name: array for name, array in arrays.items() if name not in rows}
    first = {name: bridge.array(STATE + name, value, layer) for name, value in table_of("state", given).items()}

    def advance(before: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
        return part(_applied(bridge, layer, before, {**others, **own}), STATE)

    return bridge.repeated(advance, first, pieces, count)


def value(bridge: Bridge, problem: Problem, gradient: GradientEstimator | None = None) -> Callable[..., Any]:
    """Return the loss of a ``problem`` as a function ``loss(parameters, state=None)`` of arrays by name. The loss has
    the shape (), or (batch,) for a batch.

    If ``state`` is given, the run begins with this state. Reverse mode uses the estimator ``gradient``, by default
    `gradients.Exact`. The gradient is equal to the gradient of `Problem.value_and_gradient`, bit for bit.

    Example::

        loss = value(problem)
        print(loss({"gravity": gravity}))
    """
    layer = Value(problem, gradient)

    def loss(parameters: Table, given: Table | None = None) -> Any:
        return _applied(bridge, layer, given, parameters)[LOSS]

    return loss


def measure(bridge: Bridge, simulation: Simulation, what: Sensor | str) -> Callable[..., Any]:
    """Return a function ``reading(state, parameters=None)`` of arrays. The argument ``what`` is a sensor of
    `cortado.sensors`, or a quantity of the particles, such as "pressure".

    The reading of a sensor is an array (k,) with one number for each column of the sensor. The reading of a quantity is
    (n,) or (n, d). ``parameters`` are the parameters of the next time step, because the pressure is computed in that
    step. Raises `InputError` if ``simulation`` is a batch.

    Example::

        pressure = measure(simulation, "pressure")
        print(pressure(state(simulation)))  # (n,) Pa
    """
    if not isinstance(simulation, Simulation):
        raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
    layer = Measure(simulation, what)

    def reading(given: Table, parameters: Table | None = None) -> Any:
        return _applied(bridge, layer, given, parameters)[READING]

    return reading


def picture(bridge: Bridge, renderer: Renderer, positions: Any, fractions: Any = None, colours: Any = None) -> Any:
    """Return a picture (rows, columns, 3) of particles in linear RGB, as a function of arrays. See also
    `Renderer.render`.

    Args:
        renderer: from `Simulation.renderer`.
        positions: (n, d) [m].
        fractions: mass fractions (n, phases), which may be left out for a single phase.
        colours: (phases, 3), by default the colours of the renderer.

    Arrays are copied to the host. Derivatives of a picture exist in reverse mode only. Raises `InputError` for
    unsuitable arguments.

    Example: ``image = picture(simulation.renderer(resolution=(64, 48)), end["positions"])  # (48, 64, 3)``
    """
    layer = getattr(renderer, "_layer", None) or Picture(renderer)
    renderer.__dict__["_layer"] = layer
    given = {"positions": positions, "fractions": fractions, "colours": colours}
    found = {name: bridge.array(name, value, layer) for name, value in given.items() if value is not None}
    layer.check({name: tuple(array.shape) for name, array in found.items()})
    return bridge.apply(layer, found)[PICTURE]


def _applied(bridge: Bridge, layer: Layer, given: Table | None, parameters: Table | None) -> dict[str, Any]:
    own, others = table_of("state", given), table_of("parameters", parameters)
    arrays = {**named(STATE, own), **named(PARAMETER, others)}
    found = {name: bridge.array(name, value, layer) for name, value in arrays.items()}
    layer.check({name: tuple(array.shape) for name, array in found.items()})
    return bridge.apply(layer, found)


def table_of(what: str, given: Table | None) -> Table:
    """Return a dictionary unchanged, or an empty dictionary for None. Raises `InputError` for any other value."""
    found = {} if given is None else given
    likely = {"parameters": "{'gravity': array}", "weights": "{'bias': array}"}.get(what, "{'positions': array, ...}")
    require_table(what, found, likely)
    for name in found:
        if not isinstance(name, str):
            raise InputError(f"{what} has the name {shown(name)}, but names must be strings.")
    return found


DISPLACED = "initial_positions"


class Loop:
    def __init__(
        self, bridge: Bridge, simulation: Simulation, loss: Callable[..., Any], begin: Mapping[str, Any] | None
    ):
        self._layer = steps_layer(simulation, 1)
        self.simulation, self._bridge = simulation, bridge
        require_arguments("loss", loss, ("weights", "a state", "an estimator"))
        self._loss = loss
        given = state(bridge, simulation, None, None) if begin is None else table_of("state", begin)
        self._state = {name: bridge.array(f"state {name}", array, self._layer) for name, array in given.items()}
        check_state({name: tuple(array.shape) for name, array in self._state.items()}, self._layer.states.shapes)
        self._positions = bridge.numbers("state positions", self._state["positions"])
        self._mapped: dict[Any, Callable[..., tuple[Any, Any]]] = {}

    def value(self, parameters: Values) -> float:
        return float(self.at([parameters])[0][0])

    def forward_pass(self, parameters: Values) -> "OneLoop":
        return OneLoop(self, [parameters])

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        return self.simulation.room(1, 2**30 if estimator else 0.0)

    def together(self, points: Sequence[Values], estimator: AdjointEstimator | None = None) -> list[Estimate]:
        """Estimate the losses and gradients of closed loops at several points in one batch. The estimate of an infinite
        loss contains an error."""
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
        """Return the losses of k loops (k,) in float64. If ``slope`` is true, also return the gradients (k, ...) by
        name."""

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
            raise InputError(f"loss returned an array of shape {found.shape[1:]}, but must return one number.")
        return found, {name: self._bridge.numbers(name, array) for name, array in gradient.items()}


class LoopPass:
    def __init__(self, loop: Loop, points: Sequence[Values]):
        self._loop, self._points = loop, points
        self._losses: np.ndarray | None = None

    @property
    def loss(self) -> Any:
        if self._losses is None:
            self._losses, _ = self._loop.at(self._points)
        return self._losses

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        self._losses, gradient = self._loop.at(self._points, estimator, slope=True)
        return gradient


class OneLoop(LoopPass):
    @property
    def loss(self) -> float:
        return float(super().loss[0])

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        return {name: array[0] for name, array in super().back(estimator).items()}


class Smoothed:
    """The loss of a closed loop, smoothed over an ensemble by an estimator. See `smoothed`."""

    def __init__(self, bridge: Bridge, estimator: GradientEstimator, loop: Loop):
        self._bridge, self._estimator, self._loop = bridge, estimator, loop

    def __call__(self, weights: Mapping[str, Any]) -> Any:
        """Return the mean of the loss over the ensemble. In reverse mode, the derivative of the mean is the smoothed
        gradient, as in `estimate`."""

        def found(given: Mapping[str, Any]) -> tuple[float, Arrays]:
            own = self.estimate(given)
            return own.loss if own.mean_loss is None else own.mean_loss, own.gradient

        return self._bridge.with_gradient(found, table_of("weights", weights))

    def estimate(self, weights: Mapping[str, Any]) -> Estimate:
        """Return the loss at the weights, and the smoothed gradient with its standard error, as NumPy arrays by name.

        Raises `InputError` if weights are not numbers, or if a weight has the reserved name "initial_positions".
        """
        given = table_of("weights", weights)
        own = {name: self._bridge.numbers(f"weight {name}", array) for name, array in given.items()}
        if DISPLACED in own:
            raise InputError(f"weights has {DISPLACED}, but must have another name, as this name is reserved.")
        return estimate(self._loop, own, self._estimator)


def smoothed(
    bridge: Bridge,
    simulation: Simulation,
    loss: Callable[..., Any],
    estimator: GradientEstimator,
    state: Mapping[str, Any] | None = None,
) -> Smoothed:
    """Return the ``loss`` of a closed loop, smoothed over an ensemble, as a function of ``weights``. Weights are arrays
    by name.

    The value of the function is the mean loss over the ensemble. The derivative of the function is the smoothed
    gradient. The method ``estimate(weights)`` of the function returns an `Estimate` of the mean and of the gradient,
    with the standard error.

    Args:
        simulation: simulation in which the loop runs.
        loss: user-defined function ``loss(weights, state, gradient)``, which returns a number. The
            function must pass ``gradient`` on to `step` or `rollout`.
        estimator: gradient estimator, with the spread of the weights (in their units) and of the initial positions.
            `gradients.EnsembleMean` averages gradients, and `gradients.Guided` also corrects their size by differences
            of the loss.
        state: initial state of the loops, by default the initial state of the scene.

    Closed loops run in batches, by `torch.vmap` or by compiled `jax.vmap`. Raises `InputError` for unsuitable
    arguments, or if a compiled program calls the function.

    Example::

        loss = smoothed(simulation, loop, cortado.gradients.Guided(0.1))
        print(loss(weights))
    """
    return Smoothed(bridge, estimator, Loop(bridge, simulation, loss, state))
