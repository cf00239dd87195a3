"""The kernels of surface tension, a stress of pairs (the continuum surface stress of Lafaurie et al. 1994, between
particles):

    n_i = (1 / N) sum_j (1 - s)^2 x_ij,   s = |x|^2 / h^2
    S_i = (|n_i|^2 1 - PART n_i n_i) / sqrt(1 + |n_i|^2)
    m_i s^d a_i = -(sigma / Gamma) sum_j s (1 - s)^2 (S_i + S_j) x_ij

m_i s^d is the mass of a particle, with the spacing s of the lattice at rest. n points out of the fluid; its size is 1
in the outermost layer of a lattice that is cut, and about 0 inside. S pulls along the surface, and with PART below 1
also a little across it: a stress along the surface alone lets particles go, and one that is the same in all directions
makes a solid. The force of a pair grows with its distance up to 0.65 h, so that particles of the surface do not clump.
N and Gamma: see `cortado.sph.surface_tension`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import adjoint_of, fluid_sum, tangent_of
from cortado.particles.particle_kernels import sum_kernels

PART = 2.0 / 3.0
"""The part by which the stress across the surface is less than along it; see above."""


@dataclass(frozen=True)
class TensionFunctions:
    """Warp functions of the surface stress between two particles at a separation x, where ``h2`` is h^2."""

    pull: Any
    """s (1 - s)^2"""
    pull_derivative: Any
    """The derivative of the pull by |x|^2 / 2, times h^2."""
    stress: Any
    """S(n) x"""
    stress_change: Any
    """The derivative of S(n) x along a change of n."""
    stress_derivative: Any
    """The derivative of w . S(n) x by n."""


@cache
def tension_functions(discretisation: Discretisation) -> TensionFunctions:
    """Make the Warp functions of the surface stress of pairs, for a precision."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    part, one, two = wp.constant(real(PART)), wp.constant(real(1.0)), wp.constant(real(2.0))

    @wp.func
    def pull(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return s * d * d

    @wp.func
    def pull_derivative(x: vector, h2: real) -> real:
        s = wp.dot(x, x) / h2
        d = wp.max(one - s, real(0.0))
        return two * d * (d - two * s)

    @wp.func
    def stress(n: vector, x: vector) -> vector:
        return (wp.dot(n, n) * x - (part * wp.dot(n, x)) * n) / wp.sqrt(one + wp.dot(n, n))

    @wp.func
    def stress_change(n: vector, n_dot: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(n, n_dot) * x - part * (wp.dot(n_dot, x) * n + wp.dot(n, x) * n_dot)
        return turn / wp.sqrt(size) - (wp.dot(n, n_dot) / size) * stress(n, x)

    @wp.func
    def stress_derivative(n: vector, w: vector, x: vector) -> vector:
        size = one + wp.dot(n, n)
        turn = two * wp.dot(w, x) * n - part * (wp.dot(n, w) * x + wp.dot(n, x) * w)
        return turn / wp.sqrt(size) - (wp.dot(w, stress(n, x)) / size) * n

    return TensionFunctions(pull, pull_derivative, stress, stress_change, stress_derivative)


@cache
def surface_tension_kernels(discretisation: Discretisation) -> Kernels:
    """Make the kernels of the acceleration by surface tension; ``scale`` is 1 / (Gamma s^d), with the spacing s."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    functions = tension_functions(discretisation)
    pull, pull_derivative = functions.pull, functions.pull_derivative
    stress, stress_change, stress_derivative = functions.stress, functions.stress_change, functions.stress_derivative

    @fluid_sum(discretisation)
    def tension(
        x_ij: vector, normals_i: vector, normals_j: vector, m_i: real, sigma: real, scale: real, s: neighbourhood
    ) -> vector:
        both = stress(normals_i, x_ij) + stress(normals_j, x_ij)
        return (-sigma * scale / m_i * pull(x_ij, s.support * s.support)) * both

    @tangent_of(tension)
    @fluid_sum(discretisation, ahead=False)
    def tension_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        normals_i: vector,
        normals_j: vector,
        normals_dot_i: vector,
        normals_dot_j: vector,
        m_i: real,
        m_dot_i: real,
        sigma: real,
        sigma_dot: real,
        scale: real,
        s: neighbourhood,
    ) -> vector:
        h2 = s.support * s.support
        g = pull(x_ij, h2)
        both = stress(normals_i, x_ij) + stress(normals_j, x_ij)
        turn = stress_change(normals_i, normals_dot_i, x_ij) + stress_change(normals_j, normals_dot_j, x_ij)
        moved = turn + stress(normals_i, x_dot_ij) + stress(normals_j, x_dot_ij)
        g_dot = pull_derivative(x_ij, h2) * wp.dot(x_ij, x_dot_ij) / h2
        total = (sigma_dot - sigma * m_dot_i / m_i) * g * both + sigma * (g_dot * both + g * moved)
        return (-scale / m_i) * total

    @adjoint_of(tension)
    @fluid_sum(discretisation)
    def tension_adjoint(
        x_ij: vector,
        normals_i: vector,
        normals_j: vector,
        m_i: real,
        m_j: real,
        bar_i: vector,
        bar_j: vector,
        sigma: real,
        scale: real,
        s: neighbourhood,
    ) -> tuple[vector, vector, real, real]:
        """Return a pair's part in the adjoints of x, the normals, m and sigma of i."""
        h2 = s.support * s.support
        w_i = (-scale / m_i) * bar_i
        w_ij = w_i + (scale / m_j) * bar_j
        g = pull(x_ij, h2)
        both = stress(normals_i, x_ij) + stress(normals_j, x_ij)
        turn = stress(normals_i, w_ij) + stress(normals_j, w_ij)
        x_part = g * turn + (pull_derivative(x_ij, h2) * wp.dot(both, w_ij) / h2) * x_ij
        work = g * wp.dot(both, w_i)
        return sigma * x_part, (sigma * g) * stress_derivative(normals_i, w_ij, x_ij), -sigma * work / m_i, work

    return sum_kernels(
        "accelerate",
        discretisation.modules("surface_tension"),
        (tension, tension_tangent, tension_adjoint),
        "acceleration",
        before="acceleration_in",
        numbers=["scale"],
        written=["normals"],
        sigma="surface_tension",
    )
