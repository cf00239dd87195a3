"""A jug is turned, and moved a little, so that its syrup ends in a glass.

After PourWater of SoftGym (Lin et al. 2020), with its reward: the share of the fluid that is in the glass. SoftGym
counts particles; here they count smoothly (`cortado.environments.terms.Share`), and the jug stays at its height.
"""

from typing import Any

from cortado.environments.actuators import Actuator, Velocity
from cortado.environments.reward import Reward
from cortado.environments.task import WATER, Task
from cortado.environments.terms import OneBox, Share
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

LOWER, UPPER, WALL = (0.25, -0.28), (0.45, -0.12), 0.05
"""Corners of the inside of the glass, and the thickness of walls [m]."""
FASTEST, TURNING = 0.1, 4.0
"""[m/s], [rad/s]"""


class Pour(Task):
    """Actions: velocity of the jug along x, and rate at which it turns, counterclockwise."""

    name = "Pour"
    horizon, repeats = 75, 10
    coarse_spacing, coarse_step = 0.0125, 0.00154
    lowest = 0.0

    @property
    def scene(self) -> Scene:
        cup = {"shape": "cup", "thickness": WALL, "colour": [0.6, 0.6, 0.65]}
        jug: dict[str, Any] = {"name": "jug", "base": [0.075, -0.05], "radius": 0.075, "height": 0.25}
        glass: dict[str, Any] = {"name": "glass", "base": [0.5 * (LOWER[0] + UPPER[0]), LOWER[1] - WALL]}
        glass |= {"radius": 0.5 * (UPPER[0] - LOWER[0]), "height": UPPER[1] - LOWER[1] + WALL}
        return self.scene_of(
            container={"shape": "box", "lower": [-0.3, LOWER[1] - WALL], "upper": [0.7, 0.4]},
            phase=[{**WATER, "name": "syrup", "viscosity": 0.3, "colour": [0.8, 0.45, 0.1]}],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.15, 0.125], "phase": "syrup"}],
            solid=[{**cup, **jug, "motion": "path", "angular_velocity": 0.0}, {**cup, **glass}],
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        along = Velocity("jug.displacement", (0.0, 0.0), (0,), (FASTEST,))
        return along, Velocity("jug.turn", (0.0,), (0,), (TURNING,), is_number=True)

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((1.0, Share(OneBox(LOWER, UPPER), 2.0 * self.coarse_spacing)),))
