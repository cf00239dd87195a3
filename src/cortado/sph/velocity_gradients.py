"""Velocity gradients of particles, for functions of users that ask for them: by sums over fluid neighbours,

    G_i = S(M_i) A_i M_i^-1,   shear rate = sqrt(2 D : D),   D = (G + G^T) / 2,

with M, A and S of `cortado.sph.stress_kernels`. G is exact where velocities are linear, also at a free surface, and 0
in spray. Walls have no part in it.
"""

from functools import cache, cached_property
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.state import zeros
from cortado.sph.moment_functions import matrix_type, moment_functions
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_kernels import SLOWEST, part_functions, stress_kernels
from cortado.sph.viscosity_law import newtonian_law


@cache
def gradient_functions(precision: Precision, dimension: int) -> tuple[Any, Any]:
    """Make the Warp functions of the velocity gradient [1/s] and of the shear rate [1/s], by M and A."""
    real, matrix = precision.real, matrix_type(precision)
    part, regular = part_functions(precision, dimension)
    inverse, slowest = moment_functions(precision, dimension).inverse, wp.constant(real(SLOWEST**2))

    @wp.func
    def velocity_gradient(M_i: matrix, A_i: matrix) -> matrix:
        M = real(0.5) * (M_i + wp.transpose(M_i))  # so that the adjoint of M is symmetric, as M is
        return part(M) * (A_i * inverse(regular(M)))

    @wp.func
    def shear_rate(M_i: matrix, A_i: matrix) -> real:
        G = velocity_gradient(M_i, A_i)
        twice_D = G + wp.transpose(G)
        return wp.sqrt(real(0.5) * wp.ddot(twice_D, twice_D) + slowest)  # with a derivative at rest

    return velocity_gradient, shear_rate


class VelocityGradients:
    """The sums M and A of the particles of one solver, with their tangents and adjoints."""

    def __init__(self, setting: Setting):
        self._setting = setting
        self._kernels = stress_kernels(setting.discretisation, setting.scene.dimension, newtonian_law(), False).moments
        self._sums = self._arrays("", setting.discretisation.taped)

    def measure(self, step: StepContext) -> dict[str, wp.array]:
        """Write the sums of a step, and return them by the names of kernels' arguments."""
        step.launch(self._kernels.forward, self._sums, least=0.0)
        return self._sums

    def tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        """Write the tangents of the sums, and return these and the sums."""
        step.launch(self._kernels.tangent, self._sums, self._dots, *dot.named, least=0.0)
        return {**self._sums, **self._dots}

    def known(self) -> dict[str, wp.array]:
        """Return the sums of the step that was taken last, and room for their adjoints."""
        return {**self._sums, **self._bars}

    def adjoint(self, step: StepContext, bar: Adjoints) -> None:
        """Add to the adjoints of particles, given those of the sums."""
        step.launch(self._kernels.adjoint, self._bars, *bar.named, least=0.0)

    @cached_property
    def _dots(self) -> dict[str, wp.array]:
        return self._arrays("_dot")

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        return self._arrays("_bar")

    def _arrays(self, suffix: str, requires_grad: bool = False) -> dict[str, wp.array]:
        layout, matrix = self._setting.layout, matrix_type(self._setting.layout.precision)
        kinds = {"M": matrix, "A": matrix, "R": layout.precision.real}
        sizes = {f"{name}{suffix}": (layout.all_particles, kind) for name, kind in kinds.items()}
        return zeros(sizes, layout.device, requires_grad)
