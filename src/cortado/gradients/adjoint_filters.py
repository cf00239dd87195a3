"""Filters that act on the adjoint of a state between two backward steps, and the norms of adjoints."""

import numpy as np
import warp as wp

from cortado.gradients.filter_kernels import adjoint_filter_kernels
from cortado.particles.state import Parameters, State
from cortado.solvers.solver import Solver


class EddyViscosity:
    """Blends the adjoints of positions and of velocities with their averages over the neighbours that the solver holds,
    the more the faster the forward flow strains there."""

    def __init__(self, solver: Solver, coefficient: float):
        self._solver, self._coefficient = solver, coefficient
        self._kernels = adjoint_filter_kernels(solver.discretisation)
        precision, particles, device = solver.discretisation.precision, solver.layout.all_particles, solver.device
        self._most, self.strengths = (wp.zeros(particles, dtype=precision.real, device=device) for _ in range(2))
        a, b = (wp.zeros(particles, dtype=precision.vector, device=device) for _ in range(2))
        self._sorted = {"a_sorted": a, "b_sorted": b}

    def __call__(self, bar: State, parameters: Parameters) -> None:
        """Blend the adjoint of the state whose step the solver has replayed last. ``strengths`` are then those of its
        particles, sorted."""
        context, kernels = self._solver.context(parameters), self._kernels
        fields = {"a": bar.positions, "b": bar.velocities, **self._sorted}
        flow = {"most": self._most, "strengths": self.strengths}
        context.launch(kernels.crowd, most=self._most)
        context.launch(kernels.strength, coefficient=self._coefficient, **flow)
        context.launch(kernels.sort, **fields)
        context.launch(kernels.viscosity, **flow, **fields)


class Limit:
    """Limits the vector of each particle in an adjoint to a number of times the root mean square over all particles."""

    def __init__(self, solver: Solver, times: float):
        layout, self._times = solver.layout, times
        self._launch, self._particles = solver.launch, layout.particles
        self._kernels = adjoint_filter_kernels(solver.discretisation)
        self._squares = wp.zeros(layout.all_particles, dtype=wp.vec2d, device=layout.device)
        self._sum, self._sum_of_strengths = layout.sum_of(wp.vec2d), layout.sum_of(layout.precision.real)

    def __call__(self, bar: State, strengths: wp.array) -> None:
        """Limit the adjoint of a state; where the ``strengths`` of its `EddyViscosity` are all 0, nothing changes."""
        squares, fields = self._squares, {"a": bar.positions, "b": bar.velocities}
        self._launch(self._kernels.squares, **fields, found=squares)
        sums = {"squares": squares, "sums": self._sum(squares), "strengths": self._sum_of_strengths(strengths)}
        self._launch(self._kernels.limit, **sums, **fields, times=self._times, particles=self._particles)


class AdjointNorms:
    """An observer of the reverse pass that keeps the norms of adjoints, on the device until `numpy` is called."""

    def __init__(self, solver: Solver, steps: int):
        self._launch, self._layout = solver.launch, solver.layout
        self._kernel = adjoint_filter_kernels(solver.discretisation).squares
        self._squares = wp.zeros(self._layout.all_particles, dtype=wp.vec2d, device=solver.device)
        self._sum = self._layout.sum_of(wp.vec2d)
        self._history = wp.zeros((steps + 1) * self._layout.members, dtype=wp.vec2d, device=solver.device)

    def __call__(self, step: int, bar: State) -> None:
        self._launch(self._kernel, a=bar.positions, b=bar.velocities, found=self._squares)
        members = self._layout.members
        wp.copy(self._history, self._sum(self._squares), dest_offset=step * members, count=members)

    def numpy(self) -> np.ndarray:
        """(steps + 1, 2), in a batch (steps + 1, batch, 2), norms over all particles of a scene of the adjoints of
        positions and of velocities, state by state."""
        norms = np.sqrt(self._history.numpy())
        return norms if self._layout.batch is None else norms.reshape(-1, self._layout.batch, 2)
