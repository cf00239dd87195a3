"""Which particles are lost: outside of their container or in a solid, too far away, or not finite."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of

NO_PARTICLE = 2**31 - 1
"""What stands for 'every particle is well' where the first bad one would be named."""


@cache
def bounds_type(precision: Precision) -> Any:
    """The Warp struct of a `Region`, a tolerance included, and of how far particles may go."""
    real, vector = precision.real, precision.vector

    class Bounds:
        lower: vector
        upper: vector
        base: vector
        across: vector
        up: vector
        """Along the axis of an open cup; 0 where there is none."""
        radius: real
        rim: real
        nearest: vector
        """The corners of the box in which positions are precise enough."""
        furthest: vector

    Bounds.__name__ = Bounds.__qualname__ = f"Bounds_{precision.name}"
    return wp.struct(Bounds)


@cache
def solids_type(precision: Precision) -> Any:
    """The Warp struct of solids, as meshes about their middles."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)

    class Solids:
        meshes: wp.array(dtype=wp.uint64)
        still: wp.int32
        """How many do not move; the others come after them."""
        middles: wp.array(dtype=vector)
        """About which meshes are, of those at rest in space, of others in their own frame [m]."""
        before: wp.array2d(dtype=vector)
        """(members, solids) where the middles of those that move are before a step [m]."""
        turns_before: wp.array2d(dtype=matrix)
        after: wp.array2d(dtype=vector)
        turns: wp.array2d(dtype=matrix)
        scales: wp.array2d(dtype=real)
        """(members, solids) how many times as large as their meshes they are."""
        sides: wp.array(dtype=real)
        """1 where fluid is outside of a mesh, -1 where it is inside."""
        tolerances: wp.array(dtype=real)
        """How deep in a solid a particle may be [m]."""
        reach: wp.float32
        """How far from a surface one is looked for [m]."""
        period: vector
        """[m], 0 along an axis that is not periodic."""
        frequency: vector
        """1 / period [1 / m], or 0."""

    Solids.__name__ = Solids.__qualname__ = f"Solids_{precision.name}"
    return wp.struct(Solids)


@cache
def lost_kernel(precision: Precision) -> Any:
    """The kernel that looks for particles that were lost in a step."""
    real, vector = precision.real, precision.vector
    bounds_struct, solids_struct, matrix = bounds_type(precision), solids_type(precision), matrix_of(precision)
    module = kernel_module(f"containment_{precision.name}")

    @wp.func
    def between(x: vector, lower: vector, upper: vector) -> bool:
        """False for what is not a number, too."""
        return (
            x[0] >= lower[0]
            and x[1] >= lower[1]
            and x[2] >= lower[2]
            and x[0] <= upper[0]
            and x[1] <= upper[1]
            and x[2] <= upper[2]
        )

    @wp.func
    def contains(x: vector, b: bounds_struct) -> bool:
        return between(x, b.lower, b.upper) and wp.length(wp.cw_mul(x - b.base, b.across)) <= b.radius

    @wp.func
    def nearest_image(y: vector, solids: solids_struct) -> vector:
        turns = wp.cw_mul(y, solids.frequency)
        return y - wp.cw_mul(vector(wp.round(turns[0]), wp.round(turns[1]), wp.round(turns[2])), solids.period)

    @wp.func
    def scale_of(k: int, member: int, solids: solids_struct) -> real:
        scale = real(1.0)
        if k >= solids.still:
            scale = solids.scales[member, k - solids.still]
        return scale

    @wp.func
    def seen_from(
        x: vector,
        k: int,
        member: int,
        positions: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        solids: solids_struct,
    ) -> vector:
        """Where x is for the mesh of solid k."""
        if k < solids.still:
            return nearest_image(x - solids.middles[k], solids)
        away = nearest_image(x - positions[member, k - solids.still], solids)
        return wp.transpose(turns[member, k - solids.still]) * away / scale_of(k, member, solids) - solids.middles[k]

    @wp.func
    def is_deep(y: vector, k: int, scale: real, solids: solids_struct) -> bool:
        """Whether a place of the mesh of solid k is deeper in the solid than it may be; what is far from the surface is
        not."""
        place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
        found = wp.mesh_query_point_sign_winding_number(solids.meshes[k], place, solids.reach)
        depth = real(0.0)
        if found.result:
            surface = wp.mesh_eval_position(solids.meshes[k], found.face, found.u, found.v)
            depth = -real(found.sign) * solids.sides[k] * scale * real(wp.length(place - surface))
        return depth > solids.tolerances[k]

    @wp.func
    def is_free(x: vector, member: int, solids: solids_struct) -> bool:
        """Whether x was not deep in any solid before the step."""
        for k in range(solids.meshes.shape[0]):
            y = seen_from(x, k, member, solids.before, solids.turns_before, solids)
            if is_deep(y, k, scale_of(k, member, solids), solids):
                return False
        return True

    @wp.func
    def has_entered(before: vector, x: vector, member: int, solids: solids_struct) -> bool:
        """Whether x is deep in a solid, and was not in any before the step. Depths change by no more than the way that
        was gone, so that what is further from the surface than that and the tolerance need not be looked at: which side
        it is on takes long to find out."""
        for k in range(solids.meshes.shape[0]):
            y = seen_from(x, k, member, solids.after, solids.turns, solids)
            gone = wp.length(y - seen_from(before, k, member, solids.before, solids.turns_before, solids))
            scale = scale_of(k, member, solids)
            furthest = wp.float32(real(1.001) * (solids.tolerances[k] / scale + gone))
            place = wp.vec3f(wp.float32(y[0]), wp.float32(y[1]), wp.float32(y[2]))
            found = wp.mesh_query_point_no_sign(solids.meshes[k], place, wp.min(furthest, solids.reach))
            if found.result:
                surface = wp.mesh_eval_position(solids.meshes[k], found.face, found.u, found.v)
                if scale * real(wp.length(place - surface)) > solids.tolerances[k]:  # noqa: SIM102, as Warp reads both
                    if is_deep(y, k, scale, solids):
                        return is_free(before, member, solids)
        return False

    @wp.func
    def below_rim(x: vector, b: bounds_struct) -> bool:
        return wp.dot(x, b.up) < b.rim

    @wp.kernel(module=module, enable_backward=False)
    def find_lost(
        bounds: bounds_struct,
        solids: solids_struct,
        particles: int,
        first_waiting: int,
        order: wp.array(dtype=wp.int32),
        x_before: wp.array(dtype=vector),
        rho_0: wp.array(dtype=real),
        x_free: wp.array(dtype=vector),
        v_free: wp.array(dtype=vector),
        x: wp.array(dtype=vector),
        bad_step: wp.array(dtype=wp.int32),
        # in and out
        bad: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
    ):
        """``bad``: the first particle of a scene, in its order, that is lost; ``count``: how many are. After a bad step
        nothing is looked for.

        Lost is what is not finite, too far away, of a mixture without a volume, or what went through a wall: it was
        inside before the step and is outside after it, or it is in a solid then. Over the rim of an open cup fluid may
        go, and what a nozzle leads, so that it is not where it would be without one, passes walls with it: such are
        only among the particles from ``first_waiting`` on, in scene order. ``x`` is the new state in that order; the
        others are sorted, and ``x_free`` and ``v_free`` are the new state without the nozzle.
        """
        i = wp.tid()
        member = i // particles
        if bad_step[member] >= 0:
            return
        p = order[i] - member * particles
        x_i = x_free[i]
        let_go = bool(True)
        if p >= first_waiting:
            let_go = x[order[i]] == x_i
            x_i = x[order[i]]
        before = x_before[i]
        good = between(x_i, bounds.nearest, bounds.furthest) and wp.isfinite(v_free[i]) and rho_0[i] > real(0.0)
        escaped = (
            let_go
            and contains(before, bounds)
            and not contains(x_i, bounds)
            and below_rim(before, bounds)
            and below_rim(x_i, bounds)
        )
        entered = bool(False)
        if let_go and good:
            entered = has_entered(before, x_i, member, solids)
        if escaped or entered or not good:
            wp.atomic_min(bad, member, p)
            wp.atomic_add(count, member, 1)

    return find_lost
