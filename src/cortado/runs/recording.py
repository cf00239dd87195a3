"""Which states of a run become frames, every so many steps or so many in a second, and the trajectories of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from cortado.errors import DivergedError, InputError
from cortado.rollout.rollout import Rollout
from cortado.rollout.step_bounds import expected_frames
from cortado.runs.frames import Marks
from cortado.runs.sensor import Readings
from cortado.runs.solid_motion import solid_motions
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameter_values import Arrays
from cortado.scene.restart import Clock
from cortado.scene.scene import Scene
from cortado.words import counted


class FrameChoice(Protocol):
    """A choice of the states that are frames of a run, besides the first and the last."""

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings by which one run is told from another."""

    @property
    def rate(self) -> float | None:
        """Return the number of frames in a simulated second [1/s]; None where steps are chosen, not times."""

    def is_due(self, step: int, before: float, now: float) -> bool:
        """Test whether the state after a step is a frame, given the times [s] of the state before and of itself, after
        the first state."""

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        """Return times (frames,) [s] for as many frames as there can be, exact if they are known before the run, else
        about right."""

    def expected(self, rollout: Rollout) -> int:
        """Return how many frames are likely to come."""

    def count(self, steps: int, time: float | None) -> int | None:
        """Return how many frames ``steps`` steps of one length have that simulate a time [s]; None where that depends
        on an unknown time."""


@dataclass(frozen=True)
class EverySteps:
    """A choice of one frame for every ``record_every`` steps; a `FrameChoice`."""

    steps: int

    @property
    def settings(self) -> dict[str, Any]:
        return {"record_every": self.steps}

    @property
    def rate(self) -> None:
        """Return None, as steps are chosen."""

    def is_due(self, step: int, before: float, now: float) -> bool:
        return step % self.steps == 0

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        recorded = np.array([*range(0, rollout.steps, self.steps), rollout.steps])
        clock = Clock(rollout.clocks[0].steps, rollout.clocks[0].time)  # as steps of one length go on from the first
        return clock.times(recorded, float(rollout.time_steps[0]))

    def expected(self, rollout: Rollout) -> int:
        return expected_frames(rollout, self.steps)

    def count(self, steps: int, time: float | None) -> int:
        return 1 + -(-steps // self.steps)


@dataclass(frozen=True)
class FramesPerSecond:
    """A choice of a number of frames in each simulated second, each the first state at its time or after it; a
    `FrameChoice`.

    Raises:
        InputError: a rate that is not a number greater than 0.
    """

    rate: float
    """[1/s]"""

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < inf:
            raise InputError(f"--fps is {self.rate:g}, but must be a number of frames in a second greater than 0.")

    @property
    def settings(self) -> dict[str, Any]:
        return {"fps": self.rate}

    def is_due(self, step: int, before: float, now: float) -> bool:
        passed, due = Marks(0.0, self.rate).passed(np.array([before, now])).tolist()
        return due > passed

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        start, size = rollout.clocks[0].time, float(rollout.time_steps[0])  # where steps are chosen the longest one
        duration = min(rollout.steps * size, rollout.step_sizes.end - start + size)
        return Marks(start, self.rate).at(np.arange(min(rollout.steps, int(duration * self.rate) + 1) + 2))

    def expected(self, rollout: Rollout) -> int:
        return len(self.announced(rollout))

    def count(self, steps: int, time: float | None) -> int | None:
        if time is None:
            return None
        before, due = Marks(0.0, self.rate).passed(np.array([time - time / steps, time])).tolist()
        return 1 + min(steps, due if due > before else due + 1)


@dataclass(frozen=True, eq=False)
class TrajectoryBatch(Sequence[Trajectory]):
    """The trajectories of a batch of runs: ``batch[b]`` is the `Trajectory` of scene b, with the bits of its single
    run; of a scene that lost a particle it has the frames before."""

    trajectories: tuple[Trajectory, ...]
    """One for each scene."""
    fields: Mapping[str, NDArray[Any]]
    """(frames, batch, ...) every field that steps change, by its name; NaN behind the last frame of a lost scene."""
    lost: Mapping[int, DivergedError]
    """Errors of the scenes that lost a particle, by their number."""

    def __repr__(self) -> str:
        lost = f", {len(self.lost)} lost" if self.lost else ""
        frames, _, particles, _ = self.positions.shape
        sizes = f"{counted(frames, 'frame')} of {counted(particles, 'particle')}"
        return f"TrajectoryBatch({counted(len(self), 'scene')}{lost}, {sizes})"

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.trajectories)

    @overload
    def __getitem__(self, b: int) -> Trajectory: ...

    @overload
    def __getitem__(self, b: slice) -> Sequence[Trajectory]: ...

    def __getitem__(self, b: int | slice) -> Trajectory | Sequence[Trajectory]:
        return self.trajectories[b]

    @property
    def positions(self) -> NDArray[Any]:
        """Return the positions (frames, batch, n, d) [m]."""
        return self.fields["positions"]

    @property
    def velocities(self) -> NDArray[Any]:
        """Return the velocities (frames, batch, n, d) [m/s]."""
        return self.fields["velocities"]

    @property
    def mass_fractions(self) -> NDArray[Any] | None:
        """Return the mass fractions (frames, batch, n, phases) [-]; None with one phase."""
        return self.fields.get("mass_fractions")


def recorded(
    rollout: Rollout,
    scene: Scene,
    steps: np.ndarray,
    fields: Arrays,
    constants: Arrays,
    quantities: Arrays,
    readings: Callable[[int], Mapping[str, Readings]],
) -> Trajectory | TrajectoryBatch:
    """Make the trajectory of a scene from fields (frames, ...) after numbers of steps (frames,), in a batch (frames,
    batch, ...), and from the fields that no step changes. Beside them are ``quantities`` (frames, ...) of the same
    frames, and ``readings`` of sensors by the number of the scene."""

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
            sensors=readings(number),
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
