"""The operator of implicit viscosity, for `cortado.sph.conjugate_gradients`:

    (B y)_i = y_i - dt g(y)_i,

where g(y) is the acceleration by viscosity as a stress (`cortado.sph.stress_kernels`) of fluid with velocities y, with
M and mu kept. B is symmetric and positive with respect to the product sum_i m_i a_i . b_i.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.moment_functions import matrix_type
from cortado.sph.stress_forces import stress_sums
from cortado.sph.stress_functions import stress_functions
from cortado.sph.stress_moments import moment_sums
from cortado.sph.viscosity_law import Law


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
