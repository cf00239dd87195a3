"""What is noted of a system of equations that a force solves in every step."""

from typing import Protocol

import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import HostCopy, KernelLauncher
from cortado.particles.state import Layout
from cortado.solvers.convergence import convergence_kernels


class IterativeSolve(Protocol):
    """What solves it, the ``solve`` of a force."""

    name: str
    """That of its iterations in the diagnostics of a run."""
    count: wp.array
    """(members,) iterations of the last solve."""


class SolveRecord:
    """The iterations of every step, on the device until they are read."""

    def __init__(self, steps: int, solve: IterativeSolve, layout: Layout):
        self.iterations = wp.zeros((max(steps, 1), layout.members), dtype=wp.int32, device=layout.device)
        """(steps, members) on the device."""
        self.solve, self._kept = solve, (slice(None), 0 if layout.batch is None else slice(None))
        self._seen, self._note = HostCopy(self.iterations), convergence_kernels(layout.precision).note
        self.read(0)

    def read(self, steps: int) -> None:
        """Read so many steps from the device."""
        self.found: NDArray = self._seen.read(steps).astype(int)[self._kept]
        """(steps,), in a batch (steps, batch), of the steps that were read."""

    def assign(self, other: "SolveRecord") -> None:
        """Hold what another has read, on the device and off it."""
        wp.copy(self.iterations, other.iterations)
        self.found = other.found

    def note(self, launch: KernelLauncher, step: wp.array) -> None:
        """Record the solve of a step, given the number of it in each scene."""
        members = self.iterations.shape[1]
        launch(self._note, count=self.solve.count, step=step, iterations=self.iterations, threads=members)
