"""How a rollout whose scene chooses its time steps is made ready."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cortado.rollout.rollout import Rollout
from cortado.rollout.scene_parameters import SceneParameters
from cortado.rollout.step_bounds import step_bounds
from cortado.rollout.step_sizes import ChosenSteps, Fill
from cortado.scene.parameters.values import Arrays, stacked
from cortado.scene.scene import Scene
from cortado.scene.solvers import COURANT


def begin_choosing(rollout: Rollout, scene: Scene, parameters: SceneParameters, members: Sequence[Arrays]) -> None:
    """Before a run: ``members`` are the upright values of the scenes of a batch, whose clocks and first states the
    rollout has."""
    if not isinstance(rollout.step_sizes, ChosenSteps):
        courant = COURANT if scene.solver.courant is None else scene.solver.courant
        length = courant * 0.5 * scene.discretisation.support_radius
        rollout.step_sizes = ChosenSteps(rollout.solver, rollout.parameters, rollout.log, rollout.steps, length)
    least = 1.0 / rollout.solver.layout.precision.greatest
    bounds = np.stack([step_bounds(scene, own, rollout.steps, least) for own in members], axis=1)
    fill = _fill(rollout, parameters, members) if any(map(parameters.courses, members)) else None
    rollout.clocks = rollout.step_sizes.begin(rollout.clocks, bounds, fill)
    rollout.step_sizes.begin_at(rollout.initial)


def _fill(rollout: Rollout, parameters: SceneParameters, members: Sequence[Arrays]) -> Fill:
    """Writes the rows of what is scheduled, each at its own time."""

    def fill(step: int, times: NDArray, sizes: NDArray) -> None:
        each = zip(members, times.tolist(), sizes.tolist(), strict=True)
        rows = [parameters.scheduled_at(*one) for one in each]
        rollout.parameters.set_row(step, stacked(rows))

    return fill
