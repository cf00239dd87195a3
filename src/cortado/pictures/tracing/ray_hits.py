"""Warp functions that find the first hit of a ray on solids, walls, glass, and the surface of the fluid."""

from functools import cache
from typing import Any

import warp as wp

from cortado.pictures.tracing.backdrop import (
    CLEAR,
    FAR,
    GLASS_EDGE,
    OPAQUE,
    Environment,
    LitSurface,
    Passed,
    SurfaceHit,
    at_surface,
    between,
    mirrored,
    nearest_side,
    open_background,
    open_light,
    pane,
    rim_of,
    room,
    schlick,
    sky,
    smooth_step,
    wall_normal,
    within_tube,
    within_walls,
)
from cortado.pictures.tracing.near_particles import Vec3s2d

LAYERS = 8
"""Greatest number of transparent surfaces along a ray."""


@wp.struct
class SolidHit:
    t: wp.float32
    """Distance along the ray, or FAR without a hit."""
    is_cut: wp.bool
    """True if the ray hits the plane at which a container wall cuts a solid."""
    face: wp.int32
    u: wp.float32
    v: wp.float32


@wp.func
def reach_solid(s: Environment, o: wp.vec3, d: wp.vec3):
    met = SolidHit()
    met.t = FAR
    part = wp.vec2(-FAR, FAR)
    if s.solids.are_cut > 0:
        part = within_walls(s, o, d)
    start = wp.max(part[0] - s.nearest, 0.0)  # a side that lies in a wall is seen
    if part[1] <= start:
        return met
    hit = wp.mesh_query_ray(s.solids.opaque, o + start * d, d, FAR)
    if not hit.result:
        return met
    met.is_cut = hit.sign < 0.0 and part[0] > 0.0
    if met.is_cut:
        met.t = part[0]
    elif start + hit.t <= part[1] - 2.0 * s.nearest:
        met.t = start + hit.t
    met.face = hit.face
    met.u = hit.u
    met.v = hit.v
    return met


@wp.func
def meet_solid(s: Environment, o: wp.vec3, d: wp.vec3):
    reached = reach_solid(s, o, d)
    met = SurfaceHit()
    met.t = FAR
    if reached.t >= FAR:
        return met
    met = at_surface(s.solids.surfaces[OPAQUE], reached.t, d, reached.face, reached.u, reached.v)
    met.is_solid = True
    met.reflectivity = s.solids.surfaces[OPAQUE].reflectivity[reached.face]
    if reached.is_cut:
        n = wall_normal(s, o + reached.t * d)
        met.normal = wp.where(wp.dot(n, d) > 0.0, -n, n)
        met.light = open_light(s, met.normal)
    return met


@wp.func
def shaded_solid(s: Environment, met: SurfaceHit, d: wp.vec3, glossy: wp.float32):
    """Return the light that a solid sends back along a ray. Inside fluid, ``glossy`` is 0."""
    r = mirrored(d, met.normal)
    seen = sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))
    seen = wp.vec3(wp.min(seen[0], 1.8), wp.min(seen[1], 1.8), wp.min(seen[2], 1.8))
    reflectance = 0.6 * glossy * schlick(0.04, -wp.dot(met.normal, d))
    lit = wp.min(wp.max(met.light[0], wp.max(met.light[1], met.light[2])), 1.0)
    paint = (1.0 - reflectance) * wp.cw_mul(met.colour, met.light) + reflectance * lit * seen
    if s.has_floor > 0:
        seen = wp.lerp(seen, s.floor_colour, smooth_step(0.0, 0.25, -r[1]))
    return wp.lerp(paint, lit * wp.cw_mul(met.colour, seen), met.reflectivity)


@wp.func
def clear_layers(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32, before: Passed):
    """Add transparent solids behind the nearer layers ``before``, up to the distance ``most`` [m] along a ray."""
    passed = before
    start = s.nearest
    for _ in range(LAYERS):
        if start >= most:
            break
        hit = wp.mesh_query_ray(s.solids.clear, o + start * d, d, most - start)
        if not hit.result:
            break
        t = start + hit.t
        if s.has_floor == 0 or o[1] + t * d[1] > s.floor_height + 2.0 * s.nearest:
            met = at_surface(s.solids.surfaces[CLEAR], t, d, hit.face, hit.u, hit.v)
            off = s.solids.surfaces[CLEAR].from_edges[hit.face] * wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
            rim = rim_of(wp.min(off[0], wp.min(off[1], off[2])), wp.max(0.006 * s.size, 1.2 * spread * t))
            passed = pane(s, d, met.normal, rim, 1.0, GLASS_EDGE, passed)
            both = s.solids.surfaces[CLEAR].left[hit.face]
            left = wp.where(hit.sign < 0.0, both[0], both[1])
            passed.light += passed.through * (1.0 - left) * wp.cw_mul(met.colour, met.light)
            passed.through = passed.through * left
        start = t + s.nearest
    return passed


@wp.func
def wall_hit(s: Environment, t: wp.float32, normal: wp.vec3):
    met = SurfaceHit()
    met.found = True
    met.is_solid = True
    met.t = t
    met.normal = normal
    met.colour = s.wall_colour
    met.light = open_light(s, normal)
    met.reflectivity = s.wall_reflectivity
    return met


@wp.func
def opaque_wall(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, before: Passed):
    """Add an opaque wall behind the nearer layers ``before``, up to the distance ``most`` [m] along a ray."""
    part = within_walls(s, o, d)
    t = part[1]
    if t <= wp.max(part[0], s.nearest) or t >= most:
        return before
    p = o + t * d
    q = s.glass_frame * p
    for a in range(3):  # there is no wall above
        if q[a] < s.glass_lower[a] - 2.0 * s.nearest or q[a] > s.glass_upper[a] + 2.0 * s.nearest:
            return before
    passed = Passed()
    passed.light = before.light + before.through * shaded_solid(s, wall_hit(s, t, -wall_normal(s, p)), d, 1.0)
    passed.through = 0.0
    return passed


@wp.func
def box_side(s: Environment, q: wp.vec3, d: wp.vec3, width: wp.float32, before: Passed):
    """Add a flat pane at the point ``q``, in container axes, behind the nearer layers ``before``."""
    axis, side, _distance = nearest_side(s, q, s.glass_lower, s.glass_upper)
    off = FAR
    for a in range(3):
        if a != axis:
            off = wp.min(off, wp.min(q[a] - s.glass_lower[a], s.glass_upper[a] - q[a]))
    n = wp.vec3(0.0)
    n[axis] = 1.0
    is_pane = s.panes[wp.max(side, 0), axis]
    return pane(s, d, wp.transpose(s.glass_frame) * n, rim_of(off, width), is_pane, s.edge_colour, before)


@wp.func
def tube_side(s: Environment, q: wp.vec3, d: wp.vec3, width: wp.float32, before: Passed):
    """Add a round pane at the point ``q``, in container axes, behind the nearer layers ``before``."""
    if q[1] < s.glass_lower[1] or q[1] > s.glass_upper[1]:
        return before
    x = 0.5 * (s.glass_lower[0] + s.glass_upper[0])
    z = 0.5 * (s.glass_lower[2] + s.glass_upper[2])
    n = wp.normalize(wp.vec3(q[0] - x, 0.0, q[2] - z))
    off = wp.min(q[1] - s.glass_lower[1], s.glass_upper[1] - q[1])
    is_pane = 1.0 - wp.float32(s.has_walls)
    return pane(s, d, wp.transpose(s.glass_frame) * n, rim_of(off, width), is_pane, s.edge_colour, before)


@wp.func
def container_glass(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32, before: Passed):
    own_o = s.glass_frame * o
    own_d = s.glass_frame * d
    span = wp.vec2(-FAR, FAR)
    if s.glass == 2:
        span = within_tube(s.glass_lower, s.glass_upper, own_o, own_d)
    else:
        for a in range(3):
            span = between(s.glass_lower[a], s.glass_upper[a], own_o[a], own_d[a], span)
    passed = before
    for k in range(2):
        t = span[k]
        if span[0] < span[1] and t > s.nearest and t < most:
            q = own_o + t * own_d
            if s.glass == 2:
                passed = tube_side(s, q, d, wp.max(0.010 * s.size, 1.2 * spread * t), passed)
            else:
                passed = box_side(s, q, d, wp.max(0.006 * s.size, 1.2 * spread * t), passed)
    return passed


@cache
def glass_functions(has_opaque: bool, has_clear: bool) -> tuple[Any, Any]:
    @wp.func
    def glass(s: Environment, o: wp.vec3, d: wp.vec3, most: wp.float32, spread: wp.float32):
        """Return the light and the transmission of all glass along a ray, up to the distance ``most`` [m]."""
        passed = Passed()
        passed.through = 1.0
        if s.glass > 0:
            passed = container_glass(s, o, d, most, spread, passed)
        if has_clear:
            passed = clear_layers(s, o, d, most, spread, passed)
        if s.has_walls > 0:
            passed = opaque_wall(s, o, d, most + 2.0 * s.nearest, passed)
        return passed

    @wp.func
    def background(s: Environment, shadow: Vec3s2d, o: wp.vec3, d: wp.vec3, spread: wp.float32):
        most = FAR
        if s.has_floor > 0 and d[1] < -1.0e-4:
            most = wp.max((s.floor_height - o[1]) / d[1], 0.0)
        if has_opaque:
            met = meet_solid(s, o, d)
            if met.found and met.t < most:
                before = glass(s, o, d, met.t + 2.0 * s.nearest, spread)
                return before.light + before.through * shaded_solid(s, met, d, 1.0)
        passed = glass(s, o, d, most, spread)
        return passed.light + passed.through * open_background(s, shadow, o, d, spread)

    return glass, background


@wp.func
def at_wall(s: Environment, surface: LitSurface, p: wp.vec3, d: wp.vec3, t: wp.float32, normal: wp.vec3):
    """Move a hit behind a container wall to the wall."""
    near = wp.mesh_query_point_no_sign(surface.mesh, p, surface.reach)
    if not near.result:  # deep within fluid that has just reached the wall
        near = wp.mesh_query_point_no_sign(surface.mesh, p, s.size)
    met = at_surface(surface, t, d, near.face, near.u, near.v)
    met.normal = wp.where(wp.dot(normal, d) > 0.0, -normal, normal)
    return met


@wp.func
def behind_wall(surface: LitSurface, p: wp.vec3, d: wp.vec3, t: wp.float32, normal: wp.vec3):
    met = SurfaceHit()
    hit = wp.mesh_query_ray(surface.mesh, p, normal, surface.reach)
    if hit.result and hit.sign < 0.0:
        met = at_surface(surface, t, d, hit.face, hit.u, hit.v)
        met.normal = normal
    return met


@wp.func
def into_fluid(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3, part: wp.vec2):
    met = SurfaceHit()
    met.t = FAR
    if part[0] <= 0.0:
        hit = wp.mesh_query_ray(surface.mesh, o, d, part[1])
        if hit.result:
            met = at_surface(surface, hit.t, d, hit.face, hit.u, hit.v)
        return met
    start = part[0]
    p = o + start * d
    normal = wall_normal(s, p)
    touched = behind_wall(surface, p, d, start, normal)
    if touched.found:
        return touched
    hit = wp.mesh_query_ray(surface.mesh, p, d, FAR)
    if not hit.result:
        return met
    if hit.sign < 0.0:
        return at_wall(s, surface, p, d, start, normal)
    if start + hit.t > part[1]:
        return met
    return at_surface(surface, start + hit.t, d, hit.face, hit.u, hit.v)


@wp.func
def into_fluid_among_clear(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3, part: wp.vec2):
    met = SurfaceHit()
    met.t = FAR
    start = wp.max(part[0], 0.0)
    beside_container = part[0] > 0.0
    beside_solid = wp.bool(False)
    face = wp.int32(0)  # of the solid that the ray comes out of
    place = wp.vec2(0.0)
    layers = wp.int32(0)
    while layers < LAYERS:
        layers += 1
        p = o + start * d
        clear = wp.mesh_query_ray(s.solids.clear, p, d, FAR)
        in_solid = clear.sign < 0.0
        end = start + clear.t
        if not clear.result:
            in_solid = s.solids.has_tank > 0
            end = FAR
        if not in_solid:
            hit = wp.mesh_query_ray(surface.mesh, p, d, FAR)
            if hit.result and hit.sign < 0.0 and (beside_container or beside_solid):
                normal = wall_normal(s, p)
                if beside_solid:
                    normal = at_surface(s.solids.surfaces[CLEAR], start, d, face, place[0], place[1]).normal
                met = at_wall(s, surface, p, d, start, normal)
            elif hit.result and start + hit.t <= wp.min(part[1], end):
                met = at_surface(surface, start + hit.t, d, hit.face, hit.u, hit.v)
        if met.found or end >= part[1]:
            break
        start = end + s.nearest
        face = clear.face
        place = wp.vec2(clear.u, clear.v)
        beside_container = False
        beside_solid = in_solid
    return met


@cache
def surface_functions(has_opaque: bool, has_clear: bool) -> tuple[Any, Any]:
    @wp.func
    def meet(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3):
        """Find where a ray enters the fluid."""
        met = SurfaceHit()
        met.t = FAR
        part = room(s, o, d)
        if part[1] <= wp.max(part[0], 0.0):
            return met
        met = into_fluid_among_clear(s, surface, o, d, part) if has_clear else into_fluid(s, surface, o, d, part)
        if has_opaque:
            reached = reach_solid(s, o, d).t
            if reached < met.t + 3.0 * s.nearest:  # a solid covers fluid that goes on behind its side
                met.found = False
                met.t = FAR
        return met

    @wp.func
    def leave(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3, most: wp.float32):
        """Find where a ray inside the fluid leaves the fluid, up to the distance ``most`` [m]."""
        part = room(s, o, d)
        wall_at = wp.where(part[1] > 0.0, part[1], FAR)
        hit = wp.mesh_query_ray(surface.mesh, o, d, wp.min(wall_at, most))
        met = SurfaceHit()
        met.found = hit.result
        met.t = wp.where(most < FAR, most, 0.0)
        if hit.result:
            met = at_surface(surface, hit.t, d, hit.face, hit.u, hit.v)
        elif wall_at < most:  # the wall comes first; what colour fluid has there does not matter
            met.found = True
            met.t = part[1]
            met.normal = -wall_normal(s, o + part[1] * d)
            if s.has_walls > 0:
                met = wall_hit(s, part[1], met.normal)
        if has_clear:
            clear = wp.mesh_query_ray(s.solids.clear, o, d, met.t)
            if met.found and clear.result and clear.sign > 0.0:
                met = at_surface(s.solids.surfaces[CLEAR], clear.t, d, clear.face, clear.u, clear.v)
        if has_opaque:
            solid = meet_solid(s, o, d)
            if solid.found and (not met.found or solid.t < met.t):
                return solid
        return met

    return meet, leave
