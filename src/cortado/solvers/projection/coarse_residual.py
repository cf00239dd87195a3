"""The kernels of what of the divergence a coarse pressure is to take away: r of
`cortado.solvers.projection.coarse_pressure`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.solvers.projection.clamp import clamp_functions
from cortado.solvers.projection.coarse_hats import source_type
from cortado.solvers.projection.effects import weights_type
from cortado.solvers.projection.images import image_sums
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.sph.moment_functions import matrix_type, symmetric


@dataclass(frozen=True)
class ResidualKernels:
    """Of r, what of the divergence a coarse pressure is to take away."""

    residual: Any
    residual_tangent: Any
    residual_adjoint: Any
    """To the adjoint d_bar of D u and to S = d_bar L, with which that of the pressure's update goes on."""


@cache
def residual_kernels(discretisation: Discretisation, dimension: int) -> ResidualKernels:
    """In 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), projection_sums(discretisation)
    spread, spread_tangent = image_sums(discretisation).spread, image_sums(discretisation).spread_tangent
    gradient, gradient_tangent = sums.velocity_gradient, sums.velocity_gradient_tangent
    packed, clamp = symmetric(precision), clamp_functions(precision)
    wanted, wanted_tangent = clamp.wanted, clamp.wanted_tangent
    six, pack, topic = packed.kind, packed.pack, f"projection_{dimension}d"
    own = {
        name: kind for name, kind in entries(precision).items() if name in ("L", "gamma", "drift", "weights", "image")
    }
    seen = bundle(**own, coarse=real)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.func
    def counts(y: real, tension: real, left: real) -> real:
        """Which part of a divergence does. Where iterations let through but a part of a tension, they leave one that
        the coarse grid must not take away; at the corner between it is the mean of both sides. NaN counts, which must
        not be hidden."""
        if y > real(0.0) or tension >= real(1.0) or not (left <= real(0.0)):
            return real(1.0)
        return wp.where(left == real(0.0), real(0.5), real(0.0))

    @wp.kernel(module=discretisation.module(True, topic))
    def residual(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        # out
        r: wp.array(dtype=real),
        out: source_type(precision),
    ):
        """A and the divergence are written to ``at``."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient(i, x, at.u, s)
        widened = spread(i, x, at.u, s)
        if lane() > 0:
            return
        A = wp.matrix_from_rows(row_x, row_y, row_z)
        D = wp.ddot(of.L[i], A) + wp.dot(of.gamma[i], at.u[i]) - of.drift[i] + of.image[i] * widened
        left = D - wanted(n[i], of.weights[i][1], time_step[i // s.particles])
        left *= counts(at.y[i], of.weights[i][0], left)
        at.A[i] = A
        at.d[i] = D
        r[i] = left
        out.s_value[i] = of.coarse[i] * left
        out.s_slope[i] = vector()
        out.s_bent[i] = vector()
        out.s_own[i] = real(0.0)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def residual_tangent(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        dot: bundle(u=vector, **own),
        # out
        r_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient_tangent(i, x, x_dot, at.u, dot.u, s)
        widened, widened_dot = spread(i, x, at.u, s), spread_tangent(i, x, x_dot, at.u, dot.u, s)
        if lane() > 0:
            return
        member = i // s.particles
        D_dot = wp.ddot(of.L[i], wp.matrix_from_rows(row_x, row_y, row_z)) + wp.ddot(dot.L[i], at.A[i]) - dot.drift[i]
        D_dot += wp.dot(of.gamma[i], dot.u[i]) + wp.dot(dot.gamma[i], at.u[i])
        D_dot += of.image[i] * widened_dot + dot.image[i] * widened
        dt, full = time_step[member], of.weights[i][1]
        b = wanted(n[i], full, dt)
        b_dot = wanted_tangent(n[i], n_dot[i], full, dot.weights[i][1], dt, time_step_dot[member])
        r_dot[i] = counts(at.y[i], of.weights[i][0], at.d[i] - b) * (D_dot - b_dot)

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def residual_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        of: seen,
        d: wp.array(dtype=real),
        y: wp.array(dtype=real),
        r_bar: wp.array(dtype=real),
        # in and out
        bar: bundle(n=real, time_step=real, drift=real, weights=weights4),
        # out
        d_bar: wp.array(dtype=real),
        S: wp.array(dtype=six),
    ):
        i = wp.tid()
        no, dt, full = real(0.0), time_step[i // particles], of.weights[i][1]
        b = wanted(n[i], full, dt)
        found = counts(y[i], of.weights[i][0], d[i] - b) * r_bar[i]
        if n[i] < real(1.0):
            bar.n[i] = bar.n[i] + (real(1.0) - full) / dt * found
            bar.weights[i] = bar.weights[i] + weights4(no, (real(1.0) - n[i]) / dt * found, no, no)
        bar.time_step[i] = bar.time_step[i] + b / dt * found
        bar.drift[i] = bar.drift[i] - found
        d_bar[i] = found
        S[i] = found * pack(of.L[i])

    return ResidualKernels(residual, residual_tangent, residual_adjoint)
