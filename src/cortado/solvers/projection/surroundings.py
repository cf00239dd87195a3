"""Number densities, moments of neighbours, and sums over walls for each particle, with derivatives."""

from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.state import clear
from cortado.particles.wall_terms import solid_kernel
from cortado.solvers.particles import ParticleSystem
from cortado.solvers.projection.effects import effect_functions, image_share, image_sums
from cortado.solvers.projection.lattice import ProjectionConstants
from cortado.solvers.projection.sums import APART, projection_sums
from cortado.solvers.projection.wall_sums import FaceShares, beside_sums, beside_term, edge_functions, weights_type
from cortado.sph.density import Density, DensityAdjoint, DensityTangent
from cortado.sph.moment_functions import moment_functions, symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents


def entries(precision: Precision) -> dict[str, Any]:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    own = {"M": matrix, "Q": matrix, "g": vector, "gamma": vector, "nu": real, "drift": real}
    own |= {"normal": vector, "whole": vector, "normal_drift": real, "whole_drift": real, "edge": real}
    own |= {"beside": vector, "mirror": vector, "behind": real, "images": real, "image": real, "sweep": real}
    own |= {"crowd": vector, "apart": vector, "L": matrix, "a": real}
    return {**own, "weights": weights_type(precision), "coarse": real}


def bar_entries(precision: Precision) -> dict[str, Any]:
    return {name: kind for name, kind in entries(precision).items() if name != "Q"}


@cache
def surrounding_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, precision.matrix, weights_type(precision)
    neighbourhood, mirrors = neighbourhood_type(precision), image_sums(discretisation)
    moments, moments_tangent, moments_back = projection_sums(discretisation).moments
    beside, beside_tangent, beside_back = beside_sums(discretisation)
    (image_weights, image_weights_tangent, _), (sweep, sweep_tangent, _) = mirrors.weights, mirrors.sweep
    (mirror_walls, mirror_walls_tangent, mirror_walls_back), mirror_of = mirrors.walls, mirrors.mirror_of
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")
    own, packed = moment_functions(precision, dimension), symmetric(precision)
    whole, change, six, pack = own.whole, own.change, packed.kind, packed.pack
    echo, here = mirrors.echo, effect_functions(precision, dimension, module)
    weights_of, correction_of, diagonal_of, share_of = here.weights, here.correction, here.diagonal, here.share
    along = effect_functions(precision, dimension, tangent_module).back
    back = effect_functions(precision, dimension, adjoint_module).back
    edge = edge_functions(precision, dimension, module).edge
    edge_along = edge_functions(precision, dimension, tangent_module).back
    edge_back = edge_functions(precision, dimension, adjoint_module).back
    image_of = image_share(precision, dimension, module)[0]
    image_along = image_share(precision, dimension, tangent_module)[1]
    image_back = image_share(precision, dimension, adjoint_module)[1]
    around, bars = bundle(time_step=real, **entries(precision)), bundle(**bar_entries(precision))
    LANES, lane = discretisation.lanes, discretisation.lane

    typed = TypesByName(real, {neighbourhood: "s", vector: "x v", around: "of dot", bars: "bar", six: "M Q"})

    @typed.kernel(module)
    def surroundings(s, least: real, per_nearest: real, per_apart: real, x, v, m, n, of, surfaced: wp.array(dtype=int)):
        """Set ``surfaced`` to 1 in scenes with a free surface."""
        i = s.first + wp.tid() // LANES
        diagonal, others, square, mixed, g, crowd, apart, near = moments(i, x, m, per_nearest, per_apart, s)
        normal, entire, nu, normal_drift, whole_drift = beside(i, x, v, s)
        images = image_weights(i, x, s)
        mirror, behind, swept = mirror_walls(i, x, v, mirror_of(x[i], i // s.particles, s), s)
        if wp.static(discretisation.moving):
            swept = sweep(i, x, s) / of.time_step[i // s.particles] - swept
        if lane() > 0:
            return
        e, h = edge(normal, entire, least), image_of(images, behind, nu)
        gamma = normal + e * (entire - normal)
        M, Q = whole(diagonal, others), change(square, mixed)
        L = correction_of(M, gamma, mirror, nu, behind, least)
        n[i] = s.volume * real(1 - s.filling[i]) * s.self_weight + near + nu + h * (images - behind)
        of.M[i] = M
        of.Q[i] = Q
        of.g[i] = g
        of.gamma[i] = gamma - h * mirror
        of.beside[i] = gamma
        of.mirror[i] = mirror
        of.nu[i] = nu
        of.behind[i] = behind
        of.images[i] = images
        of.image[i] = h
        of.drift[i] = normal_drift + e * (whole_drift - normal_drift) + h * swept
        of.sweep[i] = swept
        of.normal[i] = normal
        of.whole[i] = entire
        of.normal_drift[i] = normal_drift
        of.whole_drift[i] = whole_drift
        of.edge[i] = e
        of.L[i] = L
        of.crowd[i] = crowd
        of.apart[i] = apart
        of.a[i] = diagonal_of(L, Q, g, gamma, m[i], least)
        of.weights[i] = weights_of(M, nu, behind)
        shared = share_of(M, nu)
        of.coarse[i] = shared
        if not (shared > real(0.0)) and surfaced[i // s.particles] == 0:
            surfaced[i // s.particles] = 1

    @typed.kernel(tangent_module)
    def surroundings_tangent(
        s, least: real, per_nearest: real, per_apart: real, x, x_dot, v, v_dot, m, m_dot, of, n_dot, dot
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, square, mixed, g_i_dot, crowd_dot, apart_dot, near_dot = moments_tangent(
            i, x, x_dot, m, m_dot, per_nearest, per_apart, s
        )
        normal_dot, whole_dot, nu_i_dot, normal_drift_dot, whole_drift_dot = beside_tangent(i, x, x_dot, v, v_dot, s)
        images_i_dot = image_weights_tangent(i, x, x_dot, s)
        mirror_i_dot, behind_i_dot, swept_dot = mirror_walls_tangent(
            i, x, x_dot, v, v_dot, mirror_of(x[i], i // s.particles, s), s
        )
        if wp.static(discretisation.moving):
            dt = of.time_step[i // s.particles]
            swept_dot = (
                sweep_tangent(i, x, x_dot, s) - sweep(i, x, s) * dot.time_step[i // s.particles] / dt
            ) / dt - swept_dot
        if lane() > 0:
            return
        e, off = of.edge[i], of.whole[i] - of.normal[i]
        by_normal, by_whole = edge_along(of.normal[i], of.whole[i], least, real(1.0))
        e_dot = wp.dot(by_normal, normal_dot) + wp.dot(by_whole, whole_dot)
        by_images, by_behind, by_all = image_along(of.images[i], of.behind[i], of.nu[i])
        h, h_dot = of.image[i], by_images * images_i_dot + by_behind * behind_i_dot + by_all * nu_i_dot
        gamma_i_dot = normal_dot + e * (whole_dot - normal_dot) + e_dot * off
        drift_i_dot = normal_drift_dot + e * (whole_drift_dot - normal_drift_dot)
        drift_i_dot += e_dot * (of.whole_drift[i] - of.normal_drift[i]) + h * swept_dot + h_dot * of.sweep[i]
        M_i_dot, Q_i_dot = change(diagonal, others), change(square, mixed)
        M, Q, g, gamma, nu, m_i = of.M[i], of.Q[i], of.g[i], of.beside[i], of.nu[i], m[i]
        L_dot, weights_dot, a_dot, coarse_dot = matrix(), weights4(), real(0.0), real(0.0)
        count = int(15)  # not a number: Warp would write the gradient out for each
        for k in range(count):
            L_unit, a_unit, weights_unit, coarse_unit = matrix(), real(0.0), weights4(), real(0.0)
            if k < 9:
                L_unit[k // 3, k % 3] = real(1.0)
            elif k < 13:
                weights_unit[k - 9] = real(1.0)
            elif k < 14:
                a_unit = real(1.0)
            else:
                coarse_unit = real(1.0)
            by_M, by_Q, by_g, by_gamma, by_mirror, by_nu, by_walls, by_m = along(
                M, Q, g, gamma, of.mirror[i], nu, of.behind[i], m_i, least, L_unit, a_unit, weights_unit, coarse_unit
            )
            entry = wp.ddot(by_M, M_i_dot) + wp.ddot(by_Q, Q_i_dot) + wp.dot(by_g, g_i_dot)
            entry += wp.dot(by_gamma, gamma_i_dot) + by_nu * nu_i_dot + by_m * m_dot[i]
            entry += wp.dot(by_mirror, mirror_i_dot) + by_walls * behind_i_dot
            if k < 9:
                L_dot[k // 3, k % 3] = entry
            elif k < 13:
                weights_dot[k - 9] = entry
            elif k < 14:
                a_dot = entry
            else:
                coarse_dot = entry
        n_dot[i] = near_dot + nu_i_dot + h * (images_i_dot - behind_i_dot) + h_dot * (of.images[i] - of.behind[i])
        dot.M[i] = M_i_dot
        dot.Q[i] = Q_i_dot
        dot.g[i] = g_i_dot
        dot.gamma[i] = gamma_i_dot - h * mirror_i_dot - h_dot * of.mirror[i]
        dot.beside[i] = gamma_i_dot
        dot.image[i] = h_dot
        dot.nu[i] = nu_i_dot
        dot.drift[i] = drift_i_dot
        dot.edge[i] = e_dot
        dot.L[i] = L_dot
        dot.crowd[i] = crowd_dot
        dot.apart[i] = apart_dot
        dot.a[i] = a_dot
        dot.weights[i] = weights_dot
        dot.coarse[i] = coarse_dot

    @typed.kernel(adjoint_module)
    def own_adjoint(least: real, m, n_bar, of, m_bar, bar, M_pull, Q_pull):
        i = wp.tid()
        M_bar, Q_bar, g_bar, gamma_bar, mirror_bar, nu_bar, behind_bar, m_i_bar = back(
            of.M[i], of.Q[i], of.g[i], of.beside[i], of.mirror[i], of.nu[i], of.behind[i], m[i], least,
            bar.L[i], bar.a[i], bar.weights[i], bar.coarse[i],
        )  # fmt: skip
        m_bar[i] = m_bar[i] + m_i_bar
        M_pull[i] = pack(bar.M[i] + M_bar)
        Q_pull[i] = pack(Q_bar)
        bar.g[i] = bar.g[i] + g_bar
        h, h_bar = of.image[i], bar.image[i] - wp.dot(bar.gamma[i], of.mirror[i])
        h_bar += n_bar[i] * (of.images[i] - of.behind[i]) + bar.drift[i] * of.sweep[i]
        by_images, by_behind, by_all = image_back(of.images[i], of.behind[i], of.nu[i])
        bar.nu[i] = bar.nu[i] + nu_bar + n_bar[i] + by_all * h_bar
        bar.mirror[i] = mirror_bar - h * bar.gamma[i]
        bar.sweep[i] = h * bar.drift[i]
        bar.images[i] = h * n_bar[i] + by_images * h_bar
        bar.behind[i] = behind_bar - h * n_bar[i] + by_behind * h_bar
        push_bar, drift_bar, e = bar.gamma[i] + bar.beside[i] + gamma_bar, bar.drift[i], of.edge[i]
        e_bar = bar.edge[i] + wp.dot(push_bar, of.whole[i] - of.normal[i])
        e_bar += drift_bar * (of.whole_drift[i] - of.normal_drift[i])
        normal_bar, whole_bar = edge_back(of.normal[i], of.whole[i], least, e_bar)
        bar.normal[i] = (real(1.0) - e) * push_bar + normal_bar
        bar.whole[i] = e * push_bar + whole_bar
        bar.normal_drift[i] = (real(1.0) - e) * drift_bar
        bar.whole_drift[i] = e * drift_bar

    @typed.kernel(adjoint_module)
    def sums_adjoint(s, per_nearest: real, per_apart: real, x, v, m, n_bar, M_pull, Q_pull, bar, x_bar, m_bar):
        i = s.first + wp.tid() // LANES
        x_part, m_part = moments_back(
            i, x, m, M_pull, Q_pull, bar.g, bar.crowd, bar.apart, n_bar, per_nearest, per_apart, s
        )
        wall_part = beside_back(i, x, v, bar.normal, bar.whole, bar.nu, bar.normal_drift, bar.whole_drift, s)
        mirrors = mirror_of(x[i], i // s.particles, s)
        wall_part += mirror_walls_back(i, x, v, bar.mirror, bar.behind, bar.sweep, mirrors, s)
        wall_part += echo(i, x, bar.images, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part + wall_part
        m_bar[i] = m_bar[i] + m_part

    return Kernels(surroundings, surroundings_tangent, (own_adjoint, sums_adjoint))


class SurroundingsTangent(DensityTangent):
    def __init__(self, surroundings: "Surroundings"):
        super().__init__(surroundings)
        layout = surroundings.system.layout
        self.around = layout.arrays("_dot", **entries(layout.precision))

    def measure(self, context: StepContext, dot: Tangents) -> None:
        own = self._density
        context.launch(own.kernels.tangent, *dot.named, self.around, own.around, own.constants)


class SurroundingsAdjoint(DensityAdjoint):
    def __init__(self, surroundings: "Surroundings"):
        super().__init__(surroundings)
        layout, precision = surroundings.system.layout, surroundings.system.layout.precision
        self.around = layout.arrays("_bar", **bar_entries(precision))
        self._faces = FaceShares(surroundings.system)
        self._moments = layout.arrays("_pull", M=precision.six, Q=precision.six)

    def begin(self) -> None:
        clear(self.around.values())

    def measure(self, context: StepContext, bar: Adjoints) -> None:
        own, known = self._density, (*bar.named, self.around, self._density.around)
        for kernel in own.kernels.adjoint:
            context.launch(kernel, *known, self._moments, own.constants)
        bar.solids.add(context.launch, partial(solid_kernel, own.discretisation, "projection", beside_term), *known)
        images = {"density": self.around["images_bar"], "swept": self.around["sweep_bar"]}
        self._faces.add(context, bar, context.fields.named(), own.around, images)


class Surroundings(Density):
    derivatives = SurroundingsTangent, SurroundingsAdjoint

    def __init__(self, system: ParticleSystem, topic: str, constants: ProjectionConstants):
        kernels = surrounding_kernels(system.discretisation, system.walled.dimension)
        super().__init__(system.discretisation, topic, kernels)
        self.system, layout = system, system.layout
        self.around = layout.arrays(**entries(layout.precision))
        per_nearest, per_apart = 1.0 / constants.nearest_weight, (APART * constants.spacing) ** -2
        self.constants = {"least": constants.least_diagonal, "per_nearest": per_nearest, "per_apart": per_apart}
        self.surfaced = wp.zeros(layout.members, dtype=wp.int32, device=layout.device)
        """Array of shape (members,) with 1 for each scene with a free surface, otherwise 0."""

    def measure(self, context: StepContext) -> None:
        self.surfaced.zero_()
        context.launch(self.kernels.forward, self.around, self.constants, surfaced=self.surfaced)
