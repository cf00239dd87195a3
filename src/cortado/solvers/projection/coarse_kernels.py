"""The kernels of a pressure on a coarse grid of hat functions phi_I, one at each node of a `CellSort`'s grid.

With the share c of each particle, and N and h of `cortado.solvers.projection.coarse_sums`,

    q_iI = N_i grad phi_I(x_i) + phi_I(x_i) h_i        what the coarse pressure phi_I c pushes particle i with,
    A_IJ = sum_i (q_iI . q_iJ + eps delta_IJ) / m_i        over the particles of the cells around I and J,
    A e = sum_i phi_I c_i r_i,   r = D u - b where k > 0 or sigma > 1/2 or D u > b, else 0,
    y' = z where z = y + c_i sum_I phi_I(x_i) e_I > 0, else sigma z.

eps makes e small at nodes that few particles touch. Everything goes between nodes and particles in two ways: `spread`
sums phi_I s_i + grad phi_I . t_i + hess phi_I : R_i + e_I o_i over the particles of the cells around a node, in their
order, and `at` gives E = sum_I phi_I e_I, its gradient G and its mixed second derivatives at a particle. With
w = (N G + h E) / m, A e is `spread` of s = h . w, t = N^T w and o = eps / m.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.bundles import bundle
from cortado.device.cells import cell_functions, cell_grid_type
from cortado.device.lanes import lane_functions
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.solvers.projection.clamp import clamp_functions
from cortado.solvers.projection.effects import weights_type
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.sph.moment_functions import cross_terms_function, matrix_type, symmetric


def source_type(precision: Precision) -> Any:
    """The bundle of what is spread."""
    return bundle(s_value=precision.real, s_slope=precision.vector, s_bent=precision.vector, s_own=precision.real)


@dataclass(frozen=True)
class NodeKernels:
    """Those of nodes, and those of a particle and the nodes around it."""

    fill: Any
    """A, for each node and each of its neighbours, itself among them."""
    weigh: Any
    """The diagonal of A, 1 at nodes without particles."""
    multiply: Any
    """A p over its diagonal."""
    spread: Any
    """A sum over particles, over the diagonal of A."""
    correct: Any
    correct_tangent: Any
    """Of y', given e and its tangent."""
    source_tangent: Any
    """What is spread for the tangent of e."""
    correct_adjoint: Any
    """From the adjoint of y' to what is spread for that of e."""
    source_adjoint: Any
    """From lambda, A lambda = the adjoint of e, to all adjoints."""


@cache
def node_kernels(precision: Precision, dimension: int) -> NodeKernels:
    """In 2 or 3 dimensions."""
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    grid_type, cells = cell_grid_type(precision), cell_functions(precision)
    wrap, cell_of = cells.wrap, cells.cell_of
    packed, cross_terms = symmetric(precision), cross_terms_function(precision)
    six, pack, parts = packed.kind, packed.pack, clamp_functions(precision).parts
    module = kernel_module(f"coarse_{dimension}d_{precision.name}")
    source = source_type(precision)
    CORNERS, AROUND = wp.constant(2**dimension), wp.constant(3**dimension)
    flat = wp.constant(dimension == 2)

    @wp.struct
    class Hat:
        """phi, its gradient and its mixed second derivatives yz, xz and xy."""

        value: real
        slope: vector
        bent: vector

    @wp.func
    def side(t: real, upper: int) -> real:
        return wp.where(upper == 1, t, real(1.0) - t)

    @wp.func
    def bit(corner: int, axis: int) -> int:
        return (corner >> axis) & 1

    @wp.func
    def hat(x: vector, corner: int, grid: grid_type) -> Hat:
        """That of one of the nodes at the corners of a position's cell."""
        s = wp.cw_mul(x - grid.origin, grid.frequency)
        t = s - vector(wp.floor(s[0]), wp.floor(s[1]), wp.floor(s[2]))
        f, found = grid.frequency, Hat()
        a, b = side(t[0], bit(corner, 0)), side(t[1], bit(corner, 1))
        p = wp.where(bit(corner, 0) == 1, f[0], -f[0])
        q = wp.where(bit(corner, 1) == 1, f[1], -f[1])
        c, r = real(1.0), real(0.0)
        if not flat:
            c = side(t[2], bit(corner, 2))
            r = wp.where(bit(corner, 2) == 1, f[2], -f[2])
        found.value = a * b * c
        found.slope = vector(p * b * c, a * q * c, a * b * r)
        found.bent = vector(a * q * r, p * b * r, p * q * c)
        return found

    @wp.func
    def number_of(cell: wp.vec3i, grid: grid_type) -> int:
        return (cell[2] * grid.shape[1] + cell[1]) * grid.shape[0] + cell[0]

    @wp.func
    def moved(cell: wp.vec3i, by: wp.vec3i, grid: grid_type) -> wp.vec3i:
        return wp.vec3i(
            wrap(cell[0] + by[0], grid.shape[0]),
            wrap(cell[1] + by[1], grid.shape[1]),
            wrap(cell[2] + by[2], grid.shape[2]),
        )

    @wp.func
    def cell_of_number(number: int, grid: grid_type) -> wp.vec3i:
        row = number // grid.shape[0]
        return wp.vec3i(number % grid.shape[0], row % grid.shape[1], row // grid.shape[1])

    @wp.func
    def corner_step(corner: int) -> wp.vec3i:
        return wp.vec3i(bit(corner, 0), bit(corner, 1), bit(corner, 2))

    @wp.func
    def offset_step(offset: int) -> wp.vec3i:
        """From a node to one of those around it."""
        if flat:
            return wp.vec3i(offset % 3 - 1, offset // 3 - 1, 0)
        return wp.vec3i(offset % 3 - 1, (offset // 3) % 3 - 1, offset // 9 - 1)

    @wp.func
    def first_corner(i: int, particles: int, x: vector, grid: grid_type):
        """The cell of a particle, and the first node of its scene."""
        return cell_of(x, grid), (i // particles) * (grid.shape[0] * grid.shape[1] * grid.shape[2])

    @wp.func
    def at(i: int, particles: int, x: vector, e: wp.array(dtype=real), grid: grid_type) -> Hat:
        """E, G and H of particle i."""
        own, first = first_corner(i, particles, x, grid)
        found = Hat()
        for corner in range(CORNERS):
            phi = hat(x, corner, grid)
            value = e[first + number_of(moved(own, corner_step(corner), grid), grid)]
            found.value += value * phi.value
            found.slope += value * phi.slope
            found.bent += value * phi.bent
        return found

    @wp.func
    def products(
        i: int, particles: int, x: vector, e: wp.array(dtype=real), u: wp.array(dtype=real), grid: grid_type
    ) -> real:
        """The sum of e u over the nodes that particle i touches."""
        own, first = first_corner(i, particles, x, grid)
        total = real(0.0)
        for corner in range(CORNERS):
            node = first + number_of(moved(own, corner_step(corner), grid), grid)
            total += e[node] * u[node]
        return total

    @wp.func
    def bend(bent: vector, v: vector) -> vector:
        """H v"""
        return vector(bent[2] * v[1] + bent[1] * v[2], bent[2] * v[0] + bent[0] * v[2], bent[1] * v[0] + bent[0] * v[1])

    @wp.kernel(module=module, enable_backward=False)
    def fill(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        eps: real,
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        h: wp.array(dtype=vector),
        N: wp.array(dtype=matrix),
        # out
        A: wp.array2d(dtype=real),
    ):
        """With a thread for each entry (offset, node)."""
        offset = wp.tid() // A.shape[1]
        node = wp.tid() - offset * A.shape[1]
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, step = cell_of_number(node - member * nodes, grid), offset_step(offset)
        total = real(0.0)
        for corner in range(CORNERS):
            own = corner_step(corner)
            other = own + step
            if wp.min(wp.min(other[0], other[1]), other[2]) >= 0 and wp.max(wp.max(other[0], other[1]), other[2]) <= 1:
                cell = member * nodes + number_of(moved(here, -own, grid), grid)
                far = other[0] + 2 * other[1] + 4 * other[2]
                for p in range(grid.starts[cell], grid.starts[cell + 1]):
                    i = order[p]
                    a, b = hat(x[i], corner, grid), hat(x[i], far, grid)
                    q_a, q_b = N[i] * a.slope + a.value * h[i], N[i] * b.slope + b.value * h[i]
                    total += wp.dot(q_a, q_b) / m[i]
                    if offset == AROUND // 2:
                        total += eps / m[i]
        A[offset, node] = total

    @wp.kernel(module=module, enable_backward=False)
    def weigh(A: wp.array2d(dtype=real), w: wp.array(dtype=real)):
        node = wp.tid()
        own = A[AROUND // 2, node]
        w[node] = wp.where(own > real(0.0), own, real(1.0))

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        grid: grid_type,
        A: wp.array2d(dtype=real),
        w: wp.array(dtype=real),
        p: wp.array(dtype=real),
        # out
        product: wp.array(dtype=real),
        share: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, total = cell_of_number(node - member * nodes, grid), real(0.0)
        for offset in range(AROUND):
            there = member * nodes + number_of(moved(here, offset_step(offset), grid), grid)
            total += A[offset, node] * p[there]
        product[node] = total / w[node]
        share[node] = p[node] * total

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        grid: grid_type,
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        of: source,
        e: wp.array(dtype=real),
        w: wp.array(dtype=real),
        # out
        r: wp.array(dtype=real),
    ):
        node = wp.tid()
        nodes = grid.shape[0] * grid.shape[1] * grid.shape[2]
        member = node // nodes
        here, total = cell_of_number(node - member * nodes, grid), real(0.0)
        for corner in range(CORNERS):
            cell = member * nodes + number_of(moved(here, -corner_step(corner), grid), grid)
            for p in range(grid.starts[cell], grid.starts[cell + 1]):
                i = order[p]
                phi = hat(x[i], corner, grid)
                total += phi.value * of.s_value[i] + wp.dot(phi.slope, of.s_slope[i]) + wp.dot(phi.bent, of.s_bent[i])
                total += e[node] * of.s_own[i]
        r[node] = total / w[node]

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
        k_out: wp.array(dtype=real),
        y_out: wp.array(dtype=real),
        T: wp.array(dtype=six),
    ):
        """T is y' L."""
        i = wp.tid()
        z = y[i] + coarse[i] * at(i, particles, x[i], e, grid).value
        new = z
        if z < real(0.0):
            new = weights[i][0] * z
        k_out[i] = new
        y_out[i] = new
        T[i] = new * pack(L[i])

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
        out: source,
    ):
        i = wp.tid()
        f = at(i, particles, x[i], e, grid)
        N, h, N_dot, h_dot, v = of.N[i], of.h[i], of.N_dot[i], of.h_dot[i], x_dot[i]
        along = wp.dot(f.slope, v)
        w = (N * f.slope + f.value * h) / m[i]
        w_dot = (N_dot * f.slope + N * bend(f.bent, v) + along * h + f.value * h_dot - m_dot[i] * w) / m[i]
        p, cr = wp.transpose(N) * w, of.coarse[i] * of.r[i]
        out.s_value[i] = of.coarse_dot[i] * of.r[i] + of.coarse[i] * of.r_dot[i] - wp.dot(h_dot, w) - wp.dot(h, w_dot)
        out.s_own[i] = eps * m_dot[i] / (m[i] * m[i])
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
        k_out_dot: wp.array(dtype=real),
        y_out_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        f, change = at(i, particles, x[i], e, grid), at(i, particles, x[i], e_dot, grid)
        z = of.y[i] + of.coarse[i] * f.value
        z_dot = of.y_dot[i] + of.coarse_dot[i] * f.value
        z_dot += of.coarse[i] * (wp.dot(f.slope, x_dot[i]) + change.value)
        rise, fall = parts(z, z)
        found = rise * z_dot + fall * (of.weights_dot[i][0] * z + of.weights[i][0] * z_dot)
        k_out_dot[i] = found
        y_out_dot[i] = found

    @wp.kernel(module=module, enable_backward=False)
    def correct_adjoint(
        grid: grid_type,
        particles: int,
        x: wp.array(dtype=vector),
        of: bundle(coarse=real, weights=weights4, y=real),
        e: wp.array(dtype=real),
        # in and out: at first those of k' and y', at last those of k and y
        k_bar: wp.array(dtype=real),
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
        rise, fall = parts(z, z)
        new_bar = k_bar[i] + y_bar[i]
        z_bar = (rise + fall * of.weights[i][0]) * new_bar
        weights_bar[i] = weights_bar[i] + weights4(fall * z * new_bar, no, no, no)
        coarse_bar[i] = coarse_bar[i] + z_bar * f.value
        x_bar[i] = x_bar[i] + (z_bar * c) * f.slope
        k_bar[i] = no
        y_bar[i] = z_bar
        s_value[i] = c * z_bar
        s_slope[i] = vector()
        s_bent[i] = vector()
        s_own[i] = no

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
        # out
        r_bar: wp.array(dtype=real),
    ):
        """``multiplier`` is lambda."""
        i = wp.tid()
        f, g = at(i, particles, x[i], e, grid), at(i, particles, x[i], multiplier, grid)
        N, h, c, r = of.N[i], of.h[i], of.coarse[i], of.r[i]
        w, u = (N * f.slope + f.value * h) / m[i], (N * g.slope + g.value * h) / m[i]
        r_bar[i] = c * g.value
        bar.coarse[i] = bar.coarse[i] + g.value * r
        bar.h[i] = bar.h[i] - g.value * w - f.value * u
        bar.N[i] = bar.N[i] - wp.outer(w, g.slope) - wp.outer(u, f.slope)
        bar.m[i] = bar.m[i] + wp.dot(u, w) + eps * products(i, particles, x[i], e, multiplier, grid) / (m[i] * m[i])
        x_part = (c * r - wp.dot(h, w)) * g.slope - wp.dot(h, u) * f.slope
        x_part -= bend(g.bent, wp.transpose(N) * w) + bend(f.bent, wp.transpose(N) * u)
        bar.x[i] = bar.x[i] + x_part

    return NodeKernels(
        fill,
        weigh,
        multiply,
        spread,
        correct,
        correct_tangent,
        source_tangent,
        correct_adjoint,
        source_adjoint,
    )


@dataclass(frozen=True)
class ResidualKernels:
    """Of r, what of the divergence a coarse pressure is to take away."""

    residual: Any
    residual_tangent: Any
    residual_adjoint: Any
    """To the adjoint d_bar of D u and to S = d_bar L, with which that of the pressure's update goes on."""


@cache
def residual_kernels(discretisation: Discretisation, dimension: int) -> ResidualKernels:
    """In 2 or 3 dimensions."""
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), projection_sums(discretisation)
    gradient, gradient_tangent = sums.velocity_gradient, sums.velocity_gradient_tangent
    packed, wanted = symmetric(precision), clamp_functions(precision).wanted
    six, pack, topic = packed.kind, packed.pack, f"projection_{dimension}d"
    own = {name: kind for name, kind in entries(precision).items() if name in ("L", "gamma", "drift", "weights")}
    seen = bundle(**own, coarse=real)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.func
    def counts(y: real, tension: real, left: real) -> bool:
        """Not where a surface is free: its divergence changes no pressure. NaN counts, which must not be hidden."""
        return y > real(0.0) or tension > real(0.5) or not (left <= real(0.0))

    @wp.kernel(module=discretisation.module(True, topic))
    def residual(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        # out
        r: wp.array(dtype=real),
        out: source_type(precision),
    ):
        """A and the divergence are written to ``at``."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient(i, x, at.u, s)
        if lane() > 0:
            return
        A = wp.matrix_from_rows(row_x, row_y, row_z)
        D = wp.ddot(of.L[i], A) + wp.dot(of.gamma[i], at.u[i]) - of.drift[i]
        left = D - wanted(n[i], of.weights[i][1], time_step[i // s.particles])
        if not counts(at.y[i], of.weights[i][0], left):
            left = real(0.0)
        at.A[i] = A
        at.d[i] = D
        r[i] = left
        out.s_value[i] = of.coarse[i] * left
        out.s_slope[i] = vector()
        out.s_bent[i] = vector()
        out.s_own[i] = real(0.0)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def residual_tangent(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        of: seen,
        at: bundle(u=vector, A=matrix, d=real, y=real),
        dot: bundle(u=vector, **own),
        # out
        r_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = gradient_tangent(i, x, x_dot, at.u, dot.u, s)
        if lane() > 0:
            return
        member = i // s.particles
        D_dot = wp.ddot(of.L[i], wp.matrix_from_rows(row_x, row_y, row_z)) + wp.ddot(dot.L[i], at.A[i]) - dot.drift[i]
        D_dot += wp.dot(of.gamma[i], dot.u[i]) + wp.dot(dot.gamma[i], at.u[i])
        dt, full = time_step[member], of.weights[i][1]
        b = wanted(n[i], full, dt)
        b_dot = -b * time_step_dot[member] / dt
        if n[i] < real(1.0):
            b_dot -= ((real(1.0) - full) * n_dot[i] + dot.weights[i][1] * (real(1.0) - n[i])) / dt
        r_dot[i] = wp.where(counts(at.y[i], of.weights[i][0], at.d[i] - b), D_dot - b_dot, real(0.0))

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def residual_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        of: seen,
        d: wp.array(dtype=real),
        y: wp.array(dtype=real),
        r_bar: wp.array(dtype=real),
        # in and out
        bar: bundle(n=real, time_step=real, drift=real, weights=weights4),
        # out
        d_bar: wp.array(dtype=real),
        S: wp.array(dtype=six),
    ):
        i = wp.tid()
        no, dt, full = real(0.0), time_step[i // particles], of.weights[i][1]
        b = wanted(n[i], full, dt)
        found = wp.where(counts(y[i], of.weights[i][0], d[i] - b), r_bar[i], no)
        if n[i] < real(1.0):
            bar.n[i] = bar.n[i] + (real(1.0) - full) / dt * found
            bar.weights[i] = bar.weights[i] + weights4(no, (real(1.0) - n[i]) / dt * found, no, no)
        bar.time_step[i] = bar.time_step[i] + b / dt * found
        bar.drift[i] = bar.drift[i] - found
        d_bar[i] = found
        S[i] = found * pack(of.L[i])

    return ResidualKernels(residual, residual_tangent, residual_adjoint)
