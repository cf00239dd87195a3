"""Kernels that are deliberately wrong: a neighbour sum and its non-linear use in one kernel.

Every value is that of the solver's kernels, bit for bit. But Warp's backward pass does not run a dynamic loop again:
after the loop the sum is 0 there, and what follows it (the clamp of the pressure, the pressure relaxation beside a
wall) has a silently wrong adjoint, without a warning. The obvious way to write SPH in Warp has this error, and so has
Warp's own example.
"""

# mypy: ignore-errors
# Kernels are Warp's language, not Python's: their annotations are types made in a factory.

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.device.modules import Kernels
from cortado.gradients import Tape
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.rollout.rollout import BackwardStep, Rollout
from cortado.sph.density import Density


@dataclass(frozen=True)
class OneKernelTape(Tape):
    """Warp's tape again, over kernels of which some sum and go on in one."""

    topics: tuple[str, ...]
    """Of `one_kernel_loops`."""

    def derivative(self, rollout: Rollout) -> BackwardStep:
        step = super().derivative(rollout)
        loops = one_kernel_loops(step.solver.discretisation)
        wrong = {topic: Kernels(loops[topic], None, None) for topic in self.topics}
        if "density" in wrong:
            step.solver.density = Density(step.solver.discretisation, "one_kernel_loops", wrong.pop("density"))
        step.solver.kernels = SimpleNamespace(**vars(step.solver.kernels) | wrong)
        return step


@cache
def one_kernel_loops(discretisation: Discretisation) -> dict[str, wp.Kernel]:
    """Forward kernels by topic: "density" and "force" are linear after their sums, and so right; "wall_relaxation" and
    "pressure" are not."""
    real, vector, pair_of = (
        discretisation.precision.real,
        discretisation.precision.vector,
        discretisation.precision.pair,
    )
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, weight, gradient = pair.separation, pair.weight, pair.gradient
    module = discretisation.module(True, "one_kernel_loops")

    @wp.kernel(module=module)
    def density(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        n: wp.array(dtype=real),
    ):
        i = s.first + wp.tid()
        total = real(0.0)
        for k in range(s.fluid_count[i]):
            total += weight(separation(x[i], x[s.neighbours[k, i]], s), s)
        for k in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[k, i]
            total += s.wall_weights[b] * weight(separation(x[i], s.wall_positions[b], s), s)
        n[i] = s.volume * (real(1 - s.filling[i]) * s.self_weight + total)

    @wp.kernel(module=module)
    def wall_relaxation(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        y: wp.array(dtype=real),
    ):
        i = s.first + wp.tid()
        total = vector()
        for k in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[k, i]
            total += (s.response_scale * s.wall_weights[b]) * gradient(separation(x[i], s.wall_positions[b], s), s)
        y[i] = real(1.0) / (real(1.0) + wp.dot(total, total))

    @wp.kernel(module=module)
    def pressure(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        stiffness: real,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        rho_0: wp.array(dtype=real),
        y: wp.array(dtype=real),
        x_star: wp.array(dtype=vector),
        p_in: wp.array(dtype=real),
        # out
        p_out: wp.array(dtype=real),
        c: wp.array(dtype=real),
        error: wp.array(dtype=pair_of),
    ):
        i = s.first + wp.tid()
        if k >= rounds[0]:
            return
        total = real(0.0)
        for row in range(s.fluid_count[i]):
            total += weight(separation(x_star[i], x_star[s.neighbours[row, i]], s), s)
        for row in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[row, i]
            total += s.wall_weights[b] * weight(separation(x_star[i], s.wall_positions[b], s), s)
        excess = m[i] * s.volume * (real(1 - s.filling[i]) * s.self_weight + total) - rho_0[i]
        delta = y[i] * stiffness / (time_step[0] * time_step[0])
        p_i = wp.max(p_in[i] + delta * excess, real(0.0))
        compression = wp.max(excess / rho_0[i], real(0.0))
        p_out[i] = p_i
        c[i] = p_i / (n[i] * n[i])
        error[i] = pair_of(compression, compression)

    @wp.kernel(module=module)
    def pressure_force(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        x_before: wp.array(dtype=vector),
        v_before: wp.array(dtype=vector),
        # out
        x_star: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        if k >= rounds[0]:
            x_star[i] = x_before[i]
            v_star[i] = v_before[i]
            return
        total = vector()
        for row in range(s.fluid_count[i]):
            j = s.neighbours[row, i]
            total += (c[i] + c[j]) * gradient(separation(x[i], x[j], s), s)
        for row in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[row, i]
            total += (s.wall_weights[b] * c[i]) * gradient(separation(x[i], s.wall_positions[b], s), s)
        dt = time_step[0]
        push = (-s.volume / m[i]) * total
        velocity = v[i] + dt * (acceleration[i] + push)
        v_star[i] = velocity
        x_star[i] = x[i] + dt * velocity

    return {"density": density, "wall_relaxation": wall_relaxation, "pressure": pressure, "force": pressure_force}
