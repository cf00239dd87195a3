"""The force between a body and a solid that it touches: a smooth penalty.

Points of a body's surface that are in the other solid, d_j > 0 deep, give it the momentum

    P = (q / dt) M sum_j f_j n_j,   f_j = d_j^3 / sqrt(S),   S = sum_j d_j^4,

along the normals n_j of the faces above them, and the other one -P. It is that of the potential q M sqrt(S) / (2 dt^2),
for a depth S^(1/4) that is near the greatest one whatever the number of points: of a spring in which the lighter of two
bodies, with M m / (M + m), would swing with sqrt(q) / dt. As d_j is where the body would go, a swing shrinks by
sqrt(1 - q) in a step: a body leaves what it falls on with 0.6 of its speed, whatever the time step. At a depth of 0 f_j
has two derivatives, both 0; where the face above a point changes, there is a corner.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.sph.free_kernels import free_module

STIFFNESS = 0.04
"""The stiffness q of contacts [-]."""


@cache
def strength_kernels(precision: Precision) -> Kernels:
    """Make kernels that turn sums over a body's points into the momenta of both bodies in contact; a thread a scene."""
    real, vector, pair = precision.real, precision.vector, precision.pair
    module, stiffness = free_module(precision), wp.constant(real(STIFFNESS))
    bars = bundle(**{f"{name}_bar": vector for name in ("push", "twist", "other")})
    given = bundle(pushed=vector, twisted=vector)
    sums, sum_dots = (
        bundle(**dict.fromkeys((f"{name}_sum{end}" for name in ("push", "twist", "other")), vector))
        for end in ("", "_dot")
    )

    @wp.func
    def strength(dt: real, own: real, other: real, is_free: bool) -> real:
        """Return q M / dt of a contact [kg / s]: M is the own mass, or the reduced mass if the other body is free
        too."""
        mass = own
        if is_free:
            mass = own * other / (own + other)
        return stiffness * mass / dt

    @wp.func
    def part(own: real, other: real, is_free: bool) -> real:
        """Return the derivative of a contact's mass M with respect to the own mass: 1, or that of a reduced mass."""
        found = real(1.0)
        if is_free:
            found = (other / (own + other)) * (other / (own + other))
        return found

    @wp.kernel(module=module, enable_backward=False)
    def give(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        by: sums,
        # in and out
        own: given,
        pushed_other: wp.array(dtype=vector),
        twisted_other: wp.array(dtype=vector),
    ):
        b = wp.tid()
        c = strength(time_step[b], density[b] * volumes[0], other_density[b] * volumes[1], is_free)
        own.pushed[b] = own.pushed[b] + c * by.push_sum[b]
        own.twisted[b] = own.twisted[b] + c * by.twist_sum[b]
        if is_free:
            pushed_other[b] = pushed_other[b] - c * by.push_sum[b]
            twisted_other[b] = twisted_other[b] - c * by.other_sum[b]

    @wp.kernel(module=module, enable_backward=False)
    def give_tangent(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        dot: bundle(time_step=real, density=real, other_density=real, pushed=vector, twisted=vector),
        by: sums,
        by_dot: sum_dots,
        # in and out, with the last two of ``dot``
        pushed_other_dot: wp.array(dtype=vector),
        twisted_other_dot: wp.array(dtype=vector),
    ):
        b = wp.tid()
        dt, m, m_other = time_step[b], density[b] * volumes[0], other_density[b] * volumes[1]
        c = strength(dt, m, m_other, is_free)
        mass_dot = part(m, m_other, is_free) * volumes[0] * dot.density[b]
        if is_free:
            mass_dot += part(m_other, m, is_free) * volumes[1] * dot.other_density[b]
        c_dot = stiffness * mass_dot / dt - c * dot.time_step[b] / dt
        dot.pushed[b] = dot.pushed[b] + c_dot * by.push_sum[b] + c * by_dot.push_sum_dot[b]
        dot.twisted[b] = dot.twisted[b] + c_dot * by.twist_sum[b] + c * by_dot.twist_sum_dot[b]
        if is_free:
            pushed_other_dot[b] = pushed_other_dot[b] - c_dot * by.push_sum[b] - c * by_dot.push_sum_dot[b]
            twisted_other_dot[b] = twisted_other_dot[b] - c_dot * by.other_sum[b] - c * by_dot.other_sum_dot[b]

    @wp.kernel(module=module, enable_backward=False)
    def give_adjoint(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        by: sums,
        own_bar: bundle(pushed_bar=vector, twisted_bar=vector),
        pushed_other_bar: wp.array(dtype=vector),
        twisted_other_bar: wp.array(dtype=vector),
        # in and out
        bar: bundle(time_step=real, density=real),
        other_density_bar: wp.array(dtype=real),
        # out
        share_bar: bars,
    ):
        b = wp.tid()
        dt, m, m_other = time_step[b], density[b] * volumes[0], other_density[b] * volumes[1]
        c, twist_bar, from_other, other_bar = (
            strength(dt, m, m_other, is_free),
            own_bar.twisted_bar[b],
            vector(),
            vector(),
        )
        if is_free:
            from_other = -pushed_other_bar[b]
            other_bar = -twisted_other_bar[b]
        push_bar = own_bar.pushed_bar[b] + from_other
        c_bar = (
            wp.dot(by.push_sum[b], push_bar) + wp.dot(by.twist_sum[b], twist_bar) + wp.dot(by.other_sum[b], other_bar)
        )
        mass_bar = stiffness * c_bar / dt
        bar.density[b] = bar.density[b] + mass_bar * part(m, m_other, is_free) * volumes[0]
        bar.time_step[b] = bar.time_step[b] - c_bar * c / dt
        if is_free:
            other_density_bar[b] = other_density_bar[b] + mass_bar * part(m_other, m, is_free) * volumes[1]
        share_bar.push_bar[b] = c * push_bar
        share_bar.twist_bar[b] = c * twist_bar
        share_bar.other_bar[b] = c * other_bar

    return Kernels(give, give_tangent, give_adjoint)


FAR = 1e6
"""[m] beyond which no face is looked for."""


@dataclass(frozen=True)
class ContactKernels:
    """Kernels of contact between a body and a solid, with a thread for each surface point in each scene."""

    look: Kernels
    """These find the normal n and the depth d of a point."""
    push: Kernels
    """These compute the force f n of a point, and its moments about the middles of both bodies."""


@cache
def contact_kernels(precision: Precision) -> ContactKernels:
    """Make the kernels of contacts between bodies and solids in a precision."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    module = free_module(precision)
    seen = bundle(normal=vector, depth=real)
    shares, share_dots = (
        bundle(**dict.fromkeys((f"{name}{end}" for name in ("push", "twist", "other")), vector)) for end in ("", "_dot")
    )
    bars = bundle(**{f"{name}_bar": vector for name in ("push", "twist", "other")})

    @wp.func
    def vec(a: wp.vec3f) -> vector:
        return vector(real(a[0]), real(a[1]), real(a[2]))

    @wp.func
    def along(way: real, length: real) -> real:
        found = way
        if length > real(0.0):
            found = way - length * wp.round(way / length)
        return found

    @wp.func
    def nearest(way: vector, period: vector) -> vector:
        """Shorten a separation [m] to that of the nearest periodic image."""
        return vector(along(way[0], period[0]), along(way[1], period[1]), along(way[2], period[2]))

    @wp.kernel(module=module, enable_backward=False)
    def look(
        points: int,
        number: int,
        against: int,
        period: vector,
        mesh: wp.uint64,
        middle: vector,
        side: real,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        scales: wp.array2d(dtype=real),
        # in and out
        normal: wp.array(dtype=vector),
        depth: wp.array(dtype=real),
        square: wp.array(dtype=real),
    ):
        """Find normal and depth of each body point in a solid, where it is deeper than in those seen before.
        ``against`` is -1 for a solid at rest, ``period`` is 0 along an axis without one, and ``square`` is d^4."""
        j = wp.tid()
        member = j // points
        x = after[member, number] + turns[member, number] * own[j - member * points]
        R = matrix(real(1.0), real(0.0), real(0.0), real(0.0), real(1.0), real(0.0), real(0.0), real(0.0), real(1.0))
        y, scale = nearest(x - middle, period), real(1.0)
        if against >= 0:
            R = turns[member, against]
            scale = scales[member, against]
            y = wp.transpose(R) * nearest(x - after[member, against], period) / scale - middle
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(mesh, place, wp.float32(FAR))
        if not found.result or real(found.sign) * side > real(0.0):
            return
        corners = wp.mesh_get(mesh)
        a = vec(corners.points[corners.indices[3 * found.face]])
        b = vec(corners.points[corners.indices[3 * found.face + 1]])
        c = vec(corners.points[corners.indices[3 * found.face + 2]])
        n = side * wp.normalize(wp.cross(b - a, c - a))
        d = scale * wp.dot(n, a - y)
        if d > depth[j]:
            normal[j] = R * n
            depth[j] = d
            square[j] = d * d * d * d

    @wp.kernel(module=module, enable_backward=False)
    def look_tangent(
        points: int,
        number: int,
        against: int,
        period: vector,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        after_dot: wp.array2d(dtype=vector),
        turned_dot: wp.array2d(dtype=vector),
        growths: wp.array2d(dtype=real),
        of: seen,
        # out
        normal_dot: wp.array(dtype=vector),
        depth_dot: wp.array(dtype=real),
        square_dot: wp.array(dtype=real),
    ):
        j = wp.tid()
        member = j // points
        r, d = turns[member, number] * own[j - member * points], of.depth[j]
        away = after_dot[member, number] + wp.cross(turned_dot[member, number], r)
        turn, grown = vector(), real(0.0)
        if against >= 0:
            turn = turned_dot[member, against]
            x = nearest(after[member, number] + r - after[member, against], period)
            away = away - after_dot[member, against] - wp.cross(turn, x)
            grown = growths[member, against] * (d + wp.dot(of.normal[j], x))
        change = grown - wp.dot(of.normal[j], away)
        if d <= real(0.0):
            change = real(0.0)
        normal_dot[j] = wp.cross(turn, of.normal[j])
        depth_dot[j] = change
        square_dot[j] = real(4.0) * d * d * d * change

    @wp.kernel(module=module, enable_backward=False)
    def push(
        points: int,
        number: int,
        against: int,
        period: vector,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        of: seen,
        whole: wp.array(dtype=real),
        # out
        share: shares,
    ):
        """Write the contact force f n of each point and its moments about both middles; ``whole`` is S = sum d^4."""
        j = wp.tid()
        member = j // points
        r, d, S = turns[member, number] * own[j - member * points], of.depth[j], whole[member]
        f = vector()
        if d > real(0.0):
            f = (d * d * d / wp.sqrt(S)) * of.normal[j]
        share.push[j] = f
        share.twist[j] = wp.cross(r, f)
        other = vector()
        if against >= 0:
            other = wp.cross(nearest(after[member, number] + r - after[member, against], period), f)
        share.other[j] = other

    @wp.kernel(module=module, enable_backward=False)
    def push_tangent(
        points: int,
        number: int,
        against: int,
        period: vector,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        after_dot: wp.array2d(dtype=vector),
        turned_dot: wp.array2d(dtype=vector),
        of: seen,
        dot: seen,
        whole: wp.array(dtype=real),
        whole_dot: wp.array(dtype=real),
        # out
        share: share_dots,
    ):
        j = wp.tid()
        member = j // points
        r, d, S = turns[member, number] * own[j - member * points], of.depth[j], whole[member]
        r_dot = wp.cross(turned_dot[member, number], r)
        f, f_dot = vector(), vector()
        if d > real(0.0):
            size = d * d * d / wp.sqrt(S)
            rate = real(3.0) * dot.depth[j] / d - real(0.5) * whole_dot[member] / S
            f = size * of.normal[j]
            f_dot = (size * rate) * of.normal[j] + size * dot.normal[j]
        share.push_dot[j] = f_dot
        share.twist_dot[j] = wp.cross(r_dot, f) + wp.cross(r, f_dot)
        other = vector()
        if against >= 0:
            x = nearest(after[member, number] + r - after[member, against], period)
            x_dot = after_dot[member, number] + r_dot - after_dot[member, against]
            other = wp.cross(x_dot, f) + wp.cross(x, f_dot)
        share.other_dot[j] = other

    @wp.kernel(module=module, enable_backward=False)
    def push_adjoint(
        points: int,
        number: int,
        against: int,
        period: vector,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        of: seen,
        share_bar: bars,
        # out
        work: wp.array(dtype=real),
        weighed: wp.array(dtype=real),
    ):
        """Compute n . f_bar for the adjoint f_bar of a point's contact force f n, and its product with d^3;
        ``share_bar`` holds the adjoints (members,) of the sums."""
        j = wp.tid()
        member = j // points
        r, d, n = turns[member, number] * own[j - member * points], of.depth[j], of.normal[j]
        u = share_bar.push_bar[member] + wp.cross(share_bar.twist_bar[member], r)
        if against >= 0:
            x = nearest(after[member, number] + r - after[member, against], period)
            u = u + wp.cross(share_bar.other_bar[member], x)
        work[j] = wp.dot(n, u)
        weighed[j] = d * d * d * wp.dot(n, u)

    @wp.kernel(module=module, enable_backward=False)
    def look_adjoint(
        points: int,
        number: int,
        against: int,
        period: vector,
        own: wp.array(dtype=vector),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        of: seen,
        whole: wp.array(dtype=real),
        work: wp.array(dtype=real),
        weighed_sum: wp.array(dtype=real),
        share_bar: bars,
        # out
        moved: bundle(own_force=vector, own_torque=vector, other_force=vector, other_torque=vector, other_growth=real),
    ):
        """Turn adjoints of normals and depths into those of both poses and of the other solid's growth."""
        j = wp.tid()
        member = j // points
        d, n = of.depth[j], of.normal[j]
        own_force, own_torque, other_force, other_torque = vector(), vector(), vector(), vector()
        other_growth = real(0.0)
        if d > real(0.0):
            r, S = turns[member, number] * own[j - member * points], whole[member]
            root = wp.sqrt(S)
            f = (d * d * d / root) * n
            depth_bar = real(3.0) * d * d / root * work[j]
            depth_bar -= real(2.0) * d * d * d * weighed_sum[member] / (S * root)
            u = share_bar.push_bar[member] + wp.cross(share_bar.twist_bar[member], r)
            x_bar = -depth_bar * n
            own_torque = wp.cross(r, wp.cross(f, share_bar.twist_bar[member]))
            if against >= 0:
                x = nearest(after[member, number] + r - after[member, against], period)
                u = u + wp.cross(share_bar.other_bar[member], x)
                by_arm = wp.cross(f, share_bar.other_bar[member])
                other_torque = -wp.cross(x, x_bar) + wp.cross(f, u)
                other_growth = depth_bar * (d + wp.dot(n, x))
                x_bar += by_arm
                other_force = -x_bar
            own_force = x_bar
            own_torque += wp.cross(r, x_bar)
        moved.own_force[j] = own_force
        moved.own_torque[j] = own_torque
        moved.other_force[j] = other_force
        moved.other_torque[j] = other_torque
        moved.other_growth[j] = other_growth

    return ContactKernels(Kernels(look, look_tangent, look_adjoint), Kernels(push, push_tangent, push_adjoint))
