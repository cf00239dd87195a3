"""Two factors on the pressure correction delta of an iteration: the density-ratio relaxation of a heavy particle among
lighter ones, and the pressure relaxation beside walls.

delta is made for particles of one mass. The pressure of a particle with lighter neighbours moves these further, by
the ratio of the masses, and where the answer of its own density is more than twice what is wanted the iteration
diverges. So its pressure relaxation is multiplied with

    1 / (1 + e(t_i)),   t_i = V sum_j W_ij (m_i / m_j - 1),   e(t) = t^2 / (2 (t + a)) for t > 0, else 0,

which is 1 among particles of its own mass or heavier ones, and tends to the mean 1 / (1 + t / 2) that the lattice asks
for. a makes it smooth at 0.

delta is made for a particle with a filled neighbourhood. Beside a wall the same pressure moves a particle's own
density further, by |S_i|^2 / (2 sum_j G_j . G_j of the prototype) with S_i = sum_b w_b G_ib, and where that is above 2
the iteration overshoots and kicks it away. A particle that nears a wall within the step meets a steeper one than at the
step's start, where S_i is taken, so that the answer counts twice. delta is multiplied by the pressure relaxation

    y_i = 1 / (1 + |S_i|^2 / response),   response = sum_j G_j . G_j,

which is 1 away from walls, and smooth. It changes how fast the iteration converges, not what it converges to. Sums are
multiplied with the response scale, response^(-1/2), before they are squared: in float32 the square of a gradient
overflows where spacings are small.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel, sum_kernel
from cortado.sph.walls import wall_slope_sums

SOFTNESS = 0.2
"""The softness a of the density-ratio relaxation [-]."""


@dataclass(frozen=True)
class DensityRatioKernels(Kernels):
    """The kernels of the relaxation by density ratios in PCISPH; the adjoint has two of them."""

    factor_adjoint: Any
    """Comes before ``adjoint``."""


@cache
def density_ratio_kernels(discretisation: Discretisation) -> DensityRatioKernels:
    """Make the kernels of the density-ratio relaxation for a smoothing kernel and a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    weight, gradient = pair.weight, pair.gradient
    module, tangent_module, adjoint_module = discretisation.modules("density_ratio")
    a = wp.constant(real(SOFTNESS))

    @fluid_sum(discretisation)
    def density_ratio_sum(x_ij: vector, m_i: real, m_j: real, s: neighbourhood) -> real:
        """Return a pair's term W_ij (m_i / m_j - 1) of t_i / V."""
        return weight(x_ij, s) * (m_i / m_j - real(1.0))

    @tangent_of(density_ratio_sum)
    @fluid_sum(discretisation, ahead=False)
    def density_ratio_sum_tangent(
        x_ij: vector, x_dot_ij: vector, m_i: real, m_j: real, m_dot_i: real, m_dot_j: real, s: neighbourhood
    ) -> real:
        ratio = m_i / m_j
        change = wp.dot(gradient(x_ij, s), x_dot_ij) * (ratio - real(1.0))
        return change + weight(x_ij, s) * ratio * (m_dot_i / m_i - m_dot_j / m_j)

    @adjoint_of(density_ratio_sum)
    @fluid_sum(discretisation)
    def density_ratio_sum_adjoint(
        x_ij: vector, m_i: real, m_j: real, t_bar_i: real, t_bar_j: real, s: neighbourhood
    ) -> tuple[vector, real]:
        own = t_bar_i * m_i / m_j
        other = t_bar_j * m_j / m_i
        return (own - t_bar_i + other - t_bar_j) * gradient(x_ij, s), weight(x_ij, s) * (own - other) / m_i

    @wp.func
    def excess(t: real) -> real:
        """Return e(t) = t^2 / (2 (t + a)) for t > 0, else 0."""
        if t > real(0.0):
            return real(0.5) * t * t / (t + a)
        return real(0.0)

    @wp.func
    def excess_derivative(t: real) -> real:
        """Return the derivative e'(t) of `excess`."""
        if t > real(0.0):
            return real(0.5) * t * (t + real(2.0) * a) / ((t + a) * (t + a))
        return real(0.0)

    @particle_kernel(module, "t y", [over(density_ratio_sum, "total")])
    def density_ratio(total: real, wall_y_i: real, s: neighbourhood) -> tuple[real, real]:
        return s.volume * total, wall_y_i / (real(1.0) + excess(s.volume * total))

    @particle_kernel(tangent_module, "y_dot", [over(density_ratio_sum_tangent, "total_dot")])
    def density_ratio_tangent(total_dot: real, t_i: real, y_i: real, wall_y_dot_i: real, s: neighbourhood) -> real:
        part = real(1.0) / (real(1.0) + excess(t_i))
        return part * (wall_y_dot_i - y_i * excess_derivative(t_i) * s.volume * total_dot)

    @particle_kernel(adjoint_module, "y_bar t_bar")
    def factor_adjoint(t_i: real, y_i: real, y_bar_i: real) -> tuple[real, real]:
        """Turn the adjoint of the relaxation y into those of the wall relaxation and of t."""
        part = real(1.0) / (real(1.0) + excess(t_i))
        return y_bar_i * part, -y_bar_i * y_i * part * excess_derivative(t_i)

    density_ratio_adjoint = sum_kernel(
        "density_ratio_adjoint", adjoint_module, "+x_bar +m_bar", density_ratio_sum_adjoint, times="s.volume"
    )
    return DensityRatioKernels(density_ratio, density_ratio_tangent, density_ratio_adjoint, factor_adjoint)


@cache
def wall_kernels(discretisation: Discretisation) -> Kernels:
    """Make kernels ``forward``, ``tangent`` and ``adjoint`` of the pressure relaxation beside walls."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = wall_slope_sums(discretisation)
    slope, change, LANES = sums.slope, sums.change, discretisation.lanes
    module, tangent_module, adjoint_module = discretisation.modules("pcisph")
    lane = lane_functions(discretisation.precision, LANES).lane

    @particle_kernel(module, "y", [over(slope, "total")])
    def wall_relaxation(total: vector, s: neighbourhood) -> real:
        scaled = s.response_scale * total
        return real(1.0) / (real(1.0) + wp.dot(scaled, scaled))

    @particle_kernel(tangent_module, "y_dot", [over(slope, "total"), over(sums.tangent, "total_dot")])
    def wall_relaxation_tangent(total: vector, total_dot: vector, y_i: real, s: neighbourhood) -> real:
        along = wp.dot(s.response_scale * total, s.response_scale * total_dot)
        return real(-2.0) * y_i * y_i * along

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def wall_relaxation_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        y: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
        # out
        slope_bar: wp.array(dtype=vector),
    ):
        """Add to the adjoint of positions from that of y; ``slope_bar`` gets the adjoint of S."""
        i = s.first + wp.tid() // LANES
        total = s.response_scale * slope(i, x, s)
        along = (real(-2.0) * y_bar[i] * y[i] * y[i] * s.response_scale) * total
        x_sum = change(i, x, along, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        slope_bar[i] = along

    return Kernels(wall_relaxation, wall_relaxation_tangent, wall_relaxation_adjoint)
