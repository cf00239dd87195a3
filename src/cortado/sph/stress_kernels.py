"""Viscosity as a stress: f = -G^T (2 mu D), the force per volume of the velocity gradient's exact transpose.

With s_ij = -V a_ij of grad W = a x, so that s_ij is not negative, the sums of particle i over its neighbours are

    M_i = sum_j s_ij x_ij x_ij^T,   A_i = sum_j s_ij v_ij x_ij^T,   R_i = sum_j s_ij |x_ij|^2 / mu_j,

of which A M^-1 is the velocity gradient, corrected so that it is exact where velocities are linear (Bonet and Lok
1999). It is also the one that fits the velocities of the neighbours best, with weights s_ij. What it leaves of them,
v_ij - G_i x_ij, is damped (Ganzenmueller 2015 damps it against modes that the gradient does not see):

    m_i a_i = -sum_j s_ij ((T_i + T_j) x_ij + C (mu_i + mu_j) v_ij),   T_i = 2 mu_i D_i M_i^-1 - C mu_i G_i.

That is minus half the derivative by v_i of what is dissipated, sum_i mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i
x_ij|^2), as the weighted sum of the remainders times x_ij is 0. So energy is never made; both parts are 0 where a body
turns as a whole, whatever the order of its particles, so that linear and angular momentum are kept. On a lattice a
shear wave of wave number k decays with mu k^2 (1 + (C / 4 - 1 / (3 m_2)) k^2 m_4 + ...). With the moments m_2 and m_4
of s_ij along k, C = 4 / (3 m_2) takes the second term out, in every direction and for every kernel.

mu_i is the harmonic mean of the viscosities between i and its neighbours (`cortado.sph.stress_functions`): it keeps the
shear stress the same on both sides of a layer.

Walls without slip: `cortado.sph.stress_forces`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels, sum_kernel
from cortado.particles.wall_terms import solid_kernel
from cortado.sph.moment_functions import matrix_type, moment_functions
from cortado.sph.stress_forces import stress_sums, stress_work
from cortado.sph.stress_functions import moment_sums, moments_work, stress_of_particle
from cortado.sph.viscosity_law import Law


@dataclass(frozen=True)
class StressKernels:
    """The kernels of viscosity as a stress, in the order in which a step needs them."""

    moments: Kernels
    """M, A and R."""
    stress: Kernels
    """T and mu from M, A and R; mu follows from A, and T from ``A_u`` of resisted velocities."""
    force: Kernels
    """The acceleration. Its adjoint are two kernels: that of T and mu, and that of particles."""


@cache
def stress_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> StressKernels:
    """Make the kernels of the viscous stress in 2 or 3 dimensions, with a law of viscosity; with ``sticks`` walls have
    no slip. ``control`` of kernels is C, ``eta`` the viscosity of the stress, and ``theta`` are the parameters of the
    law."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    modules = discretisation.modules(f"viscous_stress_{law.topic}{dimension}d" + "_no_slip" * sticks)
    sums, forces = moment_sums(discretisation, sticks), stress_sums(discretisation, sticks)
    known = moment_functions(precision, dimension)
    given: dict[str, Any] = {
        "numbers": ["control", "least"],
        "mu": "eta",
        "mu_dot": "eta_dot",
        "bar": "acceleration_bar",
    }

    def moments_of(name: str, module: Any, results: str, total: Any, symmetric: Any) -> Any:
        names = "diagonal others row_x row_y row_z thin"

        @particle_kernel(module, results, [over(total, names)], numbers=["least"], name=name)
        def moments(
            diagonal: vector, others: vector, row_x: vector, row_y: vector, row_z: vector, thin: real
        ) -> tuple[matrix, matrix, real]:
            return symmetric(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z), thin

        return moments

    back = over(forces.traction_back, "row_x row_y row_z mu_bar", bar="acceleration_bar")

    @particle_kernel(modules[2], "T_bar eta_bar", [back], numbers=["control", "least"])
    def traction_adjoint(row_x: vector, row_y: vector, row_z: vector, mu_bar: real) -> tuple[matrix, real]:
        return wp.matrix_from_rows(row_x, row_y, row_z), mu_bar

    return StressKernels(
        Kernels(
            moments_of("moments", modules[0], "M A R", sums.sums, known.whole),
            moments_of("moments_tangent", modules[1], "M_dot A_dot R_dot", sums.tangent, known.change),
            sum_kernel("moments_adjoint", modules[2], "+x_bar +v_bar +mu_bar", sums.back, numbers=["least"]),
        ),
        pointwise_kernels(
            precision,
            modules,
            partial(stress_of_particle, precision, dimension, law),
            ["T", "eta"],
            numbers=["control"],
            written=["M", "A", "A_u", "R", "theta"],
        ),
        Kernels(
            sum_kernel("force", modules[0], "acceleration:acceleration_in", forces.force, **given),
            sum_kernel("force_tangent", modules[1], "acceleration_dot:acceleration_in_dot", forces.tangent, **given),
            (
                traction_adjoint,
                sum_kernel("force_adjoint", modules[2], "+x_bar +v_bar +m_bar", forces.back, **given),
            ),
        ),
    )


def stress_solid_kernels(discretisation: Discretisation) -> list[Callable[[], Any]]:
    """Return makers of the kernels that add viscous adjoints to those of moving solids without slip."""
    works = (moments_work, stress_work)
    return [partial(solid_kernel, discretisation, "viscous_stress", work, rubs=True) for work in works]
