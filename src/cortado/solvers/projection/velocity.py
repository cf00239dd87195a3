"""The velocity that pressures leave of a predicted one, v* - D^T y / m: see `cortado.solvers.projection.pressure`.

A = sum_j v_ij g_ij^T has kernels of its own for the fixed point of the projection, where no iteration has found it.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.solvers.projection.images import image_sums
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.sph.moment_functions import matrix_type, moment_functions, symmetric


@dataclass(frozen=True)
class VelocityKernels:
    """Of the velocity."""

    velocity: Kernels
    """Its adjoint goes on from the f of all particles."""
    pull_tangent: wp.Kernel
    """Comes before the tangent of the velocity."""
    own_adjoint: wp.Kernel
    """Comes before the adjoint of the velocity: from the adjoints of u and of the kick to that of v* and to f."""
    time_adjoint: wp.Kernel
    """What v* = v + dt a gives to the adjoint of dt."""


@cache
def velocity_kernels(discretisation: Discretisation, dimension: int) -> VelocityKernels:
    """In 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), projection_sums(discretisation)
    force, force_tangent, force_back = sums.force, sums.force_tangent, sums.force_back
    mirrors = image_sums(discretisation)
    lift, lift_tangent, lift_back = mirrors.lift, mirrors.lift_tangent, mirrors.lift_back
    packed = symmetric(precision)
    six, pack, times = packed.kind, packed.pack, packed.times
    whole, topic = moment_functions(precision, dimension).change, f"projection_{dimension}d"
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    own = {name: kind for name, kind in entries(precision).items() if name in ("L", "gamma", "image")}
    seen, bars = bundle(**own), bundle(x=vector, **own)
    pulled = bundle(y=real, T=six, g=vector, gamma=vector, image=real)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def velocity(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        y: wp.array(dtype=real),
        T: wp.array(dtype=six),
        g: wp.array(dtype=vector),
        gamma: wp.array(dtype=vector),
        image: wp.array(dtype=real),
        v_star: wp.array(dtype=vector),
        # out
        kick: wp.array(dtype=vector),
        u: wp.array(dtype=vector),
    ):
        """T is y L, and ``kick`` -D^T y / m."""
        i = s.first + wp.tid() // LANES
        total = force(i, x, T, s) + lift(i, x, y, image, s)
        if lane() > 0:
            return
        change = -(total + times(T[i], g[i]) + y[i] * gamma[i]) / m[i]
        kick[i] = change
        u[i] = v_star[i] + change

    @wp.kernel(module=tangent_module, enable_backward=False)
    def pull_tangent(
        y: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        L: wp.array(dtype=matrix),
        L_dot: wp.array(dtype=matrix),
        # out
        T: wp.array(dtype=six),
        T_dot: wp.array(dtype=six),
    ):
        """T = y L, and its tangent."""
        i = wp.tid()
        T[i] = y[i] * pack(L[i])
        T_dot[i] = y_dot[i] * pack(L[i]) + y[i] * pack(L_dot[i])

    @wp.kernel(module=tangent_module, enable_backward=False)
    def velocity_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        of: pulled,
        dot: pulled,
        v_star: wp.array(dtype=vector),
        v_star_dot: wp.array(dtype=vector),
        u: wp.array(dtype=vector),
        # out
        kick_dot: wp.array(dtype=vector),
        u_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = force_tangent(i, x, x_dot, of.T, dot.T, s)
        total += lift_tangent(i, x, x_dot, of.y, dot.y, of.image, dot.image, s)
        if lane() > 0:
            return
        change = total + times(dot.T[i], of.g[i]) + times(of.T[i], dot.g[i])
        change += dot.y[i] * of.gamma[i] + of.y[i] * dot.gamma[i]
        change = -(change + m_dot[i] * (u[i] - v_star[i])) / m[i]
        kick_dot[i] = change
        u_dot[i] = v_star_dot[i] + change

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def velocity_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        y: wp.array(dtype=real),
        T: wp.array(dtype=six),
        of: seen,
        f: wp.array(dtype=vector),
        # in and out
        y_bar: wp.array(dtype=real),
        bar: bars,
    ):
        """From f of all particles; T is y L."""
        i = s.first + wp.tid() // LANES
        diagonal, others, x_part = force_back(i, x, T, f, s)
        widened, x_lift = lift_back(i, x, y, of.image, f, s)
        if lane() > 0:
            return
        A = whole(diagonal, others)
        y_bar[i] = y_bar[i] + wp.ddot(of.L[i], A) + wp.dot(of.gamma[i], f[i]) + of.image[i] * widened
        bar.image[i] = bar.image[i] + y[i] * widened
        bar.L[i] = bar.L[i] + y[i] * A
        bar.gamma[i] = bar.gamma[i] + y[i] * f[i]
        bar.x[i] = bar.x[i] + x_part + x_lift

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def own_adjoint(
        m: wp.array(dtype=real),
        v_star: wp.array(dtype=vector),
        y: wp.array(dtype=real),
        L: wp.array(dtype=matrix),
        u: wp.array(dtype=vector),
        u_bar: wp.array(dtype=vector),
        # in and out: the adjoint of the kick is 0 afterwards
        kick_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        # out
        T: wp.array(dtype=six),
        f: wp.array(dtype=vector),
    ):
        """f = -(u_bar + kick_bar) / m, and T is y L."""
        i = wp.tid()
        bar = u_bar[i] + kick_bar[i]
        v_bar[i] = v_bar[i] + u_bar[i]
        m_bar[i] = m_bar[i] + wp.dot(bar, v_star[i] - u[i]) / m[i]
        T[i] = y[i] * pack(L[i])
        f[i] = -bar / m[i]
        kick_bar[i] = vector()

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def time_adjoint(
        acceleration: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        # in and out
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        time_step_bar[i] = time_step_bar[i] + wp.dot(v_bar[i], acceleration[i])

    return VelocityKernels(
        Kernels(velocity, velocity_tangent, velocity_adjoint), pull_tangent, own_adjoint, time_adjoint
    )


@cache
def velocity_gradient_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """In 2 or 3 dimensions; that of the adjoint needs g, the sum of g_ij."""
    precision = discretisation.precision
    vector, matrix, neighbourhood = precision.vector, matrix_type(precision), neighbourhood_type(precision)
    sums, topic = projection_sums(discretisation), f"projection_{dimension}d"
    rows, rows_tangent, rows_back = sums.velocity_gradient, sums.velocity_gradient_tangent, sums.velocity_gradient_back
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=discretisation.module(True, topic))
    def velocity_gradient(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        # out
        A: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = rows(i, x, v_flow, s)
        if lane() > 0:
            return
        A[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def velocity_gradient_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        v_flow_dot: wp.array(dtype=vector),
        # out
        A_dot: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = rows_tangent(i, x, x_dot, v_flow, v_flow_dot, s)
        if lane() > 0:
            return
        A_dot[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def velocity_gradient_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        g: wp.array(dtype=vector),
        A_bar: wp.array(dtype=matrix),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_flow_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        v_part, x_part = rows_back(i, x, v_flow, A_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part
        v_flow_bar[i] = v_flow_bar[i] + v_part + A_bar[i] * g[i]

    return Kernels(velocity_gradient, velocity_gradient_tangent, velocity_gradient_adjoint)
