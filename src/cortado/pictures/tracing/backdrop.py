"""Warp functions for the surroundings of the fluid: lit surfaces, sky with lamps, floor, and glass container.

Coordinates are in picture axes with y upwards, and colours are linear.
"""

from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.pictures.tracing.near_particles import Floats, Ints, Vec2s, Vec3s, Vec3s2d


@wp.struct
class LitSurface:
    mesh: wp.uint64
    corners: Ints
    """Indices of the three vertices of each triangle, in one array (3 triangles,)."""
    normals: Vec3s
    """Outward unit normals at the vertices (points,)."""
    colours: Vec3s
    light: Vec3s
    """Light on each vertex (points,). The light 1 gives a white surface the brightness 1."""
    media: Vec2s
    """Scattering and absorption coefficients of the fluid at each vertex (points,) [1/m]."""
    is_flat: wp.int32
    reach: wp.float32
    """Greatest distance [m] to which the fluid's surface extends behind a container wall."""
    left: Vec2s
    """Fractions of light that a transparent triangle transmits from inside and from outside (triangles,)."""
    reflectivity: Floats
    """Mirror reflectivity of each triangle of an opaque solid (triangles,)."""
    from_edges: wp.array(dtype=wp.mat33)
    """Distances [m] of a triangle's corners (columns) from its sides (rows). For smooth sides the distance is `FAR`."""


@wp.func
def at_corners(surface: LitSurface, values: wp.array(dtype=Any), face: wp.int32, u: wp.float32, v: wp.float32):
    return (
        u * values[surface.corners[3 * face]]
        + v * values[surface.corners[3 * face + 1]]
        + (1.0 - u - v) * values[surface.corners[3 * face + 2]]
    )


@wp.func
def facing(normal: wp.vec3, face_normal: wp.vec3, d: wp.vec3):
    """Turn an interpolated ``normal`` against the direction ``d`` of a ray."""
    outside = face_normal
    n = normal
    if wp.dot(outside, d) > 0.0:
        outside = -outside
        n = -n
    cosine = wp.dot(n, d)
    if cosine > -0.02:
        n = n - (cosine + 0.02) * d
    return wp.normalize(n)


@wp.struct
class SurfaceHit:
    found: wp.bool
    is_solid: wp.bool
    t: wp.float32
    normal: wp.vec3
    """Normal that points against the ray."""
    colour: wp.vec3
    light: wp.vec3
    reflectivity: wp.float32
    face: wp.int32
    u: wp.float32
    v: wp.float32


@wp.func
def at_surface(surface: LitSurface, t: wp.float32, d: wp.vec3, face: wp.int32, u: wp.float32, v: wp.float32):
    i = surface.corners[3 * face]
    j = surface.corners[3 * face + 1]
    k = surface.corners[3 * face + 2]
    mesh = wp.mesh_get(surface.mesh)
    flat = wp.normalize(wp.cross(mesh.points[j] - mesh.points[i], mesh.points[k] - mesh.points[i]))
    met = SurfaceHit()
    met.found = True
    met.t = t
    met.normal = facing(at_corners(surface, surface.normals, face, u, v), flat, d)
    met.colour = at_corners(surface, surface.colours, face, u, v)
    met.light = at_corners(surface, surface.light, face, u, v)
    met.face = face
    met.u = u
    met.v = v
    return met


OPAQUE, CLEAR = wp.constant(0), wp.constant(1)
NO_GLASS, GLASS_BOX, GLASS_CYLINDER = 0, 1, 2
FAR = wp.constant(wp.float32(1.0e9))


def shading_module(has_opaque: bool, has_clear: bool) -> Any:
    return kernel_module("shading" + "_opaque" * has_opaque + "_clear" * has_clear)


@wp.struct
class Solids:
    opaque: wp.uint64
    are_cut: wp.int32
    clear: wp.uint64
    """Mesh of transparent solids and of tanks."""
    has_tank: wp.int32
    surfaces: wp.array(dtype=LitSurface)
    """The surface of all opaque solids, and the surface of all transparent solids."""


@wp.struct
class Environment:
    size: wp.float32
    """Greatest side of the box around the fluid and the container [m]."""
    nearest: wp.float32
    """Smallest distance [m] along a ray between the start and a hit."""
    segments: wp.int32
    sun: wp.vec3
    fill: wp.vec3
    """Unit vector towards a second, weak lamp."""
    lamp: wp.vec3
    strip: wp.vec3
    sunlight: wp.vec3
    horizon: wp.vec3
    zenith: wp.vec3
    has_floor: wp.int32
    floor_colour: wp.vec3
    floor_height: wp.float32
    floor_centre: wp.vec3
    grid: wp.float32
    """Distance between the lines on the floor [m], or 0 without lines."""
    shadow_corner: wp.vec3
    shadow_cell: wp.float32
    glass: wp.int32
    glass_frame: wp.mat33
    """Rotation from picture axes to container axes. The axis of a cylinder is the second container axis."""
    glass_lower: wp.vec3
    """Lower corner of the container in container axes [m]."""
    glass_upper: wp.vec3
    has_room: wp.int32
    room_lower: wp.vec3
    """Lower corner of the shown region in container axes [m], -FAR if the region is infinite."""
    room_upper: wp.vec3
    panes: wp.mat33
    """Mask of panes of glass, for lower and upper sides (rows 0 and 1) along each axis (columns)."""
    edge_colour: wp.vec3
    has_walls: wp.int32
    """True for an opaque container."""
    wall_colour: wp.vec3
    wall_reflectivity: wp.float32
    solids: Solids


@wp.func
def smooth_step(lower: wp.float32, upper: wp.float32, x: wp.float32):
    t = wp.clamp((x - lower) / (upper - lower), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def schlick(normal_reflectance: wp.float32, cosine: wp.float32):
    """Return the Fresnel reflectance in the approximation of Schlick (1994)."""
    m = wp.clamp(1.0 - cosine, 0.0, 1.0)
    m2 = m * m
    return normal_reflectance + (1.0 - normal_reflectance) * m2 * m2 * m


@wp.func
def mirrored(direction: wp.vec3, normal: wp.vec3):
    return direction - 2.0 * wp.dot(direction, normal) * normal


@wp.func
def sky(s: Environment, d: wp.vec3):
    base = wp.lerp(s.horizon, s.zenith, smooth_step(0.0, 0.9, d[1]))
    lamp = smooth_step(0.945, 0.985, wp.dot(d, s.sun))
    strip = smooth_step(0.90, 0.96, wp.dot(d, s.fill))
    return base + s.lamp * lamp + s.strip * strip


@wp.func
def open_light(s: Environment, normal: wp.vec3):
    return 0.35 * (s.horizon + s.zenith) + s.sunlight * wp.max(wp.dot(normal, s.sun), 0.0)


@wp.func
def shadow_at(s: Environment, shadow: Vec3s2d, x: wp.float32, z: wp.float32):
    """Return the fraction of light that reaches a point of the floor."""
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
    """Return 1 on the lines of a grid and 0 between the lines. Lines thinner than a pixel fade."""
    off = wp.abs(x / grid - wp.round(x / grid)) * grid
    return 1.0 - smooth_step(0.35 * width, width, off)


@wp.func
def floor(s: Environment, shadow: Vec3s2d, p: wp.vec3, footprint: wp.float32):
    """``footprint`` is the width of a pixel at the point ``p`` [m]."""
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
def open_background(s: Environment, shadow: Vec3s2d, o: wp.vec3, d: wp.vec3, spread: wp.float32):
    """``spread`` [m] is the width of a pixel at 1 m from the camera."""
    if s.has_floor > 0 and d[1] < -1.0e-4:
        t = (s.floor_height - o[1]) / d[1]
        if t > 0.0:
            slant = wp.max(-d[1], 0.05)
            return floor(s, shadow, o + t * d, spread * t / slant)
    return sky(s, wp.vec3(d[0], wp.max(d[1], 0.0), d[2]))


@wp.func
def between(lower: wp.float32, upper: wp.float32, o: wp.float32, d: wp.float32, span: wp.vec2):
    """Cut the interval ``span`` of a ray at two planes. ``o`` and ``d`` are components along the planes' normal."""
    if wp.abs(d) > 1.0e-9:
        t1 = (lower - o) / d
        t2 = (upper - o) / d
        return wp.vec2(wp.max(span[0], wp.min(t1, t2)), wp.min(span[1], wp.max(t1, t2)))
    if o < lower or o > upper:
        return wp.vec2(span[0], -FAR)
    return span


@wp.func
def within_tube(lower: wp.vec3, upper: wp.vec3, o: wp.vec3, d: wp.vec3):
    """Return the interval of a ray inside the upright cylinder of a box, or (FAR, -FAR) for a miss."""
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
    """Return the interval of a ray inside the container, or (FAR, -FAR) for a miss."""
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
    """Return the interval of a ray in which fluid is shown, or (FAR, -FAR) for a miss."""
    if s.has_room == 0:
        return wp.vec2(-FAR, FAR)
    return within_walls(s, o, d)


@wp.func
def nearest_side(s: Environment, q: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Return axis, side (-1 or 1) and distance of the flat container side nearest to ``q``, in container axes."""
    axis = wp.int32(0)
    side = wp.int32(-1)
    best = FAR
    for a in range(3):
        if s.glass == 1 or a == 1:
            low = wp.abs(q[a] - lower[a])
            high = wp.abs(q[a] - upper[a])
            if wp.min(low, high) < best:
                best = wp.min(low, high)
                axis = a
                side = wp.where(high < low, 1, -1)
    return axis, side, best


@wp.func
def wall_normal(s: Environment, p: wp.vec3):
    """Return the outward normal of the nearest container wall."""
    q = s.glass_frame * p
    axis, side, best = nearest_side(s, q, s.room_lower, s.room_upper)
    n = wp.vec3(0.0)
    n[axis] = float(side)
    if s.glass == 2:
        x = q[0] - 0.5 * (s.room_lower[0] + s.room_upper[0])
        z = q[2] - 0.5 * (s.room_lower[2] + s.room_upper[2])
        away = wp.sqrt(x * x + z * z)
        if wp.abs(away - 0.5 * (s.room_upper[0] - s.room_lower[0])) < best:
            n = wp.vec3(x / away, 0.0, z / away)
    return wp.transpose(s.glass_frame) * n


EDGE = (0.50, 0.62, 0.64)
GLASS_EDGE = wp.constant(wp.vec3(*EDGE))
MILKY = wp.constant(wp.float32(0.07))
"""Greatest reflectance of a pane of glass."""


@wp.struct
class Passed:
    """Light of the glass layers along a ray, and the fraction of light that passes through these layers."""

    light: wp.vec3
    through: wp.float32


@wp.func
def pane(
    s: Environment, d: wp.vec3, normal: wp.vec3, rim: wp.float32, is_pane: wp.float32, colour: wp.vec3, behind: Passed
):
    """Add a sheet of glass behind nearer sheets. ``rim`` is the visibility of the coloured edge, from 0 to 1."""
    cosine = wp.abs(wp.dot(d, normal))
    f = schlick(0.04, cosine)
    reflectance = is_pane * wp.min(1.4 * f / (1.0 + f), MILKY)
    r = mirrored(d, normal)
    seen = sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))
    seen = wp.vec3(wp.min(seen[0], 1.8), wp.min(seen[1], 1.8), wp.min(seen[2], 1.8))
    edge = colour * 0.75 + 0.25 * seen
    passed = Passed()
    passed.light = behind.light + behind.through * (rim * edge + (1.0 - rim) * reflectance * seen)
    passed.through = behind.through * (1.0 - rim) * (1.0 - reflectance) * (1.0 - 0.015 * is_pane)
    return passed


@wp.func
def rim_of(off: wp.float32, width: wp.float32):
    return 0.8 * (1.0 - smooth_step(0.55 * width, width, off))
