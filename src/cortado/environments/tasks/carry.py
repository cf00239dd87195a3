"""A cup of water is carried to a place, without spilling.

After TransportWater of SoftGym (Lin et al. 2020), with its reward: minus the distance of the cup to its goal [m], minus
10 times the share of the water that is not in the cup. SoftGym counts particles; here they count smoothly
(`cortado.environments.terms.Share`). The cup can lean as well.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator, Velocity
from cortado.environments.reward import Reward
from cortado.environments.task import WATER, Task
from cortado.environments.terms import Distance, OneBox, Share
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

WIDTH, DEPTH, HEIGHT, WALL = 0.15, 0.1, 0.175, 0.05
"""Of the inside of the cup, of its water, of the cup above the floor of its inside, and of its walls [m]."""
FLOOR = -0.15
"""Height of what spilt water falls on: deeper than a corner of the cup ever is [m]."""
FASTEST, TURNING = 0.6, 1.0
"""[m/s], [rad/s]"""


class Carry(Task):
    """Actions: velocity of the cup along x, and rate at which it leans. Goal: where its middle shall be."""

    name = "Carry"
    horizon, repeats = 75, 6
    coarse_spacing, coarse_step = 0.0125, 0.0025
    lowest = -12.0
    goal_names: ClassVar[tuple[str, ...]] = ("x of the cup [m]",)

    @property
    def scene(self) -> Scene:
        cup = {"name": "cup", "shape": "cup", "base": [0.5 * WIDTH, -WALL], "radius": 0.5 * WIDTH}
        cup |= {"height": WALL + HEIGHT, "thickness": WALL, "motion": "path", "velocity": [0.0, 0.0]}
        reach = 1.1 * FASTEST * self.horizon * self.repeats * self.coarse_step
        return self.scene_of(
            container={"shape": "box", "lower": [-0.2 - reach, FLOOR], "upper": [WIDTH + 0.2 + reach, 0.5]},
            phase=[WATER],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [WIDTH, DEPTH], "phase": "water"}],
            solid=[{**cup, "colour": [0.6, 0.6, 0.65]}],
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        along = Velocity("cup.displacement", (0.0, 0.0), (0,), (FASTEST,))
        return along, Velocity("cup.turn", (0.0,), (0,), (TURNING,), is_number=True)

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        start = 0.5 * WIDTH
        return np.array([start + 0.3]), np.array([start + 0.5])

    def reward(self, simulation: Simulation) -> Reward:
        middle = simulation.scene.solid[0].middle()
        inside = OneBox(tuple(-middle), tuple(np.array([WIDTH, HEIGHT]) - middle))
        share = Share(inside, self.coarse_spacing, solid="cup")
        return Reward(((-1.0, Distance("cup")), (10.0, share)), constant=-10.0)
