"""The frames of a batch of runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

from numpy.typing import NDArray

from cortado.errors import DivergedError
from cortado.runs.trajectory import Trajectory
from cortado.words import counted


@dataclass(frozen=True, eq=False)
class TrajectoryBatch(Sequence[Trajectory]):
    """What a batch of runs leaves: ``batch[b]`` is the `Trajectory` of scene b, with the bits of its single run; of a
    scene that lost a particle it has the frames before."""

    trajectories: tuple[Trajectory, ...]
    """One for each scene."""
    fields: Mapping[str, NDArray[Any]]
    """(frames, batch, ...) every field that steps change, by its name; NaN behind the last frame of a lost scene."""
    lost: Mapping[int, DivergedError]
    """What happened to the scenes that lost a particle, by their number."""

    def __repr__(self) -> str:
        lost = f", {len(self.lost)} lost" if self.lost else ""
        frames, _, particles, _ = self.positions.shape
        sizes = f"{counted(frames, 'frame')} of {counted(particles, 'particle')}"
        return f"TrajectoryBatch({counted(len(self), 'scene')}{lost}, {sizes})"

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.trajectories)

    @overload
    def __getitem__(self, b: int) -> Trajectory: ...

    @overload
    def __getitem__(self, b: slice) -> Sequence[Trajectory]: ...

    def __getitem__(self, b: int | slice) -> Trajectory | Sequence[Trajectory]:
        return self.trajectories[b]

    @property
    def positions(self) -> NDArray[Any]:
        """(frames, batch, n, d) [m]"""
        return self.fields["positions"]

    @property
    def velocities(self) -> NDArray[Any]:
        """(frames, batch, n, d) [m/s]"""
        return self.fields["velocities"]

    @property
    def mass_fractions(self) -> NDArray[Any] | None:
        """(frames, batch, n, phases) [-]; None with one phase"""
        return self.fields.get("mass_fractions")
