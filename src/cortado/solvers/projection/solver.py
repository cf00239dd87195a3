"""The velocity projection as the solver of a scene: its steps, forward, and their derivatives; and the adjoint of the
pressure as the fixed point of its iterations, for `gradients.ImplicitPressure`.

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
from math import inf
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.device.precision import TypesByName
from cortado.errors import InputError, MissingDerivativeError
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.particles.state import Parameters, State
from cortado.scene.solvers import ProjectionSolver
from cortado.solvers.build import SolverSetting, particle_system
from cortado.solvers.loop import LoopLimits
from cortado.solvers.pcisph.solver import Pcisph
from cortado.solvers.projection.derivatives import ProjectionAdjoint, ProjectionTangent
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.lattice import coarse_grid, endless, lattice_constants
from cortado.solvers.projection.names import weights_type
from cortado.solvers.projection.pressure import clamp_functions
from cortado.solvers.projection.steps import IMPULSE, ProjectionSteps
from cortado.solvers.projection.sums import projection_sums, velocity_gradient_kernels
from cortado.solvers.solver import Counts, ResumingAdjoint, Solver, StepAdjoint, StepTangent
from cortado.sph.moment_functions import ConjugateGradients, matrix_type, round_off, symmetric
from cortado.sph.parts import Carried, StepContext


@dataclass(frozen=True)
class FixedPointKernels:
    """Kernels of the linear system that the adjoint of the converged pressure solves."""

    pull: Any
    """y = sqrt(c) p, and T = y L."""
    linearise: Any
    """D v, sqrt(c), (1 - c) a / omega, w and the right-hand side at the fixed point."""
    multiply: Any
    """The operator over w applied to a vector, given -D^T y / m."""
    recover: Any
    """The adjoint lambda from the solution q."""


@cache
def fixed_point_kernels(discretisation: Discretisation) -> FixedPointKernels:
    """Make the kernels of the implicit pressure adjoint's linear system, in any dimension."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    weights4, packed = weights_type(precision), symmetric(precision)
    six, pack = packed.kind, packed.pack
    spread = image_sums(discretisation).spread.forward
    gradient, clamp = projection_sums(discretisation).velocity_gradient.forward, clamp_functions(precision)
    wanted, parts = clamp.wanted, clamp.parts
    module = discretisation.module(False, "fixed_point")

    @particle_kernel(module, "y T")
    def pull(p_i: real, root_i: real, L_i: matrix) -> tuple[real, six]:
        pulled = root_i * p_i
        return pulled, pulled * pack(L_i)

    widened = over(spread, "widened")

    typed = TypesByName(real, {matrix: "L A", vector: "gamma u row", weights4: "weights"})

    @particle_kernel(module, "d root rest w r", [widened], numbers=["omega"])
    @typed
    def linearise(
        widened, omega, time_step, n_i, L_i, gamma_i, drift_i, a_i, weights_i, image_i, u_i, A_i, y_i, k_bar_i
    ) -> tuple[real, real, real, real, real]:
        D = wp.ddot(L_i, A_i) + wp.dot(gamma_i, u_i) - drift_i + image_i * widened
        b = wanted(n_i, weights_i[1], time_step)
        per = omega / a_i
        rise, fall = parts(y_i + per * (D - b), y_i + per * D)
        c = rise + fall * weights_i[0]
        rest = (real(1.0) - c) * a_i / omega
        w = c * a_i + rest
        return D, wp.sqrt(c), rest, w, wp.sqrt(c) * k_bar_i / w

    @particle_kernel(module, "product share", [over(gradient, "row_x row_y row_z", v="u"), widened])
    @typed
    def multiply(
        row_x, row_y, row_z, widened, L_i, gamma_i, image_i, u_i, root_i, rest_i, w_i, p_i
    ) -> tuple[real, real]:
        """Apply the operator of the adjoint system, divided by the weights w, to p; ``u`` is -D^T y / m."""
        total = wp.ddot(L_i, wp.matrix_from_rows(row_x, row_y, row_z)) + image_i * widened
        found = rest_i * p_i - root_i * (total + wp.dot(gamma_i, u_i))
        return found / w_i, p_i * found

    @particle_kernel(module, "k_bar y_bar", numbers=["omega"])
    def recover(omega: real, a_i: real, root_i: real, q_i: real) -> tuple[real, real]:
        """Return lambda from q. Where c is 0, so are sigma and its derivatives, and nothing depends on lambda."""
        found = real(0.0)
        if root_i > real(0.0):
            found = a_i * q_i / (omega * root_i)
        return found, real(0.0)

    return FixedPointKernels(pull, linearise, multiply, recover)


class FixedPointAdjoint(ProjectionAdjoint):
    """The adjoint of steps that takes the pressure as a fixed point: neither its work nor its memory depends on the
    number of iterations. It is a `ResumingAdjoint`."""

    def __init__(self, solver: ProjectionSteps, steps: int, tolerance: float, most: int):
        """Prepare a backward pass over ``steps`` steps; `Solver.implicit_adjoint` explains the arguments."""
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
        wp.copy(self._after[IMPULSE], state[IMPULSE])

    def replay(self, state: State, parameters: Parameters, counts: Counts) -> None:
        """Replay a step without pressure iterations, from k of the state after it; see `ResumingAdjoint`."""
        solver, repairs = self._solver, counts[1]
        solver.reserve((0, repairs))
        context, at = solver.predict(state, parameters), solver.iterates[0]
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
        """Apply the adjoint of the fixed point and of the new velocities, to the adjoint of v*."""
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


class Projection(ProjectionSteps):
    """The solver by a projection that pushes and pulls incompressible SPH fluid, with derivatives; see `Solver`."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return ProjectionTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return ProjectionAdjoint(self, steps)

    def implicit_adjoint(self, steps: int, tolerance: float, iterations: int) -> ResumingAdjoint:
        if self.bodies is not None:
            raise MissingDerivativeError("bodies that are free have no implicit adjoint: try gradients.Exact.")
        return FixedPointAdjoint(self, steps, tolerance, iterations)


class ProjectionMaker:
    """A maker of the projection solver that the table [solver] of a scene describes."""

    batches = True

    def __init__(self, table: ProjectionSolver):
        self._table = table

    def build(self, setting: SolverSetting) -> Solver:
        """Make the projection solver of a scene that is cut into particles, on a device. Without pressure nothing is
        projected, and all solvers take the same step."""
        system, table = particle_system(setting), self._table
        if not setting.scene.forces.pressure:
            return Pcisph(system, None)
        if setting.batch is not None and table.tolerance is not None:
            raise InputError(
                f"batch is {setting.batch}, but must be left out, as solver.tolerance is that of one scene."
            )
        grid = coarse_grid(setting.scene, setting.discrete, system.layout.particles)
        constants = lattice_constants(setting.scene, setting.discrete)
        own = table.repairs, table.velocities_follow, grid, endless(setting.discrete)
        return Projection(system, constants, pressure_limits(table), *own)


maker = ProjectionMaker


def pressure_limits(table: ProjectionSolver) -> LoopLimits:
    """Return the bounds on iterations and errors at which the projection's pressure loop stops."""
    if table.tolerance is None:
        return LoopLimits(table.iterations, table.iterations, 0.0, 0.0)
    return LoopLimits(table.iterations, table.maximum_iterations, table.tolerance, inf)
