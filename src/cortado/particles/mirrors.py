"""Flat walls that act on fluid by mirror images of the particles instead of by wall particles.

The mirror image of a particle at x is at R x + o. The matrix R and the vector o define a reflection at a flat wall, or
at two or three adjacent sides of the container. The sides of the container have the numbers 1, 2, 4 at the lower ends
of the axes, and 8, 16, 32 at the upper ends. The number of a reflection is the sum of its sides' numbers. Reflections
at flat faces of moving solids have numbers from `FACES` on.

In lists of neighbours, an image of particle j has the number ``reflections j + reflection``. Here ``reflection`` is the
number of the reflection, and ``reflections`` is the count of all reflections. A wall mirrors only particles in front of
the wall.

If a solid moves, the velocity of an image also depends on ``swept``, the displacement of the mirror in the time step.
Tangents and adjoints of images include derivatives with respect to the pose of the solid (`MovingWalls`).
"""

from typing import Any

import warp as wp

from cortado.device.modules import by_name
from cortado.device.precision import Precision

FACES, MOST_FACES = 64, 64
"""Reflection number of the first flat face of the moving solids, and greatest number of such faces."""
NUMBERS = 2**31
CONTAINER = -1
NOTHING = ALL_WALLS = -NUMBERS
"""Values of ``solid`` that stand for no solid and for all walls, instead of the number of a solid."""


def reflections(moving: bool) -> int:
    return FACES + MOST_FACES * moving


def most_imaged(moving: bool) -> int:
    return (NUMBERS - 1) // reflections(moving)


OVER_IMAGES = """\
    _member = i // s.particles
    for _place in range(s.count[i] + _lane(), s.all_count[i], _LANES):
        _image = _neighbour(_place, i, s)
        _j, _one = _image // _REFLECTIONS, _image % _REFLECTIONS
        _R, _offset = _reflection(_one, _member, s)
        _x_ij = _separation(_x_i, _turned(_R, x[_j]) + _offset, s)
        {body}
"""
OF_IMAGES = {
    "direct": "_separation(_x_i, x[_j], s)",
    "direct_dot": "_x_dot_i - x_dot[_j]",
    "swept": "_swept(_one, x[_j], _member, s)",
    "swept_dot": "_swept_dot(_one, x[_j], x_dot[_j], _member, s)",
}
OWNED = "wp.where(_mirrors_by(_one, solid, s), _real(1.0), _real(0.0))"


def mirror_functions(precision: Precision, moving: bool, neighbourhood: Any) -> dict[str, Any]:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    turning = matrix if moving else vector

    @wp.func
    def near_mirrors(x: vector, s: neighbourhood) -> int:
        found = int(0)
        for axis in range(3):
            if x[axis] - s.mirror_lower[axis] < s.reach:
                found = found | (1 << axis)
            if s.mirror_upper[axis] - x[axis] < s.reach:
                found = found | (8 << axis)
        return found

    @wp.func
    def before_mirrors(x: vector, s: neighbourhood) -> int:
        found = int(0)
        for axis in range(3):
            if x[axis] >= s.mirror_lower[axis]:
                found = found | (1 << axis)
            if x[axis] <= s.mirror_upper[axis]:
                found = found | (8 << axis)
        return found

    @wp.func
    def reflects(bits: int, near: int) -> bool:
        return (bits & near) == bits and (bits & (bits >> 3)) == 0

    @wp.func
    def side_reflection(bits: int, s: neighbourhood):
        flip, offset = vector(real(1.0), real(1.0), real(1.0)), vector()
        for axis in range(3):
            lower, upper = (bits >> axis) & 1, (bits >> (axis + 3)) & 1
            if lower + upper == 1:
                flip[axis] = real(-1.0)
                offset[axis] = real(2.0) * wp.where(lower == 1, s.mirror_lower[axis], s.mirror_upper[axis])
        return flip, offset

    @wp.func
    def sides(x: vector, s: neighbourhood) -> int:
        return near_mirrors(x, s) & before_mirrors(x, s)

    @wp.func
    def place_at(x: vector, f: int, member: int, s: neighbourhood) -> vector:
        k = s.face_solids[f]
        own = wp.transpose(s.turns[member, k]) * (x - s.after[member, k])
        return s.face_frames[f] * (own - s.scales[member, k] * s.face_places[f])

    @wp.func
    def before_face(x: vector, f: int, furthest: real, member: int, s: neighbourhood) -> bool:
        at, sizes = place_at(x, f, member, s), s.scales[member, s.face_solids[f]] * s.face_sizes[f]
        beside = wp.abs(at[1]) < sizes[1] and wp.abs(at[2]) < sizes[2]
        return at[0] >= real(0.0) and at[0] < furthest and beside

    @wp.func
    def face_reflection(f: int, member: int, s: neighbourhood):
        k = s.face_solids[f]
        n = s.turns[member, k] * s.face_frames[f][0]
        p = s.after[member, k] + s.scales[member, k] * (s.turns[member, k] * s.face_places[f])
        unit = wp.diag(vector(real(1.0), real(1.0), real(1.0)))
        return unit - real(2.0) * wp.outer(n, n), (real(2.0) * wp.dot(n, p)) * n

    @wp.func
    def sees(one: int, near: int, x: vector, member: int, s: neighbourhood) -> bool:
        if wp.static(moving):  # noqa: SIM102, as Warp leaves out what is constant and false
            if one >= FACES:
                return before_face(x, one - FACES, s.reach, member, s)
        return reflects(one, near)

    @wp.func
    def shows(one: int, x: vector, member: int, s: neighbourhood) -> bool:
        if wp.static(moving):  # noqa: SIM102
            if one >= FACES:
                return before_face(x, one - FACES, real(1e30), member, s)
        return reflects(one, before_mirrors(x, s))

    @wp.func
    def last_reflection(near: int, x: vector, member: int, s: neighbourhood) -> int:
        last = int(near)
        if wp.static(moving):
            for f in range(s.faces):
                if before_face(x, f, s.reach, member, s):
                    last = FACES + f
        return last

    @wp.func
    def reflection(one: int, member: int, s: neighbourhood):
        if wp.static(moving):
            if one < FACES:
                flip, shift = side_reflection(one, s)
                return wp.diag(flip), shift
            R, offset = face_reflection(one - FACES, member, s)
            return R, offset
        else:
            flip, offset = side_reflection(one, s)
            return flip, offset

    @wp.func
    def turned(R: turning, a: vector) -> vector:
        if wp.static(moving):
            return R * a
        else:
            return wp.cw_mul(R, a)

    @wp.func
    def mirror_of(x: vector, member: int, s: neighbourhood) -> int:
        if wp.static(not moving):
            return wp.where(near_mirrors(x, s) > 0, CONTAINER, NOTHING)
        found, face, nearest = wp.where(near_mirrors(x, s) > 0, 1, 0), int(0), real(s.reach)
        for f in range(s.faces):
            if before_face(x, f, nearest, member, s):
                nearest = place_at(x, f, member, s)[0]
                face = f + 1
        return found + 2 * face

    @wp.func
    def mirrors_in(b: int, mirrors: int, s: neighbourhood) -> bool:
        if wp.static(not moving):
            return s.wall_solids[b] == mirrors
        if s.wall_solids[b] == CONTAINER:
            return (mirrors & 1) == 1
        return mirrors > 1 and s.wall_faces[b] + 1 == mirrors // 2

    @wp.func
    def carried(x: vector, k: int, member: int, s: neighbourhood) -> vector:
        back = s.turns_before[member, k] * (wp.transpose(s.turns[member, k]) * (x - s.after[member, k]))
        return x - s.before[member, k] - back

    @wp.func
    def swept(one: int, x: vector, member: int, s: neighbourhood) -> vector:
        found = vector()
        if one >= FACES:
            k = s.face_solids[one - FACES]
            R, offset = face_reflection(one - FACES, member, s)
            found = carried(R * x + offset, k, member, s) - R * carried(x, k, member, s)
        return found

    @wp.func
    def twist(x: vector, k: int, member: int, s: neighbourhood) -> vector:
        arm = x - s.after[member, k]
        grown = s.scales_dot[member, k] / s.scales[member, k]
        return s.after_dot[member, k] + wp.cross(s.turned_dot[member, k], arm) + grown * arm

    @wp.func
    def image_dot(one: int, x: vector, x_dot: vector, member: int, s: neighbourhood) -> vector:
        R, offset = reflection(one, member, s)
        found = R * x_dot
        if one >= FACES:
            k = s.face_solids[one - FACES]
            found += twist(R * x + offset, k, member, s) - R * twist(x, k, member, s)
        return found

    @wp.func
    def turned_dot(one: int, a: vector, a_dot: vector, member: int, s: neighbourhood) -> vector:
        R, _offset = reflection(one, member, s)
        found = R * a_dot
        if one >= FACES:
            w = s.turned_dot[member, s.face_solids[one - FACES]]
            found += wp.cross(w, R * a) - R * wp.cross(w, a)
        return found

    @wp.func
    def carried_dot(x: vector, x_dot: vector, k: int, member: int, s: neighbourhood) -> vector:
        Q, w = s.turns_before[member, k] * wp.transpose(s.turns[member, k]), s.turned_dot[member, k]
        arm = x - s.after[member, k]
        found = x_dot - s.before_dot[member, k] - wp.cross(s.turned_before_dot[member, k], Q * arm)
        return found - Q * (x_dot - s.after_dot[member, k] - wp.cross(w, arm))

    @wp.func
    def swept_dot(one: int, x: vector, x_dot: vector, member: int, s: neighbourhood) -> vector:
        found = vector()
        if one >= FACES:
            k = s.face_solids[one - FACES]
            R, offset = face_reflection(one - FACES, member, s)
            end_dot = image_dot(one, x, x_dot, member, s)
            found = carried_dot(R * x + offset, end_dot, k, member, s)
            found -= turned_dot(one, carried(x, k, member, s), carried_dot(x, x_dot, k, member, s), member, s)
        return found

    @wp.func
    def mirrors_by(one: int, solid: int, s: neighbourhood) -> bool:
        if wp.static(moving):  # noqa: SIM102
            if one >= FACES:
                return solid == ALL_WALLS or s.face_solids[one - FACES] == solid
        return solid == ALL_WALLS

    own = (sides, sees, shows, last_reflection, reflection, turned, mirror_of, mirrors_in, mirrors_by)
    return vars(by_name(*own, *((swept, image_dot, turned_dot, swept_dot) if moving else ())))
