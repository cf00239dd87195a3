"""What light does where no fluid is, as Warp functions: the sky with its lamps, the floor, and the container of glass.

All is in the frame of the picture: y points upwards. Colours are linear.
"""

import warp as wp

NO_GLASS, GLASS_BOX, GLASS_CYLINDER = 0, 1, 2
FAR = wp.constant(wp.float32(1.0e9))


@wp.struct
class Surroundings:
    """Everything around the fluid."""

    size: wp.float32
    """Of what is shown [m]: floor, grid and rims go by it."""
    nearest: wp.float32
    """How far a ray starts from the surface that sends it [m]."""
    sun: wp.vec3
    """Unit vector towards the lamp."""
    fill: wp.vec3
    """Unit vector towards a second, weak one, which is only seen in reflections."""
    horizon: wp.vec3
    zenith: wp.vec3
    has_floor: wp.int32
    floor_colour: wp.vec3
    floor_height: wp.float32
    """[m]"""
    floor_centre: wp.vec3
    """[m]; its height does not matter"""
    grid: wp.float32
    """Distance between the lines on the floor [m]; none if 0."""
    shadow_corner: wp.vec3
    """[m] where the first node of the shadow lies"""
    shadow_cell: wp.float32
    """Distance between its nodes [m]."""
    glass: wp.int32
    """NO_GLASS, GLASS_BOX or GLASS_CYLINDER, whose axis is the second of its own frame."""
    glass_frame: wp.mat33
    """From the frame of the picture to that of the container."""
    glass_lower: wp.vec3
    """[m] in its own frame"""
    glass_upper: wp.vec3
    """[m]"""
    has_room: wp.int32
    """Whether fluid is shown within the container only."""
    room_lower: wp.vec3
    """[m] in the frame of the container: where that ends; -FAR where it does not"""
    room_upper: wp.vec3
    """[m]"""
    panes: wp.mat33
    """1 where the container has a pane, 0 where it is open: rows for lower and upper ends, columns for axes."""


@wp.struct
class Passed:
    """What the glass on a way adds and leaves."""

    light: wp.vec3
    through: wp.float32


@wp.func
def smooth_step(lower: wp.float32, upper: wp.float32, x: wp.float32):
    t = wp.clamp((x - lower) / (upper - lower), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def schlick(normal_reflectance: wp.float32, cosine: wp.float32):
    """Fresnel's reflectance, as Schlick (1994) approximates it."""
    m = wp.clamp(1.0 - cosine, 0.0, 1.0)
    m2 = m * m
    return normal_reflectance + (1.0 - normal_reflectance) * m2 * m2 * m


@wp.func
def mirrored(direction: wp.vec3, normal: wp.vec3):
    return direction - 2.0 * wp.dot(direction, normal) * normal


@wp.func
def sky(s: Surroundings, d: wp.vec3):
    """Light from a direction above the floor: a gradient, a soft lamp, and a strip of light on the other side."""
    base = wp.lerp(s.horizon, s.zenith, smooth_step(0.0, 0.9, d[1]))
    lamp = smooth_step(0.945, 0.985, wp.dot(d, s.sun))
    strip = smooth_step(0.90, 0.96, wp.dot(d, s.fill))
    return base + wp.vec3(7.0, 6.8, 6.4) * lamp + wp.vec3(1.6, 1.7, 1.8) * strip


@wp.func
def shadow_at(s: Surroundings, shadow: wp.array2d(dtype=wp.vec3), x: wp.float32, z: wp.float32):
    """The part of the light that reaches a place of the floor, interpolated between nodes; all of it elsewhere."""
    u = (x - s.shadow_corner[0]) / s.shadow_cell
    v = (z - s.shadow_corner[2]) / s.shadow_cell
    i = wp.int32(wp.floor(u))
    j = wp.int32(wp.floor(v))
    if i < 0 or j < 0 or i + 1 >= shadow.shape[0] or j + 1 >= shadow.shape[1]:
        return wp.vec3(1.0)
    a = u - wp.float32(i)
    b = v - wp.float32(j)
    low = wp.lerp(shadow[i, j], shadow[i + 1, j], a)
    high = wp.lerp(shadow[i, j + 1], shadow[i + 1, j + 1], a)
    return wp.lerp(low, high, b)


@wp.func
def line(x: wp.float32, grid: wp.float32, width: wp.float32):
    """1 on the lines of a grid, 0 between them; thinner than a pixel they fade."""
    off = wp.abs(x / grid - wp.round(x / grid)) * grid
    return 1.0 - smooth_step(0.35 * width, width, off)


@wp.func
def floor(s: Surroundings, shadow: wp.array2d(dtype=wp.vec3), p: wp.vec3, footprint: wp.float32):
    """The floor at p, which becomes the horizon further out; ``footprint``: the width of a pixel there [m]."""
    colour = s.floor_colour
    if s.grid > 0.0:
        thin = 0.0035 * s.size
        width = wp.max(thin, 1.5 * footprint)
        ink = wp.max(line(p[0] - s.floor_centre[0], s.grid, width), line(p[2] - s.floor_centre[2], s.grid, width))
        colour = colour * (1.0 - 0.10 * ink * thin / width)
    lit = wp.cw_mul(colour, shadow_at(s, shadow, p[0], p[2]))
    away = wp.length(wp.vec2(p[0] - s.floor_centre[0], p[2] - s.floor_centre[2])) / s.size
    return wp.lerp(lit, s.horizon, smooth_step(0.9, 3.2, away))


@wp.func
def open_background(s: Surroundings, shadow: wp.array2d(dtype=wp.vec3), o: wp.vec3, d: wp.vec3, spread: wp.float32):
    """What a ray sees that meets neither fluid nor glass; ``spread``: the width of a pixel at 1 m [m]."""
    if s.has_floor > 0 and d[1] < -1.0e-4:
        t = (s.floor_height - o[1]) / d[1]
        if t > 0.0:
            slant = wp.max(-d[1], 0.05)
            return floor(s, shadow, o + t * d, spread * t / slant)
    return sky(s, wp.vec3(d[0], wp.max(d[1], 0.0), d[2]))


@wp.func
def pane(s: Surroundings, d: wp.vec3, normal: wp.vec3, rim: wp.float32, is_pane: wp.float32, behind: Passed):
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
def box_pane(s: Surroundings, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
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
    s: Surroundings,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    enter = -FAR
    leave = FAR
    for a in range(3):
        if wp.abs(d[a]) > 1.0e-9:
            t1 = (s.glass_lower[a] - o[a]) / d[a]
            t2 = (s.glass_upper[a] - o[a]) / d[a]
            enter = wp.max(enter, wp.min(t1, t2))
            leave = wp.min(leave, wp.max(t1, t2))
        elif o[a] < s.glass_lower[a] or o[a] > s.glass_upper[a]:
            leave = -FAR
    passed = before
    if enter < leave:
        if enter > least and enter < most:
            passed = box_pane(s, o, d, world, enter, wp.max(0.006 * s.size, 1.2 * spread * enter), passed)
        if leave > least and leave < most:
            passed = box_pane(s, o, d, world, leave, wp.max(0.006 * s.size, 1.2 * spread * leave), passed)
    return passed


@wp.func
def tube(s: Surroundings, o: wp.vec3, d: wp.vec3, world: wp.vec3, t: wp.float32, width: wp.float32, before: Passed):
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
    s: Surroundings,
    o: wp.vec3,
    d: wp.vec3,
    world: wp.vec3,
    least: wp.float32,
    most: wp.float32,
    spread: wp.float32,
    before: Passed,
):
    radius = 0.5 * (s.glass_upper[0] - s.glass_lower[0])
    ox = o[0] - 0.5 * (s.glass_lower[0] + s.glass_upper[0])
    oz = o[2] - 0.5 * (s.glass_lower[2] + s.glass_upper[2])
    a = d[0] * d[0] + d[2] * d[2]
    b = ox * d[0] + oz * d[2]
    c = ox * ox + oz * oz - radius * radius
    discriminant = b * b - a * c
    passed = before
    if a > 1.0e-12 and discriminant > 0.0:
        root = wp.sqrt(discriminant)
        t1 = (-b - root) / a
        t2 = (-b + root) / a
        if t1 > least and t1 < most:
            passed = tube(s, o, d, world, t1, wp.max(0.010 * s.size, 1.2 * spread * t1), passed)
        if t2 > least and t2 < most:
            passed = tube(s, o, d, world, t2, wp.max(0.010 * s.size, 1.2 * spread * t2), passed)
    return passed


@wp.func
def glass(s: Surroundings, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32):
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
def background(s: Surroundings, shadow: wp.array2d(dtype=wp.vec3), o: wp.vec3, d: wp.vec3, spread: wp.float32):
    """What a ray sees that meets no fluid."""
    most = FAR
    if s.has_floor > 0 and d[1] < -1.0e-4:
        most = wp.max((s.floor_height - o[1]) / d[1], 0.0)
    passed = glass(s, o, d, most, spread)
    return passed.light + passed.through * open_background(s, shadow, o, d, spread)


@wp.func
def room(s: Surroundings, o: wp.vec3, d: wp.vec3):
    """From where to where on a ray fluid is shown; from FAR to -FAR where it is not."""
    enter = -FAR
    leave = FAR
    if s.has_room == 0:
        return wp.vec2(enter, leave)
    p = s.glass_frame * o
    q = s.glass_frame * d
    for a in range(3):
        if s.glass == 1 or a == 1:
            if wp.abs(q[a]) > 1.0e-9:
                t1 = (s.room_lower[a] - p[a]) / q[a]
                t2 = (s.room_upper[a] - p[a]) / q[a]
                enter = wp.max(enter, wp.min(t1, t2))
                leave = wp.min(leave, wp.max(t1, t2))
            elif p[a] < s.room_lower[a] or p[a] > s.room_upper[a]:
                leave = -FAR
    if s.glass == 2:
        radius = 0.5 * (s.room_upper[0] - s.room_lower[0])
        x = p[0] - 0.5 * (s.room_lower[0] + s.room_upper[0])
        z = p[2] - 0.5 * (s.room_lower[2] + s.room_upper[2])
        a2 = q[0] * q[0] + q[2] * q[2]
        b = x * q[0] + z * q[2]
        c = x * x + z * z - radius * radius
        discriminant = b * b - a2 * c
        if a2 > 1.0e-12:
            if discriminant > 0.0:
                root = wp.sqrt(discriminant)
                enter = wp.max(enter, (-b - root) / a2)
                leave = wp.min(leave, (-b + root) / a2)
            if discriminant <= 0.0:
                leave = -FAR
        if a2 <= 1.0e-12 and c > 0.0:
            leave = -FAR
    if enter >= leave:
        return wp.vec2(FAR, -FAR)
    return wp.vec2(enter, leave)


@wp.func
def wall_normal(s: Surroundings, p: wp.vec3):
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
