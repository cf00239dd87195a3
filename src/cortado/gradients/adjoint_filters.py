"""Filters of the adjoint of a state between two backward steps, an eddy viscosity and a limit; norms of adjoints."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.lanes import lane_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.state import Parameters, State
from cortado.solvers.solver import Solver

STRONGEST = 0.6
"""Strength s of the viscosity at most: waves of two spacings are damped by a factor, and do not change their sign."""


@cache
def adjoint_filter_kernels(discretisation: Discretisation) -> Any:
    """The kernels of `AdjointViscosity`, which has their formulas, by name. Adjoints are in the scene's order, and
    ``sort`` sorts them for ``viscosity``, which needs ``crowd`` and ``strength`` before it. Owing to the division by S
    it acts at a surface, and in a drop of a few particles, as it does within the fluid; W(h / 2) limits it where
    particles hardly touch."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    weight, per_size = pair.weight, pair.per_size
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane
    module = discretisation.module(False, "adjoint_filters")
    strongest = wp.constant(real(STRONGEST))

    @fluid_sum(discretisation)
    def weights(x_ij: vector, s: neighbourhood) -> real:
        return weight(x_ij, s)

    @fluid_sum(discretisation)
    def strain(x_ij: vector, v_ij: vector, most_i: real, most_j: real, s: neighbourhood) -> real:
        """gamma_i^2"""
        return weight(x_ij, s) / wp.max(most_i, most_j) * wp.dot(v_ij, v_ij) * per_size(x_ij, s)

    @fluid_sum(discretisation)
    def exchange(
        x_ij: vector,
        most_i: real,
        most_j: real,
        strengths_i: real,
        strengths_j: real,
        a_ij: vector,
        b_ij: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector]:
        share = wp.max(strengths_i, strengths_j) * (weight(x_ij, s) / wp.max(most_i, most_j))
        return share * a_ij, share * b_ij

    @wp.kernel(module=module, enable_backward=False)
    def crowd(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        most: wp.array(dtype=real),
    ):
        """max(S_i, W(h / 2))"""
        i = s.first + wp.tid() // LANES
        total = weights(i, x, s) - real(s.filling[i]) * s.self_weight
        if lane() > 0:
            return
        most[i] = wp.max(total, weight(vector(real(0.5) * s.support, real(0.0), real(0.0)), s))

    @wp.kernel(module=module, enable_backward=False)
    def strength(
        s: neighbourhood,
        coefficient: real,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        most: wp.array(dtype=real),
        # out
        strengths: wp.array(dtype=real),
    ):
        """s_i, of sorted particles as all arguments"""
        i = s.first + wp.tid() // LANES
        total = strain(i, x, v, most, s)
        if lane() > 0:
            return
        strengths[i] = wp.min(coefficient * time_step[i // s.particles] * wp.sqrt(total), strongest)

    @wp.kernel(module=module, enable_backward=False)
    def sort(
        order: wp.array(dtype=wp.int32),
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        # out
        a_sorted: wp.array(dtype=vector),
        b_sorted: wp.array(dtype=vector),
    ):
        i = wp.tid()
        a_sorted[i] = a[order[i]]
        b_sorted[i] = b[order[i]]

    @wp.kernel(module=module, enable_backward=False)
    def viscosity(
        s: neighbourhood,
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        most: wp.array(dtype=real),
        strengths: wp.array(dtype=real),
        a_sorted: wp.array(dtype=vector),
        b_sorted: wp.array(dtype=vector),
        # out
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
    ):
        """Two fields of an adjoint at once, which are written in the scene's order."""
        i = s.first + wp.tid() // LANES
        a_total, b_total = exchange(i, x, most, strengths, a_sorted, b_sorted, s)
        if lane() > 0:
            return
        a[order[i]] = a_sorted[i] - a_total
        b[order[i]] = b_sorted[i] - b_total

    @wp.kernel(module=module, enable_backward=False)
    def squares(
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
        # out
        found: wp.array(dtype=wp.vec2d),
    ):
        """|a_i|^2 and |b_i|^2, in float64: adjoints grow beyond what a square in float32 may be."""
        i = wp.tid()
        a_i = wp.vec3d(a[i])
        b_i = wp.vec3d(b[i])
        found[i] = wp.vec2d(wp.dot(a_i, a_i), wp.dot(b_i, b_i))

    @wp.kernel(module=module, enable_backward=False)
    def limit(
        times: wp.float64,
        particles: int,
        squares: wp.array(dtype=wp.vec2d),
        sums: wp.array(dtype=wp.vec2d),
        strengths: wp.array(dtype=real),
        # in and out
        a: wp.array(dtype=vector),
        b: wp.array(dtype=vector),
    ):
        """``squares`` of every particle, of a and of b; their ``sums`` over each scene, and that of all strengths of
        the viscosity: a flow without strain is not limited."""
        i = wp.tid()
        if strengths[i // particles] == real(0.0):
            return
        most = (times * times / wp.float64(particles)) * sums[i // particles]
        own = squares[i]
        if own[0] > most[0]:
            a[i] = real(wp.sqrt(most[0] / own[0])) * a[i]
        if own[1] > most[1]:
            b[i] = real(wp.sqrt(most[1] / own[1])) * b[i]

    return SimpleNamespace(crowd=crowd, strength=strength, sort=sort, viscosity=viscosity, limit=limit, squares=squares)


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
