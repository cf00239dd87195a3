"""The surface of the fluid, as Warp functions: where rays come into the fluid and out of it."""

import warp as wp

from cortado.pictures.glass import room, wall_normal
from cortado.pictures.surroundings import FAR, Environment


@wp.struct
class FluidSurface:
    """Triangles with what is known at their corners."""

    mesh: wp.uint64
    corners: wp.array(dtype=wp.int32)
    """(3 triangles,) indices of points"""
    normals: wp.array(dtype=wp.vec3)
    """(points,) outwards"""
    colours: wp.array(dtype=wp.vec3)
    """(points,)"""
    light: wp.array(dtype=wp.vec3)
    """(points,) light that falls on the surface, of which white reflects 1"""
    scattering: wp.float32
    """[1/m]"""
    reach: wp.float32
    """How far behind a wall the triangles of fluid that touches it are, at most [m]."""


@wp.func
def at_corners(surface: FluidSurface, values: wp.array(dtype=wp.vec3), face: wp.int32, u: wp.float32, v: wp.float32):
    """Interpolated on a triangle."""
    return (
        u * values[surface.corners[3 * face]]
        + v * values[surface.corners[3 * face + 1]]
        + (1.0 - u - v) * values[surface.corners[3 * face + 2]]
    )


@wp.func
def facing(normal: wp.vec3, face_normal: wp.vec3, d: wp.vec3):
    """An interpolated normal on the side of the triangle that the ray comes from."""
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
    """Where a ray hits the surface of the fluid."""

    found: wp.bool
    t: wp.float32
    normal: wp.vec3
    """On the side that the ray comes from."""
    colour: wp.vec3
    light: wp.vec3


@wp.func
def at_surface(surface: FluidSurface, t: wp.float32, d: wp.vec3, face: wp.int32, u: wp.float32, v: wp.float32):
    """Where a ray hits a triangle."""
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
    return met


@wp.func
def at_wall(s: Environment, surface: FluidSurface, o: wp.vec3, d: wp.vec3, t: wp.float32):
    """Where a ray hits the wall that fluid touches, beyond which its triangles go on: they are near."""
    p = o + t * d
    near = wp.mesh_query_point_no_sign(surface.mesh, p, surface.reach)
    if not near.result:  # deep within fluid that has just reached the wall
        near = wp.mesh_query_point_no_sign(surface.mesh, p, s.size)
    met = at_surface(surface, t, d, near.face, near.u, near.v)
    n = wall_normal(s, p)
    met.normal = wp.where(wp.dot(n, d) > 0.0, -n, n)
    return met


@wp.func
def meet(s: Environment, surface: FluidSurface, o: wp.vec3, d: wp.vec3):
    """Where a ray from outside of the fluid comes into it."""
    none = SurfaceHit()
    none.found = False
    none.t = FAR
    part = room(s, o, d)
    start = wp.max(part[0], 0.0)
    if part[1] <= start:
        return none
    hit = wp.mesh_query_ray(surface.mesh, o + start * d, d, FAR)
    if not hit.result:
        return none
    if hit.sign < 0.0 and part[0] > 0.0:
        return at_wall(s, surface, o, d, start)
    if start + hit.t > part[1]:
        return none
    return at_surface(surface, start + hit.t, d, hit.face, hit.u, hit.v)


@wp.func
def leave(s: Environment, surface: FluidSurface, o: wp.vec3, d: wp.vec3):
    """Where a ray within the fluid comes out of it."""
    part = room(s, o, d)
    hit = wp.mesh_query_ray(surface.mesh, o, d, FAR)
    if hit.result and (hit.t <= part[1] or part[1] <= 0.0):
        return at_surface(surface, hit.t, d, hit.face, hit.u, hit.v)
    met = SurfaceHit()
    met.found = hit.result
    met.t = 0.0
    if hit.result:  # the wall comes first; what colour fluid has there does not matter
        met.t = part[1]
        met.normal = -wall_normal(s, o + part[1] * d)
    return met
