"""What bounds the time steps of a run whatever the speed of the fluid: limits of the scene, gravity that is scheduled,
and what moves along paths; and how many steps a run takes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, log

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters, Simulated
from cortado.rollout.step_sizes import GROWTH, ChosenSteps
from cortado.scene.model import SceneTables
from cortado.scene.motions import Course, Knots, displacement_name, reach, told, turn_name
from cortado.scene.parameter_values import Arrays, Tilt, stacked
from cortado.scene.parameters import Changing
from cortado.scene.scene import Scene
from cortado.scene.solvers import COURANT
from cortado.scene.stability import SOLID_STEP, chosen_limits, gravity_limits, stability_limits

ROOM = 4
"""There is room for so many times the steps that fluid takes which falls through the whole container all the time."""
MOST = 1e17
"""Steps of a run of so many seconds."""
LEAST = 1e-4
"""A path makes no step shorter than this part of the greatest: what goes further then has jumped."""
PARTS = 8
"""Into which a step is cut: gravity that changes within it is looked at after each."""
Moved = Sequence[tuple[float, Changing | None]]
"""The courses that move something, each with the length that makes a speed of its rate [m] or, of a place, 1."""


def greatest_step(scene: SceneTables, values: Arrays) -> float:
    """That no step of a run with these parameters is longer than, whatever its gravity [s]; raises `InputError` where
    nothing bounds them."""
    found = min(chosen_limits(scene, values).values())
    if not np.isfinite(found):
        raise InputError(
            "solver.greatest_time_step is missing, but must be given, as nothing else bounds the time step with these "
            "parameters where the fluid rests."
        )
    return found


def step_bounds(scene: SceneTables, values: Arrays, steps: int, least: float = 0.0) -> NDArray:
    """(steps,) that of each step [s]: a gravity that is given bounds each by its own row. Raises `InputError` where
    one, or one of a scheduled gravity, is below the ``least`` [s] that a precision bears."""
    bounds = np.full(max(steps, 1), greatest_step(scene, values))
    if "gravity" in values:
        limits = gravity_limits(scene, np.atleast_2d(values["gravity"])).values()
        bounds = np.minimum(bounds, np.minimum.reduce(list(limits)))
    strongest = stability_limits(scene, values)  # which a schedule has at some time
    if (shortest := min(float(bounds.min()), strongest["gravity"], strongest["depth"])) < least:
        raise InputError(
            f"The time step is chosen as {shortest:.3g} s at most, but must be at least {least:g} s in this precision: "
            "make solver.greatest_time_step, or what else bounds it, larger."
        )
    return bounds


def moved_by(scene: Scene, values: Arrays, courses: Mapping[str, Changing]) -> dict[str, Moved]:
    """What courses of parameters move in a scene, by what it is in words, with parameters that replace the scene's."""
    found: dict[str, Moved] = {"the nozzle": [(1.0, courses.get("nozzle_path"))]}
    for solid in told(scene.solid):
        shift, turn = (courses.get(name(solid.name)) for name in (displacement_name, turn_name))
        found[f"the solid {solid.name!r}"] = [(1.0, shift), (reach(solid, values), turn)]
    return found


@dataclass(frozen=True, eq=False)
class Travel:
    """Of the fastest point on any of some paths, whose speed is constant between times."""

    times: NDArray[np.float64]
    """(k,) from 0 on [s]"""
    speeds: NDArray[np.float64]
    """(k,) after each of the times, 0 after the last [m/s]"""
    lengths: NDArray[np.float64]
    """(k,) how far it has come [m]"""
    furthest: float
    """How far it may go in a step [m]."""
    least: float
    """That no step has to be shorter than [s]."""

    @classmethod
    def of(cls, scene: Scene, values: Arrays, moved: Iterable[Moved]) -> "Travel":
        """Of what moves in a scene, with parameters that replace the scene's."""
        known = [[(arm, c) for arm, c in one if isinstance(c, Knots | Course)] for one in moved]
        times = np.unique(np.concatenate([[0.0], *(c.times for one in known for _, c in one)]))
        speeds = np.zeros(len(times))
        for one in known:
            rates = [arm * np.linalg.norm(c.rates(times).reshape(len(times), -1), axis=1) for arm, c in one]
            speeds = np.maximum(speeds, sum(rates, np.zeros(len(times))))
        lengths = np.concatenate([[0.0], np.cumsum(speeds[:-1] * np.diff(times))])
        furthest = SOLID_STEP * scene.discretisation.spacing
        return cls(times, speeds, lengths, furthest, LEAST * greatest_step(scene, values))

    def longest(self, time: float) -> float:
        """A step that begins at a time [s] may be so long [s]; infinite where the paths end before."""
        reached = float(self.at(time)) + self.furthest
        k = int(np.searchsorted(self.lengths, reached, side="right")) - 1
        if self.speeds[k] == 0.0:
            return inf
        end = self.times[k] + (reached - self.lengths[k]) / self.speeds[k]
        return max(float(end - time), self.least)

    def at(self, times: ArrayLike) -> NDArray[np.float64]:
        """How far it has come at times [s], of their shape [m]."""
        return np.asarray(np.interp(np.asarray(times), self.times, self.lengths))

    def steps(self, duration: float, longest: float) -> float:
        """How many steps it needs at most in so many seconds beside those that are as long as the ``longest`` [s]: to
        go its way, and until they are long again wherever it becomes slower."""
        begins = np.concatenate([self.times, self.times - duration])
        way = float((self.at(begins + duration) - self.at(begins)).max())
        with np.errstate(divide="ignore"):
            bounds = np.clip(self.furthest / self.speeds, self.least, max(longest, self.least))
        grown = sum(log(after / before) for before, after in pairwise(bounds) if after > before)
        return min(way / self.furthest, duration / self.least) + grown / log(GROWTH)


@dataclass(frozen=True, eq=False)
class Pull:
    """Of a gravity that changes, as such or by a tilt."""

    scene: Scene
    course: Course
    upright: Callable[[NDArray], NDArray]
    """Gravity (k, d) [m/s2] of values of the course."""
    greatest: float
    """No step is longer [s]."""

    @classmethod
    def of(cls, scene: Scene, courses: Mapping[str, Changing], greatest: float) -> "dict[str, Pull]":
        """Those among the courses of parameters in a scene, by what they are in words."""
        upright: dict[str, Callable[[NDArray], NDArray]] = {
            "gravity": np.asarray,
            "tilt": Tilt(scene.forces.gravity).gravity,
        }
        return {
            f"the scheduled {name}": cls(scene, one, upright[name], greatest)
            for name, one in courses.items()
            if name in upright and isinstance(one, Course)
        }

    def longest(self, time: float) -> float:
        """A step that begins at a time [s] may be so long [s]: it is over before gravity is too strong for it."""
        ways = np.linspace(0.0, self.greatest, PARTS + 1)
        known = np.array(self.course.times) - time
        ways = np.concatenate([ways, known[(known > 0.0) & (known < self.greatest)]])
        limits = np.minimum.reduce([*gravity_limits(self.scene, self.upright(self.course.at(time + ways))).values()])
        return float(np.maximum(limits, ways).min())


def scheduled_bounds(scene: Scene, values: Arrays, parameters: SceneParameters) -> dict[str, Travel | Pull]:
    """What changes by the time and bounds each step by itself, in words, with parameters that replace the scene's."""
    courses = parameters.courses(values)
    travel = Travel.of(scene, values, moved_by(scene, values, courses).values())
    return {"the speed along paths": travel, **Pull.of(scene, courses, greatest_step(scene, values))}


def begin_choosing(rollout: Rollout, scene: Scene, parameters: SceneParameters, members: Sequence[Arrays]) -> None:
    """Before a run: ``members`` are the upright values of the scenes of a batch, whose clocks and first states the
    rollout has."""
    if not isinstance(rollout.step_sizes, ChosenSteps):
        courant = COURANT if scene.solver.courant is None else scene.solver.courant
        length = courant * 0.5 * scene.discretisation.support_radius
        rollout.step_sizes = ChosenSteps(rollout.solver, rollout.parameters, rollout.steps, length)
    least = 1.0 / rollout.solver.layout.precision.greatest
    bounds = np.stack([step_bounds(scene, own, rollout.steps, least) for own in members], axis=1)
    scheduled = Courses(rollout, scene, parameters, members) if any(map(parameters.courses, members)) else None
    rollout.clocks = rollout.step_sizes.begin(rollout.clocks, bounds, scheduled)
    rollout.step_sizes.begin_at(rollout.initial)


class Courses:
    """What is scheduled in the scenes of a batch, each at its own time."""

    def __init__(self, rollout: Rollout, scene: Scene, parameters: SceneParameters, members: Sequence[Arrays]):
        self._rollout, self._parameters, self._members = rollout, parameters, members
        self._bounds = [scheduled_bounds(scene, own, parameters) for own in members]

    def longest(self, times: NDArray) -> NDArray:
        """See `Scheduled`."""
        each = zip(self._bounds, times.tolist(), strict=True)
        return np.array([min(bound.longest(time) for bound in bounds.values()) for bounds, time in each])

    def fill(self, step: int, times: NDArray, sizes: NDArray) -> None:
        """See `Scheduled`."""
        each = zip(self._members, times.tolist(), sizes.tolist(), strict=True)
        rows = [self._parameters.scheduled_at(*one) for one in each]
        self._rollout.parameters.set_row(step, stacked(rows))


def expected_steps(simulation: Simulated, time: float, values: Arrays) -> int:
    """How many steps fluid would take for a time [s] that falls through the whole container all the time, and what
    moves along a path beside it, with parameters that replace the scene's; raises `InputError` where nobody can count
    them."""
    scene = simulation.scene
    courant = COURANT if scene.solver.courant is None else scene.solver.courant
    limits = stability_limits(scene, values)
    limit = limits["speed"] * courant * 0.5 / 0.4  # which is of 0.4 support radii
    longest = min(float(step_bounds(scene, values, 1)[0]), limit, limits["gravity"], limits["depth"])
    courses = SceneParameters(simulation, 0).courses(values)
    travel = Travel.of(scene, values, moved_by(scene, values, courses).values())
    return counted_steps(time, time / longest + travel.steps(time, longest))


def counted_steps(time: float, steps: float) -> int:
    """So many steps, rounded up."""
    if steps > MOST:
        raise InputError(f"time is {time:g} s, but must be less, as that takes about {steps:.2g} steps.")
    return max(ceil(steps), 1)


def expected_frames(rollout: Rollout, record_every: int) -> int:
    """How many frames a run has, with one for every so many steps."""
    return 2 + rollout.steps // (ROOM if ends_at_a_time(rollout) else 1) // record_every


def ends_at_a_time(rollout: Rollout) -> bool:
    """Whether nobody knows how many steps a rollout has, as it ends at a time."""
    return bool(np.isfinite(rollout.step_sizes.end))


def done_of(rollout: Rollout, step: int, time: float) -> int:
    """How far a rollout is after a step, at a time [s]: so many steps, or percents of its time if it ends at one."""
    if not ends_at_a_time(rollout):
        return step
    begun, end = rollout.clocks[0].time, rollout.step_sizes.end
    return min(int(100.0 * (time - begun) / (end - begun)), 100)
