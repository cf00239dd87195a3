"""Estimators that go back through a run step by step: exact, by a tape, or with filters of the adjoint of a
state between two steps, an eddy viscosity and a limit; norms of adjoints.
"""

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
"""Greatest strength s of the viscosity, at which waves of two spacings are damped and keep their sign."""


@cache
def adjoint_filter_kernels(discretisation: Discretisation) -> Any:
    """Return the kernels of `AdjointViscosity`, which has their formulas, by name. Adjoints are in the scene's order,
    and ``sort`` sorts them for ``viscosity``, which needs ``crowd`` and ``strength`` before it. Owing to the division
    by S it acts at a surface, and in a drop of a few particles, as it does within the fluid; W(h / 2) limits it where
    particles hardly touch."""
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
        """Return the squared strain rate gamma_i^2 as a sum over neighbours."""
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
        """Write max(S_i, W(h / 2)) with the sum S_i of weights over neighbours."""
        i = s.first + wp.tid() // LANES
        total = weights(i, x, s) - real(s.filling[i]) * s.self_weight
        if lane() > 0:
            return
        most[i] = wp.max(total, weight(vector(real(0.5) * s.support, real(0.0), real(0.0)), s))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def strength(s, coefficient: real, time_step, x, v, most, strengths):
        """Write the strength s_i of the viscosity for sorted particles, from sorted arguments."""
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
        """Blend two fields of an adjoint at once, written in the scene's order."""
        i = s.first + wp.tid() // LANES
        a_total, b_total = exchange(i, x, most, strengths, a_sorted, b_sorted, s)
        if lane() > 0:
            return
        a[order[i]] = a_sorted[i] - a_total
        b[order[i]] = b_sorted[i] - b_total

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def squares(a, b, found):
        """Write |a_i|^2 and |b_i|^2 in float64, as adjoints may have squares beyond float32."""
        i = wp.tid()
        a_i = wp.vec3d(a[i])
        b_i = wp.vec3d(b[i])
        found[i] = wp.vec2d(wp.dot(a_i, a_i), wp.dot(b_i, b_i))

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def limit(times: wp.float64, particles: int, squares, sums, strengths, a, b):
        """Limit a and b, given their ``squares`` by particle, their ``sums`` over each scene, and the sum of the
        viscosity's strengths: a flow without strain is not limited."""
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
    """A filter that blends adjoints of positions and velocities with averages over neighbours, the more the faster the
    forward flow strains there."""

    def __init__(self, solver: Solver, coefficient: float):
        self._solver, self._coefficient = solver, coefficient
        self._kernels = adjoint_filter_kernels(solver.discretisation)
        precision, particles, device = solver.discretisation.precision, solver.layout.all_particles, solver.device
        self._most, self.strengths = (wp.zeros(particles, dtype=precision.real, device=device) for _ in range(2))
        a, b = (wp.zeros(particles, dtype=precision.vector, device=device) for _ in range(2))
        self._sorted = {"a_sorted": a, "b_sorted": b}

    def __call__(self, bar: State, parameters: Parameters) -> None:
        """Blend the adjoint of the state whose step the solver has replayed last, and set ``strengths`` for its sorted
        particles."""
        context, kernels = self._solver.context(parameters), self._kernels
        fields = {"a": bar.positions, "b": bar.velocities, **self._sorted}
        flow = {"most": self._most, "strengths": self.strengths}
        context.launch(kernels.crowd, most=self._most)
        context.launch(kernels.strength, coefficient=self._coefficient, **flow)
        context.launch(kernels.sort, **fields)
        context.launch(kernels.viscosity, **flow, **fields)


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
        """Return the norms (steps + 1, 2), in a batch (steps + 1, batch, 2), of the adjoints of positions and of
        velocities over all particles of a scene, state by state."""
        norms = np.sqrt(self._history.numpy())
        return norms if self._layout.batch is None else norms.reshape(-1, self._layout.batch, 2)


@dataclass(frozen=True)
class Exact(AdjointEstimator):
    """A gradient estimator: the exact adjoint of the discrete step, by gathers: no atomics, the same bits every time.

    Formula: the transposed derivative of the step. Bias: none; but where neighbouring trajectories diverge it grows as
    fast as they do, by a constant factor a step. Cost: every step is computed once more forward, and the backward step
    has about twice the neighbour sums of a forward one.

    Example: ``value, gradient = problem.value_and_gradient(parameters, cortado.gradients.Exact())``
    """

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return AdjointStep(rollout, rollout.solver.adjoint(rollout.steps))


@dataclass(frozen=True)
class Tape(AdjointEstimator):
    """A gradient estimator: the exact adjoint by Warp's own automatic differentiation of the forward kernels.

    It is slower than `Exact`, with atomics on a GPU, and is kept to check it. Only for scenes with the solver
    ``"pcisph"``; others say so.

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
        tape = wp.Tape()
        try:
            self._back(tape, counts, bar)
        finally:
            self._forget(tape)

    def _back(self, tape: wp.Tape, counts: Counts, bar: State) -> None:
        with tape:
            self.solver.replay(self._before, self._own, counts)
            self.solver.write_state(counts, self._own, self._after)
        tape.backward(grads=dict(zip(self._after.arrays(), bar.arrays(), strict=True)))
        for own, total in zip(self._before.arrays(), bar.arrays(), strict=True):
            wp.copy(total, own.grad)

    def _forget(self, tape: Any) -> None:
        """Zero every adjoint but those of the parameters, which add up over the steps."""
        kept = {own.ptr for own in self._own.arrays()}
        for array, gradient in tape.gradients.items():
            if isinstance(array, wp.array) and array.ptr not in kept:
                gradient.zero_()

    def parameters(self) -> Parameters:
        return self._own.gradients()


EXACT = Exact()


@dataclass(frozen=True)
class AdjointViscosity(AdjointEstimator):
    """A gradient estimator: the adjoint with an eddy viscosity that follows the strain rate of the forward flow.

    Formula: after each backward step the adjoints a of positions and of velocities are blended with their averages over
    fluid neighbours,

        a_i <- a_i + sum_j max(s_i, s_j) w_ij (a_j - a_i),    s_i = min(coefficient dt gamma_i, 0.6),
        gamma_i^2 = sum_j w_ij (v_i - v_j)^2 / ((x_i - x_j)^2 + 0.01 h^2),
        w_ij = W_ij / max(S_i, S_j, W(h / 2)),                S_i = sum_j W_ij.

    Here x and v are positions and velocities in the state of the adjoint. The weights are symmetric and add up to
    0.6 at most: sum_i a_i is kept, the square norm does not grow.

    Why: what grows exponentially in an adjoint lives at the scale of particles, the response to a parameter at that of
    the fluid. A step damps a wave of length l by about s (2 pi / l)^2 s_W^2 / 2, s_W^2 being the second moment of W.
    The adjoint grows where the forward flow strains, and as fast; so one coefficient serves all flows, and where the
    flow is calm nothing is damped.

    Then each vector of a is limited to ``limit`` root mean squares over all particles. Now and then the adjoint of a
    few particles grows faster than the average can spread it, and would dominate the rest. Where nothing strains
    there is no limit either.

    Long waves are damped too, a little, and most of all the gradient with respect to early steps. With an ``order`` of
    2 the gradients g of two coefficients are extrapolated to none (Richardson): g = 2 g(C) - g(2 C).

    Bias: the short waves of the adjoint are lost, and of the long ones a part: gradients of long runs are too small.
    The gradient of a loss of single particles, which has no long waves, is poor. Noise: with the second order more,
    so that it is for means over several runs (`EnsembleMean`). Cost: ``order`` reverse passes, with three more sums
    over neighbours for each step.

    Sources: Smagorinsky (1963) for a viscosity by the strain rate. Wang and Zaki (2026, arXiv 2606.25399) for an eddy
    viscosity of the adjoint of turbulence. Ke, You and Wang (2026, arXiv 2602.14016) precondition the adjoint by its
    spectrum instead.

    Example: ``value, gradient = problem.value_and_gradient(parameters, cortado.gradients.AdjointViscosity())``
    """

    coefficient: float = 2.0
    """Coefficient C of the viscosity, at least 0, with which it equals `Exact`."""
    limit: float = 4.0
    """Greatest vector of a particle, in root mean squares over all; infinite for none."""
    order: int = 1
    """Order 1, or 2 for an extrapolation by two passes over a whole run: not with respect to the first state, nor step
    by step."""

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
        """Return the backward step of the first order; raise `InputError` for another, which takes two passes."""
        if self.order != 1:
            raise InputError(f"order is {self.order}, but must be 1 where a gradient goes on to the state before.")
        step = EXACT.derivative(rollout)
        return _ViscousStep(step, rollout, self) if self.coefficient > 0.0 else step

    def back(self, forward_pass: ForwardPass, observe: Observer | None = None) -> Arrays:
        """Return the gradient of a forward run's loss; ``observe`` is given the adjoints of the smaller coefficient."""
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
        self._viscosity = EddyViscosity(base.solver, float(estimator.coefficient))
        layout, self._parameters = base.solver.layout, rollout.parameters
        self._limits = {"times": float(estimator.limit), "particles": layout.particles}
        self._squares = wp.zeros(layout.all_particles, dtype=wp.vec2d, device=layout.device)
        self._sum, self._sum_of_strengths = layout.sum_of(wp.vec2d), layout.sum_of(layout.precision.real)

    def filter(self, bar: State) -> None:
        """Blend the adjoint, then limit each particle's vector to a multiple of the root mean square over all; where
        nothing strains, nothing changes."""
        self._viscosity(bar, self._parameters)
        launch, kernels = self.solver.launch, adjoint_filter_kernels(self.solver.discretisation)
        squares, fields = self._squares, {"a": bar.positions, "b": bar.velocities}
        launch(kernels.squares, **fields, found=squares)
        strengths = self._sum_of_strengths(self._viscosity.strengths)
        launch(kernels.limit, self._limits, **fields, squares=squares, sums=self._sum(squares), strengths=strengths)
