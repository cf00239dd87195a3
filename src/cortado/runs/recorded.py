"""A trajectory from what was recorded of a rollout."""

from typing import Any

import numpy as np

from cortado.rollout.rollout import Rollout
from cortado.runs.solid_motion import solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.runs.trajectory_batch import TrajectoryBatch
from cortado.scene.parameters.values import Arrays
from cortado.scene.scene import Scene


def recorded(
    rollout: Rollout, scene: Scene, steps: np.ndarray, fields: Arrays, constants: Arrays, quantities: Arrays
) -> Trajectory | TrajectoryBatch:
    """Of a scene, from fields (frames, ...) after so many steps (frames,), in a batch (frames, batch, ...), and of the
    fields of the rollout's states that no step changes, with ``quantities`` (frames, ...) of the same frames."""

    def one(number: int, kept: slice, at: tuple[Any, ...]) -> Trajectory:
        own = {name: array[kept][at] for name, array in fields.items()}
        clock = rollout.clocks[number]
        return Trajectory(
            times=clock.times(steps[kept], float(rollout.time_steps[number])),
            steps=clock.steps + steps[kept],
            positions=own.pop("positions"),
            velocities=own.pop("velocities"),
            diagnostics={name: column[at] for name, column in rollout.diagnostics.items()},
            mass_fractions=own.pop("mass_fractions", None),
            others=own,
            solids=solid_motions(scene, own),
            scene=scene,
            constants={name: array[at[1:]] for name, array in constants.items()},
            substeps=rollout.substeps,
            origin=rollout.origins[number],
            quantities={name: array[kept][at] for name, array in quantities.items()},
        )

    batch = rollout.solver.layout.batch
    if batch is None:
        return one(0, slice(None), (slice(None),))
    found = []
    for b in range(batch):
        good = np.count_nonzero(steps < rollout.lost[b].step) if b in rollout.lost else len(steps)
        found.append(one(b, slice(good), (slice(None), b)))
        for array in fields.values():
            array[good:, b] = np.nan
    return TrajectoryBatch(tuple(found), fields, rollout.lost)
