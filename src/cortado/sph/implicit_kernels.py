"""The kernels of implicit viscosity: the method of conjugate gradients (Hestenes and Stiefel 1952) for

    B y = r,   (B y)_i = y_i - dt g(y)_i,

where g(y) is the acceleration by viscosity as a stress (`cortado.sph.stress_kernels`) of fluid with velocities y, with
M and mu kept. B is symmetric and positive with respect to the product sum_i m_i a_i . b_i, in which everything is
measured here. Each scene of a batch goes on until |r| has fallen to a part of the first, and stays as it is then.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.precision import Precision
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


@dataclass(frozen=True)
class SolveKernels:
    """The kernels of conjugate gradients that need no neighbours."""

    begin: Any
    """p = r, y = 0."""
    start: Any
    """Of a scene: whether there is anything to do."""
    descend: Any
    """y and r after a step along p."""
    turn: Any
    """The next p."""
    decide: Any
    """Of a scene: whether to go on."""


@cache
def solve_kernels(precision: Precision) -> SolveKernels:
    """Of a precision; ``going`` (members,) is 1 for a scene that goes on."""
    real, vector = precision.real, precision.vector
    module = wp.get_module(f"cortado_conjugate_gradients_{precision.name}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        m: wp.array(dtype=real),
        r: wp.array(dtype=vector),
        # out
        p: wp.array(dtype=vector),
        y: wp.array(dtype=vector),
        share: wp.array(dtype=real),
    ):
        i = wp.tid()
        p[i] = r[i]
        y[i] = vector()
        share[i] = m[i] * wp.dot(r[i], r[i])

    @wp.kernel(module=module, enable_backward=False)
    def start(
        total: wp.array(dtype=real),
        # out
        first: wp.array(dtype=real),
        size: wp.array(dtype=real),
        count: wp.array(dtype=wp.int32),
        going: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
    ):
        """``active`` is the number of scenes that go on."""
        b = wp.tid()
        first[b] = total[b]
        size[b] = total[b]
        count[b] = 0
        going[b] = 0
        if total[b] > real(0.0):
            going[b] = 1
            wp.atomic_add(active, 0, 1)

    @wp.kernel(module=module, enable_backward=False)
    def descend(
        particles: int,
        going: wp.array(dtype=wp.int32),
        size: wp.array(dtype=real),
        curvature: wp.array(dtype=real),
        m: wp.array(dtype=real),
        p: wp.array(dtype=vector),
        product: wp.array(dtype=vector),
        # in and out
        y: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        # out
        share: wp.array(dtype=real),
    ):
        i = wp.tid()
        b = i // particles
        if going[b] == 0:
            return
        step = size[b] / curvature[b]
        left = r[i] - step * product[i]
        y[i] = y[i] + step * p[i]
        r[i] = left
        share[i] = m[i] * wp.dot(left, left)

    @wp.kernel(module=module, enable_backward=False)
    def turn(
        particles: int,
        going: wp.array(dtype=wp.int32),
        size: wp.array(dtype=real),
        total: wp.array(dtype=real),
        r: wp.array(dtype=vector),
        # in and out
        p: wp.array(dtype=vector),
    ):
        i = wp.tid()
        b = i // particles
        if going[b] == 1:
            p[i] = r[i] + (total[b] / size[b]) * p[i]

    @wp.kernel(module=module, enable_backward=False)
    def decide(
        tolerance: real,
        most: int,
        total: wp.array(dtype=real),
        first: wp.array(dtype=real),
        # in and out
        size: wp.array(dtype=real),
        count: wp.array(dtype=wp.int32),
        going: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
    ):
        b = wp.tid()
        if going[b] == 0:
            return
        size[b] = total[b]
        count[b] = count[b] + 1
        if count[b] >= most or not total[b] > tolerance * tolerance * first[b]:
            going[b] = 0
            wp.atomic_sub(active, 0, 1)

    return SolveKernels(begin, start, descend, turn, decide)
