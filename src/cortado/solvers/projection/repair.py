"""Repairs of the density, by Jacobi iterations that change only positions.

`docs/projection_step.md` has the equations. Repairs use kernel gradients, wall sums and the diagonal from the start of
the step. Only the number density is computed at the moved positions, over the neighbours from the start of the step.
Repairs do not change velocities, because a repair would then act a second time in the next step.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import TypesByName
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.surroundings import entries
from cortado.solvers.projection.wall_sums import weights_type
from cortado.sph.density import density_sums

FARTHEST = 1.0 / 6.0
"""Greatest displacement of a particle by the repairs of a step [spacings]."""


@cache
def repair_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    pair_of, weights4 = precision.pair, weights_type(precision)
    mirrors, (push, push_tangent, push_back) = image_sums(discretisation), projection_sums(discretisation).push
    (image_weights, image_weights_tangent, _), mirror_of = mirrors.weights, mirrors.mirror_of
    (lift, lift_tangent, lift_back), (behind, behind_tangent, behind_back) = mirrors.lift, mirrors.behind
    weights, weights_tangent, weights_adjoint = density_sums(discretisation)
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")
    own = {name: kind for name, kind in entries(precision).items() if name in ("gamma", "a", "weights", "image")}
    seen, bars = bundle(**own), bundle(x=vector, m=real, **own)
    LANES, lane = discretisation.lanes, discretisation.lane
    farthest = wp.constant(real(FARTHEST))

    @wp.func
    def along(change: vector, back: vector, held: real) -> vector:
        if held < real(1.0):
            return held * (change - (wp.dot(back, change) / wp.dot(back, back)) * back)
        return change

    typed = TypesByName(real, {neighbourhood: "s", seen: "of dot", vector: "x pushed lifted gamma f", bars: "bar"})

    @typed.kernel(module)
    def measure(s, omega: real, of, x_now, c_in, c_out, excess, error: wp.array(dtype=pair_of)):
        """``c_in`` are the old and ``c_out`` the new multipliers, ``excess`` is the density error."""
        i = s.first + wp.tid() // LANES
        total = weights(i, x_now, s)
        surplus = image_weights(i, x_now, s) - behind(i, x_now, mirror_of(x_now[i], i // s.particles, s), s)
        if lane() > 0:
            return
        over = s.volume * (real(1 - s.filling[i]) * s.self_weight + total) - real(1.0)
        over += of.image[i] * surplus
        z = c_in[i] + omega * over / of.a[i]
        if z < real(0.0):
            z = of.weights[i][3] * z
        compression = wp.max(over, real(0.0))
        c_out[i] = z
        excess[i] = over
        error[i] = pair_of(compression, compression)

    @typed.kernel(tangent_module)
    def measure_tangent(s, omega: real, of, dot, x_now, x_now_dot, c_in, c_in_dot, excess, c_out_dot):
        i = s.first + wp.tid() // LANES
        total = s.volume * weights_tangent(i, x_now, x_now_dot, s)
        solid = mirror_of(x_now[i], i // s.particles, s)
        surplus = image_weights(i, x_now, s) - behind(i, x_now, solid, s)
        change = image_weights_tangent(i, x_now, x_now_dot, s) - behind_tangent(i, x_now, x_now_dot, solid, s)
        if lane() > 0:
            return
        total += of.image[i] * change + dot.image[i] * surplus
        per = omega / of.a[i]
        z = c_in[i] + per * excess[i]
        z_dot = c_in_dot[i] + per * (total - dot.a[i] / of.a[i] * excess[i])
        if z < real(0.0):
            z_dot = of.weights[i][3] * z_dot + dot.weights[i][3] * z
        c_out_dot[i] = z_dot

    @typed.kernel(adjoint_module)
    def measure_adjoint(s, x_now, image, n_now_bar, image_bar, x_now_bar):
        i = s.first + wp.tid() // LANES
        total = weights_adjoint(i, x_now, n_now_bar, s)
        solid = mirror_of(x_now[i], i // s.particles, s)
        surplus = image_weights(i, x_now, s) - behind(i, x_now, solid, s)
        lifted, walled = lift(i, x_now, n_now_bar, image, s), behind_back(i, x_now, solid, s)
        if lane() > 0:
            return
        image_bar[i] = image_bar[i] + n_now_bar[i] * surplus
        x_now_bar[i] = s.volume * total + lifted - (image[i] * n_now_bar[i]) * walled

    both = [over(push, "pushed"), over(lift, "lifted", y="c")]

    @particle_kernel(module, "held x_now", both, numbers=["spacing"], typed=typed)
    def move(pushed, lifted, spacing, m_i, gamma_i, c_i, x_moved_i) -> tuple[real, vector]:
        """Return the fraction of the displacement that the bound allows, and the new position of a particle."""
        back = (pushed + lifted + c_i * gamma_i) / m_i
        most, length, part = farthest * spacing, wp.length(back), real(1.0)
        if length > most:
            part = most / length
        return part, x_moved_i - part * back

    both = [over(push_tangent, "pushed"), over(lift_tangent, "lifted", y="c", y_dot="c_dot")]

    @particle_kernel(tangent_module, "x_now_dot", both, typed=typed)
    def move_tangent(
        pushed, lifted, m_i, m_dot_i, gamma_i, gamma_dot_i, c_i, c_dot_i, x_moved_i, x_moved_dot_i, x_now_i, held_i
    ) -> vector:
        change = pushed + lifted + c_dot_i * gamma_i + c_i * gamma_dot_i
        back = (x_moved_i - x_now_i) / held_i
        return x_moved_dot_i - along((change - m_dot_i * back) / m_i, back, held_i)

    @particle_kernel(adjoint_module, "+m_bar +x_moved_bar f", typed=typed)
    def begin_adjoint(m_i, x_now_i, x_moved_i, held_i, x_now_bar_i) -> tuple[real, vector, vector]:
        back = (x_moved_i - x_now_i) / held_i
        bar = along(x_now_bar_i, back, held_i)
        return wp.dot(bar, back) / m_i, x_now_bar_i, -bar / m_i

    @typed.kernel(adjoint_module)
    def move_adjoint(s, omega: real, x, of, c_in, c_out, excess, f, c_bar, bar, n_now_bar):
        i = s.first + wp.tid() // LANES
        by_c, x_part = push_back(i, x, c_out, f, s)
        widened, x_lift = lift_back(i, x, c_out, of.image, f, s)
        if lane() > 0:
            return
        a = of.a[i]
        per = omega / a
        z_bar = c_bar[i] + by_c + wp.dot(of.gamma[i], f[i]) + of.image[i] * widened
        bar.image[i] = bar.image[i] + c_out[i] * widened
        z = c_in[i] + per * excess[i]
        if z < real(0.0):
            no = real(0.0)
            bar.weights[i] = bar.weights[i] + weights4(no, no, no, z * z_bar)
            z_bar = of.weights[i][3] * z_bar
        bar.gamma[i] = bar.gamma[i] + c_out[i] * f[i]
        bar.a[i] = bar.a[i] - per * excess[i] / a * z_bar
        bar.x[i] = bar.x[i] + x_part + x_lift
        n_now_bar[i] = per * z_bar
        c_bar[i] = z_bar

    measures = Kernels(measure, measure_tangent, measure_adjoint)
    return SimpleNamespace(measure=measures, move=Kernels(move, move_tangent, (begin_adjoint, move_adjoint)))


def repair_term(d: Discretisation) -> Any:
    real, vector, weight = d.precision.real, d.precision.vector, pair_functions(d).weight

    def repair_work(
        x_ij: vector, n_now_bar_i: real, image_i: real, mirrored: real, s: neighbourhood_type(d.precision)
    ) -> real:
        return s.volume * weight(x_ij, s) * (real(1.0) - mirrored * image_i) * n_now_bar_i

    return repair_work
