"""A pressure on a coarse grid of hat functions phi_I, one at each node of a `CellSort`'s grid.

With the share c of each particle, and N and h of `cortado.solvers.projection.coarse_residual`,

    q_iI = N_i grad phi_I(x_i) + phi_I(x_i) h_i        what the coarse pressure phi_I c pushes particle i with,
    A_IJ = sum_i (q_iI . q_iJ + (eps + h_i^2 / 100) delta_IJ) / m_i    over the particles of the cells around I and J,
    A e = sum_i phi_I c_i r_i,   r = D u - b where y > 0 or sigma = 1 or D u > b, else 0,
    d = z - y where z = y + c_i sum_I phi_I(x_i) e_I > y-, else y- + sigma (z - y-) - y,   y- = min(y, 0),
    y' = y + alpha d,   u' = u - alpha D^T d / m,
    alpha = sum_i (r_i d_i + l_i) / sum_i (|D^T d|^2 / m + l_i), from 0 to 1,   l_i = m_i (1e-6 s / dt)^2.

But for l, alpha is the step along d after which the kinetic energy is least, so that a correction adds none, whatever
the clamp leaves of it. Where it is next to nothing, as in fluid that falls freely, alpha is 1 by l, and y' follows a
small change of u linearly. Before the first iteration, l is in the second sum alone, and alpha is 0 there: a small
change of u makes a pressure in a step, so that the next one is not cold. Free bodies add to A and to what alpha divides
by: `cortado.solvers.projection.coarse_bodies`.

eps makes e small at nodes that few particles touch. So does h^2 / 100, which is next to nothing in fluid and beside
walls that close it: a particle that has a wall beside it and no fluid tells the nodes around it one thing, and what it
leaves open would take solves hundreds of iterations, in dams that have run out. Everything goes between nodes and
particles in two ways: `spread` sums phi_I s_i + grad phi_I . t_i + hess phi_I : R_i + e_I o_i over the particles of the
cells around a node, in their order, and `at` gives E = sum_I phi_I e_I, its gradient G and its mixed second derivatives
at a particle. With w = (N G + h E) / m, A e is `spread` of s = h . w, t = N^T w and o = (eps + h^2 / 100) / m.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.cells import cell_grid_type
from cortado.device.launching import bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.solvers.projection.coarse_nodes import ALONE, hat_functions, source_type
from cortado.solvers.projection.effects import weights_type
from cortado.solvers.projection.pressure import clamp_functions
from cortado.sph.moment_functions import cross_terms_function, matrix_type, symmetric


@dataclass(frozen=True)
class CoarsePressureKernels:
    """Of d, given e; `LengthKernels` has those of alpha."""

    correct: Any
    correct_tangent: Any
    """Given the tangent of e."""
    source_tangent: Any
    """What is spread for the tangent of e."""
    correct_adjoint: Any
    """From the adjoint of d to what is spread for that of e."""
    source_adjoint: Any
    """From lambda, A lambda = the adjoint of e, to all adjoints."""


@cache
def coarse_pressure_kernels(precision: Precision, dimension: int) -> CoarsePressureKernels:
    """In 2 or 3 dimensions."""
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    grid_type, hats = cell_grid_type(precision), hat_functions(precision, dimension)
    at, products, bend, held, alone = hats.at, hats.products, hats.bend, hats.held, wp.constant(real(2.0 * ALONE))
    packed, cross_terms = symmetric(precision), cross_terms_function(precision)
    six, pack, parts = packed.kind, packed.pack, clamp_functions(precision).parts
    module = kernel_module(f"coarse_pressure_{dimension}d_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def correct(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        L: wp.array(dtype=matrix),
        coarse: wp.array(dtype=real),
        weights: wp.array(dtype=weights4),
        y: wp.array(dtype=real),
        e: wp.array(dtype=real),
        # out
        change: wp.array(dtype=real),
        T: wp.array(dtype=six),
    ):
        """T is d L."""
        i = wp.tid()
        z, least = y[i] + coarse[i] * at(i, particles, x[i], e, grid).value, wp.min(y[i], real(0.0))
        new = z
        if z < least:
            new = least + weights[i][0] * (z - least)
        change[i] = new - y[i]
        T[i] = (new - y[i]) * pack(L[i])

    @wp.kernel(module=module, enable_backward=False)
    def source_tangent(
        grid: grid_type,
        particles: int,
        eps: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        of: bundle(coarse=real, coarse_dot=real, h=vector, h_dot=vector, N=matrix, N_dot=matrix, r=real, r_dot=real),
        e: wp.array(dtype=real),
        # out
        out: source_type(precision),
    ):
        i = wp.tid()
        f = at(i, particles, x[i], e, grid)
        N, h, N_dot, h_dot, v = of.N[i], of.h[i], of.N_dot[i], of.h_dot[i], x_dot[i]
        along = wp.dot(f.slope, v)
        w = (N * f.slope + f.value * h) / m[i]
        w_dot = (N_dot * f.slope + N * bend(f.bent, v) + along * h + f.value * h_dot - m_dot[i] * w) / m[i]
        p, cr = wp.transpose(N) * w, of.coarse[i] * of.r[i]
        out.s_value[i] = of.coarse_dot[i] * of.r[i] + of.coarse[i] * of.r_dot[i] - wp.dot(h_dot, w) - wp.dot(h, w_dot)
        out.s_own[i] = (held(eps, h) * m_dot[i] / m[i] - alone * wp.dot(h, h_dot)) / m[i]
        out.s_slope[i] = (cr - wp.dot(h, w)) * v - wp.transpose(N_dot) * w - wp.transpose(N) * w_dot
        out.s_bent[i] = -(cross_terms(p, v) + cross_terms(v, p))

    @wp.kernel(module=module, enable_backward=False)
    def correct_tangent(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        of: bundle(coarse=real, coarse_dot=real, weights=weights4, weights_dot=weights4, y=real, y_dot=real),
        e: wp.array(dtype=real),
        e_dot: wp.array(dtype=real),
        # out
        change_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        f, f_dot = at(i, particles, x[i], e, grid), at(i, particles, x[i], e_dot, grid)
        z = of.y[i] + of.coarse[i] * f.value
        z_dot = of.y_dot[i] + of.coarse_dot[i] * f.value
        z_dot += of.coarse[i] * (wp.dot(f.slope, x_dot[i]) + f_dot.value)
        below, below_dot, sigma = z - wp.min(of.y[i], real(0.0)), z_dot, of.weights[i][0]
        if of.y[i] < real(0.0):
            below_dot -= of.y_dot[i]
        rise, fall = parts(below, below)
        new_dot = rise * z_dot + fall * (z_dot - below_dot + of.weights_dot[i][0] * below + sigma * below_dot)
        change_dot[i] = new_dot - of.y_dot[i]

    @wp.kernel(module=module, enable_backward=False)
    def correct_adjoint(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        of: bundle(coarse=real, weights=weights4, y=real),
        e: wp.array(dtype=real),
        change_bar: wp.array(dtype=real),
        # in and out
        y_bar: wp.array(dtype=real),
        x_bar: wp.array(dtype=vector),
        coarse_bar: wp.array(dtype=real),
        weights_bar: wp.array(dtype=weights4),
        # out
        s_value: wp.array(dtype=real),
        s_slope: wp.array(dtype=vector),
        s_bent: wp.array(dtype=vector),
        s_own: wp.array(dtype=real),
    ):
        i = wp.tid()
        no, c = real(0.0), of.coarse[i]
        f = at(i, particles, x[i], e, grid)
        z = of.y[i] + c * f.value
        below, sigma, new_bar, least_bar = z - wp.min(of.y[i], no), of.weights[i][0], change_bar[i], no
        rise, fall = parts(below, below)
        z_bar = (rise + fall * sigma) * new_bar
        if of.y[i] < no:
            least_bar = fall * (real(1.0) - sigma) * new_bar
        weights_bar[i] = weights_bar[i] + weights4(fall * below * new_bar, no, no, no)
        coarse_bar[i] = coarse_bar[i] + z_bar * f.value
        x_bar[i] = x_bar[i] + (z_bar * c) * f.slope
        y_bar[i] = y_bar[i] + z_bar + least_bar - new_bar
        s_value[i] = c * z_bar
        s_slope[i] = vector()
        s_bent[i] = vector()
        s_own[i] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def source_adjoint(
        grid: grid_type,
        particles: int,
        eps: real,
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        of: bundle(coarse=real, h=vector, N=matrix, r=real),
        e: wp.array(dtype=real),
        multiplier: wp.array(dtype=real),
        # in and out
        bar: bundle(x=vector, m=real, coarse=real, h=vector, N=matrix),
        r_bar: wp.array(dtype=real),
    ):
        """``multiplier`` is lambda."""
        i = wp.tid()
        f, g = at(i, particles, x[i], e, grid), at(i, particles, x[i], multiplier, grid)
        N, h, c, r = of.N[i], of.h[i], of.coarse[i], of.r[i]
        w, u = (N * f.slope + f.value * h) / m[i], (N * g.slope + g.value * h) / m[i]
        r_bar[i] = r_bar[i] + c * g.value
        bar.coarse[i] = bar.coarse[i] + g.value * r
        both = products(i, particles, x[i], e, multiplier, grid)
        bar.h[i] = bar.h[i] - g.value * w - f.value * u - (alone * both / m[i]) * h
        bar.N[i] = bar.N[i] - wp.outer(w, g.slope) - wp.outer(u, f.slope)
        bar.m[i] = bar.m[i] + wp.dot(u, w) + held(eps, h) * both / (m[i] * m[i])
        x_part = (c * r - wp.dot(h, w)) * g.slope - wp.dot(h, u) * f.slope
        x_part -= bend(g.bent, wp.transpose(N) * w) + bend(f.bent, wp.transpose(N) * u)
        bar.x[i] = bar.x[i] + x_part

    return CoarsePressureKernels(correct, correct_tangent, source_tangent, correct_adjoint, source_adjoint)


SMALL = 1e-6
"""Speed, in spacings a step, of the kinetic energy that is added to the sums of alpha."""


@dataclass(frozen=True)
class LengthKernels:
    """Of alpha, given d, the thrust -D^T d / m, and as ``carried`` the G d of free bodies, see
    `cortado.solvers.projection.coarse_bodies`."""

    share: Any
    share_tangent: Any
    """What particles add to both sums of alpha."""
    apply: Any
    apply_tangent: Any
    apply_adjoint: Any
    """Of y' and u', given both sums."""
    along_adjoint: Any
    """What the adjoint of y' and u' gives to alpha."""
    every: Any
    """Whether all scenes of a batch are warm."""


@cache
def length_kernels(precision: Precision) -> LengthKernels:
    """The same in 2 and in 3 dimensions."""
    real, vector, pair_of = precision.real, precision.vector, precision.pair
    small = wp.constant(real(SMALL))
    module = kernel_module(f"coarse_length_{precision.name}")

    @wp.func
    def length(sums: pair_of) -> real:
        """alpha; NaN stays NaN, which must not be hidden."""
        found = sums[0] / sums[1]
        return wp.where(found < real(0.0), real(0.0), wp.where(found > real(1.0), real(1.0), found))

    @wp.func
    def bends(sums: pair_of) -> bool:
        """Whether alpha is between its ends, and follows the sums."""
        return sums[0] > real(0.0) and sums[0] < sums[1]

    @wp.kernel(module=module, enable_backward=False)
    def every(scenes: int, warm: wp.array(dtype=int), all_warm: wp.array(dtype=int)):
        found = int(1)
        for scene in range(scenes):
            found = wp.min(found, warm[scene])
        all_warm[0] = found

    @wp.func
    def least(m: real, spacing: real, dt: real) -> real:
        """What a particle adds to the sums in any case."""
        v = small * spacing / dt
        return m * v * v

    @wp.kernel(module=module, enable_backward=False)
    def share(
        particles: int,
        first: int,
        spacing: real,
        stays: wp.array(dtype=int),
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        r: wp.array(dtype=real),
        change: wp.array(dtype=real),
        carried: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        parts: wp.array(dtype=pair_of),
    ):
        """In a scene that ``stays`` as it is alpha is 0."""
        i = wp.tid()
        if stays[i // particles] != 0:
            parts[i] = pair_of(real(0.0), m[i])
            return
        d, own = change[i], least(m[i], spacing, time_step[i // particles])
        parts[i] = pair_of(r[i] * d + real(1 - first) * own, m[i] * wp.dot(thrust[i], thrust[i]) + d * carried[i] + own)

    @wp.kernel(module=module, enable_backward=False)
    def apply(
        particles: int,
        sums: wp.array(dtype=pair_of),
        y: wp.array(dtype=real),
        u: wp.array(dtype=vector),
        change: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        k_out: wp.array(dtype=real),
        y_out: wp.array(dtype=real),
        u_out: wp.array(dtype=vector),
    ):
        i = wp.tid()
        alpha = length(sums[i // particles])
        new = y[i] + alpha * change[i]
        k_out[i] = new
        y_out[i] = new
        u_out[i] = u[i] + alpha * thrust[i]

    @wp.kernel(module=module, enable_backward=False)
    def share_tangent(
        particles: int,
        first: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        of: bundle(r=real, change=real, carried=real, thrust=vector),
        dot: bundle(r=real, change=real, carried=real, thrust=vector),
        # out
        parts: wp.array(dtype=pair_of),
    ):
        i = wp.tid()
        along = dot.r[i] * of.change[i] + of.r[i] * dot.change[i]
        f, f_dot = of.thrust[i], dot.thrust[i]
        energy = m_dot[i] * wp.dot(f, f) + real(2.0) * m[i] * wp.dot(f, f_dot)
        energy += dot.change[i] * of.carried[i] + of.change[i] * dot.carried[i]
        dt, dt_dot = time_step[i // particles], time_step_dot[i // particles]
        own_dot = least(m_dot[i], spacing, dt) - real(2.0) * least(m[i], spacing, dt) * dt_dot / dt
        parts[i] = pair_of(along + real(1 - first) * own_dot, energy + own_dot)

    @wp.kernel(module=module, enable_backward=False)
    def apply_tangent(
        particles: int,
        sums: wp.array(dtype=pair_of),
        sums_dot: wp.array(dtype=pair_of),
        of: bundle(change=real, change_dot=real, thrust=vector, thrust_dot=vector),
        # in and out
        k_dot: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        u_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        both, both_dot = sums[i // particles], sums_dot[i // particles]
        alpha, alpha_dot = length(both), real(0.0)
        if bends(both):
            alpha_dot = (both_dot[0] - alpha * both_dot[1]) / both[1]
        new = y_dot[i] + alpha_dot * of.change[i] + alpha * of.change_dot[i]
        k_dot[i] = new
        y_dot[i] = new
        u_dot[i] = u_dot[i] + alpha_dot * of.thrust[i] + alpha * of.thrust_dot[i]

    @wp.kernel(module=module, enable_backward=False)
    def along_adjoint(
        k_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        u_bar: wp.array(dtype=vector),
        change: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        alpha_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        alpha_bar[i] = (k_bar[i] + y_bar[i]) * change[i] + wp.dot(u_bar[i], thrust[i])

    @wp.kernel(module=module, enable_backward=False)
    def apply_adjoint(
        particles: int,
        first: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        sums: wp.array(dtype=pair_of),
        alpha_bar: wp.array(dtype=real),
        m: wp.array(dtype=real),
        of: bundle(r=real, change=real, carried=real, thrust=vector),
        u_bar: wp.array(dtype=vector),
        # in and out: at first those of k' and y', at last those of k and y
        k_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        bar: bundle(m=real, time_step=real),
        # out
        out: bundle(change_bar=real, carried_bar=real, thrust_bar=vector, r_bar=real),
    ):
        """``alpha_bar`` is that of each scene. The adjoint of u' is that of u, too."""
        i = wp.tid()
        both = sums[i // particles]
        alpha, along_bar, energy_bar = length(both), real(0.0), real(0.0)
        if bends(both):
            along_bar = alpha_bar[i // particles] / both[1]
            energy_bar = -alpha * along_bar
        new_bar, f = k_bar[i] + y_bar[i], of.thrust[i]
        k_bar[i] = real(0.0)
        y_bar[i] = new_bar
        dt, own_bar = time_step[i // particles], real(1 - first) * along_bar + energy_bar
        bar.m[i] = bar.m[i] + energy_bar * wp.dot(f, f) + own_bar * least(real(1.0), spacing, dt)
        bar.time_step[i] = bar.time_step[i] - real(2.0) * own_bar * least(m[i], spacing, dt) / dt
        out.change_bar[i] = alpha * new_bar + along_bar * of.r[i] + energy_bar * of.carried[i]
        out.carried_bar[i] = energy_bar * of.change[i]
        out.thrust_bar[i] = alpha * u_bar[i] + (real(2.0) * m[i] * energy_bar) * f
        out.r_bar[i] = along_bar * of.change[i]

    return LengthKernels(share, share_tangent, apply, apply_tangent, apply_adjoint, along_adjoint, every)
