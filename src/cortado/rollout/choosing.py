"""How a rollout whose scene chooses its time steps is made ready."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cortado.rollout.pull import Pull
from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters
from cortado.rollout.step_bounds import greatest_step, step_bounds
from cortado.rollout.step_sizes import ChosenSteps
from cortado.rollout.travel import Travel, moved_by
from cortado.scene.parameter_values import Arrays, stacked
from cortado.scene.scene import Scene
from cortado.scene.solvers import COURANT


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


def scheduled_bounds(scene: Scene, values: Arrays, parameters: SceneParameters) -> dict[str, Travel | Pull]:
    """What changes by the time and bounds each step by itself, in words, with parameters that replace the scene's."""
    courses = parameters.courses(values)
    travel = Travel.of(scene, values, moved_by(scene, values, courses).values())
    return {"the speed along paths": travel, **Pull.of(scene, courses, greatest_step(scene, values))}


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
