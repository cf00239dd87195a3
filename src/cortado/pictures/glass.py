"""The container of glass, as Warp functions: what it adds to the light on a ray and takes away, and the room within."""

import warp as wp

from cortado.pictures.surroundings import FAR, Environment, mirrored, open_background, schlick, sky, smooth_step


@wp.struct
class Passed:
    """What the glass on a way adds and leaves."""

    light: wp.vec3
    through: wp.float32


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
def pane(s: Environment, d: wp.vec3, normal: wp.vec3, rim: wp.float32, is_pane: wp.float32, behind: Passed):
    """One more sheet of glass, behind what is passed already; ``rim``: how much of its edge is seen, 0 to 1."""
    cosine = wp.abs(wp.dot(d, normal))
    f = schlick(0.04, cosine)
    reflectance = 0.7 * is_pane * 2.0 * f / (1.0 + f)
    r = mirrored(d, normal)
    seen = sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))
    seen = wp.vec3(wp.min(seen[0], 1.8), wp.min(seen[1], 1.8), wp.min(seen[2], 1.8))
    edge = wp.vec3(0.50, 0.62, 0.64) * 0.75 + 0.25 * seen
    light = behind.light + behind.through * (rim * edge + (1.0 - rim) * reflectance * seen)
    passed = Passed()
    passed.light = light
    passed.through = behind.through * (1.0 - rim) * (1.0 - reflectance) * (1.0 - 0.015 * is_pane)
    return passed


@wp.func
def rim_of(off: wp.float32, width: wp.float32):
    """How much of an edge is seen at a distance from it."""
    return 0.8 * (1.0 - smooth_step(0.55 * width, width, off))


@wp.func
def box_pane(s: Environment, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
    """The side of the box where a ray, o and d in its own frame, passes at t."""
    q = o + t * d
    axis = wp.int32(0)
    best = FAR
    side = wp.int32(0)
    for a in range(3):
        low = wp.abs(q[a] - s.glass_lower[a])
        high = wp.abs(q[a] - s.glass_upper[a])
        if low < best:
            best = low
            axis = a
            side = 0
        if high < best:
            best = high
            axis = a
            side = 1
    off = FAR
    for a in range(3):
        if a != axis:
            off = wp.min(off, wp.min(q[a] - s.glass_lower[a], s.glass_upper[a] - q[a]))
    n = wp.vec3(0.0)
    n[axis] = 1.0
    return pane(s, world, wp.transpose(s.glass_frame) * n, rim_of(off, width), s.panes[side, axis], before)


@wp.func
def box_glass(
    s: Environment,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    span = wp.vec2(-FAR, FAR)
    for a in range(3):
        span = between(s.glass_lower[a], s.glass_upper[a], o[a], d[a], span)
    enter = span[0]
    leave = span[1]
    passed = before
    if enter < leave:
        if enter > least and enter < most:
            passed = box_pane(s, o, d, world, enter, wp.max(0.006 * s.size, 1.2 * spread * enter), passed)
        if leave > least and leave < most:
            passed = box_pane(s, o, d, world, leave, wp.max(0.006 * s.size, 1.2 * spread * leave), passed)
    return passed


@wp.func
def tube(s: Environment, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
    """The side of the cylinder where a ray passes at t; nothing above and below it."""
    q = o + t * d
    if q[1] < s.glass_lower[1] or q[1] > s.glass_upper[1]:
        return before
    x = 0.5 * (s.glass_lower[0] + s.glass_upper[0])
    z = 0.5 * (s.glass_lower[2] + s.glass_upper[2])
    n = wp.normalize(wp.vec3(q[0] - x, 0.0, q[2] - z))
    off = wp.min(q[1] - s.glass_lower[1], s.glass_upper[1] - q[1])
    return pane(s, world, wp.transpose(s.glass_frame) * n, rim_of(off, width), 1.0, before)


@wp.func
def cylinder_glass(
    s: Environment,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    span = within_tube(s.glass_lower, s.glass_upper, o, d)
    t1 = span[0]
    t2 = span[1]
    passed = before
    if t1 > least and t1 < most:
        passed = tube(s, o, d, world, t1, wp.max(0.010 * s.size, 1.2 * spread * t1), passed)
    if t2 > least and t2 < most:
        passed = tube(s, o, d, world, t2, wp.max(0.010 * s.size, 1.2 * spread * t2), passed)
    return passed


@wp.func
def glass(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32):
    """The glass that a ray passes up to the distance ``most`` [m]."""
    nothing = Passed()
    nothing.light = wp.vec3(0.0)
    nothing.through = 1.0
    own_o = s.glass_frame * o
    own_d = s.glass_frame * d
    if s.glass == 1:
        return box_glass(s, own_o, own_d, d, s.nearest, most, spread, nothing)
    if s.glass == 2:
        return cylinder_glass(s, own_o, own_d, d, s.nearest, most, spread, nothing)
    return nothing


@wp.func
def background(s: Environment, shadow: wp.array2d(dtype=wp.vec3), o: wp.vec3, d: wp.vec3, spread: wp.float32):
    """What a ray sees that meets no fluid."""
    most = FAR
    if s.has_floor > 0 and d[1] < -1.0e-4:
        most = wp.max((s.floor_height - o[1]) / d[1], 0.0)
    passed = glass(s, o, d, most, spread)
    return passed.light + passed.through * open_background(s, shadow, o, d, spread)


@wp.func
def room(s: Environment, o: wp.vec3, d: wp.vec3):
    """From where to where on a ray fluid is shown; from FAR to -FAR where it is not."""
    if s.has_room == 0:
        return wp.vec2(-FAR, FAR)
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
