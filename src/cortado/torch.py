"""Cortado as a layer of PyTorch: see `docs/torch.md`.

States are dictionaries of tensors by field name, with their ``time`` [s]. The tensors have the simulation's precision
and are on its device. Parameters are dictionaries by parameter name, as in `Problem`. All functions support forward
mode, reverse mode and `torch.vmap`; second derivatives raise an error.
"""

from collections.abc import Mapping
from typing import Any

from cortado.calls import face
from cortado.errors import InputError
from cortado.gradients import AdjointEstimator
from cortado.optimisation.layers import user_functions
from cortado.optimisation.layers.user_functions import bound
from cortado.optimisation.layers.with_torch import TorchBridge, torch
from cortado.scene.parameter_values import Values
from cortado.simulation import Simulation

__all__ = ["Steps", "measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value"]

Tensors = Mapping[str, Any]
_BRIDGE = TorchBridge()
measure = bound(user_functions.measure, _BRIDGE, __name__)
picture = bound(user_functions.picture, _BRIDGE, __name__)
restart_state = bound(user_functions.restart_state, _BRIDGE, __name__)
rollout = bound(user_functions.rollout, _BRIDGE, __name__)
smoothed = bound(user_functions.smoothed, _BRIDGE, __name__)
state = bound(user_functions.state, _BRIDGE, __name__)
step = bound(user_functions.step, _BRIDGE, __name__)
value = bound(user_functions.value, _BRIDGE, __name__)


class Steps(torch.nn.Module):
    """A PyTorch module that runs ``steps`` steps of a simulation, with trained parameters of the simulation."""

    def __init__(
        self,
        simulation: Simulation,
        steps: int = 1,
        trained: Values | None = None,
        gradient: AdjointEstimator | None = None,
    ):
        """``trained`` are initial values of parameters, as in ``{"viscosity": 0.1}``. ``gradient`` is as in `step`."""
        super().__init__()
        layer = user_functions.steps_layer(simulation, steps, gradient)
        self.simulation, self.steps, self.gradient = simulation, steps, gradient
        made = {name: _BRIDGE.array(f"parameter {name}", value, layer) for name, value in (trained or {}).items()}
        trained_by_key = {name.replace(".", "/"): torch.nn.Parameter(own) for name, own in made.items()}
        self.trained, self._names = torch.nn.ParameterDict(trained_by_key), tuple(made)

    def forward(self, given: Tensors, parameters: Tensors | None = None) -> dict[str, "torch.Tensor"]:
        """Return the state after the steps. ``parameters`` are additional, untrained parameters."""
        own = {name: self.trained[name.replace(".", "/")] for name in self._names}
        for name in parameters or {}:
            if name in own:
                raise InputError(f"parameter {name} is given, but must be left out, as the module trains {name}.")
        return step(self.simulation, given, {**own, **(parameters or {})}, self.steps, self.gradient)


__dir__ = face(globals())
