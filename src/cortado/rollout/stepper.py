"""Time steps of a simulation as a function of a state and of parameters, with derivatives."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast, overload

import numpy as np
import warp as wp

from cortado.arrays import check_steps, require_methods
from cortado.calls import Staying, counted, sized
from cortado.device.threads import Turn, in_turn, require
from cortado.errors import InputError, shown, warn
from cortado.particles.state import Parameters, State
from cortado.rollout.device_states import (
    DeviceRows,
    DeviceState,
    DeviceStates,
    Given,
    HostStates,
    States,
    of_lost,
    without_lost,
)
from cortado.rollout.parameter_space import STATE_TIME, ParameterSpace
from cortado.rollout.rollout import AdjointStep, BackwardStep, Residual, Rollout
from cortado.rollout.run_checks import check_directions, trouble
from cortado.rollout.scene_parameters import Simulated
from cortado.scene.parameter_values import Arrays, Values

KEPT = 4
MOST_GROWTH = 10.0
"""Growth of an adjoint that causes a warning [e-folds]."""


class ReverseEstimator(Protocol):
    """Protocol of gradient estimators with a backward pass through each step."""

    @property
    def batches(self) -> bool:
        """True if the estimator treats the scenes of a batch separately."""

    def derivative(self, rollout: Rollout) -> BackwardStep:
        """Return the backward step for a rollout."""


def require_hash(estimator: Any) -> Any:
    """Return an estimator that can be the key of a cache. Raises `InputError` if its settings can change."""
    try:
        hash(estimator)
    except TypeError as error:
        raise InputError(f"estimator has an {error}, but must be a dataclass(frozen=True) of numbers.") from None
    return estimator


def backward_step(rollout: Rollout, estimator: ReverseEstimator | None) -> BackwardStep:
    """Return the backward step of an estimator, by default of `Exact`. The rollout caches backward steps."""
    solver = rollout.solver
    if estimator is not None:
        wanted = "an AdjointEstimator such as cortado.gradients.AdjointViscosity()"
        require_methods("gradient", estimator, ("derivative",), wanted)
        if solver.layout.batch is not None and not estimator.batches:
            found = f"{type(estimator).__name__} is given a batch, but has no `batches = True`"
            raise InputError(f"{found}, which declares that the estimator treats each scene separately.")
    if require_hash(estimator) not in rollout.derivatives:
        parts = solver.gradient_memory(rollout.log)
        require(parts, "take a larger spacing or fewer pressure iterations", solver.device)
        rollout.derivatives[estimator] = AdjointStep(rollout) if estimator is None else estimator.derivative(rollout)
    return rollout.derivatives[estimator]


@dataclass(frozen=True, eq=False, repr=False)
class StepResidual(Staying):
    """The stored data of `Stepper.step` for `Stepper.vjp` and `Stepper.jvp`. Later steps do not change a residual."""

    evaluation: Residual
    values: Arrays
    rows: Mapping[str, wp.array]
    place: HostStates
    instead = "but the state before the steps and the parameters can: take the steps again"

    def __repr__(self) -> str:
        steps = counted(self.evaluation.rollout.steps, "step")
        return f"StepResidual({steps}, parameters {sized(self.values) or 'none'})"


class AdjointGrowth:
    """The growth of the adjoint of states over successive calls of `Stepper.vjp`.

    Calls form a chain if the steps of each call end where the steps of the previous call began. The growth is the
    growth of the norm over the whole chain, or the sum of the growths within each call if smaller. The adjoints x^ of
    positions and v^ of velocities have the norm sqrt(|x^|^2 + |v^|^2 / T^2), where T is the duration of the chain.
    """

    def __init__(self) -> None:
        self._reached, self._ended, self._within, self._steps = math.nan, 0.0, 0.0, 0
        self._begun = 0.0, 0.0
        self._warned = False

    def follow(self, rollout: Rollout, squares: np.ndarray) -> None:
        """Add a call. ``squares`` are sums over the adjoints of its last and its first state."""
        size = float(rollout.time_steps[0])
        start, end = (rollout.clocks[0].after(steps, size).time for steps in (0, rollout.steps))
        into, out = np.sqrt(squares, dtype=np.float64).reshape(2, 2).tolist()
        if not (abs(end - self._reached) < 0.5 * (end - start) / rollout.steps and any(self._begun)):
            self._begun, self._ended, self._within, self._steps = into, end, 0.0, 0
        self._reached, self._steps = start, self._steps + rollout.steps
        each = [math.hypot(x, v / (self._ended - start)) for x, v in (self._begun, into, out)]
        at_first, before, after = (math.log(one) if one > 0.0 else -math.inf for one in each)
        self._within += after - before
        growth = min(after - at_first, self._within)
        if growth > MOST_GROWTH and not self._warned:
            self._warned = True
            found = f"by e^{growth:.1f}" if math.isfinite(growth) else "beyond 1e19, whose square overflows,"
            back = (
                f"backwards from {self._ended:.4g} s to {start:.4g} s, so that gradients of earlier steps are useless"
            )
            advice = "chain fewer steps, or take gradient=cortado.gradients.AdjointViscosity()"
            warn(f"The adjoint of the state has grown {found} over {self._steps} steps, {back}: {advice}.")


def write_sums_of_squares(sums: wp.array, *states: State) -> None:
    """Sum the squares of positions and of velocities of each state, without waiting for a GPU."""
    for k, array in enumerate(array for state in states for array in (state.positions, state.velocities)):
        wp.utils.array_inner(array, array, out=sums[k : k + 1])


class Stepper:
    """A fixed number of steps of a simulation, as a function of the first state and of parameters."""

    def __init__(self, simulation: Simulated, steps: int):
        self._simulation, self._space = simulation, ParameterSpace(simulation, steps)
        self._rows = DeviceRows(simulation, self._space)
        self.rollout = Rollout(simulation.solver, steps)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._simulation, self.rollout.steps)

    @property
    def turn(self) -> Turn:
        """Lock of the simulation, which allows only one call at a time."""
        return self.rollout.turn

    @in_turn
    def first(self, parameters: Values | None = None) -> States:
        """Return the state before the first step of a run with the given parameters."""
        self._space.begin(self.rollout, self._checked(parameters))
        return HostStates(self._simulation).state(self.rollout, self.rollout.initial, 0)

    @in_turn
    def on_device(self, state: Given | DeviceState, fields: Values, parameters: Values | None = None) -> DeviceState:
        """Return a copy of a state on the device, with replaced ``fields``."""
        values, place = self._checked(parameters), DeviceStates(self._simulation)
        self._begin(state, values, {})
        found = place.state(self.rollout, self.rollout.initial, 0)
        return place.replaced(self._space, found, fields) if fields else found

    @in_turn
    def on_host(self, state: DeviceState) -> States:
        """Return a state on the device as NumPy arrays."""
        if not isinstance(state, DeviceState):
            raise InputError(f"state is {shown(state)}, but must be a DeviceState from simulation.on_device.")
        return DeviceStates(self._simulation).on_host(state)

    @in_turn
    def advance(self, state: Any, parameters: Values | None = None, place: HostStates | None = None) -> Any:
        """Return the state after the steps. If ``state`` is on the device, the result is on the device. Parameters over
        time may be Warp arrays on the device, in the simulation's precision. Values in Warp arrays are unchecked."""
        values, rows = self._given(parameters)
        place = self._begin(state, values, rows, place=place)
        return place.state(self.rollout, self._forward(keep=False), self.rollout.steps, state)

    @in_turn
    def follow(self, state: DeviceState, rows: Arrays) -> DeviceState:
        """Return the state after the steps, with the parameters of the last `advance` and new parameters over time.
        ``rows`` (batch, steps, ...) are the values of all parameters over time, and are not checked."""
        place = DeviceStates(self._simulation)
        if self._space.depends_on_time(rows):
            place.begin(self._space, self.rollout, state, dict(rows), set())
        else:
            place.follow(self.rollout, state)
            self.rollout.parameters.set(rows)
        return place.state(self.rollout, self._forward(keep=False), self.rollout.steps, state)

    @in_turn
    def step(
        self, state: Any, parameters: Values | None = None, along: Iterable[str] = (), place: HostStates | None = None
    ) -> tuple[Any, StepResidual]:
        """Return the state after the steps, and a residual for `vjp` and `jvp`. Any number of residuals may exist at
        the same time.

        ``along`` names further parameters that `jvp` may vary. Only the mobility must be named, because fluid with
        mobility 0 is computed without diffusion. Parameters may be on the device, as in `Simulation.advance`.
        """
        values, rows = self._given(parameters)
        place = self._begin(state, values, rows, {*values, *self._space.checked_names("along", along)}, place)
        last = place.state(self.rollout, self._forward(keep=True), self.rollout.steps, state)
        return last, StepResidual(Residual(self.rollout), values, rows, place)

    @in_turn
    def vjp(
        self, residual: StepResidual, state_bar: Values, gradient: ReverseEstimator | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the adjoints of the first state and of the given parameters, given the adjoint ``state_bar`` of the
        last state (reverse mode). ``gradient`` is the estimator, by default `Exact`; see `docs/gradients.md`.

        The adjoint of a state is a dictionary of arrays by field name, with the shapes of the fields. The adjoint of a
        state has a number under the key ``time``. Fields without a given derivative get 0. Arrays of a `DeviceState`
        are on the device, and arrays on the host are in float64. For a batch, each array has a first axis for the
        scenes. Results for a lost scene are 0 if the scene's adjoint in ``state_bar`` is 0, and otherwise NaN.

        The adjoint of a parameter on the device is also on the device, in the shape of the parameter. Raises
        `InputError` for unknown fields and for wrong shapes.
        """
        rollout, space, place = self.rollout, self._space, self._place_of(residual)
        adjoint = backward_step(self.rollout, gradient)
        times = place.write("state_bar", state_bar, self._bar)
        values = residual.values
        residual.evaluation.bring_back()
        first = rollout.backward(adjoint, {rollout.steps: self._bar})
        write_sums_of_squares(self._squares, self._bar, first)
        found = adjoint.parameters()
        earlier = space.time_adjoints(rollout, values, found)
        before = (earlier[0] if self._simulation.batch is None else earlier) + times
        own = space.gradient(rollout, values, first, found, elsewhere=residual.rows)
        if "time_step" in own:  # a longer step ends later
            own["time_step"] = own["time_step"] + rollout.steps * times
        lost = of_lost(rollout, self._bar, times)
        time_bar = without_lost(lost, {STATE_TIME: before})
        rows = self._rows.adjoints(residual.rows, found, lost)
        state = {**place.read(first, lost), **time_bar}
        if rollout.steps:
            self._simulation.__dict__.setdefault("_growth", AdjointGrowth()).follow(rollout, self._squares.numpy())
        return state, {**without_lost(lost, own), **rows}

    @in_turn
    def jvp(self, residual: StepResidual, state_dot: Values, parameter_dots: Values | None = None) -> dict[str, Any]:
        """Return the tangent of the last state, given the tangents of the first state and of parameters (forward mode).
        Tangents have the same form as the adjoints in `vjp`."""
        rollout, space, place = self.rollout, self._space, self._place_of(residual)
        looked_at, rows = self._rows.split(parameter_dots, "direction")
        along = space.checked(looked_at, "direction")
        check_directions(along, self._simulation.known.state)
        dot, parameters_dot = self._dots
        times = place.write("state_dot", state_dot, dot)
        values = residual.values
        residual.evaluation.bring_back()
        if "mobility" in along and not rollout.substeps:
            why = 'as a step with mobility 0 computes no diffusion: step(..., along=["mobility"])'
            raise InputError(f"direction mobility is given, but must be named in the call of step, too, {why}.")
        space.set_direction(rollout, values, along, dot, parameters_dot, np.broadcast_to(times, len(rollout.clocks)))
        self._rows.write(rows, parameters_dot)
        lost = of_lost(rollout, dot, times, parameters_dot)
        rollout.tangent(dot, parameters_dot, lambda number, state: None)
        later = times + rollout.steps * np.broadcast_to(along.get("time_step", np.zeros(())), times.shape)
        return {**place.read(dot, lost), **without_lost(lost, {STATE_TIME: later})}

    def _place_of(self, residual: StepResidual) -> HostStates:
        if not isinstance(residual, StepResidual) or residual.evaluation.rollout is not self.rollout:
            raise InputError(f"residual is {shown(residual)}, but must be returned by this stepper's step.")
        return residual.place

    @cached_property
    def _bar(self) -> State:
        return self.rollout.solver.new_state()

    @cached_property
    def _squares(self) -> wp.array:
        positions = self._bar.positions
        return wp.empty(4, dtype=positions.dtype._wp_scalar_type_, device=positions.device)

    @cached_property
    def _dots(self) -> tuple[State, Parameters]:
        return self.rollout.solver.new_state(), self.rollout.solver.new_parameters(self.rollout.steps)

    def _begin(
        self,
        state: Any,
        values: Arrays,
        rows: Mapping[str, wp.array],
        varied: Iterable[str] = (),
        place: HostStates | None = None,
    ) -> HostStates:
        place = place or (DeviceStates if isinstance(state, DeviceState) else HostStates)(self._simulation)
        place.begin(self._space, self.rollout, state, values, set(varied))
        self._rows.write(rows, self.rollout.parameters)
        return place

    def _checked(self, parameters: Values | None) -> Arrays:
        return self._space.checked({} if parameters is None else parameters)

    def _given(self, parameters: Values | None) -> tuple[Arrays, dict[str, wp.array]]:
        looked_at, rows = self._rows.split(parameters)
        return self._space.checked(looked_at) | self._rows.stand_ins(rows), rows

    def _forward(self, keep: bool) -> State:
        last = self.rollout.forward(keep=keep)
        for sentence in trouble(self.rollout, self._simulation.scene):
            warn(sentence)
        return last


class Stepping:
    """Methods of a simulation that take time steps and differentiate them, such as ``step``, `vjp` and `jvp`."""

    @property
    def turn(self) -> Turn:
        """Lock of the simulation, which allows only one call at a time."""
        raise NotImplementedError

    def state(self, parameters: Values | None = None) -> States:
        """Return the state before the first step, for ``step`` and ``Simulation.run(state=...)``. For a batch, return a
        tuple with the state of each scene.

        ``parameters`` are parameters of `Problem` that change the first state, such as ``initial_velocities``. Raises
        `InputError` for any other parameter.
        """
        return self.stepper(0).first(parameters)

    def on_device(
        self, state: Given | DeviceState = None, fields: Values | None = None, parameters: Values | None = None
    ) -> DeviceState:
        """Return a state in arrays on the device, for other programs with DLPack. By default, the state is the first
        state of a run. Steps from the returned state stay on the device.

        ``fields`` are arrays with the DLPack interface that replace fields of the state: (n, 3) for vectors, (n,
        phases) for fractions, (n,) for numbers. For a batch, each array has a first axis for the scenes. Each array
        must have the precision and the device of the simulation. The simulation checks the new state on the host.
        ``parameters`` are the parameters of the run to which the state belongs. Raises `InputError` for invalid input.
        """
        return self.stepper(0).on_device(state, fields or {}, parameters)

    def on_host(self, state: DeviceState) -> States:
        """Copy a ``state`` on the device to NumPy arrays, for files, other processes and ``Simulation.run``. Raises
        `InputError` for a state of a different simulation."""
        return self.stepper(0).on_host(state)

    @overload
    def step(self, state: Given, parameters: Values | None = None, steps: int = 1) -> States: ...

    @overload
    def step(self, state: DeviceState, parameters: Values | None = None, steps: int = 1) -> DeviceState: ...

    def step(self, state: Any, parameters: Values | None = None, steps: int = 1) -> Any:
        """Return the state after ``steps`` steps from ``state``. The new state is exactly the last state of
        ``run(steps, parameters, state=state)``.

        For a batch, the result is a tuple with the state of each scene, and the state of a lost scene is NaN. For a
        `DeviceState`, the result is a `DeviceState`. ``parameters`` are any parameters of `Problem` except initial
        values, because ``state`` contains the initial values. A parameter over time has a first axis of length
        ``steps``. Further calls with the same number of steps are faster. `advance` has the same warnings and errors as
        `Simulation.run`.
        """
        return self.stepper(check_steps(steps)).advance(state, parameters)

    def vjp(
        self,
        state: Given | DeviceState,
        parameters: Values | None,
        state_bar: Values,
        steps: int = 1,
        gradient: ReverseEstimator | None = None,
    ) -> tuple[dict[str, Any], Arrays]:
        """Return the adjoints of ``state`` and of ``parameters``, given the adjoint ``state_bar`` of the state after
        ``steps`` steps (reverse mode). ``gradient`` is the estimator; see `Stepper.vjp`."""
        stepper = self.stepper(check_steps(steps))
        return stepper.vjp(stepper.step(state, parameters)[1], state_bar, gradient)

    def jvp(
        self,
        state: Given | DeviceState,
        parameters: Values | None,
        state_dot: Values,
        parameter_dots: Values | None = None,
        steps: int = 1,
    ) -> dict[str, Any]:
        """Return the tangent of the state after ``steps`` steps, given the tangents ``state_dot`` of ``state`` and
        ``parameter_dots`` of any ``parameters`` (forward mode); see `Stepper.jvp`."""
        stepper = self.stepper(check_steps(steps))
        residual = stepper.step(state, parameters, along=parameter_dots or ())[1]
        return stepper.jvp(residual, state_dot, parameter_dots)

    @in_turn
    def stepper(self, steps: int) -> Stepper:
        """Return the `Stepper` for the given number of steps. The simulation caches the last few steppers."""
        steppers: dict[int, Stepper] = self.__dict__.setdefault("_steppers", {})
        found = steppers.pop(steps, None) or Stepper(cast(Simulated, self), check_steps(steps, least=0))
        steppers[steps] = found  # the last one
        while len(steppers) > KEPT:
            steppers.pop(next(iter(steppers)))
        return found
