"""All tasks, by name: a cup that is carried, a latte, a jug that pours, a raft, a splash, and a cup that is stirred.
The cup and the jug come in the plane and in space."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.task import Actuator, Position, Task, Velocity
from cortado.environments.terms import Distance, Miss, Missed, OneBox, Pose, Reward, Share, Spread
from cortado.errors import CortadoWarning, InputError, shown
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.1, 0.3, 0.8]}
COFFEE = {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.20, 0.09, 0.04]}
MILK = {"name": "milk", "rest_density": 950.0, "viscosity": 0.05, "colour": [0.95, 0.92, 0.85]}
LED = {"motion": "path", "velocity": [0.0, 0.0], "colour": [0.6, 0.6, 0.65]}
"""Table of a solid that actions move along a path."""


def box(lower: Sequence[float], upper: Sequence[float], **others: Any) -> dict[str, Any]:
    """Return the scene table of a box with corners ``lower`` and ``upper`` [m] and other keys."""
    return {"shape": "box", "lower": lower, "upper": upper, **others}


def led(solid: str, fastest: float, turning: float, dimension: int) -> tuple[Actuator, Actuator]:
    """Return the actuators of a solid that goes along x, at most so fast [m/s], and turns about z [rad/s]."""
    still, plane = (0.0,) * dimension, dimension == 2
    turn: Any = {"rest": (0.0,), "axes": (0,)} if plane else {"rest": still, "axes": (2,)}
    return (
        Velocity(f"{solid}.displacement", still, (0,), (fastest,)),
        Velocity(f"{solid}.turn", greatest=(turning,), is_number=plane, **turn),
    )


class Vessels(Task):
    """A task of cups and jugs: in space they are round, about axes at z = 0, and in the plane they are cuts through
    these."""

    view: ClassVar[dict[str, Any]] = {}
    """Table of the pictures: in space where the camera is, and where it looks at [m]."""

    def place(self, x: float, y: float) -> list[float]:
        """Return a point of the plane z = 0 [m]."""
        return [x, y, 0.0][: self.dimension]

    def corners(self, lower: Sequence[float], upper: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return the corners of a box in the plane [m], in space with a square base about z = 0."""
        half = 0.5 * (upper[0] - lower[0])
        return [*lower, -half][: self.dimension], [*upper, half][: self.dimension]

    def filled(self, lower: Sequence[float], upper: Sequence[float], phase: str) -> dict[str, Any]:
        """Return the table of fluid in a box of the plane [m], in space in a round vessel of this cut."""
        if self.dimension == 2:
            return box(lower, upper, phase=phase)
        size = {"radius": 0.5 * (upper[0] - lower[0]), "height": upper[1] - lower[1]}
        return {"shape": "cylinder", "base": self.place(0.5 * (lower[0] + upper[0]), lower[1]), **size, "phase": phase}

    def room(self, lower: Sequence[float], upper: Sequence[float]) -> dict[str, Any]:
        """Return the table of a container; in space there is none, and what is spilt falls on and on."""
        return box(lower, upper) if self.dimension == 2 else {"shape": "none"}


class Carry(Vessels):
    """The task of carrying a cup of water to a place, without spilling.

    Actions: velocity of the cup along x, and rate at which it leans. Goal: where its middle shall be. After
    TransportWater of SoftGym (Lin et al. 2020), with its reward: minus the distance of the cup to its goal [m], minus
    10 times the share of the water that is not in the cup. SoftGym counts particles; here they count smoothly
    (`cortado.environments.terms.Share`). The cup can lean as well.
    """

    name = "Carry"
    horizon, repeats = 75, 6
    coarse_spacing, coarse_step = 0.0125, 0.0025
    lowest = -12.0
    goal_names: ClassVar[tuple[str, ...]] = ("x of the cup [m]",)
    width, depth, height, wall = 0.15, 0.1, 0.175, 0.05
    """Of the inside of the cup, of its water, of the cup above the floor of its inside, and of its walls [m]."""
    floor = -0.15
    """Height of the floor on which spilt water falls, deeper than any corner of the cup [m]."""
    fastest, turning = 0.6, 1.0
    """[m/s], [rad/s]"""
    actuators = led("cup", fastest, turning, 2)
    goals = np.array([0.5 * width + 0.3]), np.array([0.5 * width + 0.5])

    @property
    def scene(self) -> Scene:
        base = self.place(0.5 * self.width, -self.wall)
        cup = {"name": "cup", "shape": "cup", "base": base, "radius": 0.5 * self.width}
        cup |= {"height": self.wall + self.height, "thickness": self.wall}
        reach = 1.1 * self.fastest * self.horizon * self.repeats * self.coarse_step
        return self.scene_of(
            container=self.room([-0.2 - reach, self.floor], [self.width + 0.2 + reach, 0.5]),
            phase=[WATER],
            fluid=[self.filled([0.0, 0.0], [self.width, self.depth], "water")],
            solid=[{**cup, **LED, "velocity": self.place(0.0, 0.0)}],
            picture=self.view,
        )

    def reward(self, simulation: Simulation) -> Reward:
        middle = simulation.scene.solid[0].middle()
        lower, upper = self.corners([0.0, 0.0], [self.width, self.height])
        share = Share(OneBox(tuple(lower - middle), tuple(upper - middle)), self.coarse_spacing, solid="cup")
        return Reward(((-1.0, Distance("cup")), (10.0, share)), constant=-10.0)


class CarryInSpace(Carry):
    """The task of carrying a round cup of water along a line to a place, without spilling.

    Actions, goal and reward are those of `Carry`; the cup leans about the axis across its way, and is less high.
    """

    name = "CarryInSpace"
    dimension, finer = 3, 2
    depth, height = 0.1125, 0.1375
    view: ClassVar[dict[str, Any]] = {"camera": [0.3, 0.8, 1.5], "look_at": [0.3, 0.0, 0.0], "transparency": 0.1}
    actuators = led("cup", Carry.fastest, Carry.turning, 3)


class Latte(Task):
    """The task of pouring milk from a nozzle into coffee as a hidden path of the nozzle would have done.

    Actions: the positions along x to which the nozzle is sent. The task follows LatteArt of FluidLab (Xian et al.
    2023), with its reward but for scale and a constant. The reward is minus the mean squared distance between the
    poured milk and its places under the hidden path at the same time. It is divided by the squared radius of the cup.
    """

    name = "Latte"
    horizon, repeats = 32, 6
    coarse_spacing, coarse_step = 0.0025, 0.0014
    lowest = -4.0
    radius, depth, opening, column = 0.03, 0.015, 0.0025, 0.0625
    """Of the cup, of its coffee, of the nozzle, and of the milk in it [m]."""
    height = depth + 0.005
    """Height of the nozzle above the floor [m]."""
    reach, lag, pouring = 0.6 * radius, 0.03, 25
    """How far the nozzle can be sent [m], how it follows [s], and for how many steps of the environment it pours."""
    actuators = (Position("nozzle.path", (0.0, height), (0,), (reach,), lag=lag),)

    @property
    def scene(self) -> Scene:
        jet: dict[str, Any] = {"phase": "milk", "outlet": [0.0, self.height], "radius": self.opening}
        return self.scene_of(
            container=box([-self.radius, 0.0], [self.radius, 2.5 * self.depth]),
            phase=[{**one, "viscosity": 0.3} for one in (COFFEE, MILK)],
            fluid=[box([-self.radius, 0.0], [self.radius, self.depth], phase="coffee")],
            emitter=[{**jet, "length": self.column, "flow_rate": self.speed * 2.0 * self.opening}],
        )

    @property
    def speed(self) -> float:
        """Speed of the milk in the nozzle [m/s]."""
        return self.column / (self.pouring * self.repeats * self.coarse_step)

    def reward(self, simulation: Simulation) -> Reward:
        targets, weights = _hidden(self, simulation.device.alias, simulation.precision.name)
        return Reward(((-1.0, Missed(targets, weights)),))


def hidden_actions(task: Latte) -> NDArray:
    """Return the actions (horizon, 1) of the hidden path: once around the outline of a heart, then its middle."""
    angle = 2.0 * np.pi * np.arange(task.horizon) / task.pouring
    return np.where(angle < 2.0 * np.pi, np.sin(angle) ** 3, 0.0)[:, None]


@cache
def _hidden(task: Latte, device: str, precision: str) -> tuple[NDArray, NDArray]:
    """Return positions (horizon, n, d) [m] on the hidden path after each step, and the weights (horizon, n) [1/m2] of
    the milk particles poured until then."""
    simulation = Simulation(task.scene, device, precision)
    (nozzle,), steps = task.actuators, task.horizon * task.substeps
    path = nozzle.over(task.horizon, task.substeps, task.time_step).parameter(hidden_actions(task))
    with warnings.catch_warnings():  # of the milk, which is out before the end
        warnings.simplefilter("ignore", CortadoWarning)
        run = simulation.run(steps, {nozzle.parameter: path}, record_every=task.substeps)
    (emitter,) = simulation.scene.emitter
    sample, first = emitter.sample(task.spacing), simulation.free_particles
    weights = np.zeros((task.horizon, simulation.particles))
    poured = sample.upstream < sample.speed * run.times[1:, None]
    weights[:, first:] = poured / np.maximum(poured.sum(axis=1, keepdims=True), 1) / task.radius**2
    return run.positions[1:], weights


class Pour(Vessels):
    """The task of turning and moving a jug until its syrup is in a glass.

    Actions: velocity of the jug along x, and rate at which it turns, counterclockwise. After PourWater of SoftGym (Lin
    et al. 2020), with its reward: the share of the fluid that is in the glass. SoftGym counts particles; here they
    count smoothly (`cortado.environments.terms.Share`), and the jug stays at its height.
    """

    name = "Pour"
    horizon, repeats = 75, 10
    coarse_spacing, coarse_step = 0.0125, 0.00154
    lowest = 0.0
    lower, upper, wall = (0.25, -0.28), (0.45, -0.12), 0.05
    """Corners of the inside of the glass, and the thickness of walls [m]."""
    fastest, turning = 0.1, 4.0
    """[m/s], [rad/s]"""
    actuators = led("jug", fastest, turning, 2)

    @property
    def scene(self) -> Scene:
        (left, low), (right, high) = self.lower, self.upper
        cup = {"shape": "cup", "thickness": self.wall, "colour": LED["colour"]}
        jug: dict[str, Any] = {"name": "jug", "base": self.place(0.075, -0.05), "radius": 0.075, "height": 0.25}
        glass: dict[str, Any] = {"name": "glass", "base": self.place(0.5 * (left + right), low - self.wall)}
        glass |= {"radius": 0.5 * (right - left), "height": high - low + self.wall}
        return self.scene_of(
            container=self.room([-0.3, low - self.wall], [0.7, 0.4]),
            phase=[{**WATER, "name": "syrup", "viscosity": 0.3, "colour": [0.8, 0.45, 0.1]}],
            fluid=[self.filled([0.0, 0.0], [0.15, 0.125], "syrup")],
            solid=[{**cup, **jug, **LED, "velocity": self.place(0.0, 0.0)}, {**cup, **glass}],
            picture=self.view,
        )

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((1.0, self.share),))

    @property
    def share(self) -> Share:
        """The share of the syrup that is in the glass."""
        lower, upper = self.corners(self.lower, self.upper)
        return Share(OneBox(tuple(lower), tuple(upper)), 2.0 * self.coarse_spacing)


class PourInSpace(Pour):
    """The task of pouring a given share of a round jug into a round glass, and no more.

    Actions are those of `Pour`. Goal: the share of the syrup that shall be in the glass. The reward is minus the
    distance of the share that is in it from the goal.
    """

    name = "PourInSpace"
    dimension, finer = 3, 2
    lowest = -1.0
    goal_names: ClassVar[tuple[str, ...]] = ("share in the glass [-]",)
    view: ClassVar[dict[str, Any]] = {"camera": [0.25, 0.6, 1.5], "look_at": [0.2, -0.02, 0.0], "transparency": 0.1}
    actuators = led("jug", Pour.fastest, Pour.turning, 3)
    goals = np.array([0.3]), np.array([0.7])

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((-1.0, Miss(self.share)),))


class Raft(Task):
    """The task of bringing a raft to a place, and keeping it level, by the waves of a paddle.

    Actions: where the paddle is sent to, along x. Goal: where the middle of the raft shall be. The reward is
    -(x - x*)^2 / l^2 - 2 (1 - cos angle), with the goal x* and the length l of the raft.
    """

    name = "Raft"
    horizon, repeats = 40, 8
    coarse_spacing, coarse_step = 0.025, 0.003
    lowest = -15.0
    free_solids: ClassVar[tuple[str, ...]] = ("raft",)
    goal_names: ClassVar[tuple[str, ...]] = ("x of the raft [m]",)
    length = 0.25
    """Length of the raft [m]."""
    reach, lag = 0.05, 0.1
    """How far the paddle can be sent [m], and how it follows [s]."""
    actuators = (Position("paddle.displacement", (0.0, 0.0), (0,), (reach,), lag=lag),)
    goals = np.array([0.45]), np.array([0.6])

    @property
    def scene(self) -> Scene:
        raft = {"name": "raft", "motion": "free", "density": 500.0, "colour": [0.6, 0.4, 0.2]}
        return self.scene_of(
            container=box([-0.2, 0.0], [0.96, 0.5]),
            phase=[{**WATER, "viscosity": 0.1}],
            fluid=[box([0.16, 0.0], [0.96, 0.2], phase="water")],
            solid=[
                box([0.06, -0.1], [0.16, 0.4], name="paddle", **LED),
                box([0.36, 0.15], [0.36 + self.length, 0.25], **raft),
            ],
        )

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((-1.0, Pose("raft", self.length)),))


class Splash(Task):
    """The task of shaking a box, in which a dam breaks, until its water has the shape of the letter L.

    Actions: the acceleration of the box along x and y, which its water feels as gravity that leans, and grows. Goal:
    where the left side of the stem is. The reward is the share of the water that is in the letter: in its foot along
    the floor, or in its stem, which stands at a goal's place, each particle counted smoothly
    (`cortado.environments.terms.Share`).
    """

    half = 0.3
    """Half of the width of the box [m]."""
    name = "Splash"
    horizon, repeats = 40, 5
    coarse_spacing, coarse_step = half / 12, 0.003
    lowest = 0.0
    goal_names: ClassVar[tuple[str, ...]] = ("x of the stem [m]",)
    gravity, strength, lag = 9.81, 12.0, 0.05
    """What the box is shaken with at most, besides gravity [m/s2], and how it follows [s]."""
    actuators = (Position("gravity", (0.0, -gravity), (0, 1), (-strength, -strength), lag=lag),)
    goals = np.array([0.0]), np.array([1.5 * half])

    @property
    def scene(self) -> Scene:
        return self.scene_of(
            container=box([0.0, 0.0], [2.0 * self.half, 2.0 * self.half]),
            phase=[WATER],
            fluid=[box([0.0, 0.0], [self.half, self.half], phase="water")],
            forces={"gravity": [0.0, -self.gravity]},
        )

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((1.0, Share(Letter(self.half), self.coarse_spacing)),))


@dataclass(frozen=True)
class Letter:
    """A function from goals to the boxes of the letter's foot and stem, which together have the area of the water."""

    half: float
    """Side of the square that the water fills at first [m]."""

    def __call__(self, goal: NDArray) -> tuple[NDArray, NDArray]:
        lower, upper = np.zeros((len(goal), 2, 2)), np.zeros((len(goal), 2, 2))
        upper[:, 0] = [2.0 * self.half, 0.25 * self.half]
        lower[:, 1, 0], lower[:, 1, 1] = goal[:, 0], 0.25 * self.half
        upper[:, 1, 0], upper[:, 1, 1] = goal[:, 0] + 0.5 * self.half, 1.25 * self.half
        return lower, upper


class Stir(Task):
    """The task of stirring milk in a corner of a cup of coffee until it is everywhere.

    Actions: the positions to which the spoon, a disc in the plane, is sent. The task follows Mixing of FluidLab (Xian
    et al. 2023), with its reward but for scale. The reward is the mean distance of all pairs of milk particles,
    component by component, over the mean distance of all particles at the start, less 1.
    """

    name = "Stir"
    horizon, repeats = 50, 16
    coarse_spacing, coarse_step = 0.005, 0.001
    lowest = -1.0
    width, depth, milky = 0.08, 0.045, 0.02
    """Of the cup, of what is in it, and of the part whose left half is milk [m]."""
    spoon, radius, reach, lag = (0.04, 0.0225), 0.01, (0.018, 0.005), 0.1
    """Where the spoon begins, its radius, how far it can be sent [m], and how it follows [s]."""
    actuators = (Position("spoon.displacement", (0.0, 0.0), (0, 1), reach, lag=lag),)

    @property
    def scene(self) -> Scene:
        border, half = self.depth - self.milky, 0.5 * self.width
        spoon = {"name": "spoon", "shape": "sphere", "centre": self.spoon, "radius": self.radius, "slip": "no"}
        return self.scene_of(
            container=box([0.0, 0.0], [self.width, 1.8 * self.depth]),
            phase=[COFFEE, MILK],
            fluid=[
                box([0.0, 0.0], [self.width, border], phase="coffee"),
                box([half, border], [self.width, self.depth], phase="coffee"),
                box([0.0, border], [half, self.depth], phase="milk"),
            ],
            solid=[{**spoon, **LED}],
        )

    def reward(self, simulation: Simulation) -> Reward:
        milk, x, n = np.flatnonzero(simulation.mass_fractions[:, 1]), simulation.positions, simulation.particles
        # the mean distance of all pairs of particles, component by component [m]
        spread = float(2.0 * ((2.0 * np.arange(n) - n + 1.0) @ np.sort(x, axis=0)).sum() / n**2)
        return Reward(((1.0, Spread(milk, spread)),), constant=-1.0)


TASKS: dict[str, type[Task]] = {
    one.name: one for one in (Carry, CarryInSpace, Latte, Pour, PourInSpace, Raft, Splash, Stir)
}


def task_of(task: str | Task, size: str | None) -> Task:
    """Return the task of a name in a size ("small" if left out), or a user's `Task` itself; raises `InputError` for
    unknown names and sizes, and for a size beside a `Task`."""
    if isinstance(task, Task):
        if size is not None:
            raise InputError(f"size is {shown(size)}, but must be left out, as the task is one of your own.")
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise InputError(f"task is {shown(task)}, but must be one of {', '.join(TASKS)}, or a Task.")
    return TASKS[task]("small" if size is None else size)
