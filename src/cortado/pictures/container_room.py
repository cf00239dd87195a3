"""The room within a container, as Warp functions."""

import warp as wp

from cortado.pictures.surroundings import FAR, Environment


@wp.func
def between(lower: wp.float32, upper: wp.float32, o: wp.float32, d: wp.float32, span: wp.vec2):
    """The part of a ray's span, from where to where, between two planes across an axis; o and d along that axis."""
    if wp.abs(d) > 1.0e-9:
        t1 = (lower - o) / d
        t2 = (upper - o) / d
        return wp.vec2(wp.max(span[0], wp.min(t1, t2)), wp.min(span[1], wp.max(t1, t2)))
    if o < lower or o > upper:
        return wp.vec2(span[0], -FAR)
    return span


@wp.func
def within_tube(lower: wp.vec3, upper: wp.vec3, o: wp.vec3, d: wp.vec3):
    """From where to where a ray is within the upright cylinder, open at its ends, that a box holds; from FAR to -FAR
    where it is not."""
    radius = 0.5 * (upper[0] - lower[0])
    x = o[0] - 0.5 * (lower[0] + upper[0])
    z = o[2] - 0.5 * (lower[2] + upper[2])
    a = d[0] * d[0] + d[2] * d[2]
    b = x * d[0] + z * d[2]
    c = x * x + z * z - radius * radius
    if a <= 1.0e-12 and c <= 0.0:
        return wp.vec2(-FAR, FAR)
    discriminant = b * b - a * c
    if a <= 1.0e-12 or discriminant <= 0.0:
        return wp.vec2(FAR, -FAR)
    root = wp.sqrt(discriminant)
    return wp.vec2((-b - root) / a, (-b + root) / a)


@wp.func
def within_walls(s: Environment, o: wp.vec3, d: wp.vec3):
    """From where to where a ray is within the walls of the container; from FAR to -FAR where it is not."""
    p = s.glass_frame * o
    q = s.glass_frame * d
    span = wp.vec2(-FAR, FAR)
    if s.glass == 2:
        span = within_tube(s.room_lower, s.room_upper, p, q)
    for a in range(3):
        if s.glass == 1 or a == 1:
            span = between(s.room_lower[a], s.room_upper[a], p[a], q[a], span)
    if span[0] >= span[1]:
        return wp.vec2(FAR, -FAR)
    return span


@wp.func
def room(s: Environment, o: wp.vec3, d: wp.vec3):
    """From where to where on a ray fluid is shown; from FAR to -FAR where it is not."""
    if s.has_room == 0:
        return wp.vec2(-FAR, FAR)
    return within_walls(s, o, d)


@wp.func
def wall_normal(s: Environment, p: wp.vec3):
    """Outwards, of the wall that a point is on."""
    q = s.glass_frame * p
    n = wp.vec3(0.0)
    best = FAR
    for a in range(3):
        if s.glass == 1 or a == 1:
            low = wp.abs(q[a] - s.room_lower[a])
            high = wp.abs(q[a] - s.room_upper[a])
            if low < best:
                best = low
                n = wp.vec3(0.0)
                n[a] = -1.0
            if high < best:
                best = high
                n = wp.vec3(0.0)
                n[a] = 1.0
    if s.glass == 2:
        x = q[0] - 0.5 * (s.room_lower[0] + s.room_upper[0])
        z = q[2] - 0.5 * (s.room_lower[2] + s.room_upper[2])
        away = wp.sqrt(x * x + z * z)
        if wp.abs(away - 0.5 * (s.room_upper[0] - s.room_lower[0])) < best:
            n = wp.vec3(x / away, 0.0, z / away)
    return wp.transpose(s.glass_frame) * n
