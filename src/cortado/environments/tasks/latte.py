"""Milk flows from a nozzle into coffee, and shall lie where a hidden path of the nozzle would have put it.

After LatteArt of FluidLab (Xian et al. 2023), with its reward but for scale and a constant: minus the squared distances
of the milk that has been poured from where it is under the hidden path at the same time, their mean over the squared
radius of the cup.
"""

import warnings
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator, Position
from cortado.environments.reward import Reward
from cortado.environments.task import COFFEE, MILK, Task
from cortado.environments.terms import Missed
from cortado.errors import CortadoWarning
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

RADIUS, DEPTH, OPENING, COLUMN = 0.03, 0.015, 0.0025, 0.0625
"""Of the cup, of its coffee, of the nozzle, and of the milk in it [m]."""
HEIGHT = DEPTH + 0.005
"""Of the nozzle above the floor [m]."""
REACH, LAG, POURING = 0.6 * RADIUS, 0.03, 25
"""How far the nozzle can be sent [m], how it follows [s], and for how many steps of the environment it pours."""


class Latte(Task):
    """Actions: where the nozzle is sent to, along x."""

    name = "Latte"
    horizon, repeats = 32, 6
    coarse_spacing, coarse_step = 0.0025, 0.0014
    lowest = -4.0

    @property
    def scene(self) -> Scene:
        return self._poured(self.speed * 2.0 * OPENING)

    @property
    def speed(self) -> float:
        """Of the milk in the nozzle [m/s]."""
        return COLUMN / (POURING * self.repeats * self.coarse_step)

    def _poured(self, flow_rate: float) -> Scene:
        jet: dict[str, Any] = {"phase": "milk", "outlet": [0.0, HEIGHT], "radius": OPENING, "length": COLUMN}
        return self.scene_of(
            container={"shape": "box", "lower": [-RADIUS, 0.0], "upper": [RADIUS, 2.5 * DEPTH]},
            phase=[{**one, "viscosity": 0.3} for one in (COFFEE, MILK)],
            fluid=[{"shape": "box", "lower": [-RADIUS, 0.0], "upper": [RADIUS, DEPTH], "phase": "coffee"}],
            emitter={**jet, "flow_rate": flow_rate},
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        return (Position("nozzle_path", (0.0, HEIGHT), (0,), (REACH,), lag=LAG),)

    def reward(self, simulation: Simulation) -> Reward:
        targets, weights = _hidden(self, simulation.device.alias, simulation.precision.name)
        return Reward(((-1.0, Missed(targets, weights)),))


def hidden_actions(task: Latte) -> NDArray:
    """(horizon, 1) the breadth of a heart, as somebody goes once around it, and then the middle."""
    angle = 2.0 * np.pi * np.arange(task.horizon) / POURING
    return np.where(angle < 2.0 * np.pi, np.sin(angle) ** 3, 0.0)[:, None]


@cache
def _hidden(task: Latte, device: str, precision: str) -> tuple[NDArray, NDArray]:
    """Positions under the hidden path after each step of the environment (horizon, n, d) [m], and the weights of the
    particles of milk that have been poured until then (horizon, n) [1/m2]."""
    simulation = Simulation(task.scene, device, precision)
    (nozzle,), steps = task.actuators, task.horizon * task.substeps
    path = nozzle.over(task.horizon, task.substeps, task.time_step).parameter(hidden_actions(task))
    with warnings.catch_warnings():  # of the milk, which is out before the end
        warnings.simplefilter("ignore", CortadoWarning)
        run = simulation.run(steps, {nozzle.parameter: path}, record_every=task.substeps)
    emitter = simulation.scene.emitter
    assert emitter is not None
    sample, first = emitter.sample(task.spacing), simulation.free_particles
    weights = np.zeros((task.horizon, simulation.particles))
    times = run.times[1:, None]
    poured = sample.upstream < sample.speed * times
    weights[:, first:] = poured / np.maximum(poured.sum(axis=1, keepdims=True), 1) / RADIUS**2
    return run.positions[1:], weights
