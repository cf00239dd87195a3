"""Gravity: the same acceleration everywhere, one for each step."""

from functools import cache, cached_property
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.launching import TreeReduction, sum_of
from cortado.device.neighbourhood import Discretisation
from cortado.device.precision import Precision
from cortado.sph.integration import integration_module
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents


@cache
def gravity_kernels(precision: Precision, taped: bool) -> Kernels:
    """The kernels; the tangent is the acceleration itself, of another table."""
    vector = precision.vector

    @wp.kernel(module=integration_module(precision, True, taped))
    def accelerate(
        gravity: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = wp.tid()
        acceleration[i] = acceleration_in[i] + gravity[step[0]]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def adjoint(
        total: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        # in and out
        gravity_bar: wp.array(dtype=vector),
    ):
        gravity_bar[step[0]] = gravity_bar[step[0]] + total[0]

    return Kernels(accelerate, accelerate, adjoint)


class Gravity:
    """The force of gravity on a number of particles."""

    shares: tuple[str, ...] = ()

    def __init__(self, discretisation: Discretisation, particles: int, device: Any):
        self._kernels = gravity_kernels(discretisation.precision, discretisation.taped)
        self._discretisation, self._particles, self._device = discretisation, particles, device

    @cached_property
    def _sum(self) -> TreeReduction:
        """Of the adjoint alone, so that its kernel is not compiled for a run forward."""
        return sum_of(self._discretisation.precision.vector, self._particles, self._device)

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._kernels.forward, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        gravity_dot = dot.parameters["gravity"]
        step.launch(self._kernels.tangent, gravity=gravity_dot, acceleration_in=before, acceleration=after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        total = self._sum(acceleration_bar)
        step.launch(self._kernels.adjoint, *bar.named, total=total, threads=1)


def force(setting: Setting) -> Gravity:
    """Gravity in every scene."""
    return Gravity(setting.discretisation, setting.particles, setting.device)
