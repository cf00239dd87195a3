"""Cortado as a layer of PyTorch: see `docs/torch.md`.

States are dictionaries of tensors by the names of their fields, in the simulation's precision and on its device, with
their ``time`` [s]; parameters are dictionaries by the names that `Problem` has. Both modes of PyTorch's automatic
differentiation go through all functions, `torch.vmap` too; second derivatives are refused.
"""

from collections.abc import Callable, Mapping
from typing import Any

from cortado.calls import face
from cortado.errors import InputError
from cortado.gradients import AdjointEstimator, GradientEstimator
from cortado.optimisation.layers import calls
from cortado.optimisation.layers.loops import Loop, Smoothed
from cortado.optimisation.layers.with_torch import TorchBridge, torch
from cortado.problem import Problem
from cortado.render import Renderer
from cortado.rollout.device_states import DeviceState, Given, States
from cortado.runs.sensor import Sensor
from cortado.scene.parameter_values import Values
from cortado.simulation import Simulation

__all__ = ["Steps", "measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value"]

Tensors = Mapping[str, Any]
"""Tensors by name."""
_BRIDGE = TorchBridge()


def state(
    simulation: Simulation, given: Given | DeviceState = None, parameters: Values | None = None
) -> dict[str, "torch.Tensor"]:
    """Return a state as tensors: that before the first step, or a ``given`` one, such as ``trajectory.last_state``.

    ``parameters``, as numbers, are any that a first state depends on, such as ``initial_velocities``; those of the run
    that a given state is of. Returns positions [m] and velocities [m / s] (n, d), mass_fractions (n, phases),
    reference_density (n,), time () [s], and what else a solver carries; of a batch with a first axis for the scenes.
    Raises `InputError` for what does not fit.
    """
    return calls.state(_BRIDGE, simulation, given, parameters)


def restart_state(simulation: Simulation, given: Tensors, parameters: Values | None = None) -> States:
    """Return a state of tensors as restart states, which `Simulation.run`, files and other processes take."""
    return calls.restart_state(_BRIDGE, simulation, given, parameters)


def step(
    simulation: Simulation,
    given: Tensors,
    parameters: Tensors | None = None,
    steps: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, "torch.Tensor"]:
    """Return the state after ``steps`` steps from ``given``: `Simulation.step` as a function of tensors.

    ``parameters`` are any of those of `Problem` but first values, tensors or numbers; one over time has a row for each
    of these steps. Reverse mode goes back by the estimator ``gradient``, such as `gradients.AdjointViscosity`, exactly
    if it is left out; forward mode is exact. Exact derivatives of chained steps are of use within the horizon that
    `cortado gradients check` certifies, some hundred steps; beyond ten e-folds of growth a chain warns. A call costs
    1.3 ms beside its steps on a CPU, 2.5 on a GPU: see `docs/layers.md`. Raises `InputError` for what does not fit, and
    `DivergedError` when a particle is lost.
    """
    return calls.step(_BRIDGE, simulation, given, parameters, steps, gradient)


def rollout(
    simulation: Simulation,
    given: Tensors,
    parameters: Tensors | None = None,
    steps: int = 1,
    record_every: int = 1,
    gradient: AdjointEstimator | None = None,
) -> dict[str, "torch.Tensor"]:
    """Return the states after every ``record_every`` of ``steps`` steps, the first one included, along a first axis
    (frames, ...); see `step`."""
    return calls.rollout(_BRIDGE, simulation, given, parameters, steps, record_every, gradient)


def value(problem: Problem, gradient: GradientEstimator | None = None) -> Callable[..., "torch.Tensor"]:
    """Return the loss of a problem as a function ``loss(parameters, state=None)`` of tensors by name, whose result is a
    tensor (), of a batch (batch,).

    With a state the problem begins there. Reverse mode has the gradient that the estimator ``gradient`` gives,
    `gradients.Exact` by default, with the bits of `Problem.value_and_gradient`.
    """
    return calls.value(_BRIDGE, problem, gradient)


def smoothed(
    simulation: Simulation,
    loss: Callable[..., Any],
    estimator: GradientEstimator,
    state: Tensors | None = None,
) -> Smoothed:
    """Return the loss of a closed loop smoothed over an ensemble, as a function of ``weights``, tensors by name.

    Loops run as batches by `torch.vmap`. Arguments, results and errors are those of `cortado.jax.smoothed`.
    """
    return Smoothed(_BRIDGE, estimator, Loop(_BRIDGE, simulation, loss, state))


def measure(simulation: Simulation, what: Sensor | str) -> Callable[..., "torch.Tensor"]:
    """Return a sensor, such as one of `cortado.sensors`, or by its name a quantity of the particles, such as
    "pressure", as a function ``reading(state, parameters=None)`` of tensors.

    It returns (k,), a number for each column of the sensor, or the quantity (n,) or (n, d). Parameters are those of the
    step that begins at the state: the pressure is that step's. Raises `InputError` for a simulation that is a batch.
    """
    return calls.measure(_BRIDGE, simulation, what)


def picture(renderer: Renderer, positions: Any, fractions: Any = None, colours: Any = None) -> "torch.Tensor":
    """Return a picture (rows, columns, 3) of particles, linear RGB: `Renderer.render` as a function of tensors.

    ``positions`` (n, d) [m], ``fractions`` (n, phases), which may be left out with one phase, and ``colours``
    (phases, 3), those of the renderer if left out. It passes through the host, and has derivatives in reverse mode
    only. Raises `InputError` for what does not fit.
    """
    return calls.picture(_BRIDGE, renderer, positions, fractions, colours)


class Steps(torch.nn.Module):
    """A PyTorch module that takes ``steps`` steps of a simulation, with trained parameters of the simulation."""

    def __init__(
        self,
        simulation: Simulation,
        steps: int = 1,
        trained: Values | None = None,
        gradient: AdjointEstimator | None = None,
    ):
        """Make the module; ``trained``: parameters by name with their first values, such as ``{"viscosity": 0.1}``;
        ``gradient`` as of `step`."""
        super().__init__()
        layer = calls.steps_layer(simulation, steps, gradient)
        self.simulation, self.steps, self.gradient = simulation, steps, gradient
        made = {name: _BRIDGE.array(f"parameter {name}", value, layer) for name, value in (trained or {}).items()}
        self.trained = torch.nn.ParameterDict({_key(name): torch.nn.Parameter(own) for name, own in made.items()})
        self._names = tuple(made)

    def forward(self, given: Tensors, parameters: Tensors | None = None) -> dict[str, "torch.Tensor"]:
        """Return the state after the steps; ``parameters`` are further ones, which are not trained."""
        own = {name: self.trained[_key(name)] for name in self._names}
        for name in parameters or {}:
            if name in own:
                raise InputError(f"parameter {name} is given, but must be left out, as the module has its own.")
        return step(self.simulation, given, {**own, **(parameters or {})}, self.steps, self.gradient)


def _key(name: str) -> str:
    """Return PyTorch's name for a parameter, whose name may have a point."""
    return name.replace(".", "/")


__dir__ = face(globals())
