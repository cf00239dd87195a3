"""How many steps a run of so many seconds takes."""

from collections.abc import Mapping
from math import ceil
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, as_one_number, check_steps
from cortado.errors import InputError
from cortado.rollout.parameter_space import ParameterSpace
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters, Simulated
from cortado.rollout.step_bounds import step_bounds
from cortado.rollout.step_sizes import ChosenSteps
from cortado.rollout.travel import Travel, moved_by
from cortado.scene.parameter_values import Arrays
from cortado.scene.solvers import COURANT
from cortado.scene.stability import stability_limits

SAME = 1e-9
"""Relative: a time that so little is missing of has been reached."""
ROOM = 4
"""There is room for so many times the steps that fluid takes which falls through the whole container all the time."""
MOST = 1e17
"""Steps of a run of so many seconds."""


def steps_of_run(simulation: Simulated, steps: int | None, time: float | None, values: Mapping[str, Any]) -> int:
    """The number of steps of a run, which has either so many or reaches a time [s] with them; where they are chosen, as
    many as there is room for. Raises `InputError`."""
    if steps is None and time is None:
        raise InputError("steps is left out, but must be given where no time says how long the run is.")
    if steps is not None and time is not None:
        raise InputError("time is given, but must be left out, as steps says how long the run is.")
    if time is None:
        assert steps is not None
        return check_steps(steps)
    check_time("time", time)
    if not simulation.scene.solver.chooses:
        given = values.get("time_step") if isinstance(values, Mapping) else None
        sizes = as_numbers("parameter time_step", simulation.scene.solver.time_step if given is None else given)
        shortest = float(sizes.min(initial=np.inf))
        return _counted_steps(time, time / shortest * (1.0 - SAME)) if 0.0 < shortest < np.inf else 1
    if simulation.batch is not None:
        raise InputError(
            "time is given, but must be left out of a batch that chooses its time steps, whose scenes do not reach it "
            "together: give steps."
        )
    # a row for each step has no meaning: nobody knows how many there are
    own = SceneParameters(simulation, 0).upright(ParameterSpace(simulation, 0).checked(values))
    return ROOM * expected_steps(simulation, time, own)


def expected_frames(rollout: Rollout, record_every: int) -> int:
    """How many frames a run has, with one for every so many steps."""
    return 2 + expected_of(rollout) // record_every


def expected_of(rollout: Rollout) -> int:
    """How many steps of a rollout are to be expected: all of them, unless it ends at a time."""
    return rollout.steps // ROOM if ends_at_a_time(rollout) else rollout.steps


def ends_at_a_time(rollout: Rollout) -> bool:
    """Whether nobody knows how many steps a rollout has, as it ends at a time."""
    return bool(np.isfinite(rollout.step_sizes.end))


def done_of(rollout: Rollout, step: int, time: float) -> int:
    """How far a rollout is after a step, at a time [s]: so many steps, or percents of its time if it ends at one."""
    if not ends_at_a_time(rollout):
        return step
    begun, end = rollout.clocks[0].time, rollout.step_sizes.end
    return min(int(100.0 * (time - begun) / (end - begun)), 100)


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
    return _counted_steps(time, time / longest + travel.steps(time, longest))


def _counted_steps(time: float, steps: float) -> int:
    """So many steps, rounded up."""
    if steps > MOST:
        raise InputError(f"time is {time:g} s, but must be less, as that takes about {steps:.2g} steps.")
    return max(ceil(steps), 1)


def end_after(rollout: Rollout, time: float | None) -> None:
    """Have a rollout that chooses its steps end with the first state so much later than its first [s]."""
    if time is not None and isinstance(rollout.step_sizes, ChosenSteps):
        rollout.step_sizes.end_after(time * (1.0 - SAME))


def check_time(what: str, time: object) -> None:
    """Raises `InputError` for what is no length of time."""
    number = as_one_number(what, time)
    if not 0.0 < number < np.inf:
        raise InputError(f"{what} is {number:g}, but must be a number of seconds greater than 0.")
