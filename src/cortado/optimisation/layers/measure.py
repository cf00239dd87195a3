"""A sensor, or a quantity of the particles, as a layer: from a state and the parameters of the step after it to what is
read of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.device.threads import Turn, in_turn
from cortado.errors import InputError
from cortado.losses.loss import Snapshot, SnapshotAdjoint
from cortado.optimisation.layers.layer import STATE, Layer, Named, OneByOne, Shapes, named, on_host, part
from cortado.optimisation.layers.parameters import LayerParameters
from cortado.optimisation.layers.states import LAST_STEP, check_state, named_states
from cortado.rollout.device_states import DeviceStates
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.residual import Residual
from cortado.rollout.rollout import Rollout
from cortado.runs.quantities.moment import Moment, row_of
from cortado.runs.sensors.placement import warn_of_places
from cortado.runs.sensors.sensor import Sensor, checked_sensor, value_of
from cortado.scene.parameter_values import Arrays
from cortado.scene.quantity_names import QUANTITIES, check_quantity
from cortado.simulation import Simulation

READING = "reading"
"""The name of what it returns."""


@dataclass(frozen=True, eq=False)
class Look:
    """What derivatives of a reading need."""

    snapshot: Snapshot
    step: Residual
    values: Arrays


class Measure(Layer):
    """What a sensor, or by its name a quantity of the particles, is. Its arrays are those of a state, and parameters of
    the step after it."""

    def __init__(self, simulation: Simulation, what: Sensor | str):
        super().__init__()
        if simulation.batch is not None:
            raise InputError(f"simulation is a batch of {simulation.batch}, but must be of one scene to be measured.")
        self._simulation = simulation
        self._name = check_quantity(what) if isinstance(what, str) else None
        self._sensor = None if isinstance(what, str) else checked_sensor(what)
        warn_of_places(simulation, {repr(what): what})
        self._states, self._parameters = named_states(simulation), LayerParameters(simulation, 1, each=False)
        self._space, self._rollout = ParameterSpace(simulation, 1), Rollout(simulation.solver, 1)
        self.real, self.device = simulation.precision.numpy, simulation.device
        self.on_device = frozenset(STATE + name for name in self._states.fields)
        self.kept_bytes = 2 * sum(array.capacity for array in simulation.initial.arrays())

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses it."""
        return self._simulation.turn

    def check(self, given: Shapes) -> None:
        check_state(part(given, STATE), self._states.shapes)
        self._parameters.check(given, with_state=True)

    def outputs(self) -> dict[str, tuple[int, ...]]:
        simulation = self._simulation
        if self._sensor is not None:
            return {READING: (len(self._sensor.columns(simulation.dimension)),)}
        return {READING: QUANTITIES[str(self._name)].shape(simulation.particles, simulation.dimension)}

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        simulation, values = self._simulation, self._space.checked(self._parameters.values(given))
        state = self._states.state(part(given, STATE), values)
        DeviceStates(simulation).begin(self._space, self._rollout, state, values, set(values))
        moment = Moment.of(self._rollout, 0, state.arrays, simulation.evaluator)
        snapshot = Snapshot(state.arrays, simulation.dimension, self._space.colours(values), moment)
        found = snapshot[str(self._name)] if self._sensor is None else value_of(self._sensor, snapshot)
        return {READING: found}, Look(snapshot, Residual(self._rollout), values) if keep else None

    @in_turn
    def pull(self, residual: Look, bars: Named) -> Named:
        return self._back(residual, on_host(bars[READING]).astype(np.float64))

    @in_turn
    def push(self, residual: Look, dots: Named) -> Named:
        if self._sensor is not None:
            (columns,) = self.outputs()[READING]
            rows = [self._back(residual, one) for one in np.eye(columns)]
            return {READING: np.array([sum((row[n] * on_host(dot)).sum() for n, dot in dots.items()) for row in rows])}
        residual.step.bring_back()
        rollout, own = self._rollout, part(dots, STATE)
        fields = self._states.written({name: dot for name, dot in own.items() if name in self._states.fields})
        along = self._space.checked(self._parameters.values(dots), "direction")
        parameters = rollout.solver.new_parameters(1)
        times = np.reshape(on_host(own.get(STATE_TIME, np.zeros(1))), 1).astype(np.float64)
        self._space.set_direction(rollout, residual.values, along, fields, parameters, times)
        moment, row = residual.snapshot.moment, row_of(rollout, parameters.written, 0)
        assert moment is not None
        name = str(self._name)
        return {READING: moment.tangents([name], fields.numpy(self._simulation.dimension), row)[name]}

    def check_mapped(self) -> None:
        pass

    def many(self, size: int) -> Layer:
        return OneByOne(self, size)

    def _back(self, look: Look, bar: np.ndarray) -> dict[str, Any]:
        """From the adjoint of the reading to those of all arrays, float64."""
        snapshot, rollout = look.snapshot, self._rollout
        found = {str(self._name): bar} if self._sensor is None else self._sensor.adjoint(snapshot, bar)
        state = snapshot.state.like()
        state.set({name: array for name, array in found.items() if name in state.names})
        others = {name: array for name, array in found.items() if name not in state.names}
        whole = SnapshotAdjoint(state, np.zeros_like(snapshot.colours), others).through_quantities(snapshot)
        look.step.bring_back()
        parameters = rollout.solver.new_parameters(1)
        for name, own in whole.step.parameters.items() if whole.step else ():
            parameters[name].assign(own)
        times = self._space.time_adjoints(rollout, look.values, parameters)
        gradient = self._space.gradient(rollout, look.values, whole.state, parameters)
        fields = {name: on_host(array).astype(np.float64) for name, array in self._states.read(whole.state).items()}
        last = {LAST_STEP: np.zeros(())} if LAST_STEP in self._states.shapes else {}
        return {
            **named(STATE, {**fields, STATE_TIME: times[0], **last}),
            **self._parameters.adjoints(gradient, look.values),
        }
