"""The adjoint of images in flat faces of moving solids with respect to the poses of these.

In reverse mode a sum over images is a work that is linear in adjoints,

    W = sum V ((b_i + h_i c_i) W_i' + h_i d_i (u_i - R (u_j + B_j x_ij)) . g_i' + e_i swept . g_i' / dt
               - 1/2 h_i k_i (q_i + q_j) x_i' . g_i'),

as the lift is the transpose of the spread. The slope B is that of the push by a coarse pressure. Warp makes gradients
of W by the poses of the solid before and after the step. Those by positions stand elsewhere, but for what e gives.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.launching import Named, bundle
from cortado.device.precision import TypesByName
from cortado.particles.mirrors import FACES, reflections
from cortado.particles.moving_walls import matrix_of, turn_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.state import Layout
from cortado.particles.wall_terms import ALL_WALLS, share_kinds
from cortado.sph.parts import Adjoints, StepContext

NUMBERS = ("image", "density", "weighted", "spread", "swept", "k", "q")
"""h, b, c, d, e, k and q; B is the ``slope``."""


@cache
def face_share_kernel(discretisation: Discretisation) -> Any:
    """Make the kernel that adds the adjoints of images to those of one solid, and of x by what faces have swept."""
    d = replace(discretisation, lanes=1, taped=True)
    precision = d.precision
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    pair, neighbourhood, turning = pair_functions(d), neighbourhood_type(precision), turn_functions(precision)[0]
    weight, gradient, separation = pair.weight, pair.gradient, pair.separation
    neighbour, mirrors_by = pair.neighbour, pair.mirrors_by
    module = replace(d, taped=False).module(False, "projection_faces")
    seen = bundle(x=vector, u=vector, slope=matrix, **dict.fromkeys(NUMBERS, real))
    bars = bundle(x=vector, time_step=real, **share_kinds(precision))
    REFLECTIONS, FIRST = wp.constant(reflections(d.moving)), wp.constant(FACES)

    @wp.func
    def mirrored(a: vector, n: vector) -> vector:
        return a - (real(2.0) * wp.dot(n, a)) * n

    @wp.func
    def image_of(x: vector, c: vector, R: matrix, scale: real, place: vector, normal: vector) -> vector:
        n = R * normal
        return x - (real(2.0) * wp.dot(n, x - c - scale * (R * place))) * n

    typed = TypesByName(real, {vector: "x u c place normal", matrix: "R", neighbourhood: "s"})

    @wp.func(module=module)
    @typed
    def work(x_i, x_j, u_i, u_j, near, spread, pushed, c, R, scale, place, normal, s) -> real:
        x_ij = x_i - image_of(x_j, c, R, scale, place, normal)
        along = spread * (u_i - mirrored(u_j, R * normal)) - (real(0.5) * pushed) * x_ij
        return s.volume * (near * weight(x_ij, s) + wp.dot(gradient(x_ij, s), along))

    @wp.func
    def carried(x: vector, c: vector, R: matrix, c_0: vector, R_0: matrix) -> vector:
        return x - c_0 - R_0 * (wp.transpose(R) * (x - c))

    @wp.func(module=module)
    @typed
    def sweep(x_i, x_j, c, R, c_0, R_0, scale, place, normal, s) -> real:
        image = image_of(x_j, c, R, scale, place, normal)
        swept = carried(image, c, R, c_0, R_0) - mirrored(carried(x_j, c, R, c_0, R_0), R * normal)
        return s.volume * wp.dot(gradient(x_i - image, s), swept)

    @wp.func(module=module)
    def shares(i: int, solid: int, per: real, at: seen, s: neighbourhood):
        force, torque, before, turned, x_part = vector(), vector(), vector(), vector(), vector()
        growth, total, member = real(0.0), real(0.0), i // s.particles
        c, c_0, scale = s.after[member, solid], s.before[member, solid], s.scales[member, solid]
        R, R_0 = s.turns[member, solid], s.turns_before[member, solid]
        x_i, u_i, h, e_i = at.x[i], at.u[i], at.image[i], per * at.swept[i]
        near, spread = at.density[i] + h * at.weighted[i], h * at.spread[i]
        for k in range(s.count[i], s.all_count[i]):
            image = neighbour(k, i, s)
            j, f = image // REFLECTIONS, image % REFLECTIONS - FIRST
            if mirrors_by(f + FIRST, solid, s):
                x_j, e_j, place, normal = at.x[j], per * at.swept[j], s.face_places[f], s.face_frames[f][0]
                pushed, u_j = h * at.k[i] * (at.q[i] + at.q[j]), at.u[j] + at.slope[j] * separation(x_i, x_j, s)
                _i, _j, _u, _v, _a, _b, _d, by_c, by_R, by_scale, _p, _m, _ = wp.grad(work)(
                    x_i, x_j, u_i, u_j, near, spread, pushed, c, R, scale, place, normal, s
                )
                by_x, _j, along_c, along_R, by_c_0, by_R_0, along_scale, _p, _m, _ = wp.grad(sweep)(
                    x_i, x_j, c, R, c_0, R_0, scale, place, normal, s
                )
                _i, by_other, _c, _R, _c_0, _R_0, _s, _p, _m, _ = wp.grad(sweep)(
                    x_j, x_i, c, R, c_0, R_0, scale, place, normal, s
                )
                force += by_c + e_i * along_c
                torque += turning(R, by_R + e_i * along_R)
                before += e_i * by_c_0
                turned += e_i * turning(R_0, by_R_0)
                growth += by_scale + e_i * along_scale
                x_part += e_i * by_x + e_j * by_other
                total += e_i * sweep(x_i, x_j, c, R, c_0, R_0, scale, place, normal, s)
        return force, torque, before, turned, growth, x_part, per * total

    @wp.kernel(module=module, enable_backward=False)
    def face_share(
        s: neighbourhood,
        solid: int,
        time_step: wp.array(dtype=real),
        at: seen,
        # in and out
        bar: bars,
    ):
        i = s.first + wp.tid()
        if s.all_count[i] > s.count[i]:
            per = real(1.0) / time_step[i // s.particles]
            force, torque, before, turned, growth, x_part, rate = shares(i, solid, per, at, s)
            bar.force[i] = bar.force[i] + force
            bar.torque[i] = bar.torque[i] + torque
            bar.force_before[i] = bar.force_before[i] + before
            bar.torque_before[i] = bar.torque_before[i] + turned
            bar.growth[i] = bar.growth[i] + growth
            bar.x[i] = bar.x[i] + x_part
            bar.time_step[i] = bar.time_step[i] - rate

    return face_share


class FaceShares:
    """The particles' shares of the adjoints of solids by images in their faces."""

    def __init__(self, discretisation: Discretisation, layout: Layout, faces: int):
        """Prepare the adjoint of images in so many ``faces``; without any, nothing is added."""
        self._kernel, self._faces = partial(face_share_kernel, discretisation), faces
        own = {"u": layout.precision.vector, "slope": matrix_of(layout.precision)}
        self._nothing = layout.arrays(**own, **dict.fromkeys(NUMBERS, layout.precision.real)) if faces else {}

    def add(
        self, context: StepContext, bar: Adjoints, *groups: Named, over: int = ALL_WALLS, **arrays: wp.array
    ) -> None:
        """Add the shares of images, or of those ``over`` one solid, by the adjoints that are given as ``arrays``;
        others are 0. ``groups`` have h as ``image``."""
        if self._faces:
            known = {**self._nothing, **{name: array for group in groups for name, array in group.items()}, **arrays}
            bar.solids.add(context.launch, self._kernel, *bar.named, known, over=over)
