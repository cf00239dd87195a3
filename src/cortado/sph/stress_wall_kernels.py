"""The way back from the stress of a particle to the sums that it follows from, and from these to particles: see
`cortado.sph.stress_walls`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.formula import theta_of
from cortado.sph.moment_functions import matrix_type
from cortado.sph.stress_functions import moment_sums, stress_functions
from cortado.sph.viscosity_law import Law


@dataclass(frozen=True)
class StressWallKernels:
    """The kernels, by what they start from."""

    own: Any
    """From the adjoints of T and eta to those of the sums and of the law."""
    sums: Any
    """From the adjoints of the sums to those of x, v and mu."""


@cache
def stress_wall_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> StressWallKernels:
    """For the arguments of `cortado.sph.stress_kernels.stress_kernels`."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood = neighbourhood_type(precision)
    module = discretisation.module(False, f"stress_walls_{law.topic}{dimension}d" + "_no_slip" * sticks)
    stress_back = stress_functions(precision, dimension, law, module).back
    moments_back = moment_sums(discretisation, sticks).back
    theta_type = theta_of(precision, law.ranks)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    of_all = bundle(M=matrix, A=matrix, R=real, eta=real, A_u=matrix)

    @wp.kernel(module=module, enable_backward=False)
    def stress_own_adjoint(
        particles: int,
        control: real,
        theta: wp.array(dtype=theta_type),
        mu: wp.array(dtype=real),
        of: of_all,
        T_bar: wp.array(dtype=matrix),
        eta_bar: wp.array(dtype=real),
        # in and out
        mu_bar: wp.array(dtype=real),
        # out
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        A_v_bar: wp.array(dtype=matrix),
        theta_bar: wp.array(dtype=theta_type),
    ):
        """``A_bar`` is of A of the velocities that are resisted, ``A_v_bar`` of that which mu follows from."""
        i = wp.tid()
        by_M, by_A, by_A_u, by_R, by_mu, by_theta = stress_back(
            of.M[i],
            of.A[i],
            of.A_u[i],
            of.R[i],
            mu[i],
            theta[i // particles],
            of.eta[i],
            control,
            T_bar[i],
            eta_bar[i],
        )
        M_bar[i] = by_M
        A_bar[i] = by_A_u
        A_v_bar[i] = by_A
        R_bar[i] = by_R
        mu_bar[i] = mu_bar[i] + by_mu
        theta_bar[i] = by_theta

    @wp.kernel(module=module, enable_backward=False)
    def stress_sums_adjoint(
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
        mu_bar: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        x_sum, v_sum, mu_sum = moments_back(i, x, v, mu, M_bar, A_bar, R_bar, least, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        v_bar[i] = v_bar[i] + v_sum
        mu_bar[i] = mu_bar[i] + mu_sum

    return StressWallKernels(stress_own_adjoint, stress_sums_adjoint)
