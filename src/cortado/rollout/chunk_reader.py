"""What is computed of the states of a run while they are on the device: beside each step, and behind each chunk."""

from typing import Protocol

from cortado.particles.state import Parameters, State, StateSeries


class Beside(Protocol):
    """Launches beside the steps of a chunk, which are captured with them."""

    def launch(self, step: int, parameters: Parameters) -> None:
        """Launch what reads the solver's arrays after a step of a chunk, counted from 0."""


class ChunkReader(Protocol):
    """A reader of the states of a run on the device, chunk by chunk."""

    @property
    def beside(self) -> Beside | None:
        """Return what is to be launched beside each step; None for nothing."""

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        """Read the states at which steps ``step`` to ``end`` began, the ``first`` and those ``later``; the next chunk
        overwrites them."""
