"""Filters that act on the adjoint of a state between two backward steps, and the norms of adjoints."""

from collections.abc import Iterable

import numpy as np
import warp as wp

from cortado.device.state import Parameters, State
from cortado.gradients.filter_kernels import adjoint_filter_kernels
from cortado.solvers.solver import Solver

FIELDS = ("positions", "velocities")
"""Fields of a `State` that can be filtered."""


class Average:
    """Blends fields of an adjoint with their average over the neighbours that the solver holds."""

    def __init__(self, solver: Solver, fields: Iterable[str]):
        self._solver, self._fields = solver, tuple(fields)
        self._kernels = adjoint_filter_kernels(solver.discretisation)
        self._before = solver.new_state()
        real, device = solver.discretisation.precision.real, solver.device
        self._strength = wp.zeros(1, dtype=real, device=device)
        self._most = wp.zeros(solver.layout.all_particles, dtype=real, device=device)

    def set_strength(self, strength: float) -> None:
        """Set the strength of the following calls, from 0, which changes nothing, to 1."""
        self._strength.fill_(strength)

    def __call__(self, bar: State, parameters: Parameters) -> None:
        """Blend the adjoint of the state whose step the solver has replayed last."""
        context = self._solver.context(parameters)
        context.launch(self._kernels.crowd, most=self._most)
        for name in self._fields:
            wp.copy(self._before[name], bar[name])
            arrays = {"a": self._before[name], "a_new": bar[name]}
            context.launch(self._kernels.average, strength=self._strength, most=self._most, **arrays)


class Limit:
    """Limits the vector of each particle in an adjoint to a number of times the root mean square over all particles."""

    def __init__(self, solver: Solver, fields: Iterable[str]):
        layout = solver.layout
        self._launch, self._particles, self._fields = solver.launch, layout.particles, tuple(fields)
        self._kernels = adjoint_filter_kernels(solver.discretisation)
        self._squares = wp.zeros(layout.all_particles, dtype=wp.vec2d, device=layout.device)
        self._sum = layout.sum_of(wp.vec2d)
        self._times = wp.full(1, np.inf, dtype=wp.float64, device=layout.device)

    def set_times(self, times: float) -> None:
        """Set the limit of the following calls, in root mean squares; an infinite one changes nothing."""
        self._times.fill_(times)

    def __call__(self, bar: State) -> None:
        squares = self._squares
        self._launch(self._kernels.squares, a=bar.positions, b=bar.velocities, found=squares)
        known = {"times": self._times, "particles": self._particles, "squares": squares, "sums": self._sum(squares)}
        for number, name in enumerate(FIELDS):
            if name in self._fields:
                self._launch(self._kernels.limit, known, field=number, a=bar[name])


class Drag:
    """Multiplies the adjoint of velocities by exp(-rate dt)."""

    def __init__(self, solver: Solver, rate: float):
        self._solver, self._rate = solver, rate
        self._kernel = adjoint_filter_kernels(solver.discretisation).drag

    def __call__(self, bar: State, parameters: Parameters) -> None:
        self._solver.context(parameters).launch(self._kernel, rate=self._rate, a=bar.velocities)


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
