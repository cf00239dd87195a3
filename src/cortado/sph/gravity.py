"""Gravity, with one value for each step."""

from functools import cache, cached_property

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.device.reduction import TreeReduction
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import Layout
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents, integration_module


@cache
def gravity_kernels(precision: Precision, taped: bool) -> Kernels:
    vector = precision.vector

    # acceleration[i] = acceleration_in[i] + what is returned; ``gravity`` is the whole table, and ``step`` the entry of
    # the particle's scene, by the rules of `cortado.particles.particle_kernels`
    @particle_kernel(integration_module(precision, True, taped), "acceleration:acceleration_in")
    def accelerate(member: int, gravity: wp.array2d(dtype=vector), step: wp.int32) -> vector:
        return gravity[member, step]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def adjoint(total: wp.array(dtype=vector), step: wp.array(dtype=wp.int32), gravity_bar: wp.array2d(dtype=vector)):
        member = wp.tid()
        n = step[member]
        gravity_bar[member, n] = gravity_bar[member, n] + total[member]

    return Kernels(accelerate, accelerate, adjoint)


class Gravity:
    shares: tuple[str, ...] = ()
    batches = True

    def __init__(self, layout: Layout, taped: bool):
        self._kernels, self._layout, self._members = gravity_kernels(layout.precision, taped), layout, layout.members

    @cached_property
    def _sum(self) -> TreeReduction:
        return self._layout.sum_of(self._layout.precision.vector)

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._kernels.forward, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        gravity_dot = dot.parameters["gravity"]
        step.launch(self._kernels.tangent, gravity=gravity_dot, acceleration_in=before, acceleration=after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        with step.aside():
            total = self._sum(acceleration_bar)
            step.launch(self._kernels.adjoint, *bar.named, total=total, threads=self._members)


def force(setting: Setting) -> Gravity:
    return Gravity(setting.layout, setting.discretisation.taped)
