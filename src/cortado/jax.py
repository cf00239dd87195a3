"""Cortado as a layer of JAX: see `docs/layers.md`.

States are dictionaries of arrays by the names of their fields, in the simulation's precision, with their ``time`` [s];
parameters are dictionaries by the names that `Problem` has. All functions are differentiable in both modes, mapped by
`jax.vmap` as batches, and may stand within `jax.jit` and `jax.lax.scan`; second derivatives are refused.
"""

from collections.abc import Callable, Mapping
from typing import Any

from cortado.calls import face
from cortado.gradients import AdjointEstimator, GradientEstimator
from cortado.optimisation.layers import calls
from cortado.optimisation.layers.loops import Loop, Smoothed
from cortado.optimisation.layers.with_jax import JaxBridge, jax
from cortado.problem import Problem
from cortado.render import Renderer
from cortado.rollout.device_states import DeviceState, Given, States
from cortado.runs.sensor import Sensor
from cortado.scene.parameter_values import Values
from cortado.simulation import Simulation

__all__ = ["measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value"]

Arrays = Mapping[str, Any]
"""Arrays by name."""
_BRIDGE = JaxBridge()


def state(
    simulation: Simulation, given: Given | DeviceState = None, parameters: Values | None = None
) -> dict[str, "jax.Array"]:
    """Return a state as arrays of JAX: that before the first step, or a ``given`` one, such as
    ``trajectory.last_state``.

    ``parameters``, as numbers, are any that a first state depends on, such as ``initial_velocities``; those of the run
    that a given state is of. Returns positions [m] and velocities [m / s] (n, d), mass_fractions (n, phases),
    reference_density (n,), time () [s], and what else a solver carries; of a batch with a first axis for the scenes.
    Raises `InputError` for what does not fit.
    """
    return calls.state(_BRIDGE, simulation, given, parameters)


def restart_state(simulation: Simulation, given: Arrays, parameters: Values | None = None) -> States:
    """Return a state of tensors as restart states, which `Simulation.run`, files and other processes take."""
    return calls.restart_state(_BRIDGE, simulation, given, parameters)


def step(
    simulation: Simulation,
    given: Arrays,
    parameters: Arrays | None = None,
    steps: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, "jax.Array"]:
    """Return the state after ``steps`` steps from ``given``: `Simulation.step` as a function of arrays.

    ``parameters`` are any of those of `Problem` but first values, arrays or numbers; one over time has a row for each
    of these steps. Reverse mode goes back by the estimator ``gradient``, such as `gradients.AdjointViscosity`, exactly
    if it is left out; forward mode is exact. Exact derivatives of chained steps are of use within the horizon that
    `cortado gradients check` certifies, some hundred steps; beyond ten e-folds of growth a chain warns. A call costs
    1.3 ms beside its steps on a CPU, 2.5 on a GPU: see `docs/layers.md`. Raises `InputError` for what does not fit, and
    `DivergedError` when a particle is lost. Within a compiled program, where values are known only as it runs, JAX
    raises an error of its own with the same sentence.
    """
    return calls.step(_BRIDGE, simulation, given, parameters, steps, gradient)


def rollout(
    simulation: Simulation,
    given: Arrays,
    parameters: Arrays | None = None,
    steps: int = 1,
    record_every: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, "jax.Array"]:
    """Return the states after every ``record_every`` of ``steps`` steps, the first one included, along a first axis
    (frames, ...); see `step`."""
    return calls.rollout(_BRIDGE, simulation, given, parameters, steps, record_every, gradient)


def value(problem: Problem, gradient: GradientEstimator | None = None) -> Callable[..., "jax.Array"]:
    """Return the loss of a problem as a function ``loss(parameters, state=None)`` of arrays by name, whose result is an
    array (), of a batch (batch,).

    With a state the problem begins there. Reverse mode has the gradient that the estimator ``gradient`` gives,
    `gradients.Exact` by default, with the bits of `Problem.value_and_gradient`.
    """
    return calls.value(_BRIDGE, problem, gradient)


def smoothed(
    simulation: Simulation,
    loss: Callable[..., Any],
    estimator: GradientEstimator,
    state: Arrays | None = None,
) -> Smoothed:
    """Return the loss of a closed loop smoothed over an ensemble, as a function of ``weights``, arrays by name.

    Its value is the mean of the loss, and its gradient the smoothed one; its method ``estimate(weights)`` returns both
    in an `Estimate`, with the standard error. ``loss(weights, state, gradient)`` returns a number, and hands
    ``gradient`` on to `step` or `rollout`. The ``estimator`` says how to smooth, over which spread of the weights, in
    their units, and which scatter of first positions. `gradients.EnsembleMean` has the mean gradient of scattered
    loops, whose sizes `gradients.Guided` corrects by differences of the loss. Loops run as batches that are compiled.
    They begin at ``state``, the scene's first one if left out. Raises `InputError` for what does not fit, and within a
    program that is compiled.
    """
    return Smoothed(_BRIDGE, estimator, Loop(_BRIDGE, simulation, loss, state))


def measure(simulation: Simulation, what: Sensor | str) -> Callable[..., "jax.Array"]:
    """Return a sensor, such as one of `cortado.sensors`, or by its name a quantity of the particles, such as
    "pressure", as a function ``reading(state, parameters=None)`` of arrays.

    It returns (k,), a number for each column of the sensor, or the quantity (n,) or (n, d). Parameters are those of the
    step that begins at the state: the pressure is that step's. Raises `InputError` for a simulation that is a batch.
    """
    return calls.measure(_BRIDGE, simulation, what)


def picture(renderer: Renderer, positions: Any, fractions: Any = None, colours: Any = None) -> "jax.Array":
    """Return a picture (rows, columns, 3) of particles, linear RGB: `Renderer.render` as a function of arrays.

    ``positions`` (n, d) [m], ``fractions`` (n, phases), which may be left out with one phase, and ``colours``
    (phases, 3), those of the renderer if left out. It passes through the host, and has derivatives in reverse mode
    only. Raises `InputError` for what does not fit.
    """
    return calls.picture(_BRIDGE, renderer, positions, fractions, colours)


__dir__ = face(globals())
