"""Parameters in, loss out; loss and gradient; and the derivative along a direction."""

from collections.abc import Callable, Mapping
from hashlib import sha256
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.losses import Loss, Recorded, TrajectoryEnd
from cortado.particles import Parameters, State
from cortado.policies import Exact, Policy
from cortado.rollout import MEMORY_BUDGET, Rollout, StepDerivative
from cortado.simulation import Simulation, as_numbers, check_steps
from cortado.trajectory import Trajectory

SCALARS = ("rest_density", "viscosity", "time_step")
"""Parameters that are one number, in the order in which the solver adds up their adjoints."""
STATES = ("initial_positions", "initial_velocities")
NAMES = ("gravity", *STATES, *SCALARS)
UNITS = dict(zip(NAMES, ("m/s²", "m", "m/s", "kg/m³", "Pa s", "s"), strict=True))

Values = Mapping[str, Any]


class Problem:
    """A simulation of a number of steps, judged by a loss.

    Parameters, any of them together: ``gravity`` (d,) or (steps, d) [m / s2]; ``initial_positions`` [m] and
    ``initial_velocities`` [m / s], (n, d); ``viscosity`` [Pa s], ``rest_density`` [kg / m3], ``time_step`` [s].
    What is not given is the scene's. n counts fluid particles in the order in which the scene lists them.
    """

    def __init__(
        self,
        simulation: Simulation,
        steps: int,
        loss: Loss | Callable[..., Any],
        memory_budget: int = MEMORY_BUDGET,
    ):
        """``loss``: an object with ``value`` and ``adjoint``, or a function of Warp arrays (see `losses.Recorded`).

        ``memory_budget``: bytes of states kept on the way forward; with less, states are recomputed on the way back.
        """
        if not isinstance(simulation, Simulation):
            raise InputError(f"simulation is a {type(simulation).__name__}, but must be a cortado.Simulation.")
        if not hasattr(loss, "adjoint") and not callable(loss):
            raise InputError(
                f"loss is a {type(loss).__name__}, but must have a value and an adjoint, or be a function."
            )
        self.simulation, self.steps = simulation, check_steps(steps)
        self.loss: Loss = loss if hasattr(loss, "adjoint") else Recorded(loss)  # type: ignore[assignment]
        self._rollout = Rollout(simulation.solver, self.steps, memory_budget)
        self._derivatives: dict[Policy, StepDerivative] = {}

    def value(self, parameters: Values) -> float:
        """The loss, forward only."""
        return self.loss.value(self.end(parameters))

    def end(self, parameters: Values, keep: bool = False) -> TrajectoryEnd:
        """The last state of the rollout under these parameters; ``keep`` checkpoints for a derivative."""
        self._set(self._checked(parameters))
        return TrajectoryEnd(self._rollout.forward(keep=keep), self.simulation.dimension)

    def run(self, parameters: Values, record_every: int = 1) -> Trajectory:
        """The whole trajectory under these parameters; see `Simulation.run`."""
        self._set(self._checked(parameters))
        return self.simulation.collect(self._rollout, record_every)

    def value_and_gradient(
        self, parameters: Values, policy: Policy | None = None
    ) -> tuple[float, dict[str, np.ndarray]]:
        """The loss and its derivatives: for each parameter given, an array of its shape (float64)."""
        values = self._checked(parameters)
        end = self.end(values, keep=True)
        bar = self._adjoint(end)
        derivative = self._derivative(Exact() if policy is None else policy)
        self._rollout.backward(derivative, bar)
        gravity, scalars = derivative.parameters()
        found = {"gravity": gravity[:, : self.simulation.dimension], **dict(zip(SCALARS, scalars, strict=True))}
        if not values.keys().isdisjoint(STATES):
            states = (array.astype(np.float64) for array in bar.numpy(self.simulation.dimension))
            found |= dict(zip(STATES, states, strict=True))
        if "gravity" in values and values["gravity"].ndim == 1:
            found["gravity"] = found["gravity"].sum(axis=0)
        return self.loss.value(end), {name: np.asarray(found[name]) for name in values}

    def tangent(self, parameters: Values, directions: Values) -> float:
        """The derivative of the loss along ``directions`` (any of the parameters), by forward mode."""
        dot, parameters_dot = self._directions(self._checked(directions, "direction"))
        end = self.end(parameters, keep=False)
        self._rollout.tangent(dot, parameters_dot)
        pairs = zip(self._adjoint(end).numpy(3), dot.numpy(3), strict=True)
        return float(sum((bar.astype(np.float64) * d).sum() for bar, d in pairs))

    @property
    def fingerprint(self) -> str:
        """Which problem this is, in a checksum: scene, precision, steps, ``fingerprint`` of the loss; for a loss
        without one only its type is known."""
        loss = getattr(self.loss, "fingerprint", type(self.loss).__qualname__)
        text = f"{self.simulation.scene.to_json()} {self.simulation.precision.name} {self.steps} {loss}"
        return sha256(text.encode()).hexdigest()

    def iterations(self) -> np.ndarray:
        """(steps,) pressure iterations of the last evaluation."""
        return self._rollout.iterations

    def _adjoint(self, end: TrajectoryEnd) -> State:
        bar = self.loss.adjoint(end)
        if isinstance(bar, State):
            copy = self._state()
            copy.assign(bar)
            return copy
        shape = self.simulation.positions.shape
        for what, array in zip(("positions", "velocities"), bar, strict=True):
            if np.shape(array) != shape:
                raise InputError(f"the loss's adjoint of {what} has shape {np.shape(array)}, but must be {shape}.")
        return self._state(*bar)

    def _derivative(self, policy: Policy) -> StepDerivative:
        if isinstance(policy, type) or not hasattr(policy, "derivative"):
            raise InputError(f"policy is {policy!r}, but must be an object such as cortado.policies.Exact().")
        if policy not in self._derivatives:
            self._derivatives[policy] = policy.derivative(self._rollout)
        return self._derivatives[policy]

    def _checked(self, values: Values, what: str = "parameter") -> dict[str, np.ndarray]:
        shape = self.simulation.positions.shape
        checked = {}
        for name, value in values.items():
            if name not in NAMES:
                raise InputError(f"{what} {name!r} is unknown, but must be one of {', '.join(NAMES)}.")
            array = as_numbers(f"{what} {name}", value)
            wanted = {"gravity": array.shape, "initial_positions": shape, "initial_velocities": shape}.get(name, ())
            if array.shape != wanted:
                raise InputError(f"{what} {name} has shape {array.shape}, but must be {wanted}.")
            if name == "gravity":
                self.simulation.gravity_table(array, self.steps)
            if not np.isfinite(array).all():
                raise InputError(f"{what} {name} has a value that is not finite, but must be numbers.")
            if what == "parameter" and name in ("rest_density", "time_step") and array <= 0:
                raise InputError(f"{what} {name} is {array}, but must be greater than 0.")
            if what == "parameter" and name == "viscosity" and array < 0:
                raise InputError(f"{what} {name} is {array}, but must be at least 0.")
            checked[name] = array
        return checked

    def _set(self, values: dict[str, np.ndarray]) -> None:
        simulation, phase = self.simulation, self.simulation.phase
        self._rollout.initial.assign(simulation.state)
        if not values.keys().isdisjoint(STATES):
            self._rollout.initial.set(
                values.get("initial_positions", simulation.positions),
                values.get("initial_velocities", simulation.velocities),
            )
        self._rollout.parameters.set(
            simulation.gravity_table(values.get("gravity"), self.steps),
            float(values.get("rest_density", phase.rest_density)),
            float(values.get("viscosity", phase.viscosity)),
            float(values.get("time_step", simulation.scene.solver.time_step)),
        )

    def _directions(self, values: dict[str, np.ndarray]) -> tuple[State, Parameters]:
        nothing = np.zeros_like(self.simulation.positions)
        dot = self._state(*(values.get(name, nothing) for name in STATES))
        parameters = Parameters.zeros(self.steps, self.simulation.precision, self.simulation.device)
        scalars = {name: float(values.get(name, 0.0)) for name in SCALARS}
        parameters.set(values.get("gravity", np.zeros(self.simulation.dimension)), **scalars)
        return dot, parameters

    def _state(self, *arrays: np.ndarray) -> State:
        state = State.zeros(self.simulation.particles, self.simulation.precision, self.simulation.device)
        if arrays:
            state.set(*arrays)
        return state
