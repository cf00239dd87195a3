"""The adjoint of the pressure as the fixed point of its iterations, for `gradients.ImplicitPressure`.

At convergence k = Phi(k, inputs), with Phi an iteration of `cortado.solvers.projection.pressure` without extrapolation,
where k' has a part c of the slope by z: 1 where fluid is pushed, sigma where it is pulled, else 0. With A = D m^-1 D^T,
an adjoint k_bar of k makes that of Phi,

    lambda = (1 - Phi_k)^-T k_bar = k_bar + (1 - omega A / a) c lambda.

d_bar = omega c lambda / a = sqrt(c) q solves it with an operator that is symmetric and not negative, also where c is 0:

    (sqrt(c) A sqrt(c) + (1 - c) a / omega) q = sqrt(c) k_bar.

Conjugate gradients find q, preconditioned with the diagonal w = c a + (1 - c) a / omega: they solve the same divided by
w, which is symmetric in the product weighted with w. One application of the adjoint of an iteration to lambda = a q /
(omega sqrt(c)) then gives those of the inputs. The first guess, the pressure of the step before, has none.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import Named, bundle
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.state import Parameters, State
from cortado.solvers.projection.derivatives import ProjectionAdjoint
from cortado.solvers.projection.images import image_sums
from cortado.solvers.projection.pressure import clamp_functions
from cortado.solvers.projection.steps import IMPULSE, ProjectionSteps
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.solvers.projection.velocity import velocity_gradient_kernels
from cortado.solvers.solver import Counts
from cortado.sph.conjugate_gradients import ConjugateGradients, round_off
from cortado.sph.moment_functions import matrix_type, symmetric
from cortado.sph.parts import Carried, StepContext


@dataclass(frozen=True)
class FixedPointKernels:
    """The kernels, by what they do."""

    pull: Any
    """y = sqrt(c) p, and T = y L."""
    linearise: Any
    """D v, sqrt(c), (1 - c) a / omega, w and the right-hand side at the fixed point."""
    multiply: Any
    """The operator over w, given -D^T y / m."""
    recover: Any
    """lambda of the solution q."""


@cache
def fixed_point_kernels(discretisation: Discretisation) -> FixedPointKernels:
    """The same in 2 and in 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, packed = neighbourhood_type(precision), symmetric(precision)
    six, pack = packed.kind, packed.pack
    spread = image_sums(discretisation).spread
    gradient, clamp = projection_sums(discretisation).velocity_gradient, clamp_functions(precision)
    wanted, parts = clamp.wanted, clamp.parts
    module = discretisation.module(False, "fixed_point")
    used = ("L", "gamma", "drift", "a", "weights", "image")
    seen = bundle(**{name: kind for name, kind in entries(precision).items() if name in used})
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module, enable_backward=False)
    def pull(
        p: wp.array(dtype=real),
        root: wp.array(dtype=real),
        L: wp.array(dtype=matrix),
        # out
        y: wp.array(dtype=real),
        T: wp.array(dtype=six),
    ):
        i = wp.tid()
        pulled = root[i] * p[i]
        y[i] = pulled
        T[i] = pulled * pack(L[i])

    @wp.kernel(module=module, enable_backward=False)
    def linearise(
        s: neighbourhood,
        omega: real,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        of: seen,
        x: wp.array(dtype=vector),
        at: bundle(u=vector, A=matrix, y=real),
        k_bar: wp.array(dtype=real),
        # out
        d: wp.array(dtype=real),
        root: wp.array(dtype=real),
        rest: wp.array(dtype=real),
        w: wp.array(dtype=real),
        r: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        widened = spread(i, x, at.u, s)
        if lane() > 0:
            return
        a = of.a[i]
        D = wp.ddot(of.L[i], at.A[i]) + wp.dot(of.gamma[i], at.u[i]) - of.drift[i] + of.image[i] * widened
        b = wanted(n[i], of.weights[i][1], time_step[i // s.particles])
        per = omega / a
        rise, fall = parts(at.y[i] + per * (D - b), at.y[i] + per * D)
        c = rise + fall * of.weights[i][0]
        remainder = (real(1.0) - c) * a / omega
        weight = c * a + remainder
        d[i] = D
        root[i] = wp.sqrt(c)
        rest[i] = remainder
        w[i] = weight
        r[i] = wp.sqrt(c) * k_bar[i] / weight

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        of: seen,
        u: wp.array(dtype=vector),
        root: wp.array(dtype=real),
        rest: wp.array(dtype=real),
        w: wp.array(dtype=real),
        p: wp.array(dtype=real),
        # out
        product: wp.array(dtype=real),
        share: wp.array(dtype=real),
    ):
        """``u`` is -D^T y / m."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient(i, x, u, s)
        widened = spread(i, x, u, s)
        if lane() > 0:
            return
        total = wp.ddot(of.L[i], wp.matrix_from_rows(row_x, row_y, row_z)) + of.image[i] * widened
        found = rest[i] * p[i] - root[i] * (total + wp.dot(of.gamma[i], u[i]))
        product[i] = found / w[i]
        share[i] = p[i] * found

    @wp.kernel(module=module, enable_backward=False)
    def recover(
        omega: real,
        of: seen,
        root: wp.array(dtype=real),
        q: wp.array(dtype=real),
        # out
        k_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
    ):
        """Where c is 0, so are sigma and its derivatives, and nothing depends on lambda."""
        i = wp.tid()
        found = real(0.0)
        if root[i] > real(0.0):
            found = of.a[i] * q[i] / (omega * root[i])
        k_bar[i] = found
        y_bar[i] = real(0.0)

    return FixedPointKernels(pull, linearise, multiply, recover)


class FixedPointAdjoint(ProjectionAdjoint):
    """Reverse mode of steps whose pressure is known from what they led to: neither its work nor its memory depends on
    the number of iterations. It is a `ResumingAdjoint`."""

    def __init__(self, solver: ProjectionSteps, steps: int, tolerance: float, most: int):
        """As `Solver.implicit_adjoint` says."""
        super().__init__(solver, steps)
        layout, precision = solver.layout, solver.layout.precision
        self._own = fixed_point_kernels(solver.discretisation)
        self._gradient = velocity_gradient_kernels(solver.discretisation, solver.system.walled.dimension)
        self._after = layout.state(solver.carried_fields)
        """k after the step that comes next, in the scene's order."""
        self._end = Carried(solver.carried_fields, layout)
        self._root, self._rest, self._w, self._r, self._q = (solver.numbers() for _ in range(5))
        self._y, self._still, self._u = solver.numbers(), solver.vectors(), solver.vectors()
        tolerance = max(tolerance, round_off(precision)) if tolerance > 0.0 else 0.0
        self._solution = ConjugateGradients(layout, precision.real, tolerance, most)

    def arrive(self, state: State) -> None:
        """As that of `ResumingAdjoint`."""
        wp.copy(self._after[IMPULSE], state[IMPULSE])

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """As that of `ResumingAdjoint`."""
        solver, repairs = self._solver, counts[1]
        solver.reserve((0, repairs))
        context, at = solver.begin(state, parameters), solver.iterates[0]
        self._end.sort(context, self._after)
        self._root.fill_(1.0)
        self._pull_by(context, self._end[IMPULSE], at["y"], solver.pull)
        wp.copy(at["k"], self._end[IMPULSE])
        solver.press(context, at)
        context.launch(self._gradient.forward, v_flow=at["u"], A=at["A"])
        wp.copy(solver.last_gradient(0), at["A"])
        solver.move(context, 0)
        for k in range(repairs):
            solver.mend(context, k, k, k + 1)
        self.arrive(state)

    def _last(self, counts: Counts) -> dict[str, wp.array]:
        return self._solver.iterates[0]

    def _last_gradient(self, counts: Counts) -> wp.array:
        return self._solver.iterates[0]["A"]

    def _pull_by(self, context: StepContext, p: wp.array, y: wp.array, T: wp.array) -> None:
        context.launch(self._own.pull, self._solver.around, p=p, root=self._root, y=y, T=T)

    def _project(self, context: StepContext, known: tuple[Named, ...], iterations: int) -> None:
        """Of the new velocities and of the fixed point, to the adjoint of v*."""
        solver, at = self._solver, self._solver.iterates[0]
        flow = {"v_flow": at["u"], "v_flow_bar": self._u_bar, "A_bar": self._A_bar}
        context.launch(self._gradient.adjoint, *known, flow)
        self._press(context, known, at, self._k_bar)
        system = {"root": self._root, "rest": self._rest, "w": self._w}
        own = (solver.around, solver.relaxed, system)
        context.launch(self._own.linearise, *own, at, k_bar=self._k_bar, r=self._r)

        def multiply(p: wp.array, found: dict[str, wp.array]) -> None:
            by = {"y": self._y, "T": self._pull, "u": self._u, "kick": self._u}
            self._pull_by(context, p, y=self._y, T=self._pull)
            context.launch(solver.kernels.velocity.velocity.forward, solver.around, by, v_star=self._still)
            context.launch(self._own.multiply, *own, found, u=self._u, p=p)

        self._solution.solve(context, multiply, self._w, self._r, self._q)
        context.launch(self._own.recover, *own, q=self._q, k_bar=self._k_bar, y_bar=self._y_bar)
        self._back(context, known, at, 0.0, moves=False)
        self._press(context, known, at, self._y_bar)
        for bar in (self._k_bar, self._y_bar, self._u_bar):
            bar.zero_()
