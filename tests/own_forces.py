"""Forces that are not Cortado's: what the protocol promises holds for them too."""

from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.scene.parameter_values import TIME
from cortado.scene.parameters import Axis, Parameter


@cache
def breeze_kernels(discretisation):
    """a = k sin(t) (wind - v), with its derivatives by hand."""
    real, vector = discretisation.precision.real, discretisation.precision.vector

    @wp.kernel(module=discretisation.module(True, "tests_breeze"))
    def forward(
        particles: int,
        time: wp.array2d(dtype=real),
        step: wp.array(dtype=wp.int32),
        breeze_k: wp.array(dtype=real),
        breeze_wind: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = wp.tid()
        b = i // particles
        rate = breeze_k[b] * wp.sin(time[b, step[b]])
        acceleration[i] = acceleration_in[i] + rate * (breeze_wind[b] - v[i])

    @wp.kernel(module=discretisation.tangent_module("tests_breeze"), enable_backward=False)
    def tangent(
        particles: int,
        time: wp.array2d(dtype=real),
        time_dot: wp.array2d(dtype=real),
        step: wp.array(dtype=wp.int32),
        breeze_k: wp.array(dtype=real),
        breeze_k_dot: wp.array(dtype=real),
        breeze_wind: wp.array(dtype=vector),
        breeze_wind_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        b = i // particles
        t = time[b, step[b]]
        rate_dot = breeze_k_dot[b] * wp.sin(t) + breeze_k[b] * wp.cos(t) * time_dot[b, step[b]]
        change = rate_dot * (breeze_wind[b] - v[i]) + breeze_k[b] * wp.sin(t) * (breeze_wind_dot[b] - v_dot[i])
        acceleration_dot[i] = acceleration_in_dot[i] + change

    @wp.kernel(module=discretisation.module(False, "tests_breeze"), enable_backward=False)
    def adjoint(
        particles: int,
        time: wp.array2d(dtype=real),
        step: wp.array(dtype=wp.int32),
        breeze_k: wp.array(dtype=real),
        breeze_wind: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        v_bar: wp.array(dtype=vector),
        breeze_k_bar: wp.array(dtype=real),
        breeze_wind_bar: wp.array(dtype=vector),
        rate_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        b = i // particles
        t = time[b, step[b]]
        work = wp.dot(breeze_wind[b] - v[i], acceleration_bar[i])
        v_bar[i] = v_bar[i] - breeze_k[b] * wp.sin(t) * acceleration_bar[i]
        breeze_wind_bar[i] = breeze_wind_bar[i] + breeze_k[b] * wp.sin(t) * acceleration_bar[i]
        breeze_k_bar[i] = breeze_k_bar[i] + wp.sin(t) * work
        rate_bar[i] = breeze_k[b] * wp.cos(t) * work

    @wp.kernel(module=discretisation.module(False, "tests_breeze"), enable_backward=False)
    def add_time(total: wp.array(dtype=real), step: wp.array(dtype=wp.int32), time_bar: wp.array2d(dtype=real)):
        b = wp.tid()
        time_bar[b, step[b]] = time_bar[b, step[b]] + total[b]

    return Kernels(forward, tangent, adjoint), add_time


class BreezeForce:
    shares = ("breeze.k", "breeze.wind")
    batches = True

    def __init__(self, setting):
        self.layout = layout = setting.layout
        self.kernels, self.add_time = breeze_kernels(setting.discretisation)
        self.rates = wp.zeros(layout.all_particles, dtype=layout.precision.real, device=layout.device)
        self.total = layout.sum_of(layout.precision.real)

    def accelerate(self, step, before, after):
        step.launch(self.kernels.forward, acceleration_in=before, acceleration=after)

    def tangent(self, step, dot, before, after):
        step.launch(self.kernels.tangent, *dot.named, acceleration_in_dot=before, acceleration_dot=after)

    def adjoint(self, step, acceleration_bar, bar):
        step.launch(self.kernels.adjoint, *bar.named, acceleration_bar=acceleration_bar, rate_bar=self.rates)
        step.launch(self.add_time, *bar.named, total=self.total(self.rates), threads=self.layout.members)


class Breeze:
    """Makes it, of a given strength."""

    def __init__(self, k=3.0):
        self.k = k

    @property
    def parameters(self):
        wind = Parameter(
            "breeze.wind",
            "m/s",
            "wind",
            Axis.SCALAR,
            lambda s: [1.0, 0.5, 0.2][: s.scene.dimension],
            components=lambda dimension, phases: dimension,
        )
        return [Parameter("breeze.k", "1/s", "rate", Axis.SCALAR, lambda s: self.k), wind, TIME]

    def force(self, setting):
        return BreezeForce(setting)
