"""A force that is not Cortado's and keeps a field from step to step: a drag towards the velocity that a particle had.

a = k (u - v),   u' = u + dt (v - u) / tau
"""

from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.state import Entry, StateField
from cortado.scene.parameters import Axis, Parameter
from cortado.sph.parts import Carried, Part, PartAdjoint, PartTangent

U = StateField("remembered_velocities", "m/s", Entry.VECTOR, first="initial_velocities")
TAU = 0.01


@cache
def memory_kernels(discretisation):
    real, vector = discretisation.precision.real, discretisation.precision.vector
    arrays, numbers, tau = wp.array(dtype=vector), wp.array(dtype=real), wp.constant(real(TAU))
    module, tangents = discretisation.module(True, "tests_memory"), discretisation.tangent_module("tests_memory")
    adjoints = discretisation.module(False, "tests_memory")

    @wp.kernel(module=module)
    def accelerate(
        particles: int, memory_k: numbers, v: arrays, u: arrays, acceleration_in: arrays, acceleration: arrays
    ):
        i = wp.tid()
        acceleration[i] = acceleration_in[i] + memory_k[i // particles] * (u[i] - v[i])

    @wp.kernel(module=tangents, enable_backward=False)
    def accelerate_tangent(
        particles: int, memory_k: numbers, memory_k_dot: numbers, v: arrays, v_dot: arrays, u: arrays, u_dot: arrays,
        acceleration_in_dot: arrays, acceleration_dot: arrays,
    ):  # fmt: skip
        i = wp.tid()
        b = i // particles
        change = memory_k_dot[b] * (u[i] - v[i]) + memory_k[b] * (u_dot[i] - v_dot[i])
        acceleration_dot[i] = acceleration_in_dot[i] + change

    @wp.kernel(module=adjoints, enable_backward=False)
    def accelerate_adjoint(
        particles: int, memory_k: numbers, v: arrays, u: arrays, acceleration_bar: arrays, v_bar: arrays,
        memory_k_bar: numbers, u_bar: arrays,
    ):  # fmt: skip
        i = wp.tid()
        pull = memory_k[i // particles] * acceleration_bar[i]
        v_bar[i] = v_bar[i] - pull
        memory_k_bar[i] = memory_k_bar[i] + wp.dot(u[i] - v[i], acceleration_bar[i])
        u_bar[i] = pull

    @wp.kernel(module=module)
    def remember(particles: int, time_step: numbers, v: arrays, u: arrays, u_new: arrays):
        i = wp.tid()
        u_new[i] = u[i] + (time_step[i // particles] / tau) * (v[i] - u[i])

    @wp.kernel(module=tangents, enable_backward=False)
    def remember_tangent(
        particles: int, time_step: numbers, time_step_dot: numbers, v: arrays, v_dot: arrays, u: arrays, u_dot: arrays,
        u_new_dot: arrays,
    ):  # fmt: skip
        i = wp.tid()
        b = i // particles
        change = time_step_dot[b] * (v[i] - u[i]) + time_step[b] * (v_dot[i] - u_dot[i])
        u_new_dot[i] = u_dot[i] + change / tau

    @wp.kernel(module=adjoints, enable_backward=False)
    def remember_adjoint(
        particles: int, time_step: numbers, v: arrays, u: arrays, u_new_bar: arrays, v_bar: arrays,
        time_step_bar: numbers, u_bar: arrays,
    ):  # fmt: skip
        i = wp.tid()
        share = (time_step[i // particles] / tau) * u_new_bar[i]
        v_bar[i] = v_bar[i] + share
        u_bar[i] = u_bar[i] + u_new_bar[i] - share
        time_step_bar[i] = time_step_bar[i] + wp.dot(u_new_bar[i], v[i] - u[i]) / tau

    first = Kernels(accelerate, accelerate_tangent, accelerate_adjoint)
    return first, Kernels(remember, remember_tangent, remember_adjoint)


class MemoryForce(Part):
    fields = (U,)
    shares = ("memory.k",)
    batches = True

    def __init__(self, setting):
        self.layout, taped = setting.layout, setting.discretisation.taped
        self.pull, self.field = memory_kernels(setting.discretisation)
        self.u, self.u_dot, self.u_bar = Carried([U], self.layout, taped), Carried([U], self.layout), self.room()
        self.u_new = self.room(taped)

    def room(self, requires_grad=False):
        layout = self.layout
        return wp.zeros(
            layout.all_particles, dtype=layout.precision.vector, device=layout.device, requires_grad=requires_grad
        )

    def sort(self, step, state):
        self.u.sort(step, state)

    def end(self, step, state, moved):
        step.launch(self.field.forward, u=self.u[U.name], u_new=self.u_new)
        self.u.unsort(step, {U.name: self.u_new}, state)

    def new_tangent(self):
        return MemoryTangent(self)

    def new_adjoint(self):
        return MemoryAdjoint(self)

    def accelerate(self, step, before, after):
        step.launch(self.pull.forward, u=self.u[U.name], acceleration_in=before, acceleration=after)

    def tangent(self, step, dot, before, after):
        now = {"u": self.u[U.name], "u_dot": self.u_dot[U.name]}
        step.launch(self.pull.tangent, *dot.named, **now, acceleration_in_dot=before, acceleration_dot=after)

    def adjoint(self, step, acceleration_bar, bar):
        now = {"u": self.u[U.name], "u_bar": self.u_bar}
        step.launch(self.pull.adjoint, *bar.named, **now, acceleration_bar=acceleration_bar)


class MemoryTangent(PartTangent):
    def __init__(self, force):
        self.force, self.u_new_dot = force, force.room()

    def sort(self, step, dot, state_dot):
        self.force.u_dot.sort(step, state_dot)

    def end(self, step, dot, state_dot):
        force = self.force
        now = {"u": force.u[U.name], "u_dot": force.u_dot[U.name], "u_new_dot": self.u_new_dot}
        step.launch(force.field.tangent, *dot.named, **now)
        force.u_dot.unsort(step, {U.name: self.u_new_dot}, state_dot)


class MemoryAdjoint(PartAdjoint):
    def __init__(self, force):
        self.force, self.new_bar = force, Carried([U], force.layout)

    def sort(self, step, bar, state_bar):
        force = self.force
        self.new_bar.sort(step, state_bar)
        now = {"u": force.u[U.name], "u_new_bar": self.new_bar[U.name], "u_bar": force.u_bar}
        step.launch(force.field.adjoint, *bar.named, **now)
        self.new_bar.unsort(step, {U.name: force.u_bar}, state_bar)


class Memory:
    parameters = (Parameter("memory.k", "1/s", "rate", Axis.SCALAR, lambda source: 30.0),)

    def force(self, setting):
        return MemoryForce(setting)
