"""The functions of a layer, such as `cortado.jax` and `cortado.torch`: states, steps, rollouts and losses of arrays."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from cortado.arrays import as_precise_numbers, require_table, whole_number
from cortado.errors import InputError, shown
from cortado.gradients import AdjointEstimator, GradientEstimator
from cortado.gradients.estimator import checked_reverse
from cortado.optimisation.layers.functions import LOSS, PICTURE, READING, Measure, Picture, Steps, Value
from cortado.optimisation.layers.layer import PARAMETER, STATE, Layer, Named, check_state, kept_or_made, named, part
from cortado.problem import Problem
from cortado.render import Renderer
from cortado.rollout.device_states import DeviceState, Given
from cortado.rollout.stepper import require_hash
from cortado.runs.sensor import Sensor
from cortado.scene.parameter_values import Values
from cortado.scene.restart import RestartState
from cortado.simulation import Simulation

Table = Mapping[str, Any]
"""Arrays by name."""
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
KEPT = 4
"""Most layers of one simulation, by their numbers of steps, that are kept for the next call."""


class Bridge(ABC):
    """The functions of another program, such as JAX or PyTorch, that calls of layers need."""

    stack: Callable[[list[Any]], Any]
    """Stacks arrays of the other program along a first axis."""

    @abstractmethod
    def apply(self, layer: Layer, given: dict[str, Any]) -> dict[str, Any]:
        """Apply a layer to arrays by name, differentiably, and return its results by name."""

    @abstractmethod
    def array(self, what: str, value: Any, layer: Layer) -> Any:
        """Return an array of the layer's precision as it is, or numbers as one; raise `InputError` for any other."""

    @abstractmethod
    def made(self, found: Named, layer: Layer) -> dict[str, Any]:
        """Copy arrays of a layer to arrays of the other program."""

    @abstractmethod
    def mapped(self, loss: Callable[[Any, Any], Any], slope: bool) -> Callable[[Any, Any], tuple[Any, Any]]:
        """Return a function of many weights and first positions, along a first axis, whose results are the losses (k,)
        and, with ``slope``, their gradients by name, else an empty table."""

    @abstractmethod
    def with_gradient(self, found: Callable[[Any], tuple[float, Mapping[str, np.ndarray]]], weights: Any) -> Any:
        """Return the value that a function of numbers finds, as one with its gradient in reverse mode."""

    def numbers(self, what: str, value: Any) -> np.ndarray:
        """Copy an array to the host, in float64; raise `InputError` for anything else."""
        return as_precise_numbers(what, value)

    def repeated(
        self, step: Callable[[Any, Any], Any], state: dict[str, Any], rows: dict[str, Any], count: int
    ) -> dict[str, Any]:
        """Return the states to which a step leads again and again, with the next row of each array, and the first one,
        along a first axis."""
        states = [state]
        for k in range(count):
            states.append(step(states[-1], {name: row[k] for name, row in rows.items()}))
        return {name: self.stack([one[name] for one in states]) for name in state}


def bound(
    function: Callable[Concatenate[Bridge, Arguments], Result], bridge: Bridge, module: str
) -> Callable[Arguments, Result]:
    """Return a function below with its ``bridge``, as a public function of a ``module``."""

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
    """Return the layer of ``steps`` steps of a simulation; the last few layers are kept."""
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
    """Return a state as arrays: that before the first step, or a ``given`` one, such as ``trajectory.last_state``.

    ``parameters``, as numbers, are any that a first state depends on, such as ``initial_velocities``; those of the run
    that a given state is of. Returns positions [m] and velocities [m / s] (n, d), mass_fractions (n, phases),
    reference_density (n,), time () [s], and what else a solver carries; of a batch with a first axis for the scenes.
    Raises `InputError` for what does not fit.
    """
    layer = steps_layer(simulation, 1)
    with layer.turn:
        first = simulation.on_device(given, parameters=dict(table_of("parameters", parameters)))
        return part(bridge.made(named(STATE, layer.states.arrays(first)), layer), STATE)


def restart_state(
    bridge: Bridge, simulation: Simulation, given: Table, parameters: Values | None = None
) -> RestartState | tuple[RestartState, ...]:
    """Return a state of arrays as restart states, which `Simulation.run`, files and other processes take."""
    layer = steps_layer(simulation, 1)
    arrays = {name: bridge.numbers(f"state {name}", value) for name, value in table_of("state", given).items()}
    check_state({name: array.shape for name, array in arrays.items()}, layer.states.shapes)
    own = {
        name: bridge.numbers(f"parameter {name}", value) for name, value in table_of("parameters", parameters).items()
    }
    with layer.turn:
        return simulation.on_host(layer.states.state(arrays, own))


def step(
    bridge: Bridge,
    simulation: Simulation,
    given: Table,
    parameters: Table | None = None,
    steps: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, Any]:
    """Return the state after ``steps`` steps from ``given``: `Simulation.step` as a function of arrays.

    ``parameters`` are any of those of `Problem` but first values, arrays or numbers; one over time has a row for each
    of these steps. Reverse mode goes back by the estimator ``gradient``, such as `gradients.AdjointViscosity`, exactly
    if it is left out; forward mode is exact. Exact derivatives of chained steps are of use within the horizon that
    `cortado gradients check` certifies, some hundred steps; beyond ten e-folds of growth a chain warns. A call costs
    1.3 ms beside its steps on a CPU, 2.5 on a GPU: see `docs/layers.md`. Raises `InputError` for what does not fit, and
    `DivergedError` when a particle is lost.
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
    """Return the states after every ``record_every`` of ``steps`` steps, the first one included, along a first axis
    (frames, ...); see `step`."""
    steps, every = whole_number("steps", steps, 1), whole_number("record_every", record_every, 1)
    if steps % every:
        raise InputError(f"record_every is {every}, but must divide the {steps} steps.")
    layer, count = steps_layer(simulation, every, gradient), steps // every
    table = table_of("parameters", parameters)
    arrays = {name: bridge.array(PARAMETER + name, value, layer) for name, value in table.items()}
    if simulation.batch is not None and any(name in simulation.known.over_time for name in arrays):
        over_time = ", ".join(name for name in arrays if name in simulation.known.over_time)
        raise InputError(f"parameter {over_time} is given, but must be left out in a rollout of a batch: chain steps.")
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
    """Return the loss of a problem as a function ``loss(parameters, state=None)`` of arrays by name, whose result is an
    array (), of a batch (batch,).

    With a state the problem begins there. Reverse mode has the gradient that the estimator ``gradient`` gives,
    `gradients.Exact` by default, with the bits of `Problem.value_and_gradient`.
    """
    layer = Value(problem, gradient)

    def loss(parameters: Table, given: Table | None = None) -> Any:
        """Return the loss under these parameters, of the problem that begins at a state if one is given."""
        return _applied(bridge, layer, given, parameters)[LOSS]

    return loss


def measure(bridge: Bridge, simulation: Simulation, what: Sensor | str) -> Callable[..., Any]:
    """Return a sensor, such as one of `cortado.sensors`, or by its name a quantity of the particles, such as
    "pressure", as a function ``reading(state, parameters=None)`` of arrays.

    It returns (k,), a number for each column of the sensor, or the quantity (n,) or (n, d). Parameters are those of the
    step that begins at the state: the pressure is that step's. Raises `InputError` for a simulation that is a batch.
    """
    if not isinstance(simulation, Simulation):
        raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
    layer = Measure(simulation, what)

    def reading(given: Table, parameters: Table | None = None) -> Any:
        """Return the reading of a state; a pressure is that of the step that begins there."""
        return _applied(bridge, layer, given, parameters)[READING]

    return reading


def picture(bridge: Bridge, renderer: Renderer, positions: Any, fractions: Any = None, colours: Any = None) -> Any:
    """Return a picture (rows, columns, 3) of particles, linear RGB: `Renderer.render` as a function of arrays.

    ``positions`` (n, d) [m], ``fractions`` (n, phases), which may be left out with one phase, and ``colours``
    (phases, 3), those of the renderer if left out. It passes through the host, and has derivatives in reverse mode
    only. Raises `InputError` for what does not fit.
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
    """Return a given table, an empty one if it was left out; raise `InputError` for anything but a table by names."""
    found = {} if given is None else given
    likely = {"parameters": "{'gravity': array}", "weights": "{'bias': array}"}.get(what, "{'positions': array, ...}")
    require_table(what, found, likely)
    for name in found:
        if not isinstance(name, str):
            raise InputError(f"{what} has the name {shown(name)}, but must have texts as names.")
    return found
