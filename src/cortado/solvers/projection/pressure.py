"""The pressures of the projection, by accelerated Jacobi iterations that admit only part of the tension.

`docs/projection_step.md` has the equations. A scene without a free surface is called shut: the weight of the coarse
pressure is positive for every particle. In a shut scene tension is also admitted beside walls, because fluid that fills
a container cannot leave the walls. A scene is called warm if any particle begins with a pressure, and otherwise cold.
In a cold scene a coarse correction also precedes the first iteration.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.solvers.projection.wall_sums import types_by_name, weights_type
from cortado.sph.moment_functions import symmetric


@cache
def clamp_functions(precision: Precision) -> SimpleNamespace:
    real = precision.real

    @wp.func
    def wanted(n: real, full: real, dt: real) -> real:
        return (real(1.0) - full) * wp.max(real(1.0) - n, real(0.0)) / dt

    @wp.func
    def wanted_tangent(n: real, n_dot: real, full: real, full_dot: real, dt: real, dt_dot: real) -> real:
        found = -wanted(n, full, dt) * dt_dot / dt
        if n < real(1.0):
            found -= ((real(1.0) - full) * n_dot + full_dot * (real(1.0) - n)) / dt
        return found

    @wp.func
    def parts(up: real, down: real):
        rise, fall = real(0.0), real(0.0)
        if up > real(0.0):
            rise = real(1.0)
        elif up == real(0.0):
            rise = real(0.5)
        if up <= real(0.0):
            if down < real(0.0):
                fall = real(1.0)
            elif down == real(0.0):
                fall = real(0.5)
        return rise, fall

    return by_name(wanted, wanted_tangent, parts)


@cache
def pressure_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    pair_of, sums = precision.pair, projection_sums(discretisation)
    packed, matrix, weights4 = symmetric(precision), precision.matrix, weights_type(precision)
    six, pack, mirrors = packed.kind, packed.pack, image_sums(discretisation)
    (spread, spread_tangent, _), (lift, _, lift_back) = mirrors.spread, mirrors.lift
    gradient, gradient_tangent, _ = sums.velocity_gradient
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")
    kinds = entries(precision)
    own = {name: kind for name, kind in kinds.items() if name in ("L", "gamma", "drift", "a", "weights", "image")}
    seen, bars = bundle(**own), bundle(x=vector, n=real, time_step=real, **own)
    iterate, shared = bundle(u=vector, A=matrix, d=real, y=real, k=real), bundle(coarse=real, **own)
    moving, moved = bundle(u=vector, y=real, k=real, **own), bundle(A_dot=matrix, k_out_dot=real, y_out_dot=real)
    clamp, LANES, lane = clamp_functions(precision), discretisation.lanes, discretisation.lane
    wanted, wanted_tangent, parts = clamp.wanted, clamp.wanted_tangent, clamp.parts

    names = {seen: "of", bars: "bar", six: "S T", neighbourhood: "s", vector: "x g u", matrix: "A", iterate: "at"}
    typed = TypesByName(real, names)

    @typed.kernel(module)
    def update(
        s, omega: real, beta: real, time_step, x, n, of: shared, at, k_out, y_out, T, error: wp.array(dtype=pair_of)
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient(i, x, at.u, s)
        widened = spread(i, x, at.u, s)
        if lane() > 0:
            return
        dt, A = time_step[i // s.particles], wp.matrix_from_rows(row_x, row_y, row_z)
        D = wp.ddot(of.L[i], A) + wp.dot(of.gamma[i], at.u[i]) - of.drift[i] + of.image[i] * widened
        b = wanted(n[i], of.weights[i][1], dt)
        per = omega / of.a[i]
        up = at.y[i] + per * (D - b)
        down = at.y[i] + per * D
        new = real(0.0)
        left = real(0.0)
        if up > real(0.0):
            new = up
            left = D - b
        elif down < real(0.0):
            new = of.weights[i][0] * down
            left = of.weights[i][0] * D
        elif not (up <= real(0.0)):  # NaN, which must not be hidden
            new = up
        at.A[i] = A
        at.d[i] = D
        later = new + beta * (new - at.k[i])  # before k, which may be the same array
        k_out[i] = new
        y_out[i] = later
        T[i] = later * pack(of.L[i])
        error[i] = pair_of(of.coarse[i] * (dt * left) * (dt * left), of.coarse[i])

    @typed.kernel(tangent_module)
    def update_tangent(
        s, omega: real, beta: real, time_step, time_step_dot, x, x_dot, n, n_dot, of, at, dot: moving, out: moved
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient_tangent(i, x, x_dot, at.u, dot.u, s)
        widened, widened_dot = spread(i, x, at.u, s), spread_tangent(i, x, x_dot, at.u, dot.u, s)
        if lane() > 0:
            return
        member, change_of_A = i // s.particles, wp.matrix_from_rows(row_x, row_y, row_z)
        dt = time_step[member]
        D_dot = wp.ddot(of.L[i], change_of_A) + wp.ddot(dot.L[i], at.A[i]) - dot.drift[i]
        D_dot += wp.dot(of.gamma[i], dot.u[i]) + wp.dot(dot.gamma[i], at.u[i])
        D_dot += of.image[i] * widened_dot + dot.image[i] * widened
        out.A_dot[i] = change_of_A
        D, full = at.d[i], of.weights[i][1]
        b = wanted(n[i], full, dt)
        b_dot = wanted_tangent(n[i], n_dot[i], full, dot.weights[i][1], dt, time_step_dot[member])
        per = omega / of.a[i]
        per_dot = -per * dot.a[i] / of.a[i]
        down = at.y[i] + per * D
        rise, fall = parts(at.y[i] + per * (D - b), down)
        change = dot.y[i] + per_dot * D + per * D_dot
        found = rise * (change - per_dot * b - per * b_dot)
        found += fall * (dot.weights[i][0] * down + of.weights[i][0] * change)
        out.y_out_dot[i] = found + beta * (found - dot.k[i])  # before k, which may be the same array
        out.k_out_dot[i] = found

    @typed.kernel(adjoint_module)
    def clamp_adjoint(
        particles: int, omega: real, beta: real, time_step, n, of, at: iterate, k_bar, y_bar, bar, d_bar, S
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        D, full, a = at.d[i], of.weights[i][1], of.a[i]
        b = wanted(n[i], full, dt)
        per = omega / a
        down = at.y[i] + per * D
        rise, fall = parts(at.y[i] + per * (D - b), down)
        new_bar = k_bar[i] + (real(1.0) + beta) * y_bar[i]
        tension = of.weights[i][0]
        z_bar, tension_bar = (rise + fall * tension) * new_bar, fall * down * new_bar
        b_bar = -per * rise * new_bar
        full_bar = real(0.0)
        if n[i] < real(1.0):
            bar.n[i] = bar.n[i] - (real(1.0) - full) / dt * b_bar
            full_bar = -(real(1.0) - n[i]) / dt * b_bar
        bar.weights[i] = bar.weights[i] + weights4(tension_bar, full_bar, real(0.0), real(0.0))
        bar.time_step[i] = bar.time_step[i] - b / dt * b_bar
        bar.a[i] = bar.a[i] - per / a * (D * z_bar - rise * b * new_bar)
        k_bar[i] = -beta * y_bar[i]
        y_bar[i] = z_bar
        bar.drift[i] = bar.drift[i] - per * z_bar
        d_bar[i] = per * z_bar
        S[i] = (per * z_bar) * pack(of.L[i])

    @particle_kernel(adjoint_module, "+A_bar")
    def whole_adjoint(L_i: matrix, d_bar_i: real) -> matrix:
        return d_bar_i * L_i

    def divergence_adjoint_of(name: str, back: Any, kind: Any, times: Callable[..., Any]) -> wp.Kernel:
        @typed.arrays
        def divergence_adjoint(s, x, g, of, u, A, d_bar, S: wp.array(dtype=kind), bar, u_bar):
            i = s.first + wp.tid() // LANES
            u_part, x_part = back(i, x, u, S, s)
            u_lift = lift(i, x, d_bar, of.image, s)
            widened, x_lift = lift_back(i, x, d_bar, of.image, u, s)
            if lane() > 0:
                return
            bar.L[i] = bar.L[i] + (real(0.5) * d_bar[i]) * (A[i] + wp.transpose(A[i]))
            bar.gamma[i] = bar.gamma[i] + d_bar[i] * u[i]
            bar.image[i] = bar.image[i] + d_bar[i] * widened
            bar.x[i] = bar.x[i] + x_part + x_lift
            u_bar[i] = u_part + u_lift + times(S[i], g[i]) + d_bar[i] * of.gamma[i]

        divergence_adjoint.__qualname__ = f"pressure_kernels.<locals>.{name}"
        return wp.kernel(module=adjoint_module, enable_backward=False)(divergence_adjoint)

    @wp.func
    def whole_times(A: matrix, v: vector) -> vector:
        return A * v

    even = divergence_adjoint_of("divergence_adjoint", sums.divergence_back, six, packed.times)
    uneven = divergence_adjoint_of("divergence_adjoint_whole", sums.velocity_gradient.adjoint, matrix, whole_times)
    updates = Kernels(update, update_tangent, (clamp_adjoint, even, uneven))
    return SimpleNamespace(update=updates, whole_adjoint=whole_adjoint)


TOWARDS = 0.1
"""Greatest motion of a particle towards a wall by the pressure of the previous step [spacings]."""


@cache
def beginning_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision, modules = discretisation.precision, discretisation.modules(f"projection_{dimension}d")
    real, vector, weights4 = precision.real, precision.vector, weights_type(precision)
    towards = wp.constant(real(TOWARDS))
    typed = types_by_name(precision, {int: "surfaced warm", bundle(k=real, y=real, u=vector): "first"})

    @typed
    def start(
        spacing, time_step, k_before_i, kick_before_i, weights_i, beside_i, surfaced, v_star_i
    ) -> tuple[weights4, real, real, vector]:
        full, tension = weights_i[1], weights_i[0]
        if wp.dot(kick_before_i, beside_i) > real(0.0) and time_step * wp.length(kick_before_i) > towards * spacing:
            full = real(0.0)
        if surfaced == 0:
            tension = real(1.0)
        first = full * k_before_i
        kept = weights4(tension, weights_i[1], weights_i[2], weights_i[3])
        return kept, first, first, v_star_i + full * kick_before_i

    begun = wp.func(start, module=modules[0])

    @typed.kernel(modules[0])
    def begin(
        particles: int, spacing: real, time_step, k_before, kick_before, beside, v_star, surfaced, weights, first, warm
    ):
        """Write pressures and velocities at the start of the pressure iterations. Set ``warm`` to 1 in scenes with a
        pressure."""
        i, member = wp.tid(), wp.tid() // particles
        kept, pressure, _same, velocity = begun(
            spacing, time_step[member], k_before[i], kick_before[i], weights[i], beside[i], surfaced[member], v_star[i]
        )
        weights[i] = kept
        first.k[i] = pressure
        first.y[i] = pressure
        first.u[i] = velocity
        if not (pressure <= real(0.0)) and warm[member] == 0:
            warm[member] = 1

    roles: dict[str, Any] = {"numbers": ["spacing"], "known": ["time_step", "beside", "surfaced"]}
    results, replaced = ["weights", "k", "y", "u"], {"weights": "weights"}
    roles |= {"written": ["k_before", "kick_before"], "replaced": replaced}
    return pointwise_kernels(precision, modules, lambda _: start, results, **roles)._replace(forward=begin)
