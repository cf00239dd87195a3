"""By how much more the steps of the projection compress particles than these were before, on the device."""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.reduction import sum_and_maximum
from cortado.particles.state import State
from cortado.rollout.compression_kernels import compression_kernels
from cortado.solvers.projection.steps import ProjectionSteps


class Compressions:
    """What the steps of one run add to the compression of a particle, at most."""

    def __init__(self, solver: ProjectionSteps, steps: int):
        layout, device = solver.layout, solver.device
        self._solver, self._kernels = solver, compression_kernels(layout.precision)
        self._each = wp.zeros(layout.all_particles, dtype=layout.precision.pair, device=device)
        self._greatest = sum_and_maximum(layout.particles, layout.precision, device, layout.members)
        self._added = wp.zeros((steps, layout.members), dtype=layout.precision.real, device=device)

    def measure(self, state: State) -> None:
        """Of the step that led to a state, whose number the solver has counted: launches alone."""
        solver = self._solver
        repaired = solver.repaired[0]
        solver.launch(
            self._kernels.compare,
            particles=solver.layout.particles,
            first_waiting=solver.system.waiting,
            order=solver.search.order,
            n=solver.fields["n"],
            excess=repaired["excess"],
            x_free=repaired["x_now"],
            x=state.positions,
            added=self._each,
        )
        solver.launch(
            self._kernels.record,
            greatest=self._greatest(self._each),
            step=solver.step_number,
            added=self._added,
            threads=solver.layout.members,
        )

    def read(self, first: int, last: int) -> NDArray[np.float64]:
        """(last - first, members) of the steps between two numbers, which were taken [-]."""
        return np.asarray(self._added[first:last].numpy(), dtype=np.float64)
