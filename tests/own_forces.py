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
    numbers, vectors, times = wp.array(dtype=real), wp.array(dtype=vector), wp.array2d(dtype=real)
    places = wp.array(dtype=wp.int32)

    @wp.kernel(module=discretisation.module(True, "tests_breeze"))
    def forward(
        particles: int, time: times, step: places, breeze_k: numbers, breeze_wind: vectors, v: vectors,
        acceleration_in: vectors, acceleration: vectors,
    ):  # fmt: skip
        i = wp.tid()
        b = i // particles
        rate = breeze_k[b] * wp.sin(time[b, step[b]])
        acceleration[i] = acceleration_in[i] + rate * (breeze_wind[b] - v[i])

    @wp.kernel(module=discretisation.tangent_module("tests_breeze"), enable_backward=False)
    def tangent(
        particles: int, time: times, time_dot: times, step: places, breeze_k: numbers, breeze_k_dot: numbers,
        breeze_wind: vectors, breeze_wind_dot: vectors, v: vectors, v_dot: vectors, acceleration_in_dot: vectors,
        acceleration_dot: vectors,
    ):  # fmt: skip
        i = wp.tid()
        b = i // particles
        t = time[b, step[b]]
        rate_dot = breeze_k_dot[b] * wp.sin(t) + breeze_k[b] * wp.cos(t) * time_dot[b, step[b]]
        change = rate_dot * (breeze_wind[b] - v[i]) + breeze_k[b] * wp.sin(t) * (breeze_wind_dot[b] - v_dot[i])
        acceleration_dot[i] = acceleration_in_dot[i] + change

    @wp.kernel(module=discretisation.module(False, "tests_breeze"), enable_backward=False)
    def adjoint(
        particles: int, time: times, step: places, breeze_k: numbers, breeze_wind: vectors, v: vectors,
        acceleration_bar: vectors, v_bar: vectors, breeze_k_bar: numbers, breeze_wind_bar: vectors, rate_bar: numbers,
    ):  # fmt: skip
        i = wp.tid()
        b = i // particles
        t = time[b, step[b]]
        work = wp.dot(breeze_wind[b] - v[i], acceleration_bar[i])
        v_bar[i] = v_bar[i] - breeze_k[b] * wp.sin(t) * acceleration_bar[i]
        breeze_wind_bar[i] = breeze_wind_bar[i] + breeze_k[b] * wp.sin(t) * acceleration_bar[i]
        breeze_k_bar[i] = breeze_k_bar[i] + wp.sin(t) * work
        rate_bar[i] = breeze_k[b] * wp.cos(t) * work

    @wp.kernel(module=discretisation.module(False, "tests_breeze"), enable_backward=False)
    def add_time(total: numbers, step: places, time_bar: times):
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
        named = "breeze.wind", "m/s", "wind", Axis.SCALAR, lambda s: [1.0, 0.5, 0.2][: s.scene.dimension]
        wind = Parameter(*named, components=lambda dimension, phases: dimension)
        return [Parameter("breeze.k", "1/s", "rate", Axis.SCALAR, lambda s: self.k), wind, TIME]

    def force(self, setting):
        return BreezeForce(setting)
