"""What a step begins with of the pressure of the step before: k is f times as large as it was, and v is v* + f w, with
the kick w = -D^T k / m that it gave.

Not so for a particle that its kick would take towards a wall, gamma . w > 0, by more than a tenth of a spacing in the
step. Between walls that are nearer to one another than a spacing it has come from one to the other, and what held it
off the first would throw it at the second, harder in each step. Such a particle begins with v* and without a pressure;
of that choice there is no derivative.

In a shut scene, where every particle has a share c of the coarse pressure, tension is let through beside walls too,
sigma = 1: fluid that fills a container cannot leave its walls. Of that choice there is no derivative either.

A scene is warm in which a particle begins with a pressure. In a cold one, as in the first step of a run, the coarse
correction comes before the first iteration too (`cortado.solvers.projection.steps`).
"""

from functools import cache

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.solvers.projection.effects import weights_type

TOWARDS = 0.1
"""In spacings: how far the kick of the step before may take a particle towards a wall in a step. In dams, jets, a beach
and a fountain it took none further than that, but those that wait in a nozzle."""


@cache
def beginning_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """In 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, weights4 = precision.real, precision.vector, weights_type(precision)
    topic = f"projection_{dimension}d"
    module, tangent_module = discretisation.module(True, topic), discretisation.tangent_module(topic)
    adjoint_module = discretisation.module(False, topic)
    towards = wp.constant(real(TOWARDS))

    @wp.func
    def taken(kick: vector, gamma: vector, dt: real, spacing: real) -> real:
        """1, or 0 where nothing is."""
        if wp.dot(kick, gamma) > real(0.0) and dt * wp.length(kick) > towards * spacing:
            return real(0.0)
        return real(1.0)

    @wp.kernel(module=module)
    def begin(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        k_before: wp.array(dtype=real),
        kick_before: wp.array(dtype=vector),
        beside: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
        surfaced: wp.array(dtype=int),
        # in and out
        weights: wp.array(dtype=weights4),
        # out
        k: wp.array(dtype=real),
        y: wp.array(dtype=real),
        u: wp.array(dtype=vector),
        warm: wp.array(dtype=int),
    ):
        """``warm`` is 0 for each scene before."""
        i = wp.tid()
        if surfaced[i // particles] == 0:
            weights[i][0] = real(1.0)
        full = weights[i][1] * taken(kick_before[i], beside[i], time_step[i // particles], spacing)
        first = full * k_before[i]
        k[i] = first
        y[i] = first
        u[i] = v_star[i] + full * kick_before[i]
        if not (first <= real(0.0)) and warm[i // particles] == 0:
            warm[i // particles] = 1

    @wp.kernel(module=tangent_module, enable_backward=False)
    def begin_tangent(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        k_before: wp.array(dtype=real),
        kick_before: wp.array(dtype=vector),
        weights: wp.array(dtype=weights4),
        beside: wp.array(dtype=vector),
        surfaced: wp.array(dtype=int),
        dot: bundle(k_before=real, kick_before=vector, v_star=vector),
        # in and out
        weights_dot: wp.array(dtype=weights4),
        # out
        k_dot: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        u_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        if surfaced[i // particles] == 0:
            weights_dot[i][0] = real(0.0)
        part = taken(kick_before[i], beside[i], time_step[i // particles], spacing)
        full, full_dot = part * weights[i][1], part * weights_dot[i][1]
        first = full_dot * k_before[i] + full * dot.k_before[i]
        k_dot[i] = first
        y_dot[i] = first
        u_dot[i] = dot.v_star[i] + full_dot * kick_before[i] + full * dot.kick_before[i]

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def begin_adjoint(
        particles: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        k_before: wp.array(dtype=real),
        kick_before: wp.array(dtype=vector),
        weights: wp.array(dtype=weights4),
        beside: wp.array(dtype=vector),
        surfaced: wp.array(dtype=int),
        bar: bundle(k=real, y=real, u=vector),
        # in and out
        weights_bar: wp.array(dtype=weights4),
        v_bar: wp.array(dtype=vector),
        # out
        k_before_bar: wp.array(dtype=real),
        kick_before_bar: wp.array(dtype=vector),
    ):
        """``v_bar`` is the adjoint of v*."""
        i = wp.tid()
        part = taken(kick_before[i], beside[i], time_step[i // particles], spacing)
        y_bar, full, no = bar.k[i] + bar.y[i], part * weights[i][1], real(0.0)
        k_before_bar[i] = full * y_bar
        kick_before_bar[i] = full * bar.u[i]
        full_bar = part * (k_before[i] * y_bar + wp.dot(kick_before[i], bar.u[i]))
        weights_bar[i] = weights_bar[i] + weights4(no, full_bar, no, no)
        if surfaced[i // particles] == 0:
            weights_bar[i][0] = no
        v_bar[i] = v_bar[i] + bar.u[i]

    return Kernels(begin, begin_tangent, begin_adjoint)
