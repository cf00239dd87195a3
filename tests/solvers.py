"""Solvers that are not Cortado's: what the protocol promises holds for them too.

`Remembering` is PCISPH with a second loop and a memory of the fluid's velocity that goes on from step to step, as a
warm start does, and with a parameter of its own; `Falling` has no loops, and no derivatives,
which `Explicit` has.
"""

from functools import cache
from math import inf
from types import SimpleNamespace

import warp as wp

from cortado.particles.state import Entry, StateField
from cortado.scene.parameters import Axis, Parameter
from cortado.solvers.build import particle_system
from cortado.solvers.loop import Loop, LoopLimits
from cortado.solvers.particle_derivatives import ParticleAdjoint, ParticleTangent
from cortado.solvers.particles import ParticleSolver
from cortado.solvers.pcisph.solver import Pcisph, PcisphAdjoint, PcisphTangent

MEMORY = "memory"


@cache
def memory_kernels(precision):
    """w <- (w + v) / 2 until w is near v, and then v <- v - rate w, with derivatives of k rounds at once."""
    real, vector, pair = precision.real, precision.vector, precision.pair
    numbers, vectors, pairs = wp.array(dtype=real), wp.array(dtype=vector), wp.array(dtype=pair)
    module = wp.get_module(f"tests_memory_{precision.name}")

    @wp.kernel(module=module)
    def remember(v: vectors, w_in: vectors, w_out: vectors, error: pairs):
        i = wp.tid()
        w = real(0.5) * (w_in[i] + v[i])
        w_out[i] = w
        gap = wp.length(v[i] - w)
        error[i] = pair(gap, gap)

    @wp.kernel(module=module)
    def drag(particles: int, memory_rate: numbers, v: vectors, w: vectors, v_out: vectors):
        i = wp.tid()
        v_out[i] = v[i] - memory_rate[i // particles] * w[i]

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        particles: int, memory_rate: numbers, memory_rate_dot: numbers, left: real, w_end: vectors, v_dot: vectors,
        w_dot: vectors, v_out_dot: vectors, w_out_dot: vectors,
    ):  # fmt: skip
        i = wp.tid()
        w = left * w_dot[i] + (real(1.0) - left) * v_dot[i]
        w_out_dot[i] = w
        b = i // particles
        v_out_dot[i] = v_dot[i] - memory_rate[b] * w - memory_rate_dot[b] * w_end[i]

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        particles: int, order: wp.array(dtype=wp.int32), memory_rate: numbers, left: real, w_end: vectors,
        w_out_bar: vectors, v_scene_bar: vectors, w_bar: vectors, memory_rate_bar: numbers,
    ):  # fmt: skip
        i = wp.tid()
        p = order[i]
        memory_rate_bar[i] = memory_rate_bar[i] - wp.dot(w_end[i], v_scene_bar[p])
        total = w_out_bar[i] - memory_rate[i // particles] * v_scene_bar[p]
        v_scene_bar[p] = v_scene_bar[p] + (real(1.0) - left) * total
        w_bar[i] = left * total

    return SimpleNamespace(remember=remember, drag=drag, tangent=tangent, adjoint=adjoint)


class Remembering(Pcisph):
    carried_fields = (StateField(MEMORY, "m/s", Entry.VECTOR),)
    shares = ("memory.rate",)

    def __init__(self, system, limits, requires_grad=False):
        super().__init__(system, limits, requires_grad)
        precision = self.discretisation.precision
        rounds = LoopLimits(minimum_iterations=1, maximum_iterations=9, tolerance=0.008, greatest_tolerance=inf)
        self.memory_kernels = memory_kernels(precision)
        self.memory_loop = Loop(rounds, self.layout, self.launch, "memory_iterations", "memory_errors")
        self.loops = (*self.loops, self.memory_loop)
        self.memories, self.v = [self.vectors()], self.vectors()

    def step(self, state, new_state, parameters, log):
        context = self.predict(state, parameters)
        self.pressure_loop.run(lambda k: self.iterate(k, 0, context))
        self.memory_loop.run(lambda k: self.remember(k, 0, 0))
        self.write_state((0, 0), parameters, new_state)
        self.end_step(self.iterates.x_star[0], self.v, new_state, log)

    def reserve(self, counts):
        iterations, rounds = counts
        super().reserve((iterations,))
        while len(self.memories) <= rounds:
            self.memories.append(self.vectors())

    def replay(self, state, parameters, counts):
        self.reserve(counts)
        iterations, rounds = counts
        context = self.predict(state, parameters)
        for k in range(iterations):
            self.iterate(k, k + 1, context)
        for k in range(rounds):
            self.remember(k, k + 1, iterations)

    def write_state(self, counts, parameters, new_state):
        iterations, rounds = counts
        v, memory = self.iterates.v_star[iterations], self.memories[rounds]
        context = self.context(parameters)
        context.launch(self.memory_kernels.drag, v=v, w=memory, v_out=self.v)
        self.unsort(context, self.iterates.x_star[iterations], self.v, new_state, memory=memory)

    def remember(self, k, slot, iterations):
        before = self.carried[MEMORY] if k == 0 else self.memories[max(slot - 1, 0)]
        known = {"v": self.iterates.v_star[iterations], "error": self.memory_loop.errors}
        self.launch(self.memory_kernels.remember, known, w_in=before, w_out=self.memories[slot])

    def tangent(self, parameters_dot):
        return RememberingTangent(self, parameters_dot)

    def adjoint(self, steps):
        return RememberingAdjoint(self, steps)


class RememberingTangent(PcisphTangent):
    def __init__(self, solver, parameters_dot):
        super().__init__(solver, parameters_dot)
        self.v_dot, self.memory_dot = solver.vectors(), solver.vectors()

    def step(self, counts, state_dot, parameters):
        iterations, self.rounds = counts
        super().step((iterations,), state_dot, parameters)

    def unsort(self, context, x_dot, v_dot, state_dot):
        new = {"v_out_dot": self.v_dot, "w_out_dot": self.memory_dot}
        old = {"v_dot": v_dot, "w_dot": self.carried_dot[MEMORY], "w_end": self._solver.memories[self.rounds]}
        known = self.dot.named
        context.launch(self._solver.memory_kernels.tangent, *known, left=0.5**self.rounds, **old, **new)
        super().unsort(context, x_dot, self.v_dot, state_dot, memory=self.memory_dot)


class RememberingAdjoint(PcisphAdjoint):
    def __init__(self, solver, steps):
        super().__init__(solver, steps)
        self.memory_bar = solver.vectors()

    def step(self, counts, state_bar, parameters):
        iterations, self.rounds = counts
        super().step((iterations,), state_bar, parameters)

    def unsort(self, context, state_bar):
        free_bar = super().unsort(context, state_bar)
        bars = {"w_out_bar": self.carried_bar[MEMORY], "v_scene_bar": free_bar.velocities, "w_bar": self.memory_bar}
        own = {"left": 0.5**self.rounds, "w_end": self._solver.memories[self.rounds]}
        context.launch(self._solver.memory_kernels.adjoint, *self.bar.named, **own, **bars)
        return free_bar

    def sort(self, context, state_bar):
        super().sort(context, state_bar, memory=self.memory_bar)


class Falling(ParticleSolver):
    def __init__(self, system):
        super().__init__(system)
        self.x, self.v = self.vectors(), self.vectors()

    def step(self, state, new_state, parameters, log):
        self.replay(state, parameters, ())
        self.write_state((), parameters, new_state)
        self.end_step(self.x, self.v, new_state, log)

    def reserve(self, counts):
        pass

    def replay(self, state, parameters, counts):
        context = self.sort(state, parameters)
        new = {"x_star": self.x, "v_star": self.v}
        context.launch(self.integration.predict, acceleration=self.accelerate(context), **new)

    def write_state(self, counts, parameters, new_state):
        self.unsort(self.context(parameters), self.x, self.v, new_state)


class Explicit(Falling):
    """The same with derivatives of both modes, and for a tape."""

    def __init__(self, system, requires_grad=False):
        ParticleSolver.__init__(self, system, requires_grad)
        self.x, self.v = self.vectors(), self.vectors()

    def differentiable(self):
        return Explicit(self.system.of_one_lane(), requires_grad=True)

    def tangent(self, parameters_dot):
        return ExplicitTangent(self, parameters_dot)

    def adjoint(self, steps):
        return ExplicitAdjoint(self, steps)


class ExplicitTangent(ParticleTangent):
    def __init__(self, solver, parameters_dot):
        super().__init__(solver, parameters_dot)
        self.x_dot, self.v_dot = solver.vectors(), solver.vectors()

    def step(self, counts, state_dot, parameters):
        context = self._solver.context(parameters)
        self.sort(context, state_dot)
        self.predict(context, self._solver.v, self.x_dot, self.v_dot)
        self.unsort(context, self.x_dot, self.v_dot, state_dot)


class ExplicitAdjoint(ParticleAdjoint):
    def step(self, counts, state_bar, parameters):
        context = self._solver.context(parameters)
        self.begin_step(context, self.unsort(context, state_bar), self._solver.v)
        self.predict(context)
        self.mix(context, state_bar)
        self.sort(context, state_bar)


class MakeRemembering:
    """With so great a share of the memory taken off the velocity in each step."""

    def __init__(self, rate=0.3):
        self.rate = rate

    @property
    def parameters(self):
        return [Parameter("memory.rate", "", "share of the memory", Axis.SCALAR, lambda source: self.rate)]

    def build(self, setting):
        return Remembering(particle_system(setting), LoopLimits(2, 20, tolerance=0.01, greatest_tolerance=inf))


class MakeFalling:
    def build(self, setting):
        return Falling(particle_system(setting))


class MakeExplicit:
    batches = True

    def build(self, setting):
        return Explicit(particle_system(setting))
