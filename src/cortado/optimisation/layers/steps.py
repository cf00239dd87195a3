"""Steps of a simulation as a layer: from a state and parameters to a later state."""

from functools import cached_property
from typing import Any

import numpy as np

from cortado.arrays import check_steps
from cortado.device.threads import Turn, in_turn
from cortado.optimisation.layers.layer import STATE, Array, Layer, Named, Shapes, named, on_host, part, unbatched
from cortado.optimisation.layers.parameters import LayerParameters
from cortado.optimisation.layers.states import LAST_STEP, check_state, named_states
from cortado.rollout.checkpoints import MEMORY_BUDGET
from cortado.rollout.device_states import DeviceState
from cortado.rollout.parameter_space import STATE_TIME
from cortado.rollout.stepper import Stepper, StepResidual
from cortado.simulation import Simulation


class Steps(Layer):
    """So many steps of a simulation. Its arrays are the fields of a state, with its time, and parameters."""

    def __init__(self, simulation: Simulation, steps: int, each: bool = False):
        """``each`` as that of `LayerParameters`."""
        super().__init__()
        self._simulation, self._steps, self._each = simulation, check_steps(steps), each
        self.states = named_states(simulation)
        """What makes states of named arrays."""
        self._parameters = LayerParameters(simulation, steps, each)
        self.real, self.device = simulation.precision.numpy, simulation.device
        self.on_device = frozenset(STATE + name for name in self.states.fields)
        own = sum(array.capacity for array in simulation.initial.arrays())
        self.kept_bytes = min(steps * own, MEMORY_BUDGET)

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses it."""
        return self._simulation.turn

    @cached_property
    def _stepper(self) -> Stepper:
        return self._simulation.stepper(self._steps)

    def check(self, given: Shapes) -> None:
        check_state(part(given, STATE), self.states.shapes)
        self._parameters.check(given, with_state=True)

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return named(STATE, self.states.shapes)

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        values = self._parameters.on_device(given)
        state = self.states.state(part(given, STATE), values)
        residual: StepResidual | None = None
        if keep:
            end, residual = self._stepper.step(state, values)
        else:
            end = self._stepper.advance(state, values)
        assert isinstance(end, DeviceState)
        return named(STATE, self.states.arrays(end)), residual

    @in_turn
    def pull(self, residual: StepResidual, bars: Named) -> Named:
        before, found = self._stepper.vjp(residual, self._derivatives(bars))
        return {**self._named(before), **self._parameters.adjoints(found, residual.values)}

    @in_turn
    def push(self, residual: StepResidual, dots: Named) -> Named:
        return self._named(self._stepper.jvp(residual, self._derivatives(dots), self._parameters.on_device(dots)))

    def check_mapped(self) -> None:
        if self._simulation.batch is not None:
            raise unbatched(f"a simulation that is a batch of {self._simulation.batch}")

    def many(self, size: int) -> Layer:
        return Steps(self._simulation.batch_of(size), self._steps, each=True)

    def _derivatives(self, given: Named) -> dict[str, Any]:
        """With respect to a state, as a stepper takes them."""
        own = part(given, STATE)
        fields = self.states.written({name: array for name, array in own.items() if name in self.states.fields})
        found = {name: fields.numbers(name) for name in own if name in self.states.fields}
        members = self.states.shapes[STATE_TIME]
        return found | {name: np.reshape(on_host(own[name]), members) for name in (STATE_TIME,) if name in own}

    def _named(self, found: dict[str, Any]) -> dict[str, Array]:
        """The other way round. What steps were chosen by has no derivative."""
        last = {LAST_STEP: np.zeros(self.states.shapes[LAST_STEP])} if LAST_STEP in self.states.shapes else {}
        return named(STATE, {**self.states.narrowed(found), STATE_TIME: np.asarray(found[STATE_TIME]), **last})
