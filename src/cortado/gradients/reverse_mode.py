"""Estimators with one backward pass, and an observer of adjoint norms."""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_number, is_whole
from cortado.device.precision import TypesByName
from cortado.errors import InputError, shown
from cortado.gradients.estimator import AdjointEstimator, Filtered, ForwardPass
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import AdjointStep, BackwardStep, Observer, Rollout
from cortado.scene.parameter_values import Arrays
from cortado.solvers.solver import Counts, Solver

STRONGEST = 0.6
"""Greatest strength of the adjoint viscosity."""


@cache
def adjoint_filter_kernels(discretisation: Discretisation) -> Any:
    """Build the kernels of `AdjointViscosity`, in the notation of its docstring."""
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    weight, per_size = pair.weight, pair.per_size
    LANES, lane = discretisation.lanes, discretisation.lane
    module = discretisation.module(False, "adjoint_filters")
    strongest = wp.constant(real(STRONGEST))

    @fluid_sum(discretisation)
    def weights(x_ij: vector, s: neighbourhood) -> real:
        return weight(x_ij, s)

    @fluid_sum(discretisation)
    def strain(x_ij: vector, v_ij: vector, most_i: real, most_j: real, s: neighbourhood) -> real:
        return weight(x_ij, s) / wp.max(most_i, most_j) * wp.dot(v_ij, v_ij) * per_size(x_ij, s)

    typed = TypesByName(real, {vector: "x a b v", neighbourhood: "s", wp.vec2d: "found squares sums"})

    @fluid_sum(discretisation)
    @typed
    def exchange(x_ij, most_i, most_j, strengths_i, strengths_j, a_ij, b_ij, s) -> tuple[vector, vector]:
        share = wp.max(strengths_i, strengths_j) * (weight(x_ij, s) / wp.max(most_i, most_j))
        return share * a_ij, share * b_ij

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def crowd(s, x, most):
        """Store the kernel sum max(S_i, W(h / 2))."""
        i = s.first + wp.tid() // LANES
        total = weights(i, x, s) - real(s.filling[i]) * s.self_weight
        if lane() > 0:
            return
        most[i] = wp.max(total, weight(vector(real(0.5) * s.support, real(0.0), real(0.0)), s))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def strength(s, coefficient: real, time_step, x, v, most, strengths):
        i = s.first + wp.tid() // LANES
        total = strain(i, x, v, most, s)
        if lane() > 0:
            return
        strengths[i] = wp.min(coefficient * time_step[i // s.particles] * wp.sqrt(total), strongest)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def sort(order: wp.array(dtype=wp.int32), a, b, a_sorted, b_sorted):
        i = wp.tid()
        a_sorted[i] = a[order[i]]
        b_sorted[i] = b[order[i]]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def viscosity(s, order: wp.array(dtype=wp.int32), x, most, strengths, a_sorted, b_sorted, a, b):
        i = s.first + wp.tid() // LANES
        a_total, b_total = exchange(i, x, most, strengths, a_sorted, b_sorted, s)
        if lane() > 0:
            return
        a[order[i]] = a_sorted[i] - a_total
        b[order[i]] = b_sorted[i] - b_total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def squares(a, b, found):
        """Store squared lengths in float64, because squares may overflow float32."""
        i = wp.tid()
        a_i = wp.vec3d(a[i])
        b_i = wp.vec3d(b[i])
        found[i] = wp.vec2d(wp.dot(a_i, a_i), wp.dot(b_i, b_i))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def limit(times: wp.float64, particles: int, squares, sums, strengths, a, b):
        """Limit the lengths of a and b. ``sums`` has the sum of ``squares`` for each scene."""
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


class AdjointNorms:
    """An observer of a backward pass that computes the norms of adjoints on the device."""

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
        """Return the norms of the adjoints of positions and velocities, (steps + 1, 2) or (steps + 1, batch, 2)."""
        norms = np.sqrt(self._history.numpy())
        return norms if self._layout.batch is None else norms.reshape(-1, self._layout.batch, 2)


@dataclass(frozen=True)
class Exact(AdjointEstimator):
    """A gradient estimator: the exact adjoint of the discrete step. Repeated runs return bitwise equal gradients.

    Formula: the transposed derivative of the step. Bias: none. If neighbouring trajectories diverge, the gradient grows
    exponentially with the number of steps. Cost: every step is computed forward a second time. A backward step has
    about twice as many neighbour sums as a forward step.

    Example: ``value, gradient = problem.value_and_gradient(parameters, cortado.gradients.Exact())``
    """

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return AdjointStep(rollout)


@dataclass(frozen=True)
class Tape(AdjointEstimator):
    """A gradient estimator: the exact adjoint by Warp's automatic differentiation of the forward kernels.

    The estimator serves as a check of `Exact`. `Tape` is slower than `Exact`, uses atomics on a GPU, and works only
    with the solver ``"pcisph"``.

    Example: ``value, gradient = problem.value_and_gradient(parameters, cortado.gradients.Tape())``
    """

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return _TapeStep(rollout)


class _TapeStep:
    capturable = False

    def __init__(self, rollout: Rollout):
        solver = rollout.solver
        self.rollout, self._given, self._parameters = rollout, solver, rollout.parameters
        self.solver = solver.differentiable()
        self._before = self.solver.new_state(requires_grad=True)
        self._after = self._before.following()
        self._own = self.solver.new_parameters(rollout.steps, requires_grad=True)

    def begin(self) -> None:
        self.solver.match(self._given)
        self._own.assign(self._parameters)
        for array in self._own.arrays():
            array.grad.zero_()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self._before.assign(state)
        self.solver.follow(self._given)
        wp.copy(self._own["time_step"], self._parameters["time_step"])  # of this step, where it is chosen
        tape: Any = wp.Tape()
        try:
            with tape:
                self.solver.replay(self._before, self._own, counts)
                self.solver.write_state(counts, self._own, self._after)
            tape.backward(grads=dict(zip(self._after.arrays(), bar.arrays(), strict=True)))
            for own, total in zip(self._before.arrays(), bar.arrays(), strict=True):
                wp.copy(total, own.grad)
        finally:
            kept = {own.ptr for own in self._own.arrays()}  # summed over steps
            for array, gradient in tape.gradients.items():
                if isinstance(array, wp.array) and array.ptr not in kept:
                    gradient.zero_()

    def parameters(self) -> Parameters:
        return self._own.gradients()


@dataclass(frozen=True)
class AdjointViscosity(AdjointEstimator):
    """A gradient estimator: the adjoint with an eddy viscosity that follows the strain rate of the forward flow.

    Formula: after each backward step the adjoints a_i of positions and of velocities are blended with averages over the
    fluid neighbours j,

        a_i <- a_i + sum_j max(s_i, s_j) w_ij (a_j - a_i),    s_i = min(coefficient dt gamma_i, 0.6),
        gamma_i^2 = sum_j w_ij (v_i - v_j)^2 / ((x_i - x_j)^2 + 0.01 h^2),
        w_ij = W_ij / max(S_i, S_j, W(h / 2)),                S_i = sum_j W_ij.

    Here x_i and v_i are positions and velocities of the state, W is the smoothing kernel with the support radius h, and
    dt is the time step. Particle i has the strength s_i of the viscosity, the strain rate gamma_i and the kernel sum
    S_i. A pair has the weight w_ij. The weights are symmetric and sum to at most 1, and the strength is at most 0.6.
    The viscosity therefore conserves the sum of the a_i, and does not increase the norm of a.

    After the blending, the length of each vector a_i is limited to ``limit`` times the root mean square over all
    particles. In a flow without strain the adjoints are not limited. `docs/gradients.md` explains both.

    Long waves of the adjoint are slightly damped too, which affects gradients with respect to early steps most.
    ``order=2`` extrapolates the gradients g(C) and g(2 C) of two coefficients C and 2 C to zero viscosity (Richardson):
    the result is 2 g(C) - g(2 C).

    Bias: short waves of the adjoint are lost and long waves are weakened, so gradients of long runs are too small. If a
    loss depends on single particles, its gradient is poor, because the adjoint has no long waves. Noise: order 2 has
    more noise, so use order 2 with means over several runs (`EnsembleMean`). Cost: ``order`` backward passes, with
    three more neighbour sums per step.

    Sources: Smagorinsky (1963) uses a viscosity by the strain rate. Wang and Zaki (2026, arXiv 2606.25399) use an eddy
    viscosity for the adjoint of turbulence. Ke, You and Wang (2026, arXiv 2602.14016) precondition the adjoint by its
    spectrum instead.

    Example: ``value, gradient = problem.value_and_gradient(parameters, cortado.gradients.AdjointViscosity())``
    """

    coefficient: float = 2.0
    """Coefficient of the viscosity, at least 0. With the coefficient 0, the gradient is the gradient of `Exact`."""
    limit: float = 4.0
    """Greatest length of a particle's adjoint vector, relative to the root mean square; infinity for no limit."""
    order: int = 1
    """Order 1, or 2 for an extrapolation from two backward passes. Order 2 gives no derivatives with respect to the
    initial state, and no derivatives of a single backward step."""

    def __post_init__(self) -> None:
        if not is_whole(self.order) or self.order not in (1, 2):
            raise InputError(f"order is {shown(self.order)}, but must be 1 or 2.")
        if not (isinstance(self.limit, float) and self.limit == np.inf) and (as_number(self.limit) or 0.0) < 1.0:
            raise InputError(f"limit is {shown(self.limit)}, but must be a number of at least 1.")
        coefficient = as_number(self.coefficient)
        if coefficient is None or coefficient < 0.0:
            raise InputError(f"coefficient is {shown(self.coefficient)}, but must be a number of at least 0.")

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        """Return the backward step for order 1. Raises `InputError` for order 2, which has two backward passes."""
        if self.order != 1:
            raise InputError(f"order is {self.order}, but must be 1 for derivatives with respect to an earlier state.")
        step = AdjointStep(rollout)
        return _ViscousStep(step, rollout, self) if self.coefficient > 0.0 else step

    def back(self, forward_pass: ForwardPass, observe: Observer | None = None) -> Arrays:
        """Return the gradient. Only the pass with the smaller coefficient calls ``observe``."""
        once = replace(self, order=1)
        gradient = forward_pass.back(once, observe)
        if self.order == 1:
            return gradient
        stronger = forward_pass.back(replace(once, coefficient=2.0 * self.coefficient))
        return {name: 2.0 * weaker - stronger[name] for name, weaker in gradient.items()}


class _ViscousStep(Filtered):
    only_launches = True

    def __init__(self, base: BackwardStep, rollout: Rollout, estimator: AdjointViscosity):
        super().__init__(base)
        layout, self._parameters = base.solver.layout, rollout.parameters
        real, vector, device = layout.precision.real, layout.precision.vector, layout.device
        self._kernels = adjoint_filter_kernels(base.solver.discretisation)
        self._coefficient = {"coefficient": float(estimator.coefficient)}
        self._limits = {"times": float(estimator.limit), "particles": layout.particles}
        self._most, self.strengths = (wp.zeros(layout.all_particles, dtype=real, device=device) for _ in range(2))
        kinds = {"a_sorted": vector, "b_sorted": vector, "squares": wp.vec2d}
        self._own = {name: wp.zeros(layout.all_particles, dtype=kind, device=device) for name, kind in kinds.items()}
        self._sum, self._sum_of_strengths = layout.sum_of(wp.vec2d), layout.sum_of(real)

    def filter(self, bar: State) -> None:
        context, kernels = self.solver.context(self._parameters), self._kernels
        fields, flow = {"a": bar.positions, "b": bar.velocities}, {"most": self._most, "strengths": self.strengths}
        context.launch(kernels.crowd, most=self._most)
        context.launch(kernels.strength, self._coefficient, flow)
        context.launch(kernels.sort, fields, self._own)
        context.launch(kernels.viscosity, flow, fields, self._own)
        squares = self._own["squares"]
        self.solver.launch(kernels.squares, **fields, found=squares)
        sums = {"sums": self._sum(squares), "strengths": self._sum_of_strengths(self.strengths)}
        self.solver.launch(kernels.limit, self._limits, sums, **fields, squares=squares)
