"""Viscous friction between fluid and a free body without slip, from each particle's sums over the walls of the body.

Like other walls without slip (`cortado.sph.stress_forces`), the body acts as a neighbour at the surface point below
particle i. The surface point moves with the body. Wall particle b has the weight s_b and an own estimate of the surface
point. The vector y_b goes from this point to particle i, and r from the body's middle c'. The surface point is at
c' + r - y_b and has the velocity V + W x (r - y_b), with the body's velocity V and angular velocity W. The effect of
the body on particle i follows from three sums over wall particles,

    H = sum_b s_b,   Y = sum_b s_b y_b,   N = sum_b s_b y_b y_b^T,

and from z = v_i - V - W x r. The body adds N to M_i, tr N / mu_i to R_i, and z Y^T + [W] N to A_i, which are sums of
`cortado.sph.stress_kernels`. [W] is the matrix of the cross product with W. With the stress T_i, the damping C and the
viscosity mu_i, the acceleration a_i and its couple c_i about the particle are

    m_i a_i = -(T_i Y + C mu_i (H z + W x Y)),
    m_i c_i = -(ax(T_i N) + C mu_i (Y x z + (tr N - N) W)),   ax(B) = (B_zy - B_yz, B_xz - B_zx, B_yx - B_xy).

The body gets the force F = -sum_i m_i a_i and the torque -sum_i m_i (r x a_i - c_i) about c'. Force and torque are
minus half the derivatives of the dissipation with respect to V and W. Momentum and angular momentum are conserved, and
a common rigid rotation of body and fluid dissipates nothing.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import solid_sum
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels
from cortado.sph.moment_functions import cross_terms_function, moment_functions
from cortado.sph.moving_solids import free_module, hold_functions
from cortado.sph.stress_forces import contact_functions
from cortado.sph.stress_kernels import fluidity_function, traction_function


@cache
def friction_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    """``rub`` returns a particle's acceleration and couple, and ``bear`` the body's force and torque. ``hold`` computes
    the sums H, Y and N. ``thicken``, ``pull`` and ``push`` add the terms of the body to sums, stresses and
    accelerations of particles."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    matrix, six, known = precision.matrix, precision.six, moment_functions(precision, dimension)
    contact, cross_terms = contact_functions(discretisation), cross_terms_function(precision)
    fall, fall_change = contact.fall, contact.fall_change
    hold_weight, hold_gradient = contact.hold, contact.hold_gradient
    fluidity, separation = fluidity_function(precision), pair_functions(discretisation).separation
    modules = module, tangent_module, adjoint_module = discretisation.modules(f"free_friction_{dimension}d")
    traction, whole = traction_function(precision, dimension, module), known.change
    vectors = "x v foot turn arm Y V W after led diagonal others total rub couple"
    typed = TypesByName(real, {vector: vectors, matrix: "T M N", neighbourhood: "s", wp.int32: "solid"})
    four = tuple[real, vector, vector, vector]

    @solid_sum(discretisation, typed)
    def grip(x_ij, least, foot, solid, s) -> four:
        w, y = hold_weight(x_ij, foot, least, s), fall(x_ij, foot)
        return w, w * y, w * wp.cw_mul(y, y), w * cross_terms(y, y)

    @solid_sum(discretisation, typed)
    def grip_tangent(x_ij, x_dot_ij, least, foot, turn_dot, solid, s) -> four:
        w, y, rest = hold_weight(x_ij, foot, least, s), fall(x_ij, foot), x_dot_ij - wp.cross(turn_dot, x_ij)
        u = fall_change(x_ij, rest, foot) + wp.cross(turn_dot, y)
        w_dot = wp.dot(hold_gradient(x_ij, foot, least, s), rest)
        others = w_dot * cross_terms(y, y) + w * (cross_terms(y, u) + cross_terms(u, y))
        return w_dot, w_dot * y + w * u, wp.cw_mul(w_dot * y + real(2.0) * w * u, y), others

    @solid_sum(discretisation, typed)
    def grip_back(x_ij, H_bar_i, Y_bar_i, N_bar_i, least, foot, solid, s) -> vector:
        w, y = hold_weight(x_ij, foot, least, s), fall(x_ij, foot)
        even = N_bar_i * y + wp.transpose(N_bar_i) * y
        level = H_bar_i + wp.dot(Y_bar_i, y) + real(0.5) * wp.dot(y, even)
        return level * hold_gradient(x_ij, foot, least, s) + w * fall_change(x_ij, Y_bar_i + even, foot)

    numbers = ["solid", "least"]

    @particle_kernel(module, "H Y N arm", [over(grip, "held led diagonal others")], numbers=numbers, typed=typed)
    def hold(solid, held, led, diagonal, others, x_i, after, s) -> tuple[real, vector, matrix, vector]:
        return held, led, whole(diagonal, others), separation(x_i, after, s)

    changes = over(grip_tangent, "held led diagonal others")

    @particle_kernel(tangent_module, "H_dot Y_dot N_dot arm_dot", [changes], numbers=numbers, typed=typed)
    def hold_tangent(solid, held, led, diagonal, others, x_dot_i, after_dot) -> tuple[real, vector, matrix, vector]:
        return held, led, whole(diagonal, others), x_dot_i - after_dot

    @particle_kernel(adjoint_module, "+x_bar +force_bar +torque_bar", [over(grip_back, "total")], numbers=numbers)
    @typed
    def hold_adjoint(solid, total, arm_i, Y_i, N_i, Y_bar_i, N_bar_i, arm_bar_i) -> tuple[vector, vector, vector]:
        B = N_i * (N_bar_i + wp.transpose(N_bar_i))
        turned = vector(B[1, 2] - B[2, 1], B[2, 0] - B[0, 2], B[0, 1] - B[1, 0])
        return total + arm_bar_i, -total - arm_bar_i, wp.cross(Y_i, Y_bar_i) + turned - wp.cross(arm_i, total)

    @typed
    def lean(v_i, arm_i, Y_i, N_i, V, W) -> matrix:
        return wp.outer(v_i - V - wp.cross(W, arm_i), Y_i) + wp.skew(W) * N_i

    @typed
    def rub(v_i, m_i, T_i, eta_i, arm_i, H_i, Y_i, N_i, V, W, control) -> tuple[vector, vector]:
        z, B, C = v_i - V - wp.cross(W, arm_i), T_i * N_i, control * eta_i
        force = T_i * Y_i + C * (H_i * z + wp.cross(W, Y_i))
        twist = vector(B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1])
        twist += C * (wp.cross(Y_i, z) + wp.trace(N_i) * W - N_i * W)
        return (real(-1.0) / m_i) * force, (real(-1.0) / m_i) * twist

    @typed
    def bear(m_i, arm_i, rub_i, couple_i) -> six:
        f, t = -m_i * rub_i, m_i * (couple_i - wp.cross(arm_i, rub_i))
        return six(f[0], f[1], f[2], t[0], t[1], t[2])

    leaning, rubbing, bearing = (wp.func(one, module=module) for one in (lean, rub, bear))

    around = bundle(H=real, Y=vector, N=matrix, arm=vector)
    arrays = TypesByName(real, {vector: "v V W product", matrix: "A M T", around: "body", six: "load"})

    @arrays.kernel(module, enable_backward=False)
    def pull(particles: int, control: real, v, M, eta, body, V, W, A, T):
        i, member = wp.tid(), wp.tid() // particles
        if body.H[i] == real(0.0):
            return
        change = leaning(v[i], body.arm[i], body.Y[i], body.N[i], V[member], W[member])
        A[i] = A[i] + change
        T[i] = T[i] + traction(M[i], change, eta[i], control)

    @arrays.kernel(module, enable_backward=False)
    def push(particles: int, control: real, time_step, v, m, T, eta, body, V, W, product, share, load):
        i, member = wp.tid(), wp.tid() // particles
        if body.H[i] == real(0.0):
            load[i] = six()
            return
        H, Y, N, arm = body.H[i], body.Y[i], body.N[i], body.arm[i]
        a, c = rubbing(v[i], m[i], T[i], eta[i], arm, H, Y, N, V[member], W[member], control)
        change = -time_step[member] * a
        product[i] = product[i] + change
        share[i] = share[i] + m[i] * wp.dot(v[i], change)
        load[i] = bearing(m[i], arm, a, c)

    def thicken(N_i: matrix, mu_i: real) -> tuple[matrix, real]:
        return N_i, wp.trace(N_i) * fluidity(mu_i)

    def hang(lift: vector) -> vector:
        return lift

    def made(function: Any, results: list[str], **names: Any) -> Kernels:
        return pointwise_kernels(precision, modules, lambda _: function, results, **names)

    return SimpleNamespace(
        hold=Kernels(hold, hold_tangent, hold_adjoint),
        thicken=made(thicken, ["M:M", "R:R"]),
        lean=made(lean, ["A:A"]),
        rub=made(rub, ["rub", "couple"], numbers=["control"]),
        bear=made(bear, ["load"], summed=["load"]),
        hang=made(hang, ["u:u"]),
        pull=pull,
        push=push,
    )


@cache
def lift_kernels(precision: Precision) -> Kernels:
    real, vector = precision.real, precision.vector

    def lift(time_step_i: real, gravity_i: vector) -> vector:
        return -time_step_i * gravity_i

    return pointwise_kernels(precision, [free_module(precision)] * 3, lambda _: lift, ["lift"], told=["gravity"])


@cache
def row_kernels(precision: Precision) -> SimpleNamespace:
    """Kernels have a thread for each scene. The unknowns of a body are six numbers: momentum and angular momentum.
    ``give`` adds the impulse of the solution to the body's momenta. ``take``, ``heed`` and ``answer`` are for the
    adjoint solve."""
    real, vector, matrix, six = precision.real, precision.vector, precision.matrix, precision.six
    module, hold = free_module(precision, "rows"), hold_functions(precision)
    spin = hold.spin
    kinds = {vector: "V W pushed twisted", matrix: "turns", wp.int32: "going", hold.kind: "hold"}
    typed = TypesByName(real, {**kinds, six: "r rise p y product load impulse first"})
    kernel = typed.kernel(module, enable_backward=False)

    @wp.func
    def both(V: vector, W: vector) -> six:
        return six(V[0], V[1], V[2], W[0], W[1], W[2])

    @kernel
    def lift(r, density, volume: real, inertia: matrix, inverse: matrix, hold, turns, rise, total):
        b = wp.tid()
        P, arm = vector(r[b][0], r[b][1], r[b][2]), turns[b] * hold.arm
        L = vector(r[b][3], r[b][4], r[b][5]) - wp.cross(arm, P)
        W = spin(turns[b], inertia, inverse, L, hold) / density[b]
        found = both(wp.cw_mul(hold.moving, P) / (density[b] * volume) - wp.cross(W, arm), W)
        rise[b] = found
        total[b] = total[b] + wp.dot(r[b], found)

    @kernel
    def begin(r, rise, p, y, V, W):
        b = wp.tid()
        x = rise[b]
        p[b] = r[b]
        y[b] = six()
        V[b] = vector(x[0], x[1], x[2])
        W[b] = vector(x[3], x[4], x[5])

    @kernel
    def multiply(time_step, load, p, V, W, product, curvature):
        b = wp.tid()
        found = p[b] - time_step[b] * load[b]
        product[b] = found
        curvature[b] = curvature[b] + wp.dot(both(V[b], W[b]), found)

    @kernel
    def descend(going, size, curvature, p, product, y, r):
        b = wp.tid()
        if going[b] == 1:
            step = size[b] / curvature[b]
            y[b] = y[b] + step * p[b]
            r[b] = r[b] - step * product[b]

    @kernel
    def turn(going, size, total, r, rise, p, V, W):
        b = wp.tid()
        if going[b] == 1:
            part, x = total[b] / size[b], rise[b]
            p[b] = r[b] + part * p[b]
            V[b] = vector(x[0], x[1], x[2]) + part * V[b]
            W[b] = vector(x[3], x[4], x[5]) + part * W[b]

    @kernel
    def give(time_step, y, impulse, pushed, twisted):
        b = wp.tid()
        x = time_step[b] * y[b]
        impulse[b] = x
        pushed[b] = pushed[b] + vector(x[0], x[1], x[2])
        twisted[b] = twisted[b] + vector(x[3], x[4], x[5])

    @kernel
    def lengthen(time_step, time_step_dot, impulse, load):
        b = wp.tid()
        load[b] = load[b] + (time_step_dot[b] / (time_step[b] * time_step[b])) * impulse[b]

    @kernel
    def take(time_step, pushed_bar, twisted_bar, first, V, W):
        b = wp.tid()
        first[b] = time_step[b] * both(pushed_bar[b], twisted_bar[b])
        V[b] = -time_step[b] * pushed_bar[b]
        W[b] = -time_step[b] * twisted_bar[b]

    @kernel
    def heed(time_step, load, r):
        b = wp.tid()
        r[b] = -time_step[b] * load[b]

    @kernel
    def answer(time_step, impulse, rise, first, time_step_bar):
        b = wp.tid()
        found = first[b] + rise[b]
        first[b] = found
        time_step_bar[b] = time_step_bar[b] + wp.dot(found, impulse[b]) / (time_step[b] * time_step[b])

    return by_name(lift, begin, multiply, descend, turn, give, lengthen, take, heed, answer)
