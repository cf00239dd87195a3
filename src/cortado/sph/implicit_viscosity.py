"""Viscosity as a stress at the end of a step: its time step has no limit.

With the acceleration a by all other forces, and g(v) by the stress of fluid with velocities v
(`cortado.sph.stress_kernels`), with M and mu of the velocities at the start, what acts is a' of

    a' = a + g(v + dt a'),   that is   B (a' - a) = g(v + dt a),   B y = y - dt g(y),

which `cortado.sph.conjugate_gradients` solves to round-off. B is symmetric and positive with respect to the product
sum_i m_i a_i . b_i. mu is that of the velocities v at the start, the stress that of u = v + dt a' at the end. So the
derivatives are those of the solution, whatever way led to it: the tangent is one more solve with B, and so is the
adjoint, as B is symmetric in the product weighted with masses.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.reduction import add
from cortado.errors import MissingDerivativeError
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.state import Layout
from cortado.scene.scene import Scene
from cortado.scene.stability import is_implicit
from cortado.sph.conjugate_gradients import ConjugateGradients, round_off
from cortado.sph.formula import theta_of
from cortado.sph.moment_functions import matrix_type
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_forces import stress_sums
from cortado.sph.stress_functions import moment_sums, stress_functions
from cortado.sph.viscosity_law import Law
from cortado.sph.viscous_stress import ViscousStress


@cache
def operator_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> tuple[Any, Any]:
    """The kernel of T for some velocities with M and mu kept, and that of B."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood = neighbourhood_type(precision)
    module = discretisation.module(False, f"implicit_viscosity_{law.topic}{dimension}d" + "_no_slip" * sticks)
    traction = stress_functions(precision, dimension, law, module).traction
    moments, force = moment_sums(discretisation, sticks).sums, stress_sums(discretisation, sticks).force
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module, enable_backward=False)
    def pull(
        s: neighbourhood,
        control: real,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        mu: wp.array(dtype=real),
        M: wp.array(dtype=matrix),
        eta: wp.array(dtype=real),
        # out
        A: wp.array(dtype=matrix),
        T: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        _diagonal, _others, row_x, row_y, row_z, _thin = moments(i, x, v, mu, least, s)
        if lane() > 0:
            return
        A_i = wp.matrix_from_rows(row_x, row_y, row_z)
        A[i] = A_i
        T[i] = traction(M[i], A_i, eta[i], control)

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        s: neighbourhood,
        control: real,
        least: real,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        T: wp.array(dtype=matrix),
        eta: wp.array(dtype=real),
        # out
        product: wp.array(dtype=vector),
        share: wp.array(dtype=real),
    ):
        """B v, and each particle's share in the product with v."""
        i = s.first + wp.tid() // LANES
        total = force(i, x, v, m, T, eta, control, least, s)
        if lane() > 0:
            return
        found = v[i] - time_step[i // s.particles] * total
        product[i] = found
        share[i] = m[i] * wp.dot(v[i], found)

    return pull, multiply


@dataclass(frozen=True)
class ImplicitKernels:
    """The kernels, by what they do."""

    predict: Any
    """u = v + dt a; with tangents of v and dt that of u, where a does not change."""
    stress_tangent: Any
    """The tangents of T and mu."""
    weigh: Any
    """r = a_bar / m."""
    unweigh: Any
    """r = m y."""
    stress_adjoint: Any
    """From the adjoint of the acceleration to those of the sums and of the law."""
    end_adjoint: Any
    """From the adjoint of u to those of v and dt."""
    strain_adjoint: Any
    """From the adjoint of A of the velocities at the start to those of particles."""


@cache
def implicit_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> ImplicitKernels:
    """For the arguments of `cortado.sph.stress_kernels.stress_kernels`."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood = neighbourhood_type(precision)
    name = f"implicit_step_{law.topic}{dimension}d" + "_no_slip" * sticks
    module, tangent_module = discretisation.module(False, name), discretisation.tangent_module(name)
    along = stress_functions(precision, dimension, law, tangent_module)
    change_of_moment, change_of = along.moment_change, along.change
    stress_back = stress_functions(precision, dimension, law, module).back
    sums = moment_sums(discretisation, sticks)
    moments_tangent, moments_back = sums.tangent, sums.back
    traction_back = stress_sums(discretisation, sticks).traction_back
    theta_type = theta_of(precision, law.ranks)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    of_all = bundle(M=matrix, A=matrix, R=real, eta=real, A_u=matrix)
    of_particles, seen = bundle(x=vector, v=vector, mu=real, u=vector), bundle(x=vector, v=vector, m=real)

    @wp.kernel(module=module, enable_backward=False)
    def predict(
        particles: int,
        time_step: wp.array(dtype=real),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        # out
        u: wp.array(dtype=vector),
    ):
        i = wp.tid()
        u[i] = v[i] + time_step[i // particles] * acceleration[i]

    @wp.kernel(module=tangent_module, enable_backward=False)
    def stress_tangent(
        s: neighbourhood,
        control: real,
        least: real,
        theta: wp.array(dtype=theta_type),
        theta_dot: wp.array(dtype=theta_type),
        now: of_particles,
        dot: of_particles,
        of: of_all,
        # out
        T_dot: wp.array(dtype=matrix),
        eta_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, row_x, row_y, row_z, thin = moments_tangent(
            i, now.x, dot.x, now.v, dot.v, now.mu, dot.mu, least, s
        )
        _diagonal, _others, end_x, end_y, end_z, _thin = moments_tangent(
            i, now.x, dot.x, now.u, dot.u, now.mu, dot.mu, least, s
        )
        if lane() > 0:
            return
        M_dot, A_dot = change_of_moment(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z)
        A_u_dot, b = wp.matrix_from_rows(end_x, end_y, end_z), i // s.particles
        T_i_dot, eta_i_dot = change_of(
            of.M[i],
            of.A[i],
            of.A_u[i],
            of.R[i],
            now.mu[i],
            theta[b],
            of.eta[i],
            control,
            M_dot,
            A_dot,
            A_u_dot,
            thin,
            dot.mu[i],
            theta_dot[b],
        )
        T_dot[i] = T_i_dot
        eta_dot[i] = eta_i_dot

    @wp.kernel(module=module, enable_backward=False)
    def weigh(
        m: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # out
        r: wp.array(dtype=vector),
    ):
        i = wp.tid()
        r[i] = acceleration_bar[i] / m[i]

    @wp.kernel(module=module, enable_backward=False)
    def unweigh(
        m: wp.array(dtype=real),
        y: wp.array(dtype=vector),
        # out
        r: wp.array(dtype=vector),
    ):
        i = wp.tid()
        r[i] = m[i] * y[i]

    @wp.kernel(module=module, enable_backward=False)
    def stress_adjoint(
        s: neighbourhood,
        control: real,
        least: real,
        theta: wp.array(dtype=theta_type),
        now: seen,
        mu: wp.array(dtype=real),
        of: of_all,
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        mu_bar: wp.array(dtype=real),
        # out
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        A_v_bar: wp.array(dtype=matrix),
        theta_bar: wp.array(dtype=theta_type),
    ):
        """``now.v`` are velocities at the end, ``A_bar`` is of theirs, and ``A_v_bar`` of those at the start."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z, eta_bar = traction_back(i, now.x, now.v, now.m, acceleration_bar, control, least, s)
        if lane() > 0:
            return
        T_bar, member = wp.matrix_from_rows(row_x, row_y, row_z), i // s.particles
        by_M, by_A, by_A_u, by_R, by_mu, by_theta = stress_back(
            of.M[i], of.A[i], of.A_u[i], of.R[i], mu[i], theta[member], of.eta[i], control, T_bar, eta_bar
        )
        M_bar[i] = by_M
        A_bar[i] = by_A_u
        A_v_bar[i] = by_A
        R_bar[i] = by_R
        mu_bar[i] = mu_bar[i] + by_mu
        theta_bar[i] = by_theta

    @wp.kernel(module=module, enable_backward=False)
    def end_adjoint(
        acceleration: wp.array(dtype=vector),
        u_bar: wp.array(dtype=vector),
        # in and out
        v_bar: wp.array(dtype=vector),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        v_bar[i] = v_bar[i] + u_bar[i]
        time_step_bar[i] = time_step_bar[i] + wp.dot(u_bar[i], acceleration[i])

    @wp.kernel(module=module, enable_backward=False)
    def strain_adjoint(
        s: neighbourhood,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        mu: wp.array(dtype=real),
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        x_sum, v_sum, _mu_sum = moments_back(i, x, v, mu, M_bar, A_bar, R_bar, least, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        v_bar[i] = v_bar[i] + v_sum

    return ImplicitKernels(predict, stress_tangent, weigh, unweigh, stress_adjoint, end_adjoint, strain_adjoint)


MOST = 1_000
"""Iterations of a solve."""


class Solve(ConjugateGradients):
    """Conjugate gradients for the particles of one solver."""

    name, most = "viscous_iterations", MOST

    def __init__(self, layout: Layout, operator: tuple[Any, Any]):
        """``operator``: the kernels that `operator_kernels` gives."""
        precision = layout.precision
        super().__init__(layout, precision.vector, round_off(precision), MOST)
        self._pull, self._multiply = operator

    def __call__(self, step: StepContext, known: Any, r: wp.array, y: wp.array) -> None:
        """Write to ``y`` what solves B y = r, (n,) vectors both, and overwrite ``r``; ``known``: arguments of the
        kernels of B."""

        def multiply(p: wp.array, found: dict[str, wp.array]) -> None:
            step.launch(self._pull, *known, v=p)
            step.launch(self._multiply, *known, found, v=p)

        self.solve(step, multiply, step.fields["m"], r, y)


class ImplicitViscousStress(ViscousStress):
    """Viscosity as a stress at the end of the step. It comes after all other forces."""

    is_last = True

    def __init__(self, setting: Setting, law: Law | None = None, parameters: Any = ()):
        """As `ViscousStress`."""
        if setting.discretisation.taped:
            raise MissingDerivativeError("implicit viscosity has no tape: try gradients.Exact.")
        super().__init__(setting, law, parameters)
        layout, (discretisation, *others) = setting.layout, self._made_for
        self._implicit = implicit_kernels(*self._made_for)
        self._pull = operator_kernels(*self._made_for)[0]
        self.solve = Solve(layout, operator_kernels(discretisation.still, *others))
        sizes = {"shape": layout.all_particles, "device": layout.device}
        vectors = (wp.zeros(dtype=layout.precision.vector, **sizes) for _ in range(4))
        self._u, self._r, self._y, self._still = vectors
        matrix = self._of["T"].dtype
        self._A_u, self._T_u, self._A_bar, no_matrix = (wp.zeros(dtype=matrix, **sizes) for _ in range(4))
        self._no_bars = {"M_bar": no_matrix, "R_bar": wp.zeros(dtype=layout.precision.real, **sizes)}
        self._after: Any = None
        """a' of the last step."""
        self._after_dot: Any = None
        """Its tangent, after forward mode of the step."""

    @property
    def iterations(self) -> NDArray:
        """(members,) those of the last solve, of a run or of a derivative."""
        return np.asarray(self.solve.count.numpy())

    def _known(self, *more: Any) -> tuple[Any, ...]:
        """Arguments of the kernels of B, with A and T of the velocities u."""
        return *more, self._constants, {**self._of, "A": self._A_u, "T": self._T_u}

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._stress.forward, self._constants, **self._of, theta=self._packed.theta(step))
        step.launch(self._implicit.predict, acceleration=before, u=self._u)
        known = self._known()
        step.launch(self._pull, *known, v=self._u)
        step.launch(self._force.forward, *known, v=self._u, acceleration_in=self._still, acceleration=self._r)
        self.solve(step, known, self._r, self._y)
        wp.copy(after, before)
        add(self._y, after)
        self._after = after

    def _at_the_end(self, step: StepContext) -> None:
        """u = v + dt a', with A and T of it."""
        step.launch(self._implicit.predict, acceleration=self._after, u=self._u)
        step.launch(self._pull, *self._known(), v=self._u)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        self._at_the_end(step)
        u_dot, along = self._y, {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}
        step.launch(self._implicit.predict, along, acceleration=self._after, u=u_dot)
        change = self._stress_along(step, dot, u_dot)
        now = {"v": self._u, "v_dot": u_dot, "acceleration_in_dot": before, "acceleration_dot": self._r}
        step.launch(self._force.tangent, now, change, *self._known(*dot.named))
        self.solve(step, self._known(), self._r, after)
        self._after_dot = after

    def _stress_along(self, step: StepContext, dot: Tangents, u_dot: wp.array) -> dict[str, wp.array]:
        """Write the tangents of T and mu for one of u."""
        change = {f"{name}_dot": self._change[name] for name in ("T", "eta")}
        theta = {"theta": self._packed.theta(step), "theta_dot": self._packed.theta_dot(step, dot.parameters)}
        both = {"u": self._u, "u_dot": u_dot, "A_u": self._A_u}
        step.launch(self._implicit.stress_tangent, *dot.named, self._constants, self._of, both, **theta, **change)
        return change

    def resisted(self, step: StepContext) -> dict[str, wp.array]:
        self._at_the_end(step)
        return {"T": self._T_u, "eta": self._of["eta"], "A_u": self._A_u, "v": self._u}

    def resisted_tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        self._at_the_end(step)
        by_time, u_dot = {"v": dot.fields["v"], "time_step": dot.parameters["time_step"]}, self._y
        step.launch(self._implicit.predict, by_time, acceleration=self._after, u=self._r)
        step.launch(self._implicit.predict, v=self._r, acceleration=self._after_dot, u=u_dot)
        return {**self._stress_along(step, dot, u_dot), "v_dot": u_dot}

    def resisted_adjoint(self, step: StepContext, v_bar: wp.array, bar: Adjoints, v_star_bar: wp.array) -> None:
        own = {"v_bar": v_star_bar, "u_bar": v_bar, "acceleration": self._after}
        step.launch(self._implicit.end_adjoint, own, *bar.named)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array:
        """Returns the adjoint of the acceleration by all other forces."""
        step.launch(self._implicit.weigh, acceleration_bar=acceleration_bar, r=self._r)
        self.solve(step, self._known(), self._r, self._y)
        step.launch(self._implicit.unweigh, y=self._y, r=self._r)
        self._at_the_end(step)
        theta = {"theta": self._packed.theta(step), "theta_bar": self._packed.shares}
        change = {f"{name}_bar": self._change[name] for name in ("M", "A", "R")}
        now = {"v": self._u, "acceleration_bar": self._r}
        both = {"A_u": self._A_u, "A_v_bar": self._A_bar}
        step.launch(self._implicit.stress_adjoint, now, both, change, *bar.named, self._constants, self._of, **theta)
        u_bar = self._y
        u_bar.zero_()
        step.launch(self._force.adjoint, now, {"v_bar": u_bar}, change, *self._known(*bar.named))
        self.give(step, bar, now, change, {"T": self._T_u})
        step.launch(self._implicit.end_adjoint, {"u_bar": u_bar, "acceleration": self._after}, *bar.named)
        if not self._law.is_newtonian:
            strain = {"A_bar": self._A_bar, **self._no_bars}
            step.launch(self._implicit.strain_adjoint, strain, self._constants, *bar.named)
            self.give(step, bar, strain, by_force=False)
        self._packed.collect(step, bar)
        return self._r


def stress_of(scene: Scene) -> type[ViscousStress]:
    """The class of the viscous stress in a scene."""
    return ImplicitViscousStress if is_implicit(scene) else ViscousStress
