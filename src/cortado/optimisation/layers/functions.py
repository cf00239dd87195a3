"""Layers that compute steps, the loss of a problem, sensor readings, and pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import check_steps
from cortado.device.threads import WARP, Turn, in_turn
from cortado.errors import InputError, MissingDerivativeError, shown
from cortado.gradients import AdjointEstimator, Estimate, Exact, GradientEstimator
from cortado.gradients.estimator import checked_estimator
from cortado.losses.loss import Snapshot, bar_on_device
from cortado.optimisation.layers.layer import (
    LAST_STEP,
    PARAMETER,
    STATE,
    Array,
    Layer,
    Named,
    OneByOne,
    Shapes,
    check_state,
    named,
    named_states,
    on_host,
    part,
)
from cortado.problem import Problem
from cortado.render import Renderer
from cortado.rollout.checkpoints import MEMORY_BUDGET
from cortado.rollout.device_states import DeviceRows
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.rollout import Residual, Rollout
from cortado.rollout.stepper import Stepper, StepResidual
from cortado.runs.probes import warn_of_places
from cortado.runs.quantity_values import Moment, row_of
from cortado.runs.sensor import Sensor, checked_sensor, value_of
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import QUANTITIES, check_quantity
from cortado.simulation import Simulation

LOSS, READING, PICTURE = "loss", "reading", "picture"


class LayerParameters:
    """A converter of the arrays of a layer to parameters of a simulation, and of adjoints back to arrays.

    If ``each`` is True, each scene of the batch is one evaluation of the layer, and the first axis of every array
    numbers the evaluations. If ``each`` is False, a parameter may have any shape that `docs/batches.md` allows.
    """

    def __init__(self, simulation: Simulation, steps: int, each: bool):
        self._simulation, self._each = simulation, each
        self._space = ParameterSpace(simulation, steps)
        self._rows = DeviceRows(simulation, self._space)

    def check(self, given: Shapes, with_state: bool) -> None:
        for name, shape in part(given, PARAMETER).items():
            shapes = self._space.shapes(name)
            if with_state and name in self._simulation.known.state:
                raise InputError(f"parameter {name} is given, but must be left out: the state contains {name}.")
            if shape not in shapes:
                raise InputError(f"parameter {name} has shape {shape}, but must be {' or '.join(map(str, shapes))}.")

    def values(self, given: Named) -> Arrays:
        own = part(given, PARAMETER)
        return {name: self._shaped(name, on_host(array).astype(np.float64)) for name, array in own.items()}

    def on_device(self, given: Named) -> dict[str, Array]:
        found = {}
        for name, array in part(given, PARAMETER).items():
            stays = isinstance(array, wp.array) and self._rows.takes(name)
            found[name] = self._shaped(name, array if stays else on_host(array).astype(np.float64))
        return found

    def _shaped(self, name: str, array: Array) -> Array:
        shapes = self._space.shapes(name)
        if self._each and name in self._simulation.known.over_time and array.ndim == len(shapes[0]) + 1:
            return array.reshape((array.shape[0], 1, *array.shape[1:]))
        is_number = isinstance(array, np.ndarray) and array.shape == (1,) and (1,) not in shapes
        return array.reshape(()) if is_number else array

    def adjoints(self, found: Mapping[str, Array], values: Arrays) -> Named:
        """Return derivatives in the shapes of ``values``. If scenes share a value, the derivatives of these scenes are
        summed."""
        shared = {}
        for name, bar in found.items():
            if isinstance(bar, np.ndarray):
                shape = values[name].shape
                is_shared = bar.size != int(np.prod(shape))
                shared[name] = (bar.sum(axis=0) if is_shared else bar).reshape(shape)
        return named(PARAMETER, {**found, **shared})


class OfSimulation(Layer):
    """Base class of layers whose arguments are a state and parameters of a simulation."""

    def __init__(self, simulation: Simulation, steps: int, each: bool = False):
        super().__init__()
        self._simulation, self._each = simulation, each
        self.states = named_states(simulation)
        self._parameters = LayerParameters(simulation, steps, each)
        self.real, self.device = simulation.precision.numpy, simulation.device
        self.on_device = frozenset(STATE + name for name in self.states.fields)
        self.unmapped = f"a simulation that is a batch of {simulation.batch}" if simulation.batch is not None else ""
        self._state_size = sum(array.capacity for array in simulation.initial.arrays())

    @property
    def turn(self) -> Turn:
        return self._simulation.turn

    def check(self, given: Shapes) -> None:
        check_state(part(given, STATE), self.states.shapes)
        self._parameters.check(given, with_state=True)

    def _last_step(self) -> dict[str, Array]:
        return {LAST_STEP: np.zeros(self.states.shapes[LAST_STEP])} if LAST_STEP in self.states.shapes else {}


class Steps(OfSimulation):
    def __init__(
        self, simulation: Simulation, steps: int, gradient: AdjointEstimator | None = None, each: bool = False
    ):
        self._steps, self._gradient = check_steps(steps), gradient
        super().__init__(simulation, steps, each)
        self.kept_bytes = min(steps * self._state_size, MEMORY_BUDGET)

    @cached_property
    def _stepper(self) -> Stepper:
        return self._simulation.stepper(self._steps)

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return named(STATE, self.states.shapes)

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        values, state = self._parameters.on_device(given), part(given, STATE)
        if keep:
            end, residual = self._stepper.step(state, values, place=self.states)
            return named(STATE, end), residual
        return named(STATE, self._stepper.advance(state, values, self.states)), None

    @in_turn
    def pull(self, residual: StepResidual, bars: Named) -> Named:
        before, found = self._stepper.vjp(residual, part(bars, STATE), self._gradient)
        return {**self._named(before), **self._parameters.adjoints(found, residual.values)}

    @in_turn
    def push(self, residual: StepResidual, dots: Named) -> Named:
        return self._named(self._stepper.jvp(residual, part(dots, STATE), self._parameters.on_device(dots)))

    def _named(self, found: dict[str, Any]) -> dict[str, Array]:
        return named(STATE, {**found, STATE_TIME: np.asarray(found[STATE_TIME]), **self._last_step()})

    def many(self, size: int) -> Layer:
        if self._gradient is not None and not self._gradient.batches:
            return OneByOne(self, size)
        return Steps(self._simulation.batch_of(size), self._steps, self._gradient, each=True)


class Evaluation:
    def __init__(self, problem: Problem, values: Arrays, estimator: GradientEstimator, with_state: bool):
        self._problem, self.values, self._estimator, self._with_state = problem, values, estimator, with_state
        self._run = problem.forward_pass(values) if isinstance(estimator, AdjointEstimator) else None
        self._found: Arrays | None = None
        if self._run is None:
            found: Estimate = problem.estimate(values, estimator)
            self._found = named(PARAMETER, found.gradient)
        self.loss: Any = found.loss if self._run is None else self._run.loss

    @property
    def gradient(self) -> Arrays:
        """Return the gradient of the loss by array name, in float64. In a batch the first axis is the scene."""
        if self._found is None:
            assert self._run is not None and isinstance(self._estimator, AdjointEstimator)
            if self._with_state:
                found, state = self._run.back_to_state(self._estimator)
                last = {LAST_STEP: np.zeros(np.shape(self.loss))}  # by which the steps were chosen: see docs/steps.md
                self._found = {**named(PARAMETER, found), **named(STATE, state | last)}
            else:
                self._found = named(PARAMETER, self._estimator.back(self._run))
            self._run = None  # frees its states
        return self._found

    def along(self, dots: Named) -> Any:
        """Return the derivative of the loss along the tangents ``dots``. Forward mode is used without a gradient
        estimator."""
        if isinstance(self._estimator, Exact) and not self._with_state and self._found is None:
            return self._problem.tangent(self.values, part(dots, PARAMETER))
        terms = [self.gradient[name] * dot for name, dot in dots.items()]
        return sum(np.reshape(term, (*np.shape(self.loss), -1)).sum(axis=-1) for term in terms) + 0.0 * self.loss


class Value(OfSimulation):
    """A layer that computes the loss of a problem. The arguments are parameters and, optionally, an initial state."""

    def __init__(self, problem: Problem, gradient: GradientEstimator | None = None, each: bool = False):
        if not isinstance(problem, Problem):
            raise InputError(f"problem is {shown(problem)}, but must be a cortado.Problem.")
        super().__init__(problem.simulation, problem.steps, each)
        self._problem = problem
        self._estimator = Exact() if gradient is None else checked_estimator(gradient)
        self.on_device = frozenset()
        self.unmapped = self.unmapped and f"a problem whose simulation is a batch of {self._simulation.batch}"
        self.kept_bytes = min(problem.steps * self._state_size, problem.memory_budget)

    def check(self, given: Shapes) -> None:
        own = part(given, STATE)
        if own:
            check_state(own, self.states.shapes)
        if own and not isinstance(self._estimator, AdjointEstimator):
            kind = type(self._estimator).__name__
            raise InputError(f"gradient is a {kind}, but must be an AdjointEstimator if a state is given.")
        self._parameters.check(given, with_state=bool(own) or self._problem.state is not None)

    def outputs(self) -> dict[str, tuple[int, ...]]:
        batch = self._simulation.batch
        return {LOSS: () if batch is None else (batch,)}

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        values, own, problem = self._parameters.values(given), part(given, STATE), self._problem
        if own:
            problem = problem.beginning_at(self.states.restart_states(own, values))
        if not keep:
            return {LOSS: np.asarray(problem.value(values))}, None
        found = Evaluation(problem, values, self._estimator, bool(own))
        return {LOSS: np.asarray(found.loss)}, found

    @in_turn
    def pull(self, residual: Evaluation, bars: Named) -> Named:
        bar = on_host(bars[LOSS]).astype(np.float64).reshape(np.shape(residual.loss)) if LOSS in bars else 0.0
        scaled = {name: _times(found, bar) for name, found in residual.gradient.items()}
        own = self._parameters.adjoints(part(scaled, PARAMETER), residual.values)
        return {**{name: found for name, found in scaled.items() if name.startswith(STATE)}, **own}

    @in_turn
    def push(self, residual: Evaluation, dots: Named) -> Named:
        own = {name: on_host(dot).astype(np.float64) for name, dot in dots.items() if name.startswith(STATE)}
        found = np.asarray(residual.along({**own, **named(PARAMETER, self._parameters.values(dots))}))
        return {LOSS: np.where(self._moved(dots), found, 0.0)}

    def _moved(self, dots: Named) -> Any:
        """Return a mask () or (batch,) of the scenes with a non-zero tangent."""
        found = np.zeros(self.outputs()[LOSS], dtype=bool)
        for name, dot in dots.items():
            array = on_host(dot)
            own = self._each or name.startswith(STATE)
            found |= array.reshape(*found.shape, -1).any(axis=-1) if own else bool(array.any())
        return found

    def many(self, size: int) -> Layer:
        estimator = self._estimator
        if not isinstance(estimator, AdjointEstimator) or not estimator.batches:
            return OneByOne(self, size)
        return Value(self._problem.batch_of(size), estimator, each=True)


def _times(found: np.ndarray, bar: Any) -> np.ndarray:
    """Multiply ``found`` by the adjoint ``bar`` of each scene. The product is 0 where ``bar`` is 0, even if ``found``
    is NaN."""
    factor = np.reshape(bar, (*np.shape(bar), *(1,) * (found.ndim - np.ndim(bar))))
    return np.where(factor == 0.0, 0.0, found) * factor


@dataclass(frozen=True, eq=False)
class Look:
    snapshot: Snapshot
    step: Residual
    values: Arrays


class Measure(OfSimulation):
    """A layer that computes a sensor reading or a particle quantity. The arguments are a state and the parameters of
    the next step."""

    def __init__(self, simulation: Simulation, what: Sensor | str):
        if simulation.batch is not None:
            raise InputError(f"simulation is a batch of {simulation.batch} scenes, but must have one scene.")
        super().__init__(simulation, 1)
        self._name = check_quantity(what) if isinstance(what, str) else None
        self._sensor = None if isinstance(what, str) else checked_sensor(what)
        warn_of_places(simulation, {repr(what): what})
        self._space, self._rollout = ParameterSpace(simulation, 1), Rollout(simulation.solver, 1)
        self.kept_bytes = 2 * self._state_size

    def outputs(self) -> dict[str, tuple[int, ...]]:
        simulation = self._simulation
        if self._sensor is not None:
            return {READING: (len(self._sensor.columns(simulation.dimension)),)}
        return {READING: QUANTITIES[str(self._name)].shape(simulation.particles, simulation.dimension)}

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        simulation, values = self._simulation, self._space.checked(self._parameters.values(given))
        self.states.begin(self._space, self._rollout, part(given, STATE), values, set(values))
        state = self._rollout.initial.copy()
        moment = Moment.of(self._rollout, 0, state, simulation.evaluator)
        snapshot = Snapshot(state, simulation.dimension, self._space.colours(values), moment)
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
        fields = rollout.solver.new_state()
        times = self.states.write("direction", own, fields).reshape(1)
        along = self._space.checked(self._parameters.values(dots), "direction")
        parameters = rollout.solver.new_parameters(1)
        self._space.set_direction(rollout, residual.values, along, fields, parameters, times)
        moment, row = residual.snapshot.moment, row_of(rollout, parameters.written, 0)
        assert moment is not None
        name = str(self._name)
        found = moment.evaluator().tangents([name], moment, fields.numpy(self._simulation.dimension), row)
        return {READING: found[name]}

    def _back(self, look: Look, bar: np.ndarray) -> dict[str, Any]:
        snapshot, rollout = look.snapshot, self._rollout
        found = {str(self._name): bar} if self._sensor is None else self._sensor.adjoint(snapshot, bar)
        whole = bar_on_device(found, snapshot).through_quantities(snapshot)
        look.step.bring_back()
        parameters = rollout.solver.new_parameters(1)
        for name, own in whole.step.parameters.items() if whole.step else ():
            parameters[name].assign(own)
        times = self._space.time_adjoints(rollout, look.values, parameters)
        gradient = self._space.gradient(rollout, look.values, whole.state, parameters)
        fields = {name: on_host(array).astype(np.float64) for name, array in self.states.read(whole.state, {}).items()}
        return {
            **named(STATE, {**fields, STATE_TIME: times[0], **self._last_step()}),
            **self._parameters.adjoints(gradient, look.values),
        }


class Picture(Layer):
    """A layer that renders pictures on the host. The arguments are positions (n, d) [m] and, optionally, mass fractions
    (n, phases) and colours (phases, 3)."""

    def __init__(self, renderer: Renderer):
        super().__init__()
        if not isinstance(renderer, Renderer):
            raise InputError(f"renderer is {shown(renderer)}, but must be a renderer, such as simulation.renderer().")
        self._renderer = renderer
        self.real, self.device = renderer.precision.numpy, renderer.device
        self.kept_bytes = sum(int(np.prod(shape)) for shape in renderer.inputs.values()) * renderer.precision.bytes

    def check(self, given: Shapes) -> None:
        wanted = self._renderer.inputs
        if "positions" not in given:
            raise InputError(f"positions is left out, but must be an array of shape {wanted['positions']}.")
        for name, shape in given.items():
            if shape != wanted[name]:
                raise InputError(f"{name} has shape {shape}, but must have {wanted[name]}.")

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return {PICTURE: self._renderer.shape}

    @WARP
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        own = {name: np.array(on_host(array)) for name, array in given.items()}
        return {PICTURE: self._renderer.render(**own)}, own if keep else None

    @WARP
    def pull(self, residual: dict[str, np.ndarray], bars: Named) -> Named:
        self._renderer.render(**residual)  # because the renderer's last picture may be another one
        found = self._renderer.adjoint(on_host(bars[PICTURE]).astype(np.float64))
        positions = found.positions.numpy()[:, : residual["positions"].shape[1]]
        all_found = {"positions": positions, "fractions": found.fractions.numpy(), "colours": found.colours}
        return {name: np.array(all_found[name]) for name in residual}

    def push(self, residual: dict[str, np.ndarray], dots: Named) -> Named:
        raise MissingDerivativeError("A picture has derivatives in reverse mode only: take a gradient.")
