"""An episode as a differentiable function of its actions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_at_most, whole_number
from cortado.environments.scenes import Scenes
from cortado.environments.task import checked_actions, split
from cortado.environments.terms import MinusReward
from cortado.errors import InputError, shown
from cortado.gradients import GradientEstimator
from cortado.losses import Frames
from cortado.optimisation.transforms import Affine, FixedParameters, Transformed
from cortado.problem import Problem
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation


class Twin:
    """The same scene, start and goal as an episode, as a loss of its actions (actions, a): minus the sum of the
    rewards. Actions beyond -1 to 1 are cut off there, as in the environment, and have no derivative."""

    def __init__(self, scenes: Scenes, number: int = 0, actions: int | None = None):
        """``number`` of the scene whose present episode it is; ``actions``: how many, at most as many as an episode
        has, which is what is taken if left out."""
        task, simulation = scenes.task, scenes.simulation
        count = whole_number("actions", task.horizon if actions is None else actions, 1)
        require_at_most("actions", count, task.horizon)
        require_at_most("number", whole_number("number", number, 0), len(scenes) - 1)
        start = scenes.starts[number]
        self._actuators, self._start = task.actuators, {"initial_positions": start.positions}
        self.coordinates = {one.parameter: one.over(count, task.substeps, task.time_step) for one in task.actuators}
        """From the actions of each actuator to the parameter that it drives."""
        goal, m = start.goal[None], task.substeps
        loss = Frames({k * m: MinusReward(scenes.reward, goal, k) for k in range(1, count + 1)})
        single = Simulation(task.scene, simulation.device.alias, simulation.precision.name)
        self.problem = Problem(single, count * m, loss)
        """The loss as one of the parameters of the scene."""
        fixed: Any = FixedParameters(self.problem, self._start)
        self.search = Transformed(fixed, self.coordinates)
        """The loss as one of the actions, named by `named`: what `cortado.optimise` takes."""
        self.shape = count, sum(len(one.axes) for one in task.actuators)
        """(actions, a)"""

    def named(self, actions: Any) -> Arrays:
        """Actions by the names of the parameters that they drive."""
        parts = split(self._actuators, checked_actions("actions", actions, self.shape))
        return {one.parameter: u for one, u in zip(self._actuators, parts, strict=True)}

    def value(self, actions: Any) -> float:
        """Minus the return."""
        return self.search.value(self.named(actions))

    def value_and_gradient(
        self, actions: Any, gradient: GradientEstimator | None = None
    ) -> tuple[float, NDArray[np.float64]]:
        """The same, and its derivative (actions, a), by any estimator, `gradients.Exact` by default."""
        value, found = self.search.value_and_gradient(self.named(actions), gradient)
        bar = np.concatenate([found[one.parameter] for one in self._actuators], axis=1)
        return value, np.where(np.abs(actions) <= 1.0, bar, 0.0)

    def in_jax(self, gradient: GradientEstimator | None = None) -> Any:
        """The loss as a function of an array (actions, a) of JAX, which differentiates it: see `cortado.jax.value`."""
        from cortado.jax import value
        from cortado.optimisation.layers.with_jax import jnp

        def contracted(one: Affine, u: Any) -> Any:
            return jnp.asarray(one.base, u.dtype) + jnp.tensordot(jnp.asarray(one.matrix, u.dtype), u, 2)

        loss = value(self.problem, gradient)
        return lambda actions: loss(self._parameters(self._shaped(jnp.asarray(actions)).clip(-1.0, 1.0), contracted))

    def in_torch(self, gradient: GradientEstimator | None = None) -> Any:
        """The loss as a function of a tensor (actions, a) of PyTorch: see `cortado.torch.value`."""
        from cortado.optimisation.layers.with_torch import torch
        from cortado.torch import value

        def contracted(one: Affine, u: Any) -> Any:
            return u.new_tensor(one.base) + torch.tensordot(u.new_tensor(one.matrix), u, 2)

        loss = value(self.problem, gradient)
        return lambda actions: loss(self._parameters(self._shaped(actions).clamp(-1.0, 1.0), contracted))

    def _shaped(self, actions: Any) -> Any:
        """Actions of another library; raises `InputError` for another shape."""
        shape = getattr(actions, "shape", None)
        if shape is None or tuple(shape) != self.shape:
            found = f"is {shown(actions)}" if shape is None else f"has shape {tuple(shape)}"
            raise InputError(f"actions {found}, but must be an array {self.shape}.")
        return actions

    def _parameters(self, u: Any, contracted: Any) -> dict[str, Any]:
        """Of the scene, given actions of another library, and how it multiplies."""
        found, first = dict[str, Any](self._start), 0
        for one in self._actuators:
            last = first + len(one.axes)
            found[one.parameter] = contracted(self.coordinates[one.parameter], u[:, first:last])
            first = last
        return found
