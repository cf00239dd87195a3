"""The control tasks. `docs/environments.md` lists their actions, goals and rewards."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.task import Actuator, Position, Task, Velocity
from cortado.environments.terms import Distance, Miss, Missed, OneBox, Pose, Reward, Share, Spread
from cortado.errors import InputError, shown, unwarned
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.1, 0.3, 0.8]}
COFFEE = {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.20, 0.09, 0.04]}
MILK = {"name": "milk", "rest_density": 950.0, "viscosity": 0.05, "colour": [0.95, 0.92, 0.85]}
LED = {"motion": "path", "velocity": [0.0, 0.0], "colour": [0.6, 0.6, 0.65]}


def box(lower: Sequence[float], upper: Sequence[float], **others: Any) -> dict[str, Any]:
    return {"shape": "box", "lower": lower, "upper": upper, **others}


def led(solid: str, fastest: float, turning: float, dimension: int) -> tuple[Actuator, Actuator]:
    """Return actuators for the motion of a solid along x [m/s] and for its rotation about z [rad/s]."""
    still, plane = (0.0,) * dimension, dimension == 2
    turn: Any = {"rest": (0.0,), "axes": (0,)} if plane else {"rest": still, "axes": (2,)}
    moved = Velocity(f"{solid}.displacement", still, (0,), (fastest,))
    return moved, Velocity(f"{solid}.turn", greatest=(turning,), is_number=plane, **turn)


class Vessels(Task):
    """Tasks with cups and jugs. In 3-D a vessel is round, and its axis is at z = 0."""

    view: ClassVar[dict[str, Any]] = {}

    def place(self, x: float, y: float) -> list[float]:
        return [x, y, 0.0][: self.dimension]

    def corners(self, lower: Sequence[float], upper: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return the corners [m] of a box. In 3-D the base of the box is a square about z = 0."""
        half = 0.5 * (upper[0] - lower[0])
        return [*lower, -half][: self.dimension], [*upper, half][: self.dimension]

    def filled(self, lower: Sequence[float], upper: Sequence[float], phase: str) -> dict[str, Any]:
        """Return the scene table of a fluid. The fluid fills a box in 2-D and a cylinder in 3-D. Corners are in m."""
        if self.dimension == 2:
            return box(lower, upper, phase=phase)
        size = {"radius": 0.5 * (upper[0] - lower[0]), "height": upper[1] - lower[1]}
        return {"shape": "cylinder", "base": self.place(0.5 * (lower[0] + upper[0]), lower[1]), **size, "phase": phase}

    def room(self, lower: Sequence[float], upper: Sequence[float]) -> dict[str, Any]:
        """Return the scene table of the container. A 3-D scene has no container."""
        return box(lower, upper) if self.dimension == 2 else {"shape": "none"}


class Carry(Vessels):
    """The task of carrying a cup of water to a place, after TransportWater of SoftGym (Lin et al. 2020)."""

    name = "Carry"
    horizon, repeats, lowest = 75, 6, -12.0
    coarse_spacing, coarse_step = 0.0125, 0.0025
    goal_names: ClassVar[tuple[str, ...]] = ("x of the cup [m]",)
    width, depth, height, wall = 0.15, 0.1, 0.175, 0.05
    """Inner width of the cup, depth of the water, inner height of the cup, and thickness of the walls [m]."""
    floor = -0.15
    fastest, turning = 0.6, 1.0
    """Greatest velocity [m/s] and greatest angular velocity [rad/s] of the cup."""
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
    """The 3-D task of carrying a round cup of water. The cup is lower than in `Carry`, and turns about z."""

    name = "CarryInSpace"
    dimension, finer = 3, 2
    depth, height = 0.1125, 0.1375
    view: ClassVar[dict[str, Any]] = {"camera": [0.3, 0.8, 1.5], "look_at": [0.3, 0.0, 0.0], "transparency": 0.1}
    actuators = led("cup", Carry.fastest, Carry.turning, 3)


class Latte(Task):
    """The task of pouring milk into coffee in the same pattern as a nozzle on a hidden path, after LatteArt of FluidLab
    (Xian et al. 2023). The goal of each milk particle is its position in a run along the hidden path."""

    name = "Latte"
    horizon, repeats, lowest = 32, 6, -4.0
    coarse_spacing, coarse_step = 0.0025, 0.0014
    radius, depth, opening, column = 0.03, 0.015, 0.0025, 0.0625
    """Radius of the cup, depth of the coffee, half-width of the nozzle, and height of the milk in the nozzle [m]."""
    height = depth + 0.005
    """Height of the nozzle above the floor [m]."""
    reach, lag, pouring = 0.6 * radius, 0.03, 25
    """Greatest displacement of the nozzle [m], time constant of its motion [s], and number of pouring steps."""
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
        return self.column / (self.pouring * self.repeats * self.coarse_step)

    def reward(self, simulation: Simulation) -> Reward:
        targets, weights = _hidden(self, simulation.device.alias, simulation.precision.name)
        return Reward(((-1.0, Missed(targets, weights)),))


def hidden_actions(task: Latte) -> NDArray:
    """Return actions (horizon, 1) that lead the nozzle once around a heart, and then to x = 0."""
    angle = 2.0 * np.pi * np.arange(task.horizon) / task.pouring
    return np.where(angle < 2.0 * np.pi, np.sin(angle) ** 3, 0.0)[:, None]


@cache
def _hidden(task: Latte, device: str, precision: str) -> tuple[NDArray, NDArray]:
    """Return particle positions (horizon, n, d) [m] on the hidden path, and weights (horizon, n) [1/m2]."""
    simulation = Simulation(task.scene, device, precision)
    (nozzle,), steps = task.actuators, task.horizon * task.substeps
    path = nozzle.over(task.horizon, task.substeps, task.time_step).parameter(hidden_actions(task))
    with unwarned():  # of the nozzle, which is empty before the end
        run = simulation.run(steps, {nozzle.parameter: path}, record_every=task.substeps)
    (emitter,) = simulation.scene.emitter
    sample, first = emitter.sample(task.spacing), simulation.free_particles
    weights = np.zeros((task.horizon, simulation.particles))
    poured = sample.upstream < sample.speed * run.times[1:, None]
    weights[:, first:] = poured / np.maximum(poured.sum(axis=1, keepdims=True), 1) / task.radius**2
    return run.positions[1:], weights


class Pour(Vessels):
    """The task of pouring syrup from a jug into a glass, after PourWater of SoftGym (Lin et al. 2020)."""

    name = "Pour"
    horizon, repeats, lowest = 75, 10, 0.0
    coarse_spacing, coarse_step = 0.0125, 0.00154
    lower, upper, wall = (0.25, -0.28), (0.45, -0.12), 0.05
    """Lower and upper corner of the inside of the glass, and thickness of the walls [m]."""
    fastest, turning = 0.1, 4.0
    """Greatest velocity [m/s] and greatest angular velocity [rad/s] of the jug."""
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
        lower, upper = self.corners(self.lower, self.upper)
        return Share(OneBox(tuple(lower), tuple(upper)), 2.0 * self.coarse_spacing)


class PourInSpace(Pour):
    """The task of pouring a given fraction of syrup from a round jug into a round glass."""

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
    """The task of moving a raft to a place with waves from a paddle, while the raft stays level."""

    name = "Raft"
    horizon, repeats, lowest = 40, 8, -15.0
    coarse_spacing, coarse_step = 0.025, 0.003
    free_solids: ClassVar[tuple[str, ...]] = ("raft",)
    goal_names: ClassVar[tuple[str, ...]] = ("x of the raft [m]",)
    length = 0.25
    reach, lag = 0.05, 0.1
    """Greatest displacement of the paddle [m], and time constant of its motion [s]."""
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
    """The task of shaking a box of water after a dam break, so that the water takes the shape of the letter L."""

    half = 0.3
    name = "Splash"
    horizon, repeats, lowest = 40, 5, 0.0
    coarse_spacing, coarse_step = half / 12, 0.003
    goal_names: ClassVar[tuple[str, ...]] = ("x of the stem [m]",)
    gravity, strength, lag = 9.81, 12.0, 0.05
    """Gravity [m/s2], greatest acceleration of the box [m/s2], and time constant of the acceleration [s]."""
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
    """A function that maps goals to the two boxes of the letter L. The letter has the same area as the water."""

    half: float
    """Side length of the initial square of water [m]."""

    def __call__(self, goal: NDArray) -> tuple[NDArray, NDArray]:
        lower, upper = np.zeros((len(goal), 2, 2)), np.zeros((len(goal), 2, 2))
        upper[:, 0] = [2.0 * self.half, 0.25 * self.half]
        lower[:, 1, 0], lower[:, 1, 1] = goal[:, 0], 0.25 * self.half
        upper[:, 1, 0], upper[:, 1, 1] = goal[:, 0] + 0.5 * self.half, 1.25 * self.half
        return lower, upper


class Stir(Task):
    """The task of stirring milk into a cup of coffee, after Mixing of FluidLab (Xian et al. 2023)."""

    name = "Stir"
    horizon, repeats, lowest = 50, 16, -1.0
    coarse_spacing, coarse_step = 0.005, 0.001
    width, depth, milky = 0.08, 0.045, 0.02
    """Width of the cup, depth of the fluid, and size of the region with milk in the left half of the cup [m]."""
    spoon, radius, reach, lag = (0.04, 0.0225), 0.01, (0.018, 0.005), 0.1
    """Initial position, radius and greatest displacement of the spoon [m], and time constant of its motion [s]."""
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


_TASKS: tuple[type[Task], ...] = Carry, CarryInSpace, Latte, Pour, PourInSpace, Raft, Splash, Stir
TASKS = {one.name: one for one in _TASKS}


def task_of(task: str | Task, size: str | None) -> Task:
    """Return a task of the catalogue, or a user-defined `Task` unchanged. The default size is "small"."""
    if isinstance(task, Task):
        if size is not None:
            raise InputError(f"size is {shown(size)}, but must be left out, as the task is a Task object.")
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise InputError(f"task is {shown(task)}, but must be one of {', '.join(TASKS)}, or a Task.")
    return TASKS[task]("small" if size is None else size)
