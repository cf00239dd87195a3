"""A simulation's loss as a function of parameters, with its gradient and its directional derivative."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from cortado.arrays import check_step_numbers, check_steps, require_arguments, require_function, whole_number
from cortado.calls import Staying, counted, fixed, public
from cortado.device.threads import Turn, in_turn
from cortado.errors import DivergedError, InputError, shown, warn
from cortado.gradients import AdjointEstimator, Estimate, Exact, GradientEstimator, estimate
from cortado.gradients.estimator import checked_reverse
from cortado.losses import Frames, Loss, Snapshot, SnapshotAdjoint, SnapshotBatch
from cortado.losses import fingerprint as loss_fingerprint
from cortado.losses.loss import moment_of, slope
from cortado.losses.run_losses import LossesByStep
from cortado.particles.state import State
from cortado.rollout.checkpoints import MEMORY_BUDGET
from cortado.rollout.device_states import without_lost
from cortado.rollout.parameter_space import ParameterSpace
from cortado.rollout.rollout import OBSERVED, BackwardStep, Observer, Residual, Rollout
from cortado.rollout.run_checks import one_for_each
from cortado.rollout.stepper import backward_step
from cortado.runs.probes import warn_of_places
from cortado.runs.quantity_values import Moment, add_to_row, row_of
from cortado.runs.recording import QuantityReader
from cortado.runs.trajectory import noted
from cortado.scene.parameter_values import NAMES, UNITS, Arrays, Values, require_points
from cortado.scene.restart import RestartState
from cortado.simulation import Simulation
from cortado.solvers.build import fingerprint as parts_fingerprint
from cortado.sph.free_energy import FREE_ENERGIES
from cortado.sph.function_text import code_words

__all__ = ["NAMES", "UNITS", "Problem"]

SPARSE = 8
KEPT = 2


@dataclass(frozen=True)
class ProblemForwardPass(Staying):
    """A stored forward run of a problem, from which backward passes start."""

    loss: Any
    """Loss of the run: a number, or an array (batch,) for a batch of scenes."""
    instead = "but the problem and the parameters can: run the problem again"
    _residual: Residual
    _values: Arrays
    _bars: Mapping[int, SnapshotAdjoint]
    _space: ParameterSpace

    @property
    def turn(self) -> Turn:
        return self._residual.rollout.turn

    @in_turn
    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        """Return the gradient, computed by an ``estimator``. Later evaluations of the problem do not change the result.

        The backward pass calls ``observe`` with the number and the adjoint of each state, beginning with the last
        state. Raises `InputError` for an estimator that is not hashable, or that may mix the scenes of a batch.
        """
        return self._backward(backward_step(self._residual.rollout, estimator), observe)[1]

    @in_turn
    def back_to_state(self, estimator: AdjointEstimator) -> tuple[Arrays, Arrays]:
        """Return the gradient with respect to the parameters, and the derivatives with respect to the first state, both
        from ``estimator``. The keys of the state's derivatives are field names and ``time``."""
        rollout = self._residual.rollout
        derivative = backward_step(rollout, estimator)
        first, gradient = self._backward(derivative)
        initial_state = self._space.state_adjoint(rollout, self._values, first, derivative.parameters())
        return gradient, without_lost(dict.fromkeys(rollout.lost, np.nan), initial_state)

    def _backward(self, derivative: BackwardStep, observe: Observer | None = None) -> tuple[State, Arrays]:
        self._residual.bring_back()
        rollout = self._residual.rollout
        first = rollout.backward(derivative, {step: bar.state for step, bar in self._bars.items()}, observe)
        total = derivative.parameters()
        for own in (bar.step for bar in self._bars.values() if bar.step is not None):
            for name, bar in own.parameters.items():
                whole = total[name].numpy()
                add_to_row(rollout, name, bar, own.row, whole)
                total[name].assign(whole)
        gradient = self._space.gradient(rollout, self._values, first, derivative.parameters())
        if "colours" in self._values:
            gradient["colours"] = np.sum([bar.colours for bar in self._bars.values()], axis=0)
        gradient = without_lost(dict.fromkeys(rollout.lost, np.nan), gradient)
        return first, {name: gradient[name] for name in self._values}


@public
@fixed
class Problem:
    """The loss of a simulation over a number of steps, as a function of parameters.

    The following parameters may be given in any combination:

    - ``gravity`` (d,) or (steps, d) [m / s2]; ``time_step`` [s];
    - ``tilt`` (d - 1,) or (steps, d - 1) [degrees], in place of ``gravity``: angles that turn the scene's gravity and
      keep its magnitude. Gravity along -y turns towards x and, in 3-D, towards z; see
      `cortado.scene.parameter_values.Tilt`;
    - ``initial_positions`` (n, d) [m] and ``initial_velocities`` (n, d) [m / s] of n fluid particles, in the order of
      the scene;
    - ``viscosity`` [Pa s] and ``rest_density`` [kg / m3]: a number, or (phases,) with several phases;
    - with several phases, the initial ``mass_fractions`` (n, phases), ``mobility`` [m2 / s], ``interface_width`` [m];
    - with an emitter NAME, ``NAME.path`` (d,) or (steps, d), positions [m] of the emitter's opening after each step;
    - with an emitter or a sink NAME, ``NAME.flow_rate``, a number or (steps,) [m3 / s];
    - in a scene with surface tension, ``surface_tension`` [N / m];
    - with a loss of images, ``colours`` (phases, 3);
    - with user-defined forces in ``simulation.forces``, the parameters of these forces, such as ``drag.k``.

    Omitted parameters have the scene's values, including schedules. Methods take ``parameters``, a dictionary of values
    by parameter name. The arguments ``gradient`` and ``estimator`` are objects of `cortado.gradients`, by default
    `cortado.gradients.Exact`.

    Example::

        problem = cortado.Problem(simulation, 100, cortado.losses.CentreOfMass([1.0, 0.2]))
        value, gradient = problem.value_and_gradient({"gravity": [0.0, -9.81]})  # gradient["gravity"]: (2,)
        slope = problem.tangent({"gravity": [0.0, -9.81]}, {"gravity": [1.0, 0.0]})
    """

    def __init__(
        self,
        simulation: Simulation,
        steps: int,
        loss: Loss | Frames | Callable[..., Any],
        memory_budget: int = MEMORY_BUDGET,
        state: RestartState | Sequence[RestartState] | None = None,
    ):
        """Make a problem of ``steps`` steps. With 0 steps the loss is computed from the first state.

        ``loss`` is an object with ``value`` and ``adjoint``, a `losses.Frames` of such objects, or a function of Warp
        arrays (see `losses.Recorded`). ``memory_budget`` is the memory [bytes] for states stored by the forward run.
        The backward pass computes all other states again.

        ``state`` is the first state, or a list with one first state for each scene of a batch; see `Simulation.state`.
        With a ``state``, parameters apply to the steps after this state, and initial-value parameters raise an error.
        """
        if not isinstance(simulation, Simulation):
            raise InputError(f"simulation is a {type(simulation).__name__}, but must be a cortado.Simulation.")
        self.simulation, self.steps, self.loss, self.state = simulation, check_steps(steps, least=0), loss, state
        self.memory_budget = whole_number("memory_budget", memory_budget, 0)
        self._states = [one.fixed() for one in one_for_each(state, simulation.batch)]
        self._losses = LossesByStep(loss, self.steps, simulation.scene.solver.chooses)
        warn_of_places(simulation, self._losses.sensors)
        self._space = ParameterSpace(simulation, self.steps)
        self._rollout = Rollout(simulation.solver, self.steps, self.memory_budget)
        self._batches: dict[int, Problem] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Problem, (self.simulation, self.steps, self.loss, self.memory_budget, self._states or None)

    def __repr__(self) -> str:
        loss = getattr(self.loss, "__name__", type(self.loss).__name__)
        return f"Problem({counted(self.steps, 'step')} of {self.simulation!r}, judged by {loss})"

    @property
    def turn(self) -> Turn:
        return self.simulation.turn

    @in_turn
    def value(self, parameters: Values) -> Any:
        """Return the loss at ``parameters``: a number, or for a batch an array (batch,) with NaN for scenes in
        `lost`."""
        return self._losses.total(self._ends(self._checked(parameters), self._losses, keep=False), self._going)

    def end(self, parameters: Values) -> Any:
        """Return the last state of a run with ``parameters``: a `Snapshot`, or a `SnapshotBatch` for a batch."""
        return self.states(parameters, [self.steps])[self.steps]

    @in_turn
    def states(self, parameters: Values, steps: Iterable[int]) -> dict[int, Any]:
        """Return states of a run with ``parameters``, in a dictionary by step number. ``steps`` are the step numbers of
        the states; 0 is the first state."""
        return self._ends(self._checked(parameters), check_step_numbers(steps, self.steps), keep=False)

    @in_turn
    def run(self, parameters: Values, record_every: int = 1) -> Any:
        """Return the trajectory of a run with ``parameters``, with a frame every ``record_every`` steps."""
        self._space.begin(self._rollout, self._checked(parameters), states=self._states)
        return self.simulation.collect(self._rollout, record_every)

    def value_and_gradient(self, parameters: Values, gradient: GradientEstimator | None = None) -> tuple[Any, Arrays]:
        """Return the loss at ``parameters`` and its derivatives by parameter name. A derivative is a float64 array in
        the shape of the parameter. For a batch, each array has a first axis for the scenes."""
        found = self.estimate(parameters, gradient)
        return found.loss, found.gradient

    @in_turn
    def value_and_gradients(
        self, parameters: Values, gradient: AdjointEstimator | None = None
    ) -> tuple[Any, Arrays, Arrays]:
        """Return the loss and its derivatives with respect to ``parameters`` and with respect to the first state.

        The loss and its derivatives with respect to parameters are as in `value_and_gradient`. The derivatives with
        respect to the state are a dictionary of float64 arrays, whose keys are field names and ``time``. For a batch,
        each array has a first axis for the scenes.
        """
        forward_pass = self.forward_pass(parameters)
        return forward_pass.loss, *forward_pass.back_to_state(Exact() if gradient is None else gradient)

    @in_turn
    def estimate(
        self, parameters: Values, gradient: GradientEstimator | None = None, observe: Observer | None = None
    ) -> Estimate:
        """Return the loss, its derivatives, and the report of the estimator ``gradient``, by default `Exact`.

        Estimators with a backward pass call ``observe`` with the number and the adjoint of each state, beginning with
        the last state. `gradients.AdjointNorms` is an example of ``observe``.
        """
        require_function("observe", observe, *OBSERVED)
        found = estimate(self, parameters, gradient, observe)
        kept = slice(None) if self._going is None else self._going
        broken = [name for name, value in found.gradient.items() if not np.isfinite(np.atleast_1d(value)[kept]).all()]
        if broken:
            grew = f"is not finite, as the gradient exceeds the range of {self.simulation.precision.name}"
            advice = "try fewer steps, float64, or an estimator for long runs"
            warn(f"the gradient with respect to {', '.join(broken)} {grew}: {advice}.")
        return found

    @in_turn
    def forward_pass(self, parameters: Values) -> ProblemForwardPass:
        """Return a forward pass, from which backward passes start. A forward pass keeps its states in memory."""
        values = self._checked(parameters)
        ends = self._ends(values, self._losses, keep=True, varied=values)
        residual = Residual(self._rollout)  # before the loss, which may evaluate the problem itself
        loss, found = self._losses.total_and_adjoints(ends, self._going)
        bars = {step: bar.through_quantities(ends[step]) for step, bar in found.items()}
        return ProblemForwardPass(loss, residual, values, bars, self._space)

    @in_turn
    def tangent(self, parameters: Values, directions: Values) -> Any:
        """Return the derivative of the loss along ``directions``, which are tangents by parameter name, computed in
        forward mode. The derivative has the shape of the loss in `value`."""
        dots: dict[int, Arrays] = {}

        def observe(step: int, dot: State) -> None:
            if step in self._losses:
                dots[step] = dot.numpy(3)

        ends = self.tangents(parameters, directions, observe, self._losses)
        loss, bars = self._losses.total_and_adjoints(ends, self._going)
        for step, dot in dots.items():
            dot |= self.along(ends[step], bars[step].quantities, dot, parameters, directions)
            dot |= {name: directions[name] for name in ("colours",) if name in directions}
        found = sum((slope(bars[step], dots[step], np.shape(loss)) for step in sorted(dots)), np.zeros(np.shape(loss)))
        return found + 0.0 * loss if found.ndim else float(found)

    @in_turn
    def tangents(
        self, parameters: Values, directions: Values, observe: Observer, steps: Iterable[int] = ()
    ) -> dict[int, Any]:
        """Run in forward mode. Return a dictionary of the states after the given numbers of ``steps``.

        ``directions`` are tangents by parameter name. The run calls ``observe`` with the number and the tangent of each
        state. The next step overwrites the tangent.
        """
        return self.several_tangents(parameters, [(directions, observe)], steps)

    @in_turn
    def several_tangents(
        self, parameters: Values, each: Iterable[tuple[Values, Observer]], steps: Iterable[int] = ()
    ) -> dict[int, Any]:
        """Run once in forward mode along several directions. Return a dictionary of the states after the given numbers
        of ``steps``. ``each`` yields pairs ``(directions, observe)`` of arguments of `tangents`."""
        values, along = self._checked(parameters), list[tuple[Arrays, Observer]]()
        for pair in each if isinstance(each, Iterable) else [each]:
            if not isinstance(pair, Sequence) or len(pair) != 2:
                raise InputError(f"each contains {shown(pair)}, but must contain pairs (directions, observe).")
            directions, observe = pair
            require_arguments("observe", observe, OBSERVED)
            along.append((self._space.checked(directions, "direction"), observe))
        varied = {name for directions, _ in along for name in directions}
        ends = self._ends(values, check_step_numbers(steps, self.steps), keep=False, varied=varied)
        for directions, observe in along:
            self._rollout.tangent(*self._space.direction(self._rollout, values, directions), observe)
        return ends

    @in_turn
    def along(self, end: Any, quantities: Iterable[str], dot: Arrays, parameters: Values, directions: Values) -> Arrays:
        """Return tangents of ``quantities``, by name, at the state ``end`` of the last run. ``dot`` is the tangent of
        the state by field name. ``directions`` are tangents by parameter name."""
        names = list(quantities)
        if not names:
            return {}
        values, along = self._checked(parameters), self._space.checked(directions, "direction")
        moment, rows = moment_of(end), self._space.direction(self._rollout, values, along)[1].written
        return moment.evaluator().tangents(names, moment, dot, row_of(self._rollout, rows, moment.row))

    @property
    def lost(self) -> Mapping[int, DivergedError]:
        """Errors of the scenes that lost a particle in the last evaluation of a batch, by scene number."""
        return self._rollout.lost

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """Return the greatest number of points that `together` accepts with ``estimator``; see `Batchable.room`."""
        if self.simulation.batch is not None or (estimator is not None and not checked_reverse(estimator).batches):
            return 1
        return self.simulation.room(self.steps, self.memory_budget if estimator else 0.0)

    @in_turn
    def together(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None
    ) -> list[Estimate | DivergedError]:
        """Return estimates at several ``points``, computed as one batch; see `Batchable.together`."""
        require_points(points)
        if estimator is not None:
            checked_reverse(estimator)
        problem, known = self.batch_of(len(points)), self.simulation.known
        over_time = {n for n in points[0] if n in known.over_time and np.ndim(points[0][n]) == known[n].rank}
        rows = [{name: [value] if name in over_time else value for name, value in point.items()} for point in points]
        values = {name: np.stack([np.asarray(row[name], dtype=np.float64) for row in rows]) for name in points[0]}
        found = Estimate(problem.value(values), {}) if estimator is None else estimator.estimate(problem, values)
        shapes = {name: np.shape(value) for name, value in points[0].items()}
        lost = problem.lost
        return [lost[b] if b in lost else found.member(b, shapes) for b in range(len(points))]

    def beginning_at(self, state: RestartState | Sequence[RestartState]) -> "Problem":
        """Return a problem that begins at ``state``. The returned problem shares the arrays of the original problem."""
        found, judged = object.__new__(Problem), self.simulation.judged_states
        states = [one if one in judged else one.fixed() for one in one_for_each(state, self.simulation.batch)]
        found.__dict__ |= {**self.__dict__, "state": state, "_states": states, "_batches": {}}
        return found

    def batch_of(self, size: int) -> "Problem":
        """Return this problem for a batch of ``size`` scenes. The problem caches its batches of the last two sizes."""
        if size not in self._batches:
            while len(self._batches) >= KEPT:
                self._batches.pop(next(iter(self._batches)))
            states = self._states * size or None
            batch = self.simulation.batch_of(size), self.steps, self.loss, self.memory_budget, states
            self._batches[size] = Problem(*batch)
        return self._batches[size]

    @property
    def fingerprint(self) -> str:
        """Text that identifies the problem, for checkpoints.

        The text contains the ``fingerprint`` of the loss. A loss without a fingerprint is identified by its code if it
        is callable, or else by its type.
        """
        simulation, energy = self.simulation, self.simulation.free_energy
        parts = {
            "scene": simulation.scene.computed_json().encode(),
            "first positions": simulation.positions.tobytes(),
            "target and loss": loss_fingerprint(self.loss).encode(),
        }
        checksums = [f"{name} {sha256(content).hexdigest()[:16]}" for name, content in parts.items()]
        for state in self._states:
            fields = b"".join(np.asarray(state[name]).tobytes() for name in sorted(state.fields))
            clock = repr(state.clock) + (f" {state.clock.time_step!r}" if state.clock.time_step else "")
            checksums.append(f"state {sha256(fields + clock.encode()).hexdigest()[:16]}")
        code = "" if energy in FREE_ENERGIES.values() else f" {code_words(energy.functions)}"
        energies = f"free energy {energy.name} {energy.curvature}{code}"
        own = {"forces": simulation.forces, "solver": [simulation.own_solver] if simulation.own_solver else []}
        told = [f"{what} {text}" for what, makers in own.items() if (text := parts_fingerprint(makers, simulation))]
        return "; ".join([f"{self.steps} steps", simulation.precision.name, *checksums, energies, *told])

    def iterations(self) -> np.ndarray:
        """Return the pressure iterations (steps,) of the last evaluation, for solvers with a single iteration loop."""
        return noted(self.diagnostics, "iterations")

    @property
    def diagnostics(self) -> Mapping[str, np.ndarray]:
        """Diagnostics (steps,) of the last evaluation by name, such as ``converged``. The solver sets the names."""
        return self._rollout.diagnostics

    def _checked(self, parameters: Values) -> Arrays:
        values = self._space.checked(parameters)
        self._space.check_restarts(self._states, values)
        self.simulation.judged_states.update(one for one in self._states if one.origin is not None)
        return values

    def _ends(self, values: Arrays, steps: Iterable[int], keep: bool, varied: Iterable[str] = ()) -> dict[int, Any]:
        wanted, single, ends = set(steps), self.simulation.batch is None, dict[int, Any]()
        each = np.array([self._space.colours(own) for own in self._space.members(values)])
        made, colours = (Snapshot, each[0]) if single else (SnapshotBatch, each)

        def observe(step: int, state: State) -> None:
            if step in wanted:
                kept = state.copy()
                moment = Moment.of(self._rollout, step, kept, self.simulation.evaluator)
                ends[step] = made(kept, self.simulation.dimension, colours, moment)

        self._space.begin(self._rollout, values, varied, self._states)
        observe(0, self._rollout.initial)
        each_step = {k: name for k, name in self._losses.quantities(self.simulation.evaluator).items() if k in wanted}
        each_step.pop(self.steps, None)  # no step is behind it
        reader = None
        if each_step and len(each_step) * SPARSE >= self.steps:
            reader = QuantityReader(self.simulation.evaluator(), self._rollout, each_step)
        self._rollout.forward(observe, keep, reader=reader)
        for step, found in () if reader is None else reader.found.items():
            moment_of(ends[step]).know(found)
            moment_of(ends[step]).counts.extend([self._rollout.log.seek(step)] if single else [])
        return ends

    @property
    def _going(self) -> list[int] | None:
        batch = self.simulation.batch
        return None if batch is None else [b for b in range(batch) if b not in self.lost]
