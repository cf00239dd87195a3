"""Vorticity by summation over the fluid around a particle (Monaghan 1992):

c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

mu = -(V / d) sum_j x_j . G_j is that of the rest lattice, on which a fluid that turns as a whole has twice its rate of
turning. Walls have no part in it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.particles.particle_kernels import sum_kernels


def turns(discretisation: Discretisation) -> Callable[..., Any]:
    """Make the function of a pair's term (v_i - v_j) x G_ij in the circulation."""
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    gradient = pair_functions(discretisation).gradient

    def turning(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        return wp.cross(v_ij, gradient(x_ij, s))

    return turning


@cache
def circulation_kernels(discretisation: Discretisation) -> Kernels:
    """Make kernels ``forward``, ``tangent`` and ``adjoint`` of the sum c, the vorticity times mu n."""
    sums = (
        fluid_sum(discretisation)(turns(discretisation)),
        *(make(discretisation, turns) for make in (made_tangent, made_adjoint)),
    )
    _, tangent_module, adjoint_module = discretisation.modules("vorticity")
    modules = adjoint_module, tangent_module, adjoint_module  # a tape does not see the sum
    return sum_kernels("circulation", modules, sums, "circulation", times="s.volume")
