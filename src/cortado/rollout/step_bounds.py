"""Bounds on time steps that do not depend on the speed of the fluid, and the expected number of steps."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import ceil, inf, log
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import InputError
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters, Simulated
from cortado.rollout.step_sizes import GROWTH, ChosenSteps
from cortado.scene.courses import Knots, fastest
from cortado.scene.emitter_table import path_name
from cortado.scene.model import SceneTables
from cortado.scene.motions import displacement_name, reach, told, turn_name
from cortado.scene.parameter_values import Arrays, Tilt, stacked
from cortado.scene.parameters import Changing
from cortado.scene.scene import Scene
from cortado.scene.solvers import COURANT
from cortado.scene.stability import SOLID_STEP, chosen_limits, gravity_limits, stability_limits

ROOM = 4
"""Safety factor for the expected number of steps."""
MOST = 1e17
"""Greatest number of steps of a run that ends at a given time."""
LEAST = 1e-4
"""Shortest time step for a fast path, relative to the longest time step."""
Moved = Sequence[tuple[float, Changing | None]]
"""Pairs of a factor and a function of time for a moving object. The factor is 1 for a position, or the distance from
the axis [m] for a rotation."""


def greatest_step(scene: SceneTables, values: Arrays) -> float:
    """Return the longest possible time step [s] for any gravity."""
    found = min(chosen_limits(scene, values).values())
    if not np.isfinite(found):
        why = "as with these parameters nothing else limits the time step of fluid at rest"
        raise InputError(f"solver.greatest_time_step is missing, but must be given, {why}.")
    return found


def step_bounds(scene: SceneTables, values: Arrays, steps: int, least: float = 0.0) -> NDArray:
    """Return upper bounds of the time steps (steps,) [s] for the gravity in ``values``. ``least`` is in s."""
    bounds = np.full(max(steps, 1), greatest_step(scene, values))
    if "gravity" in values:
        limits = gravity_limits(scene, np.atleast_2d(values["gravity"])).values()
        bounds = np.minimum(bounds, np.minimum.reduce(list(limits)))
    strongest = stability_limits(scene, values)  # at the strongest scheduled gravity
    if (shortest := min(float(bounds.min()), strongest["gravity"], strongest["depth"])) < least:
        wanted = f"at least {least:g} s in this precision"
        advice = "increase solver.greatest_time_step, or relax another limit of the time step"
        raise InputError(f"The adaptive time step is at most {shortest:.3g} s, but must be {wanted}: {advice}.")
    return bounds


def moved_by(scene: Scene, values: Arrays, courses: Mapping[str, Changing]) -> dict[str, Moved]:
    """Return the paths of each emitter and solid. The result has keys such as "the emitter 'tap'", for messages."""
    names = [emitter.name for emitter in scene.emitter]
    found: dict[str, Moved] = {f"the emitter {name!r}": [(1.0, courses.get(path_name(name)))] for name in names}
    for solid in told(scene.solid):
        shift, turn = (courses.get(name(solid.name)) for name in (displacement_name, turn_name))
        found[f"the solid {solid.name!r}"] = [(1.0, shift), (reach(solid, values), turn)]
    return found


@dataclass(frozen=True, eq=False)
class Travel:
    """The distance that the fastest moving object covers, as a piecewise linear function of time."""

    times: NDArray[np.float64]
    """Times of changes of the speed (k,) [s], beginning with 0."""
    speeds: NDArray[np.float64]
    """Speeds after each time (k,) [m/s]."""
    lengths: NDArray[np.float64]
    """Distances covered before each time (k,) [m]."""
    furthest: float
    """Greatest displacement of an object in a time step [m]."""
    least: float

    @classmethod
    def of(cls, scene: Scene, values: Arrays, moved: Iterable[Moved]) -> "Travel":
        known = [[(arm, c) for arm, c in one if isinstance(c, Knots)] for one in moved]
        times = np.unique(np.concatenate([[0.0], *(c.breaks for one in known for _, c in one)]))
        speeds = np.maximum.reduce([np.zeros(len(times)), *(fastest(one, times) for one in known)])
        lengths = np.concatenate([[0.0], np.cumsum(speeds[:-1] * np.diff(times))])
        furthest = SOLID_STEP * scene.discretisation.spacing
        return cls(times, speeds, lengths, furthest, LEAST * greatest_step(scene, values))

    def longest(self, time: float) -> float:
        """Return the longest time step [s] from ``time`` [s] on, which is infinite after all paths."""
        reached = float(self.at(time)) + self.furthest
        k = int(np.searchsorted(self.lengths, reached, side="right")) - 1
        if self.speeds[k] == 0.0:
            return inf
        end = self.times[k] + (reached - self.lengths[k]) / self.speeds[k]
        return max(float(end - time), self.least)

    def at(self, times: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(np.interp(np.asarray(times), self.times, self.lengths))

    def steps(self, duration: float, longest: float) -> float:
        """Return an upper bound on the steps that paths add. ``duration`` and ``longest`` are in s."""
        begins = np.concatenate([self.times, self.times - duration])
        way = float((self.at(begins + duration) - self.at(begins)).max())
        with np.errstate(divide="ignore"):
            bounds = np.clip(self.furthest / self.speeds, self.least, max(longest, self.least))
        grown = sum(log(after / before) for before, after in pairwise(bounds) if after > before)
        return min(way / self.furthest, duration / self.least) + grown / log(GROWTH)


def scheduled_bounds(scene: Scene, values: Arrays, parameters: SceneParameters) -> dict[str, Callable[[float], float]]:
    """Return functions that map a time [s] to the longest next step [s]. The keys are phrases for messages."""
    courses, greatest = parameters.courses(values), greatest_step(scene, values)
    upright: dict[str, Any] = {"gravity": np.asarray, "tilt": Tilt(scene.forces.gravity).gravity}
    travel = Travel.of(scene, values, moved_by(scene, values, courses).values())
    found: dict[str, Callable[[float], float]] = {"the speed along paths": travel.longest}

    def pulled(name: str, course: Knots, time: float) -> float:
        ways, known = np.linspace(0.0, greatest, 9), course.breaks - time
        ways = np.concatenate([ways, known[(known > 0.0) & (known < greatest)]])
        limits = gravity_limits(scene, upright[name](course.at(time + ways)))  # of vectors (k, d) [m/s2]
        return float(np.maximum(np.minimum.reduce([*limits.values()]), ways).min())

    for name, course in courses.items():
        if name in upright and isinstance(course, Knots):
            found[f"the scheduled {name}"] = partial(pulled, name, course)
    return found


def begin_choosing(rollout: Rollout, scene: Scene, parameters: SceneParameters, members: Sequence[Arrays]) -> None:
    """Make a rollout use adaptive time steps. Set clocks and first states before this call."""
    if not isinstance(rollout.step_sizes, ChosenSteps):
        courant = COURANT if scene.solver.courant is None else scene.solver.courant
        length = courant * 0.5 * scene.discretisation.support_radius
        rollout.step_sizes = ChosenSteps(rollout.solver, rollout.parameters, rollout.room, length)
    least = 1.0 / rollout.solver.layout.precision.greatest
    bounds = np.stack([step_bounds(scene, own, rollout.steps, least) for own in members], axis=1)
    changes = any(map(parameters.courses, members))
    of_courses = [scheduled_bounds(scene, own, parameters) for own in members] if changes else []

    def longest(times: NDArray) -> NDArray:
        each = zip(of_courses, times.tolist(), strict=True)
        return np.array([min(bound(time) for bound in own.values()) for own, time in each])

    def fill(step: int, times: NDArray, sizes: NDArray) -> None:
        each = zip(members, times.tolist(), sizes.tolist(), strict=True)
        rollout.parameters.set_row(step, stacked([parameters.scheduled_at(*one) for one in each]))

    rollout.clocks = rollout.step_sizes.begin(rollout.clocks, bounds, (longest, fill) if changes else None)
    rollout.step_sizes.begin_at(rollout.initial)


def expected_steps(simulation: Simulated, time: float, values: Arrays) -> int:
    """Estimate the number of steps in ``time`` [s], for fluid that has fallen through the container."""
    scene = simulation.scene
    courant = COURANT if scene.solver.courant is None else scene.solver.courant
    limits = stability_limits(scene, values)
    limit = limits["speed"] * courant * 0.5 / 0.4  # the limit is for 0.4 support radii
    longest = min(float(step_bounds(scene, values, 1)[0]), limit, limits["gravity"], limits["depth"])
    courses = SceneParameters(simulation, 0).courses(values)
    travel = Travel.of(scene, values, moved_by(scene, values, courses).values())
    return counted_steps(time, time / longest + travel.steps(time, longest))


def counted_steps(time: float, steps: float) -> int:
    if steps > MOST:
        raise InputError(f"time is {time:g} s, but must be less, as such a run takes about {steps:.2g} steps.")
    return max(ceil(steps), 1)


def expected_frames(rollout: Rollout, record_every: int) -> int:
    return 2 + rollout.steps // (ROOM if ends_at_a_time(rollout) else 1) // record_every


def ends_at_a_time(rollout: Rollout) -> bool:
    return bool(np.isfinite(rollout.step_sizes.end))


def done_of(rollout: Rollout, step: int, time: float) -> int:
    """Return the progress: the number of steps, or a percentage for a run to a given end time."""
    if not ends_at_a_time(rollout):
        return step
    begun, end = rollout.clocks[0].time, rollout.step_sizes.end
    return min(int(100.0 * (time - begun) / (end - begun)), 100)
