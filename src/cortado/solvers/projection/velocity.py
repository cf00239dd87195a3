"""The velocity that pressures leave of a predicted one, v* - D^T y / m: see `cortado.solvers.projection.pressure`.

A = sum_j v_ij g_ij^T has kernels of its own for the fixed point of the projection, where no iteration has found it.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.solvers.projection.images import image_sums
from cortado.solvers.projection.sums import projection_sums
from cortado.sph.moment_functions import matrix_type, moment_functions, symmetric


@dataclass(frozen=True)
class VelocityKernels:
    """The kernels of u = v* - D^T y / m, the velocity that the pressure y leaves of the predicted one."""

    velocity: Kernels
    """u and the kick u - v*; their adjoint starts from the f of all particles that `own_adjoint` writes."""
    pull_tangent: wp.Kernel
    """T = y L with its tangent, which the tangent of the velocity reads of neighbours."""
    own_adjoint: wp.Kernel
    """Comes before the adjoint of the velocity: from the adjoints of u and of the kick to those of v* and f."""
    time_adjoint: wp.Kernel
    """The part of v* = v + dt a in the adjoint of dt."""


@cache
def velocity_kernels(discretisation: Discretisation, dimension: int) -> VelocityKernels:
    """Make the kernels of the velocity that pressures leave, in 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    sums, mirrors, packed = projection_sums(discretisation), image_sums(discretisation), symmetric(precision)
    six, pack, times = packed.kind, packed.pack, packed.times
    whole = moment_functions(precision, dimension).change
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")

    @particle_kernel(module, "kick u", [over(sums.force, "total"), over(mirrors.lift, "lifted")])
    def velocity(
        total: vector,
        lifted: vector,
        m_i: real,
        y_i: real,
        T_i: six,
        g_i: vector,
        gamma_i: vector,
        v_star_i: vector,
    ) -> tuple[vector, vector]:
        """Return the kick -D^T y / m by the pressure y, and the velocity u = v* + kick; T is y L."""
        change = -(total + lifted + times(T_i, g_i) + y_i * gamma_i) / m_i
        return change, v_star_i + change

    @particle_kernel(tangent_module, "T T_dot")
    def pull_tangent(y_i: real, y_dot_i: real, L_i: matrix, L_dot_i: matrix) -> tuple[six, six]:
        """Return the pull T = y L of a pressure, and its tangent."""
        return y_i * pack(L_i), y_dot_i * pack(L_i) + y_i * pack(L_dot_i)

    both = [over(sums.force_tangent, "total"), over(mirrors.lift_tangent, "lifted")]

    @particle_kernel(tangent_module, "kick_dot u_dot", both)
    def velocity_tangent(
        total: vector,
        lifted: vector,
        m_i: real,
        m_dot_i: real,
        y_i: real,
        y_dot_i: real,
        T_i: six,
        T_dot_i: six,
        g_i: vector,
        g_dot_i: vector,
        gamma_i: vector,
        gamma_dot_i: vector,
        v_star_i: vector,
        v_star_dot_i: vector,
        u_i: vector,
    ) -> tuple[vector, vector]:
        change = total + lifted + times(T_dot_i, g_i) + times(T_i, g_dot_i)
        change += y_dot_i * gamma_i + y_i * gamma_dot_i
        kick_dot = -(change + m_dot_i * (u_i - v_star_i)) / m_i
        return kick_dot, v_star_dot_i + kick_dot

    both = [over(sums.force_back, "diagonal others x_part"), over(mirrors.lift_back, "widened x_lift")]

    @particle_kernel(adjoint_module, "+y_bar +image_bar +L_bar +gamma_bar +x_bar", both)
    def velocity_adjoint(
        diagonal: vector,
        others: vector,
        x_part: vector,
        widened: real,
        x_lift: vector,
        y_i: real,
        L_i: matrix,
        gamma_i: vector,
        image_i: real,
        f_i: vector,
    ) -> tuple[real, real, matrix, vector, vector]:
        """Add to the adjoints of y, L, gamma and x by the f of all particles; T is y L."""
        A = whole(diagonal, others)
        y_part = wp.ddot(L_i, A) + wp.dot(gamma_i, f_i) + image_i * widened
        return y_part, y_i * widened, y_i * A, y_i * f_i, x_part + x_lift

    @particle_kernel(adjoint_module, "+v_bar +m_bar T f kick_bar")
    def own_adjoint(
        m_i: real, v_star_i: vector, y_i: real, L_i: matrix, u_i: vector, u_bar_i: vector, kick_bar_i: vector
    ) -> tuple[vector, real, six, vector, vector]:
        """Write f = -(u_bar + kick_bar) / m and T = y L; the adjoint of the kick is 0 afterwards."""
        bar = u_bar_i + kick_bar_i
        return u_bar_i, wp.dot(bar, v_star_i - u_i) / m_i, y_i * pack(L_i), -bar / m_i, vector()

    @particle_kernel(adjoint_module, "+time_step_bar")
    def time_adjoint(acceleration_i: vector, v_bar_i: vector) -> real:
        return wp.dot(v_bar_i, acceleration_i)

    return VelocityKernels(
        Kernels(velocity, velocity_tangent, velocity_adjoint), pull_tangent, own_adjoint, time_adjoint
    )


@cache
def velocity_gradient_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """Make the kernels of A = sum v_ij g_ij^T in 2 or 3 dimensions; the adjoint needs g, the sum of g_ij."""
    precision, modules = discretisation.precision, discretisation.modules(f"projection_{dimension}d")
    vector, matrix, sums = precision.vector, matrix_type(precision), projection_sums(discretisation)

    def gradient(name: str, module: Any, result: str, total: Any) -> Any:
        @particle_kernel(module, result, [over(total, "row_x row_y row_z", v="v_flow", v_dot="v_flow_dot")], name=name)
        def velocity_gradient(row_x: vector, row_y: vector, row_z: vector) -> matrix:
            return wp.matrix_from_rows(row_x, row_y, row_z)

        return velocity_gradient

    back = over(sums.velocity_gradient_back, "v_part x_part", v="v_flow")

    @particle_kernel(modules[2], "+x_bar +v_flow_bar", [back])
    def velocity_gradient_adjoint(
        v_part: vector, x_part: vector, g_i: vector, A_bar_i: matrix
    ) -> tuple[vector, vector]:
        return x_part, v_part + A_bar_i * g_i

    return Kernels(
        gradient("velocity_gradient", modules[0], "A", sums.velocity_gradient),
        gradient("velocity_gradient_tangent", modules[1], "A_dot", sums.velocity_gradient_tangent),
        velocity_gradient_adjoint,
    )
