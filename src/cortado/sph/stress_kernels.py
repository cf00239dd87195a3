"""Kernels of the viscous force as the divergence of a stress. `docs/discretisation.md` has the equations.

A pair with the separation x has the kernel gradient a x, so that its weight s_ij = -V a_ij is not negative. The sums of
particle i over its neighbours are

    M_i = sum_j s_ij x_ij x_ij^T,   A_i = sum_j s_ij v_ij x_ij^T,   R_i = sum_j s_ij |x_ij|^2 / mu_j.

The velocity gradient G = A M^-1 is also the least-squares fit to the velocities of the neighbours with weights s_ij.
The viscous force on a particle is minus half the derivative of the dissipation

    sum_i mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i x_ij|^2)

with respect to the particle's velocity, so that the viscous force never adds energy. The viscous force is 0 in rigid
rotation, so that momentum and angular momentum are conserved.

`stress_of_particle` computes the viscosity mu = S law(sqrt(2 D : D), mu_m) from the sums of one particle. The argument
mu_m is the harmonic mean of the viscosities of the particle and its neighbours. With a harmonic mean, the shear stress
is equal on both sides of an interface. For a Newtonian fluid the law returns mu_m.

The factor S is 1 if neighbours lie on all sides or on one side. The factor S falls smoothly to 0 if neighbours lie on a
line or are missing, because the matrix M then has no inverse. With the invariants I_2 and I_3 of M,

    H = 3 I_3 / I_2 (in 2-D 2 det M / tr M),   S = smoothstep((H - 0.2) / 0.3).

If S is positive, the determinant of M is at least 0.008, so that M has an inverse. User-defined functions may read
velocity gradients S G, whose sums exclude walls.
"""

from collections.abc import Callable
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import rubbing_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel, pointwise_kernels, sum_kernel
from cortado.sph.formula import Formula, applied, theta_of
from cortado.sph.moment_functions import cross_terms_function, moment_functions
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_forces import contact_functions, newtonian_law, stress_sums, work_types

LEAST_VISCOSITY = 1e-12
"""Regularisation of viscosities in harmonic means [Pa s]."""
SLOWEST = 1e-6
"""Regularisation of the shear rate at rest [1/s]."""
EMPTY, FULL = 0.2, 0.5


@cache
def fluidity_function(precision: Precision) -> Any:
    real = precision.real
    least = wp.constant(real(LEAST_VISCOSITY))

    @wp.func
    def fluidity(mu: real) -> real:
        return real(1.0) / (mu + least)

    return fluidity


@cache
def part_functions(precision: Precision, dimension: int) -> tuple[Any, Any]:
    real, matrix, moments = precision.real, precision.matrix, moment_functions(precision, dimension)
    fullness, smoothstep = moments.fullness, moments.smoothstep
    empty, full = wp.constant(real(EMPTY)), wp.constant(real(FULL))

    @wp.func
    def part(M: matrix) -> real:
        return smoothstep(fullness(M), empty, full)

    @wp.func
    def regular(M: matrix) -> matrix:
        result = M
        if part(M) == real(0.0):
            result = wp.identity(n=3, dtype=real)
        return result

    return part, regular


@cache
def traction_function(precision: Precision, dimension: int, module: Any) -> Any:
    real, matrix, regular = precision.real, precision.matrix, part_functions(precision, dimension)[1]
    inverse = moment_functions(precision, dimension).inverse

    @wp.func(module=module)
    def traction(M: matrix, A: matrix, mu: real, control: real) -> matrix:
        K = inverse(regular(M))
        G = A * K
        return mu * ((G + wp.transpose(G)) * K - control * G)

    return traction


def stress_of_particle(precision: Precision, dimension: int, law: Formula, module: Any) -> Callable[..., Any]:
    real, matrix, fluidity = precision.real, precision.matrix, fluidity_function(precision)
    part, regular = part_functions(precision, dimension)
    inverse, traction = moment_functions(precision, dimension).inverse, traction_function(precision, dimension, module)
    plane = wp.constant(real(float(dimension == 2)))
    tiny, slowest = wp.constant(real(1e-12)), wp.constant(real(SLOWEST**2))
    theta_type, apparent = theta_of(precision, law.ranks), applied(law, precision, 3, module)

    def stress(
        control: real, theta: theta_type, M_i: matrix, A_i: matrix, A_u_i: matrix, R_i: real, mu_i: real
    ) -> tuple[matrix, real]:
        M = real(0.5) * (M_i + wp.transpose(M_i))  # so that the adjoint of M is symmetric, as M is
        trace = M[0, 0] + M[1, 1] + M[2, 2] - plane  # M_zz is 1 in the plane
        mean = real(1.0) / (real(0.5) * fluidity(mu_i) + real(0.5) * R_i / (trace + tiny))
        G = A_i * inverse(regular(M))
        twice_D = G + wp.transpose(G)
        shear_rate = wp.sqrt(real(0.5) * wp.ddot(twice_D, twice_D) + slowest)  # sqrt(2 D : D)
        mu = part(M) * apparent(shear_rate, mean, theta)
        return traction(M, A_u_i, mu, control), mu

    return stress


@cache
def moment_sums(discretisation: Discretisation, sticks: bool) -> Kernels:
    """Walls are no-slip walls if ``sticks`` is true."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    slope_gradient, contact = pair_functions(discretisation).slope_gradient, contact_functions(discretisation)
    weight, fall, fall_change = contact.weight, contact.fall, contact.fall_change
    hold, hold_gradient = contact.hold, contact.hold_gradient
    fluidity, matrix = fluidity_function(precision), precision.matrix
    cross_terms = cross_terms_function(precision)

    typed = TypesByName(real, {vector: "x v foot turn", neighbourhood: "s", matrix: "M A"})
    summed = rubbing_sum(discretisation, sticks, typed)

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
        return cross_terms(a, b) + cross_terms(b, a)

    @wp.func
    def terms(w: real, y: vector, v: vector, thin: real):
        z = w * y
        return wp.cw_mul(z, y), cross_terms(z, y), v[0] * z, v[1] * z, v[2] * z, wp.dot(z, y) * thin

    @wp.func
    def changes(w: real, w_dot: real, y: vector, u: vector, v: vector, v_dot: vector, thin: real, thin_dot: real):
        z, z_dot, even = w * y, w_dot * y + w * u, w_dot * y + real(2.0) * w * u
        others = w_dot * cross_terms(y, y) + w * even_terms(y, u)
        x_row, y_row, z_row = v[0] * z_dot + v_dot[0] * z, v[1] * z_dot + v_dot[1] * z, v[2] * z_dot + v_dot[2] * z
        return wp.cw_mul(even, y), others, x_row, y_row, z_row, wp.dot(even, y) * thin + wp.dot(z, y) * thin_dot

    six = tuple[vector, vector, vector, vector, vector, real]

    @typed
    def wall_moments(x_ij, v_ij, mu_i, least, foot, s) -> six:
        return terms(hold(x_ij, foot, least, s), fall(x_ij, foot), v_ij, fluidity(mu_i))

    @summed(wall_moments)
    def moments(x_ij, v_ij, mu_i, mu_j, least, s) -> six:
        return terms(weight(x_ij, s), x_ij, v_ij, fluidity(mu_j))

    @typed
    def wall_moments_tangent(x_ij, x_dot_ij, v_ij, v_dot_ij, mu_i, mu_dot_i, least, foot, turn_dot, s) -> six:
        w, y, rest = hold(x_ij, foot, least, s), fall(x_ij, foot), x_dot_ij - wp.cross(turn_dot, x_ij)
        u = fall_change(x_ij, rest, foot) + wp.cross(turn_dot, y)
        w_dot, thin = wp.dot(hold_gradient(x_ij, foot, least, s), rest), fluidity(mu_i)
        return changes(w, w_dot, y, u, v_ij, v_dot_ij, thin, -thin * thin * mu_dot_i)

    @tangent_of(moments)
    @summed(wall_moments_tangent, ahead=False, grows=moments)
    def moments_tangent(x_ij, x_dot_ij, v_ij, v_dot_ij, mu_i, mu_j, mu_dot_i, mu_dot_j, least, s) -> six:
        w, w_dot = weight(x_ij, s), -s.volume * wp.dot(slope_gradient(x_ij, s), x_dot_ij)
        thin = fluidity(mu_j)
        return changes(w, w_dot, x_ij, x_dot_ij, v_ij, v_dot_ij, thin, -thin * thin * mu_dot_j)

    @typed
    def wall_moments_back(x_ij, v_ij, mu_i, M_bar_i, A_bar_i, R_bar_i, least, foot, s) -> tuple[vector, vector, real]:
        w, y, thin = hold(x_ij, foot, least, s), fall(x_ij, foot), fluidity(mu_i)
        turned, pulled, square = M_bar_i * y, A_bar_i * y, wp.dot(y, y)
        level = wp.dot(y, turned) + wp.dot(v_ij, pulled) + R_bar_i * square * thin
        by_y = real(2.0) * turned + wp.transpose(A_bar_i) * v_ij + (real(2.0) * R_bar_i * thin) * y
        x_part = level * hold_gradient(x_ij, foot, least, s) + w * fall_change(x_ij, by_y, foot)
        return x_part, w * pulled, -R_bar_i * w * square * thin * thin

    @summed(wall_moments_back)
    def moments_back(
        x_ij, v_ij, mu_i, mu_j, M_bar_i, M_bar_j, A_bar_i, A_bar_j, R_bar_i, R_bar_j, least, s
    ) -> tuple[vector, vector, real]:
        w, square, thin_i = weight(x_ij, s), wp.dot(x_ij, x_ij), fluidity(mu_i)
        A_bar, rub = A_bar_i + A_bar_j, R_bar_i * fluidity(mu_j) + R_bar_j * thin_i
        turned, pulled = (M_bar_i + M_bar_j) * x_ij, A_bar * x_ij
        level = wp.dot(x_ij, turned) + wp.dot(v_ij, pulled) + rub * square
        by_x = real(2.0) * turned + wp.transpose(A_bar) * v_ij + (real(2.0) * rub) * x_ij
        x_part = (-s.volume * level) * slope_gradient(x_ij, s) + w * by_x
        return x_part, w * pulled, -R_bar_j * w * square * thin_i * thin_i

    return Kernels(moments, moments_tangent, moments_back)


def moments_work(d: Discretisation) -> Any:
    precision, real, contact = d.precision, d.precision.real, contact_functions(d)
    fall, hold, fluidity = contact.fall, contact.hold, fluidity_function(precision)

    @work_types(precision)
    def moments_work(x_ij, v_ij, mu_i, M_bar_i, A_bar_i, R_bar_i, constants, foot, s) -> real:
        y = fall(x_ij, foot)
        bars = wp.dot(y, M_bar_i * y) + wp.dot(v_ij, A_bar_i * y) + R_bar_i * wp.dot(y, y) * fluidity(mu_i)
        return hold(x_ij, foot, constants[0], s) * bars

    return moments_work


@cache
def stress_kernels(discretisation: Discretisation, dimension: int, law: Formula, sticks: bool) -> SimpleNamespace:
    """``control`` is the damping coefficient C, ``eta`` the viscosity, and ``theta`` the parameters of the law."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    modules = discretisation.modules(f"viscous_stress_{law.topic}{dimension}d" + "_no_slip" * sticks)
    sums, forces = moment_sums(discretisation, sticks), stress_sums(discretisation, sticks)
    known = moment_functions(precision, dimension)
    renamed = {"mu": "eta", "mu_dot": "eta_dot", "bar": "acceleration_bar"}
    given: dict[str, Any] = {"numbers": ["control", "least"], **renamed}

    def moments_of(name: str, module: Any, results: str, total: Any, symmetric: Any) -> Any:
        names = "diagonal others row_x row_y row_z thin"

        @particle_kernel(module, results, [over(total, names)], numbers=["least"], name=name)
        def moments(
            diagonal: vector, others: vector, row_x: vector, row_y: vector, row_z: vector, thin: real
        ) -> tuple[matrix, matrix, real]:
            return symmetric(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z), thin

        return moments

    back = over(forces.traction_back, "row_x row_y row_z mu_bar", bar="acceleration_bar")

    @particle_kernel(modules[2], "T_bar eta_bar", [back], numbers=["control", "least"])
    def traction_adjoint(row_x: vector, row_y: vector, row_z: vector, mu_bar: real) -> tuple[matrix, real]:
        return wp.matrix_from_rows(row_x, row_y, row_z), mu_bar

    moments = Kernels(
        moments_of("moments", modules[0], "M A R", sums.forward, known.whole),
        moments_of("moments_tangent", modules[1], "M_dot A_dot R_dot", sums.tangent, known.change),
        sum_kernel("moments_adjoint", modules[2], "+x_bar +v_bar +mu_bar", sums.adjoint, numbers=["least"]),
    )
    make, written = partial(stress_of_particle, precision, dimension, law), ["M", "A", "A_u", "R", "theta"]
    stress = pointwise_kernels(precision, modules, make, ["T", "eta"], numbers=["control"], written=written)
    force_adjoint = sum_kernel("force_adjoint", modules[2], "+x_bar +v_bar +m_bar", forces.force_back, **given)
    force = Kernels(
        sum_kernel("force", modules[0], "acceleration:acceleration_in", forces.force, **given),
        sum_kernel("force_tangent", modules[1], "acceleration_dot:acceleration_in_dot", forces.force_tangent, **given),
        (traction_adjoint, force_adjoint),
    )
    return SimpleNamespace(moments=moments, stress=stress, force=force)


@cache
def gradient_functions(precision: Precision, dimension: int) -> tuple[Any, Any]:
    """Make the Warp functions of a particle's velocity gradient [1/s] and shear rate [1/s]."""
    real, matrix = precision.real, precision.matrix
    part, regular = part_functions(precision, dimension)
    inverse, slowest = moment_functions(precision, dimension).inverse, wp.constant(real(SLOWEST**2))

    @wp.func
    def velocity_gradient(M_i: matrix, A_i: matrix) -> matrix:
        M = real(0.5) * (M_i + wp.transpose(M_i))  # so that the adjoint of M is symmetric, as M is
        return part(M) * (A_i * inverse(regular(M)))

    @wp.func
    def shear_rate(M_i: matrix, A_i: matrix) -> real:
        G = velocity_gradient(M_i, A_i)
        twice_D = G + wp.transpose(G)
        return wp.sqrt(real(0.5) * wp.ddot(twice_D, twice_D) + slowest)  # with a derivative at rest

    return velocity_gradient, shear_rate


class VelocityGradients:
    def __init__(self, setting: Setting):
        self._kernels = stress_kernels(setting.discretisation, setting.scene.dimension, newtonian_law(), False).moments
        precision = setting.layout.precision
        self._arrays = partial(setting.layout.arrays, M=precision.matrix, A=precision.matrix, R=precision.real)
        self._sums = self._arrays("", setting.discretisation.taped)

    def measure(self, step: StepContext) -> dict[str, wp.array]:
        step.launch(self._kernels.forward, self._sums, least=0.0)
        return self._sums

    def tangent(self, step: StepContext, dot: Tangents) -> dict[str, wp.array]:
        step.launch(self._kernels.tangent, self._sums, self._dots, *dot.named, least=0.0)
        return {**self._sums, **self._dots}

    def known(self) -> dict[str, wp.array]:
        return {**self._sums, **self._bars}

    def adjoint(self, step: StepContext, bar: Adjoints) -> None:
        step.launch(self._kernels.adjoint, self._bars, *bar.named, least=0.0)

    @cached_property
    def _dots(self) -> dict[str, wp.array]:
        return self._arrays("_dot")

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        return self._arrays("_bar")
