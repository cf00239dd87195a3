"""The surface of the fluid, as Warp functions: where rays come into the fluid and out of it."""

from functools import cache
from typing import Any

import warp as wp

from cortado.pictures.container_room import room, wall_normal
from cortado.pictures.lit_surface import LitSurface, SurfaceHit, at_surface
from cortado.pictures.opaque_walls import wall_hit
from cortado.pictures.solid_hit import LAYERS, meet_solid, reach_solid
from cortado.pictures.surroundings import CLEAR, FAR, Environment


@wp.func
def at_wall(s: Environment, surface: LitSurface, p: wp.vec3, d: wp.vec3, t: wp.float32, normal: wp.vec3):
    """Where a ray hits, at a point p, the wall that fluid touches, beyond which its triangles go on: they are near."""
    near = wp.mesh_query_point_no_sign(surface.mesh, p, surface.reach)
    if not near.result:  # deep within fluid that has just reached the wall
        near = wp.mesh_query_point_no_sign(surface.mesh, p, s.size)
    met = at_surface(surface, t, d, near.face, near.u, near.v)
    met.normal = wp.where(wp.dot(normal, d) > 0.0, -normal, normal)
    return met


@wp.func
def behind_wall(surface: LitSurface, p: wp.vec3, d: wp.vec3, t: wp.float32, normal: wp.vec3):
    """The same, quicker, with the triangle that is straight behind the wall, along its normal, outwards; not found
    where that is not near, and where p is not within fluid."""
    met = SurfaceHit()
    met.found = False
    hit = wp.mesh_query_ray(surface.mesh, p, normal, surface.reach)
    if hit.result and hit.sign < 0.0:
        met = at_surface(surface, t, d, hit.face, hit.u, hit.v)
        met.normal = normal
    return met


@wp.func
def into_fluid(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3, part: wp.vec2):
    """Where a ray comes into the fluid on a part of its way, on which no transparent solid is."""
    met = SurfaceHit()
    met.found = False
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
    """The same where transparent solids are, within which there is no fluid."""
    met = SurfaceHit()
    met.found = False
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
    """`meet` and `leave`, where there are opaque or transparent solids."""

    @wp.func
    def meet(s: Environment, surface: LitSurface, o: wp.vec3, d: wp.vec3):
        """Where a ray from outside of the fluid comes into it, unless it meets an opaque solid before."""
        met = SurfaceHit()
        met.found = False
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
        """Where a ray within the fluid comes out of it, or meets an opaque solid, after a way of ``most`` [m] at
        most, beyond which it is not followed."""
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
