"""What is the same for every program that has Cortado as a layer: states, steps, rollouts and losses of its arrays."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

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


def steps_layer(simulation: Simulation, steps: int, gradient: AdjointEstimator | None = None) -> Steps:
    """Return the layer of ``steps`` steps of a simulation; the last few layers are kept."""
    if not isinstance(simulation, Simulation):
        raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
    steps = whole_number("steps", steps, 1)
    layers: dict[Any, Steps] = simulation.__dict__.setdefault("_layers", {})
    if gradient is not None:
        require_hash(checked_reverse(gradient))
    return kept_or_made(layers, (steps, gradient), lambda key: Steps(simulation, *key), KEPT)


def state(bridge: Bridge, simulation: Simulation, given: Given | DeviceState, parameters: Values | None) -> Any:
    """Return a state of Cortado's, the first one if left out, as a table of arrays of the other program."""
    layer = steps_layer(simulation, 1)
    with layer.turn:
        first = simulation.on_device(given, parameters=dict(table_of("parameters", parameters)))
        return part(bridge.made(named(STATE, layer.states.arrays(first)), layer), STATE)


def restart_state(
    bridge: Bridge, simulation: Simulation, given: Table, parameters: Values | None
) -> RestartState | tuple[RestartState, ...]:
    """Return a table of the other program's arrays as a state, from which Cortado can restart."""
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
    parameters: Table | None,
    steps: int,
    gradient: AdjointEstimator | None,
) -> dict[str, Any]:
    """Return the state after ``steps`` steps from a given one."""
    return part(_applied(bridge, steps_layer(simulation, steps, gradient), given, parameters), STATE)


def rollout(
    bridge: Bridge,
    simulation: Simulation,
    given: Table,
    parameters: Table | None,
    steps: int,
    record_every: int,
    gradient: AdjointEstimator | None,
) -> dict[str, Any]:
    """Return the states after every ``record_every`` steps, the first one included, along a first axis."""
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


def value(bridge: Bridge, problem: Problem, gradient: GradientEstimator | None) -> Callable[[Table, Table | None], Any]:
    """Return the loss of a problem as a function of parameters, and of a state."""
    layer = Value(problem, gradient)

    def loss(parameters: Table, given: Table | None = None) -> Any:
        """Return the loss under these parameters, of the problem that begins at a state if one is given."""
        return _applied(bridge, layer, given, parameters)[LOSS]

    return loss


def measure(bridge: Bridge, simulation: Simulation, what: Sensor | str) -> Callable[[Table, Table | None], Any]:
    """Return a sensor or a quantity of the particles as a function of a state and of parameters."""
    if not isinstance(simulation, Simulation):
        raise InputError(f"simulation is {shown(simulation)}, but must be a cortado.Simulation.")
    layer = Measure(simulation, what)

    def reading(given: Table, parameters: Table | None = None) -> Any:
        """Return the reading of a state; a pressure is that of the step that begins there."""
        return _applied(bridge, layer, given, parameters)[READING]

    return reading


def picture(bridge: Bridge, renderer: Renderer, positions: Any, fractions: Any, colours: Any) -> Any:
    """Render a picture of particles, differentiably."""
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
