"""Contacts of free bodies with the container, solids and each other: a smooth penalty with restitution and friction.

At the predicted pose, points of a body's surface are inside the other solid by depths d_j > 0 along the normals n_j of
the faces above them. The weights w_j = d_j^3 / sum d_j^3 give the contact the depth D = sum_j w_j d_j, near the
greatest depth for any number of points. The body gets the momentum

    P = (q / dt) m D sum_j w_j n_j,   1 / m = 1 / M + r^2 / I,

and the other solid -P. Here r is the arm of P and I the least moment of inertia; if the other solid is free, 1 / m also
has the same terms of that body. Each contact oscillates with the angular frequency sqrt(q) / dt. Two free bodies have
points in each other, and both contacts have the weight one half.

*Restitution*: beta - 1 times the growth of D in the step is added to D. beta(e), with which a body rebounds at e times
its speed, is fitted to steps of a body that hits a wall: within 0.004 for e from 0.03 to 0.95; for e = 1 it rebounds at
0.98.

*Friction* (Coulomb's): the momentum that would stop all slip is Q = sum_j w_j (m_j u_j + M g dt). Point j slips with
the velocity u_j and m_j is its effective mass. The term M g dt, gravity along the face, is zero if the other solid is
free. The body gets

    -Q / (1 + t^8)^(1/8),   t = sum_j w_j |m_j u_j + M g dt| / (mu (q / dt) m D):

which stops the slip if Q is small, and is mu times the push if Q is large. A body at rest on a slope creeps with up to
t^8 / 8 times M g dt / m_j.

Derivatives jump when a contact begins or the face above a point changes; at mu = 0 the derivative with respect to mu is
one-sided.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.device.launching import bundle
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.sph.moving_solids import free_module, hold_type

STIFFNESS = 0.04
"""Stiffness q of contacts [-]."""
FAR = 1e6
"""Greatest distance at which faces are searched [m]."""
SHARES = ("pushes", "drags", "scales")
"""Terms of a surface point. ``pushes`` has the columns d^3 n and its moments about the middles of both solids.
``drags`` has the same columns for d^3 times the momentum that stops the point. ``scales`` has d^3, d^4, both with d
before the step, and the length of that momentum."""
OWN = ("before", "turned_before", "after", "turned")
POSES = ("before", "turns_before", "after", "turns")
NUMBERS = ("time_step", "density", "other_density")


@cache
def contact_kernels(precision: Precision) -> SimpleNamespace:
    """Make the kernels of contact: ``look`` and ``push`` have a thread for each surface point in each scene, ``give``
    has one for each scene. ``push`` computes `SHARES` from poses, scale, lift (`lift_kernels`) and `NUMBERS`, and
    ``give`` turns their sums into momenta of both solids, 0 for a solid that is not free."""
    real, vector, matrix, pair = precision.real, precision.vector, precision.matrix, precision.pair
    modules, stiffness = [free_module(precision, "contacts")] * 3, wp.constant(real(STIFFNESS))

    @wp.func
    def vec(a: wp.vec3f) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def along(way: real, length: real) -> real:
        """Return a separation along one axis [m] as that of the nearest periodic image."""
        found = way
        if length > real(0.0):
            found = way - length * wp.round(way / length)
        return found

    no, half, one, tiny = (wp.constant(real(value)) for value in (0.0, 0.5, 1.0, precision.tiny))
    vectors, six = "before after other_before other_after own face shift lift slides", precision.six
    kinds = {
        matrix: "turns turns_before other_turns other_turns_before pushes_sum drags_sum",
        six: "scales_sum",
        pair: "volumes greatest",
        bool: "is_free",
    }
    typed = TypesByName(real, {vector: vectors, hold_type(precision): "hold", **kinds})

    @wp.func
    def ease(density: real, other: real, volumes: pair, greatest: pair, is_free: bool, arms: pair) -> real:
        """Return 1 / m of a push, given the squared arms about the middles of both solids."""
        found = (one / volumes[0] + greatest[0] * arms[0]) / density
        if is_free:
            found += (one / volumes[1] + greatest[1] * arms[1]) / other
        return found

    @wp.func
    def column(M: matrix, k: int) -> vector:
        return vector(M[0, k], M[1, k], M[2, k])

    @wp.func
    def mean(own: real, other: real, is_free: bool) -> real:
        return wp.where(is_free, half * (own + other), own)

    @wp.func
    def eased(t: real) -> real:
        """Return (1 + t^8)^(-1/8)."""
        fourth = (t * t) * (t * t)
        return one / wp.sqrt(wp.sqrt(wp.sqrt(one + fourth * fourth)))

    @wp.kernel(module=modules[0], enable_backward=False)
    @typed.arrays
    def look(
        particles: int,
        period: vector,
        axes: vector,
        mesh: wp.uint64,
        origin: vector,
        inner: vector,
        side: real,
        own,
        after,
        turns,
        other_after,
        other_turns,
        other_scales,
        of: bundle(face=vector, plane=real, shift=vector, depth=real),
    ):
        """Find the face behind which a point is deepest. The mesh is centred on ``origin`` for a solid at rest, and on
        ``inner`` in the frame of a moving solid. ``axes`` is 1 along the scene's axes; its 0 along z in the plane
        removes the 1e-18 that a GPU's fused products leave in the normal."""
        j = wp.tid()
        b = j // particles
        way = after[b] + turns[b] * own[j] - other_after[b] - origin
        x = vector(along(way[0], period[0]), along(way[1], period[1]), along(way[2], period[2]))
        y = wp.transpose(other_turns[b]) * x / other_scales[b] - inner
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(mesh, place, wp.float32(FAR))
        if not found.result or real(found.sign) * side > real(0.0):
            return
        corners = wp.mesh_get(mesh)
        first = vec(corners.points[corners.indices[3 * found.face]])
        second = vec(corners.points[corners.indices[3 * found.face + 1]])
        third = vec(corners.points[corners.indices[3 * found.face + 2]])
        n = side * wp.normalize(wp.cw_mul(axes, wp.cross(second - first, third - first)))
        d = other_scales[b] * wp.dot(n, first - y)
        if d > of.depth[j]:
            of.face[j] = n
            of.plane[j] = wp.dot(n, first + inner)
            of.shift[j] = way - x + origin
            of.depth[j] = d

    @typed
    def push(
        time_step,
        lift,
        density,
        other_density,
        before,
        turns_before,
        after,
        turns,
        other_before,
        other_turns_before,
        other_after,
        other_turns,
        other_scales,
        volumes,
        greatest,
        is_free,
        hold,
        slides,
        own_i,
        face_i,
        plane_i,
        shift_i,
    ) -> tuple[matrix, matrix, six]:
        r, n = turns * own_i, other_turns * face_i
        x = after + r - other_after - shift_i
        y = wp.transpose(other_turns) * x
        y_before = wp.transpose(other_turns_before) * (before + turns_before * own_i - other_before - shift_i)
        d = other_scales * plane_i - wp.dot(face_i, y)
        d_before = wp.max(other_scales * plane_i - wp.dot(face_i, y_before), no)
        u, g = other_turns * (y - y_before - time_step * slides), wp.cw_mul(hold.moving, lift)
        u, g = u - wp.dot(n, u) * n, wp.where(is_free, no, density * volumes[0]) * (g - wp.dot(n, g) * n)
        size = wp.dot(u, u) + tiny
        arm, other_arm = wp.cross(r, u), wp.cross(x, u)
        arms = pair(wp.dot(arm, arm) / size, wp.dot(other_arm, other_arm) / size)
        w = d * d * d
        stop = u / (time_step * ease(density, other_density, volumes, greatest, is_free, arms)) - g
        slide = w * wp.sqrt(wp.dot(stop, stop) + tiny)
        f, drag = w * n, w * stop
        begun = d_before * d_before * d_before
        pushes = wp.matrix_from_cols(f, wp.cross(r, f), wp.cross(x, f))
        drags = wp.matrix_from_cols(drag, wp.cross(r, drag), wp.cross(x, drag))
        return pushes, drags, six(w, w * d, begun, begun * d_before, slide, no)

    @typed
    def give(
        time_step_i,
        density_i,
        other_density_i,
        restitution_i,
        other_restitution_i,
        friction_i,
        other_friction_i,
        is_free,
        volumes,
        greatest,
        pushes_sum_i,
        drags_sum_i,
        scales_sum_i,
    ) -> tuple[vector, vector, vector, vector]:
        part, grip, share, cube = no, no, wp.where(is_free, half, one), scales_sum_i[0]
        if cube > no:
            turn, back = column(pushes_sum_i, 1) / cube, column(pushes_sum_i, 2) / cube
            arms, by = pair(wp.dot(turn, turn), wp.dot(back, back)), share / cube
            u = wp.log(mean(restitution_i, other_restitution_i, is_free) + real(0.03))
            beta = real(0.02943804) + u * (real(-3.44174961) + u * (real(0.11397519) - real(0.21607366) * u))
            deep = beta * scales_sum_i[1] / cube
            if scales_sum_i[2] > no:
                deep += (one - beta) * scales_sum_i[3] / scales_sum_i[2]
            light = ease(density_i, other_density_i, volumes, greatest, is_free, arms)
            part = by * stiffness * wp.max(deep, no) / (time_step_i * light)
            most, stop = mean(friction_i, other_friction_i, is_free) * part * cube, by * scales_sum_i[4]
            if stop > most:
                grip = by * (most / stop) * eased(most / stop)
            elif most > no:
                grip = by * eased(stop / most)
        found, against = part * pushes_sum_i - grip * drags_sum_i, wp.where(is_free, -one, no)
        return column(found, 0), column(found, 1), against * column(found, 0), against * column(found, 2)

    moved = [*POSES, *(f"other_{name}" for name in POSES), "other_scales", "lift", *NUMBERS]
    turned = dict(zip(POSES[1::2], OWN[1::2], strict=True))
    turned |= {f"other_{name}": f"other_{turn}" for name, turn in turned.items()}
    pushes = pointwise_kernels(
        precision,
        modules,
        lambda _: push,
        SHARES,
        numbers=["volumes", "greatest", "is_free", "hold", "slides"],
        written=moved,
        known=["own", "face", "plane", "shift"],
        where="depth",
        summed=SHARES,
        turned=turned,
    )
    gives = pointwise_kernels(
        precision,
        modules,
        lambda _: give,
        [f"{name}:{name}" for name in ("pushed", "twisted", "pushed_other", "twisted_other")],
        numbers=["is_free", "volumes", "greatest"],
        written=[f"{name}_sum" for name in SHARES],
    )
    return SimpleNamespace(look=look, push=pushes, give=gives)
